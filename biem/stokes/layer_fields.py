"""Velocity, pressure, vorticity and stress of the layers of closed curves at any points, far, near, inside and outside. X: (M, 2, N).

The sum over curves of single layers of f and double layers of tau, in float64 on the CPU:

    far    the trapezoid rule on n >= N nodes of the interpolated curve, by `farfield` and `farfield_stress`
    near   Goursat functions (`goursat`), at any distance from the curve

A pair of a point and a curve is near where the trapezoid rule would err by more than the tolerance: (n - b) rho < log(1/tolerance), with
rho its resolution (`near_search`) and b <= n/4 the modes of the density. On a curve, a point has the limits from outside. In a periodic
box curves stand for all their images, and points for theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil, log, pi

import numpy as np

from biem.backend import compiled
from biem.curves.curve import arclength_weights, center_of_nodes, length, normal
from biem.curves.fourier import derivative, resample, shift
from biem.curves.inside import polygon_around
from biem.curves.lattice import Lattice
from biem.stokes.farfield import pair_sum
from biem.stokes.farfield_direct import own_sum
from biem.stokes.farfield_stress import PeriodicStress, StressSum, periodic_cutoff, stress_sum
from biem.stokes.goursat import GoursatFunctions
from biem.stokes.near_search import NearPairs, find_near

SOURCES = 128  # nodes of a curve in the far sum, at least
OFFSET = 0.381966  # of these from nodes, in their spacing: no points that follow from the nodes coincide with them
SAFETY = 1e-2  # of the tolerance, where the near zone ends: derivatives err by more than the layer, relative to what cancels
ON = 1e-12  # lengths from a curve within which a point is on it
TYPICAL = 1 << 16  # points, for which the cut-off of stresses in a periodic box is chosen


@dataclass(frozen=True)
class LayerValues:
    """At P points: velocity u (P, 2); pressure p - i mu omega = 2 phi and deviatoric stress (s_xx - s_yy)/2 - i s_xy = D, complex (P,).

    Empty: not asked for. inside (P,): the curve around each point, -1 where there is none.
    """

    velocity: np.ndarray
    phi: np.ndarray
    D: np.ndarray
    inside: np.ndarray


@dataclass(frozen=True)
class Layers:
    """Single layers of f and double layers of tau (M, 2, N), either of them None, on the curves X (M, 2, N).

    tolerance: aimed-at error over the largest values. far_field: "auto", "direct" or "ewald". lattice: the images of the curves, in a
    periodic box, where there is no double layer and forces add up to zero.
    """

    X: np.ndarray
    mu: float
    single: np.ndarray | None = None
    double: np.ndarray | None = None
    tolerance: float = 1e-6
    far_field: str = "auto"
    lattice: Lattice | None = None

    def inside(self, points: np.ndarray) -> np.ndarray:
        """The curve around each of points (P, 2), -1 where there is none; on a curve is outside of it."""
        x = self._wrapped(points)
        return self._inside(x, self._near(x))

    def values(
        self, points: np.ndarray, velocity: bool = True, pressure: bool = True, stress: bool = True, of: int | None = None
    ) -> LayerValues:
        """At points (P, 2). velocity; pressure, which is phi; stress, which is phi and D: whether they are asked for.

        of: the number of all points where these are a part of them.
        """
        x = self._wrapped(points)
        pairs = self._near(x)
        first = np.searchsorted(pairs.target, np.arange(len(x) + 1))
        close = self._functions(np.unique(pairs.vesicle)).evaluate(x[pairs.target], pairs.vesicle, ~self._within(pairs), velocity, stress)
        u, (phi, D) = np.zeros((0, 2)), np.zeros((2, 0), dtype=np.complex128)
        if velocity:
            u = self._far_velocity(x, pairs, first, len(x) if of is None else of)
            np.add.at(u, pairs.target, close.velocity)
        if pressure or stress:
            phi, D = self._far_gradient(x, first, pairs.vesicle, stress)
            np.add.at(phi, pairs.target, close.potential)
        if stress:
            np.add.at(D, pairs.target, close.deviator)
        return LayerValues(u, phi, D if stress else D[:0], self._inside(x, pairs))

    def _functions(self, used: np.ndarray) -> GoursatFunctions:
        """Of the curves `used`; the last ones are kept, for several calls about the same curves."""
        if not (self._made and np.array_equal(self._made[0][0], used)):
            functions = GoursatFunctions.build(self._curves, *self._densities, used, self.mu, SAFETY * self.tolerance)
            self._made[:] = [(used, functions)]
        return self._made[0][1]

    @cached_property
    def _made(self) -> list[tuple[np.ndarray, GoursatFunctions]]:
        return []

    @cached_property
    def nodes(self) -> int:
        """Of a curve in the far sum."""
        N = self.X.shape[-1]
        return N * ceil(SOURCES / N)

    @cached_property
    def _least(self) -> float:
        """rho that is resolved: (n - b) rho = log(1/tolerance)."""
        return log(1.0 / (SAFETY * self.tolerance)) / (self.nodes - min(self.X.shape[-1] / 2, self.nodes / 4))

    @cached_property
    def _width(self) -> float:
        """Of the near search, in arclength spacings: at the end of the zone a curve may be bent as sharply as 1.25/distance."""
        return 2.0 * self._least * self.X.shape[-1] / (2.0 * pi)

    @cached_property
    def _images(self) -> tuple[np.ndarray, np.ndarray]:
        """Curves (M', 2, N), those that come near to a point of the periodic box, and of which each is an image (M',)."""
        if self.lattice is None:
            return self.X, np.arange(len(self.X))
        X = self.lattice.wrapped_curves(self.X)
        half = 0.5 * np.array([self.lattice.width, self.lattice.height])
        beside = np.maximum(half + X.min(axis=(0, 2)), half - X.max(axis=(0, 2))).max()  # from the curves to the sides of the box
        near = self._width * float(length(X).max()) / X.shape[-1]
        return self.lattice.with_images(X, max(self._cutoff, near) + max(float(beside), 0.0))

    @cached_property
    def _cutoff(self) -> float:
        assert self.lattice is not None
        return periodic_cutoff(self.lattice, TYPICAL, len(self.X) * self.nodes, self.tolerance)

    @property
    def _curves(self) -> np.ndarray:
        return self._images[0]

    @property
    def _densities(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """f and tau of the curves and their images."""
        source = self._images[1]
        return None if self.single is None else self.single[source], None if self.double is None else self.double[source]

    @cached_property
    def _sources(self) -> np.ndarray:
        """(M', 2, nodes)."""
        center = center_of_nodes(self._curves)
        return self._at_sources(self._curves - center) + center

    def _at_sources(self, f: np.ndarray) -> np.ndarray:
        """f (M, 2, N) there (M, 2, nodes)."""
        return shift(resample(f, self.nodes), np.asarray(OFFSET * 2.0 * pi / self.nodes))

    def _wrapped(self, points: np.ndarray) -> np.ndarray:
        x = np.ascontiguousarray(points, dtype=np.float64)
        return x if self.lattice is None else self.lattice.wrapped(x)

    def _near(self, x: np.ndarray) -> NearPairs:
        """Pairs of points and curves that the far sum does not resolve, sorted by point."""
        pairs = find_near(self._curves, x, self._width)
        return pairs.subset(pairs.rho < self._least)

    def _within(self, pairs: NearPairs) -> np.ndarray:
        """Whether the point of a pair is inside the curve."""
        return pairs.distance < -ON * length(self._curves)[pairs.vesicle]

    def _inside(self, x: np.ndarray, pairs: NearPairs) -> np.ndarray:
        around = polygon_around(self._curves, x)
        within = self._within(pairs)
        wrong = ~within & (around[pairs.target] == pairs.vesicle)  # in the polygon, not in the curve
        around[pairs.target[wrong]] = -1
        around[pairs.target[within]] = pairs.vesicle[within]
        return np.append(self._images[1], -1)[around]

    def _far_velocity(self, x: np.ndarray, pairs: NearPairs, first: np.ndarray, of: int) -> np.ndarray:
        u = np.zeros_like(x)
        Y, M = self._sources, len(self.X)
        ds = arclength_weights(Y)[:, None, :]
        single, double = self._densities
        if single is not None:
            g = self._at_sources(single) * ds
            u += pair_sum(x, Y[:M], self.mu, None, self.far_field, self.tolerance, of, self.lattice).velocity(g[:M])
            center = center_of_nodes(Y)
            own = own_sum(x[pairs.target] - center[pairs.vesicle, :, 0], Y - center, g, pairs.vesicle, self.mu)
            np.subtract.at(u, pairs.target, own)
        if double is not None:
            g, origin = self._at_sources(double) * ds, Y.mean(axis=(0, 2))
            arrays = (np.ascontiguousarray(a) for a in (x - origin, Y - origin[:, None], normal(Y), g))
            u += compiled("biem.stokes.stress_loop").double_velocity(*arrays, first, pairs.vesicle)
        return u

    def _far_gradient(self, x: np.ndarray, first: np.ndarray, skip: np.ndarray, stress: bool) -> tuple[np.ndarray, np.ndarray]:
        far: StressSum
        if self.lattice is None:
            far = stress_sum(x, self._sources, first, skip, self.far_field, self.tolerance)
        else:
            far = PeriodicStress(x, self._sources, self._images[1], first, skip, self.lattice, self.tolerance, self._cutoff)
        phi, D = np.zeros((2, len(x)), dtype=np.complex128)
        if self.single is not None:
            f = self._at_sources(self.single) * arclength_weights(self._sources[: len(self.X)])[:, None, :]
            found = far.evaluate((f[:, 0] + 1j * f[:, 1]) / (4.0 * pi), 1.0, stress)
            phi, D = phi + found[0], D + found[1]
        if self.double is not None:
            slope = derivative(self._at_sources(self.double))
            found = far.evaluate(1j * self.mu * (slope[:, 0] + 1j * slope[:, 1]) / self.nodes, -1.0, stress)
            phi, D = phi + found[0], D + found[1]
        return phi, D
