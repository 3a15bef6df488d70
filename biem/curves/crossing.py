"""Crossing membranes: polygons of the refined curves tested by shapely, candidates confirmed on finer polygons. X: (M, 2, N)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from biem.backend import Array, to_numpy
from biem.curves.fourier import resample

COARSE, FINE = 4, 32  # polygon corners per node: first test, confirmation


def polygons(X: Array, refinement: int = COARSE) -> np.ndarray:
    """Shapely polygons (M,) through the curves at `refinement` times their nodes."""
    X = to_numpy(X)
    return np.asarray(shapely.polygons(resample(X, refinement * X.shape[-1]).transpose(0, 2, 1)))


def self_crossings(X: Array, shapes: np.ndarray | None = None) -> list[int]:
    """Indices of curves that cross themselves. shapes: polygons(X) where they are at hand."""
    suspect = np.flatnonzero(~shapely.is_valid(polygons(X) if shapes is None else shapes))
    return [int(i) for i in suspect if not shapely.is_valid(polygons(to_numpy(X)[[i]], FINE)[0])]


def pair_crossings(X: Array, shapes: np.ndarray | None = None) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of curves that cross or contain one another. shapes: polygons(X) where they are at hand."""
    X = to_numpy(X)
    if X.shape[0] < 2:
        return []
    shapes = polygons(X) if shapes is None else shapes
    i, j = shapely.STRtree(shapes).query(shapes)  # boxes that meet; to prepare polygons for so few tests each would not pay
    i, j = i[i < j], j[i < j]
    meet = shapely.intersects(shapes[i], shapes[j])
    pairs = zip(i[meet].tolist(), j[meet].tolist(), strict=True)
    return [(a, b) for a, b in pairs if shapely.intersects(*polygons(X[[a, b]], FINE))]


def fluid_region(curves: Sequence[np.ndarray]) -> shapely.Polygon:
    """The region inside the first closed curve (2, N) and outside the others, prepared for tests."""
    rings = [resample(X, FINE * X.shape[-1]).T for X in curves]
    region = shapely.Polygon(rings[0], rings[1:])
    shapely.prepare(region)
    return region


def outside_region(shapes: np.ndarray, region: shapely.Polygon) -> list[int]:
    """Indices of the polygons that do not lie in the region."""
    return np.flatnonzero(~shapely.contains_properly(region, shapes)).tolist()
