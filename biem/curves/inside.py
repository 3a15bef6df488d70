"""Which of many closed polygons is around each of many points: a compiled loop where both are too many for shapely's objects."""

from __future__ import annotations

import numpy as np

from biem.backend import compiled
from biem.curves.crossing import COARSE
from biem.curves.fourier import resample


def polygon_around(X: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Index (P,) of the curve of X (M, 2, N), taken as a polygon of COARSE N corners, around each of points (P, 2); -1 where there is none.

    Of curves within curves, the last one.
    """
    corners = resample(X, COARSE * X.shape[-1])
    boxes = np.concatenate([corners.min(axis=-1), corners.max(axis=-1)], axis=-1)
    return compiled("biem.curves.inside_loop").polygon_around(np.ascontiguousarray(corners), boxes, np.ascontiguousarray(points))
