"""Crossing membranes: polygons of the refined curves tested by shapely, candidates confirmed on finer polygons. X: (M, 2, N).

Curves that come closer than their chords cut off are candidates too: a crossing as shallow as 1e-6 lengths (N = 32) is found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from biem.backend import Array, to_numpy
from biem.curves.fourier import derivative, resample
from biem.curves.lattice import Lattice

COARSE, FINE = 4, 32  # polygon corners per node: first test, confirmation
NEIGHBOURS = 3  # nodes of a side of a curve that are close to each other


def polygons(X: Array, refinement: int = COARSE) -> np.ndarray:
    """Shapely polygons (M,) through the curves at `refinement` times their nodes."""
    X = to_numpy(X)
    return np.asarray(shapely.polygons(resample(X, refinement * X.shape[-1]).transpose(0, 2, 1)))


def self_crossings(X: Array, shapes: np.ndarray | None = None) -> list[int]:
    """Indices of curves that cross themselves. shapes: polygons(X) where they are at hand."""
    X = to_numpy(X)
    suspect = np.flatnonzero(~shapely.is_valid(polygons(X) if shapes is None else shapes) | _narrow(X))
    return [int(i) for i in suspect if not shapely.is_valid(polygons(X[[i]], FINE)[0])]


def pair_crossings(X: Array, shapes: np.ndarray | None = None, lattice: Lattice | None = None) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of curves that cross or contain one another. shapes: polygons(X) where they are at hand.

    lattice: the images of the curves, in a periodic box: pairs of which any images do, i = j where a curve meets an image of its own.
    """
    X = to_numpy(X)
    if lattice is not None:
        curves, source = lattice.with_images(X, float((_cut(X) + _edge(X)).max()))
        pairs = source[np.array(pair_crossings(curves), dtype=np.int64).reshape(-1, 2)]
        return sorted({(int(min(pair)), int(max(pair))) for pair in pairs})
    if X.shape[0] < 2:
        return []
    shapes = polygons(X) if shapes is None else shapes
    cut = _cut(X)
    boxes = _boxes(shapes, cut)
    i, j = shapely.STRtree(boxes).query(boxes)  # boxes that meet; to prepare polygons for so few tests each would not pay
    i, j = i[i < j], j[i < j]
    meet = shapely.dwithin(shapes[i], shapes[j], cut[i] + cut[j])
    pairs = zip(i[meet].tolist(), j[meet].tolist(), strict=True)
    return [(a, b) for a, b in pairs if shapely.intersects(*polygons(X[[a, b]], FINE))]


def _cut(X: np.ndarray) -> np.ndarray:
    """How far curves may run outside their polygons (M,), at most: twice what chords cut off by the second derivatives at the nodes."""
    X_aa = derivative(derivative(X))
    return 0.25 * np.hypot(X_aa[:, 0], X_aa[:, 1]).max(axis=-1) * (2.0 * np.pi / (COARSE * X.shape[-1])) ** 2


def _edge(X: np.ndarray) -> np.ndarray:
    """Longest distance of neighbouring nodes (M,)."""
    return np.hypot(*np.moveaxis(X - np.roll(X, 1, axis=-1), 1, 0)).max(axis=-1)


def _narrow(X: np.ndarray) -> np.ndarray:
    """Whether two sides of a curve may meet between corners of its polygon (M,): nodes no neighbours, no farther apart than neighbours."""
    N = X.shape[-1]
    twice = np.concatenate([X, X], axis=-1)
    squares = lambda lag: ((X - twice[..., N - lag : 2 * N - lag]) ** 2).sum(axis=1)  # of the distances of nodes k and k - lag
    reach = (np.sqrt(squares(1).max(axis=-1)) + 2.0 * _cut(X))[:, None] ** 2
    narrow = np.zeros(X.shape[0], dtype=bool)
    for lag in range(NEIGHBOURS + 1, N // 2 + 1):
        narrow |= (squares(lag) < reach).any(axis=-1)
    return narrow


def fluid_region(curves: Sequence[np.ndarray]) -> shapely.Polygon:
    """The region inside the first closed curve (2, N) and outside the others, prepared for tests."""
    rings = [resample(X, FINE * X.shape[-1]).T for X in curves]
    region = shapely.Polygon(rings[0], rings[1:])
    shapely.prepare(region)
    return region


def outside_region(X: Array, region: shapely.Polygon, shapes: np.ndarray | None = None) -> list[int]:
    """Indices of curves that do not lie in the region. shapes: polygons(X) where they are at hand."""
    X = to_numpy(X)
    suspect = np.flatnonzero(~shapely.contains_properly(region, _boxes(polygons(X) if shapes is None else shapes, _cut(X))))
    return [int(i) for i in suspect if not shapely.contains_properly(region, polygons(X[[i]], FINE)[0])]


def _boxes(shapes: np.ndarray, margin: np.ndarray) -> np.ndarray:
    """Boxes about the polygons (M,), wider by the margin (M,) on every side."""
    return shapely.box(*(shapely.bounds(shapes) + margin[:, None] * np.array([-1.0, -1.0, 1.0, 1.0])).T)
