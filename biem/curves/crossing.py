"""Crossing membranes: polygons of the refined curves tested by shapely, candidates confirmed on finer polygons. X: (M, 2, N)."""

from __future__ import annotations

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
