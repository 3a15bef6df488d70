"""Smooth closed curves for walls and obstacles: (2, N) nodes equally spaced in arclength, counterclockwise, about the origin.

`size` is the radius of the circle of equal area. Corners are rounded by curvatures of Gaussian profile and ends of channels by
semicircles whose curvature is smoothed likewise, so that every curve is analytic and quadrature on it converges spectrally.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import optimize, special

from biem.curves.curve import area, length
from biem.curves.fourier import remove_nyquist, resample
from biem.curves.reparam import redistribute
from biem.curves.shapes import curve_of_angle

FINE = 4096  # nodes on which shapes are made, and brought to equal arclength, before they are resampled
MOST_NODES = 50_000  # of one wall; its equations are dense
ROUNDING = 0.12  # of corners: standard deviation of the curvature's profile, in sides
END_ROUNDING = 0.12  # of channels: the same, in lengths of the semicircle


def circle(N: int, size: float) -> np.ndarray:
    """Circle of radius `size`."""
    t = 2 * np.pi * np.arange(N) / N
    return size * np.stack([np.cos(t), np.sin(t)])


def ellipse(N: int, size: float, aspect: float) -> np.ndarray:
    """Ellipse with its long axis along x; aspect: short over long axis, in (0, 1]."""
    return _polar(N, size, lambda t: 1.0 / np.hypot(aspect * np.cos(t), np.sin(t)))


def star(N: int, size: float, sides: int, depth: float = 0.2) -> np.ndarray:
    """r = 1 + depth cos(sides t), scaled."""
    return _polar(N, size, lambda t: 1.0 + depth * np.cos(sides * t))


def polygon(N: int, size: float, sides: int) -> np.ndarray:
    """Regular polygon with rounded corners, one side parallel to x for even numbers of sides."""
    s = np.arange(FINE) / FINE
    corners = (np.arange(-sides, 2 * sides) + 0.5) / sides
    turned = 0.5 * special.erfc((corners[:, None] - s) * sides / (ROUNDING * np.sqrt(2.0)))
    angle = (2 * np.pi / sides) * (turned.sum(axis=0) - sides)
    return _scaled(curve_of_angle(angle - 2 * np.pi * s), N, size)


def channel(N: int, length: float, half_width: float) -> np.ndarray:
    """Straight walls y = -half_width and half_width with round ends; length: from end to end along x."""
    aspect = length / (2.0 * half_width)

    def box(end: float) -> np.ndarray:
        """Unit-length curve; end: share of the perimeter of one round end."""
        s = np.arange(FINE) / FINE
        # the angle turns by pi over each end: an integrated smoothed box, ends about s = 1/4 and 3/4, with their periodic images
        centers = np.array([-0.75, -0.25, 0.25, 0.75, 1.25, 1.75])[:, None]
        width = END_ROUNDING * end * np.sqrt(2.0)
        ramp = lambda x: x * (1 + special.erf(x / width)) / 2 + width / (2 * np.sqrt(np.pi)) * np.exp(-((x / width) ** 2))
        turned = (ramp(s - centers + end / 2) - ramp(s - centers - end / 2)) / end
        return curve_of_angle(np.pi * (turned.sum(axis=0) - 2.0) - 2 * np.pi * s)

    def excess(end: float) -> float:
        x, y = np.ptp(box(end), axis=1)
        return float(x / y - aspect)

    X = box(optimize.brentq(excess, 0.2 / (1.0 + aspect), 0.49, xtol=1e-15))
    fine = X * (2.0 * half_width / np.ptp(X[1]))
    return resampled(fine - (fine.max(axis=1) + fine.min(axis=1))[:, None] / 2, N)


def _polar(N: int, size: float, r: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    t = 2 * np.pi * np.arange(FINE) / FINE
    return _scaled(r(t) * np.stack([np.cos(t), np.sin(t)]), N, size)


def _scaled(X: np.ndarray, N: int, size: float) -> np.ndarray:
    return resampled(X * (size * np.sqrt(np.pi / float(area(X[None])[0]))), N)


def resampled(X: np.ndarray, N: int) -> np.ndarray:
    """N nodes equally spaced in arclength on the curve X (2, n)."""
    fine = resample(X, max(FINE, X.shape[-1]))
    return remove_nyquist(resample(redistribute(fine[None])[0][0], N))


def nodes_for(X: np.ndarray, spacing: float, least: int) -> int:
    """The even number of nodes, at least `least`, that are no further apart than `spacing` on the curve X (2, n).

    Raises ValueError for more than MOST_NODES.
    """
    perimeter = float(length(X[None])[0])
    N = 2.0 * np.ceil(0.5 * perimeter / spacing)
    if not N <= MOST_NODES:
        raise ValueError(
            f"a wall of length {perimeter:.3g} with nodes {spacing:.3g} apart needs {N:.3g} nodes: at most {MOST_NODES} are possible, "
            "enlarge walls.spacing"
        )
    return max(least, int(N))
