"""Points and curves that repeat over the plane: a doubly periodic box, at rest or sheared. X: (M, 2, N), points: (P, 2).

The images of a point x are x + m a_1 + n a_2 with a_1 = (width, 0), a_2 = (offset, height). In a simple shear (rate y, 0) the rows of
images above and below slide along (Lees & Edwards, J. Phys. C 5 (1972)): offset = rate height t, taken to within width/2, which names
the same images. Everything lies in one rectangle, |x| <= width/2, |y| <= height/2, after m and n have been taken out: rows first.

A run keeps its membranes where they have wandered to, so that paths are continuous; they are wrapped for sums, searches and pictures.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from biem.backend import Array, array_namespace, from_numpy, to_numpy
from biem.curves.curve import center_of_nodes

LARGEST = 8.0  # extent of a curve in sides of the box: beyond, it is one that a step has torn apart


@dataclass(frozen=True)
class Lattice:
    """All images of a box at one moment."""

    width: float
    height: float
    offset: float = 0.0

    @property
    def vectors(self) -> np.ndarray:
        """a_1 and a_2 as rows (2, 2)."""
        return np.array([[self.width, 0.0], [self.offset, self.height]])

    @property
    def reciprocal(self) -> np.ndarray:
        """b_1 and b_2 as rows (2, 2): a_i . b_j = 2 pi if i = j, else 0."""
        return 2.0 * pi * np.linalg.inv(self.vectors).T

    @property
    def area(self) -> float:
        return self.width * self.height

    def displacement(self, images: Array) -> Array:
        """m a_1 + n a_2 (..., 2) for numbers of images m, n (..., 2) given as floats."""
        m, n = images[..., 0], images[..., 1]
        return array_namespace(images).stack([m * self.width + n * self.offset, n * self.height], axis=-1)

    def image_of(self, points: Array) -> Array:
        """m, n (P, 2), floats, of the images of the rectangle that points (P, 2) lie in."""
        xp = array_namespace(points)
        n = xp.round(points[:, 1] / self.height)
        return xp.stack([xp.round((points[:, 0] - n * self.offset) / self.width), n], axis=-1)

    def wrapped(self, points: Array) -> Array:
        """Points (P, 2), each in the rectangle."""
        return points - self.displacement(self.image_of(points))

    def wrapped_curves(self, X: Array) -> Array:
        """Whole curves (M, 2, N), the mean node of each in the rectangle."""
        return X - self.displacement(self.image_of(center_of_nodes(X)[..., 0]))[..., None]

    def in_cell(self, points: Array) -> Array:
        """Coordinates (P, 2) in units of a_1 and a_2."""
        y = points[:, 1] / self.height
        return array_namespace(points).stack([(points[:, 0] - y * self.offset) / self.width, y], axis=-1)

    def with_images(self, X: Array, reach: float, filled: bool = False) -> tuple[Array, Array]:
        """Curves (M + I, 2, N) and the curve that each is an image of (M + I,).

        The first M are X, wrapped; then all images that a point of those (filled: or of the rectangle) may be closer to than `reach`, more
        of them rather than fewer. A curve that is not finite, or LARGEST times as large as the box, has no images.
        """
        X = self.wrapped_curves(X)
        source, displacement = self._images_near(to_numpy(X), reach, filled)
        xp = array_namespace(X)
        which = from_numpy(source, like=X)
        images = X[which] + from_numpy(displacement, like=X)[:, :, None]
        own = xp.arange(X.shape[0], dtype=which.dtype, device=which.device)
        return xp.concat([X, images], axis=0), xp.concat([own, which])

    def _images_near(self, X: np.ndarray, reach: float, filled: bool) -> tuple[np.ndarray, np.ndarray]:
        """Curve (I,) and displacement (I, 2) of the images, themselves apart, whose bounding boxes are within reach of that of all of X."""
        low, high = X.min(axis=-1), X.max(axis=-1)
        finite = (high - low <= LARGEST * np.array([self.width, self.height])).all(axis=1)
        if not finite.any():
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        half = 0.5 * np.array([self.width, self.height]) if filled else -np.inf
        least, most = np.minimum(low[finite].min(axis=0), -half) - reach, np.maximum(high[finite].max(axis=0), half) + reach
        source, displacement = [], []
        span = most - least
        rows = int(np.ceil((span[1] + (high - low)[finite, 1].max()) / self.height))
        columns = int(np.ceil((span[0] + (high - low)[finite, 0].max() + rows * abs(self.offset)) / self.width))
        for n in range(-rows, rows + 1):
            for m in range(-columns, columns + 1):
                if m == 0 and n == 0:
                    continue
                d = np.array([m * self.width + n * self.offset, n * self.height])
                near = np.flatnonzero(finite & ((low + d <= most) & (high + d >= least)).all(axis=1))
                source.append(near)
                displacement.append(np.broadcast_to(d, (len(near), 2)))
        return np.concatenate(source), np.concatenate(displacement)


@dataclass(frozen=True)
class Box:
    """A periodic box of fixed sides, sheared at `rate`: (rate y, 0) is the velocity that the images of a row have among each other."""

    width: float
    height: float
    rate: float = 0.0

    def at(self, t: float) -> Lattice:
        """The images at time t."""
        offset = self.rate * self.height * t
        return Lattice(self.width, self.height, offset - self.width * round(offset / self.width))
