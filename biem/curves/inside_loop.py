"""Compiled loop of `inside`: crossings of a ray with the edges of each polygon whose box holds the point. Importing this loads numba."""

from typing import Any

import numpy as np
from numba import njit, prange


@njit(parallel=True, error_model="numpy", cache=True, nogil=True)
def polygon_around(corners: Any, boxes: Any, points: Any) -> Any:
    """corners (M, 2, n); boxes (M, 4): x, y from and to; points (P, 2) -> (P,)."""
    P, M, n = len(points), len(corners), corners.shape[2]
    found = np.full(P, -1, dtype=np.int64)
    for p in prange(P):
        x, y = points[p, 0], points[p, 1]
        for m in range(M):
            if not (boxes[m, 0] <= x <= boxes[m, 2] and boxes[m, 1] <= y <= boxes[m, 3]):
                continue
            odd = False
            x0, y0 = corners[m, 0, n - 1], corners[m, 1, n - 1]
            for k in range(n):
                x1, y1 = corners[m, 0, k], corners[m, 1, k]
                if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                    odd = not odd
                x0, y0 = x1, y1
            if odd:
                found[p] = m
    return found
