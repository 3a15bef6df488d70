"""Random standardized shapes for the tests of what compares shapes."""

import numpy as np
from helpers import nodes

from biem.curves.fourier import resample
from biem.curves.pose import standardize
from biem.curves.reparam import redistribute


def groups_of_shapes(groups, each, spread, seed=0, points=128):
    """X (groups * each, 2, points), modes |k| < 32: about the shapes of a few groups, with deviations of the given size."""
    rng = np.random.default_rng(seed)
    k = np.arange(2, 7)
    centre = 0.35 * rng.normal(size=(groups, 1, 2, len(k)))
    a = (centre + spread * rng.normal(size=(groups, each, 2, len(k)))).reshape(-1, 2, len(k)) / k**1.5
    t = nodes(256)
    r = np.exp(a[:, 0] @ np.cos(np.outer(k, t)) + a[:, 1] @ np.sin(np.outer(k, t)))
    X = np.stack([1.4 * r * np.cos(t), 0.8 * r * np.sin(t)], axis=1)
    return resample(standardize(resample(redistribute(X)[0], 64))[0], points)
