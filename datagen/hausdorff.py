"""Hausdorff distance of closed curves of length 1, and descriptors that bound it from below.

    d_H(A, B) = max(max_{a in A} dist(a, B), max_{b in B} dist(b, A))

of two closed polygons of CORNERS corners each, taken from the trigonometric interpolants. Of the polygons it is exact: the farthest point
may lie anywhere on a side, and is found to 1e-10 of a side. A polygon is within c h^2/8 of its curve (h = 1/CORNERS: a side, c: the largest
curvature), which is 2e-6 c, so that the distance of the curves themselves differs by 2e-6 times the sum of both c at most.

The descriptor of A holds the distances dist(p_i, A) of fixed anchors p_i. By the triangle inequality none of them changes by more than
d_H(A, B) from A to B:

    max_i |dist(p_i, A) - dist(p_i, B)| <= d_H(A, B)

so that all curves within eps of A are among those whose descriptors are within eps of A's in the maximum norm. The anchors are a choice
among the points of a grid, greedy and symmetric, for the largest mean of the bound over d_H of near pairs: 0.9 to 0.97 with these.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from biem.backend import compiled
from biem.curves.fourier import resample
from datagen.shapes import decode

CORNERS = 256
QUARTER = ((0, 0), (0.12, 0), (0.24, 0), (0, 0.24), (0.04, 0.24), (0.08, 0.04), (0.16, 0.04), (0.16, 0.08))
ANCHORS = np.array(sorted({(a * x, b * y) for x, y in QUARTER for a in (-1, 1) for b in (-1, 1)}))  # around the long axis along y
BATCH = 64  # shapes that are judged together
ROUNDING = 1e-12  # of descriptors: bounds are taken as that much smaller


def polygons(shapes: np.ndarray) -> np.ndarray:
    """Corners (n, CORNERS, 2) of shapes given by nodes (n, 2, N), or by their coefficients (n, 2 modes) as `datagen.shapes` has them."""
    X = decode(shapes, CORNERS) if shapes.dtype.kind == "c" else resample(shapes, CORNERS)
    return np.ascontiguousarray(X.transpose(0, 2, 1))


def distance(A: np.ndarray, B: np.ndarray) -> float:
    """d_H of the polygons A (corners, 2) and B (corners, 2)."""
    return float(loops().distance(A, B))


def closer(A: np.ndarray, B: np.ndarray, threshold: float) -> bool:
    """Whether d_H(A, B) < threshold: found out sooner than the distance itself."""
    return bool(loops().closer(A, B, threshold))


def descriptors(P: np.ndarray) -> np.ndarray:
    """Descriptors (n, anchors) of the polygons P (n, corners, 2)."""
    return loops().descriptors(P, ANCHORS)


def candidates(E: np.ndarray, column: int, D: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the descriptors E (m, anchors), sorted by their `column`, that differ from D[i] (n, anchors) by at most reach[i] anywhere.

    Returns start (n + 1,) and the rows: those of i are rows[start[i] : start[i + 1]], ascending. A negative reach finds nothing.
    """
    first = np.searchsorted(E[:, column], D[:, column] - reach, "left")
    last = np.searchsorted(E[:, column], D[:, column] + reach, "right")
    return loops().candidates(E, first, last, D, reach)


def nearest(shapes: np.ndarray, D: np.ndarray, i: int) -> tuple[int, float]:
    """The shape nearest to shape i, and its distance: shapes as in `polygons`, at least two, with their descriptors D (n, anchors).

    Shapes are judged in the order of their bounds, until the bound is no less than the smallest distance found.
    """
    A = polygons(shapes[i : i + 1])[0]
    bound = loops().bounds(D, i) - ROUNDING
    first = int(bound.argmin())
    j, found = first, distance(A, polygons(shapes[first : first + 1])[0])
    others = np.flatnonzero(bound < found)
    others = others[np.argsort(bound[others], kind="stable")]
    for start in range(0, len(others), BATCH):
        batch = others[start : start + BATCH]
        if bound[batch[0]] >= found:
            break
        better, found = loops().nearest(A, polygons(shapes[batch]), bound[batch], found)
        j = int(batch[better]) if better >= 0 else j
    return j, float(found)


def loops() -> Any:
    """The compiled loops; numba is loaded here."""
    return compiled("datagen.hausdorff_loop")
