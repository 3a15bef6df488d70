"""The exact maps at few nodes that a hybrid map corrects, for all inputs at once: what residual targets are made from."""

from __future__ import annotations

from math import pi

import numpy as np

from biem.backend import constant, one_blas_thread
from biem.curves.fourier import derivative, differentiation_matrix, resample
from biem.membrane.maps import ExactMaps
from biem.membrane.resultants import Resultants

CHUNK = 16  # curves at a time


def exact_labels(X: np.ndarray, name: str, points: int, dt: float = 0.0) -> np.ndarray:
    """Labels of map `name` by `ExactMaps(points=points)`, of curves X (n, 2, N) in the standard pose, in float64.

    relax (n, 2, N): the increment; self_tension (n, N); advection (n, K, 2 [re, im], 2 [in], 2 [out], N) and flow_tension
    (n, K, 2, 2, N) of all modes. As the labels of `datagen`, but built at `points` nodes of the N-node curve itself.
    """
    exact = ExactMaps(points=points)
    make = {
        "relax": lambda part: exact.relax(part, dt) - part,
        "self_tension": exact.self_tension,
        "advection": lambda part: _operators(part, points)[0],
        "flow_tension": lambda part: _operators(part, points)[1],
    }[name]
    with one_blas_thread():
        return np.concatenate([make(X[i : i + CHUNK]) for i in range(0, len(X), CHUNK)])


def _operators(X: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    m, _, N = X.shape
    maps = Resultants(resample(X, points))
    n, K = points, maps.kernel()
    e = constant(_basis, N, n, like=X)  # (C, n)
    rates = (maps.t.transpose(0, 2, 1)[..., None] * derivative(e).T[:, None, :]).reshape(m, n, -1)
    sigma = maps.tensions(rates, maps.strain_matrices(K)[1]).reshape(m, n, 2, -1)
    D = constant(differentiation_matrix, n, like=X)
    rows = np.matmul(K[:, [[0, 1], [1, 2]]], maps.h * D)  # (m, out, in, n, n)
    moved = np.matmul(np.einsum("moijk,mik->mojk", rows, maps.t).reshape(m, 2 * n, n), sigma.reshape(m, n, -1))
    moved = resample(moved.reshape(m, 2, n, 2, -1).transpose(0, 4, 3, 1, 2), N)  # (m, C, in, out, N)
    advection = np.eye(2)[:, :, None] * resample(e, N)[:, None, None, :] - moved
    tension = resample(sigma.transpose(0, 3, 2, 1), N)
    return advection.reshape(m, -1, 2, 2, 2, N), tension.reshape(m, -1, 2, 2, N)


def _basis(N: int, n: int) -> np.ndarray:
    """cos(k alpha), sin(k alpha), k = 0..N/2 in turn, of N nodes, on n nodes (2 K, n)."""
    phase = np.arange(N // 2 + 1)[:, None] * (2.0 * pi / N) * np.arange(N)
    parts = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    parts[[0, -1], 1] = 0.0
    return resample(parts.reshape(-1, N), n)
