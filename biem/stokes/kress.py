"""Single layer on the curve itself by Kress's rule, spectrally accurate, as a symmetric kernel. X: (M, 2, n).

    S[X, f](x_i) = sum_j K_ij f_j ds_j,      K_ij = 1/(4 pi mu) [(c_{i-j} - log|r|) I + r r^T/|r|^2],   i != j
                                             K_ii = 1/(4 pi mu) [(c_0 - log|X_alpha|) I + t t^T]

The circulant c makes up for the logarithm: log(4 sin^2(alpha/2)) times a trigonometric polynomial is integrated exactly. K is
symmetric in (i, j), which `biem.membrane.resultants` rests on. Kress, Linear Integral Equations (1989), 12.3.
"""

from __future__ import annotations

from functools import cache
from math import pi

import numpy as np

from biem.backend import Array, array_namespace, compiled, constant, count, from_numpy, on_cpu, to_numpy
from biem.curves.curve import center_of_nodes, dot
from biem.curves.fourier import derivative, resample
from biem.stokes.kernels import LOG_SIGN, stokeslet, stokeslet_prefactor

LOOPS = "biem.stokes.kress_loop"


def single_layer_kernel(X: Array, X_alpha: Array, mu: float = 1.0) -> Array:
    """Blocks xx, xy, yy of K (M, 3, n, n), without the arclength weights of the density. X about its centre, X_alpha: (M, 2, n)."""
    count("single_layer_matrix", X.shape[0])
    if not on_cpu(X):
        return kernel_blocks(X, X_alpha, mu)
    arrays = (to_numpy(X), to_numpy(X_alpha), circulant(X.shape[-1]))
    return from_numpy(compiled(LOOPS).kernel_blocks(*arrays, stokeslet_prefactor(mu), LOG_SIGN), like=X)


def apply_single_layer(X: Array, X_alpha: Array, g: Array, mu: float = 1.0) -> Array:
    """K g (M, 2, n) for weighted densities g = f ds (M, 2, n); no matrix is kept."""
    xp = array_namespace(X)
    if not on_cpu(X):
        K = kernel_blocks(X, X_alpha, mu)
        x, y = g[:, 0, :, None], g[:, 1, :, None]
        return xp.stack([xp.matmul(K[:, 0], x) + xp.matmul(K[:, 1], y), xp.matmul(K[:, 1], x) + xp.matmul(K[:, 2], y)], axis=1)[..., 0]
    arrays = (to_numpy(X), to_numpy(X_alpha), to_numpy(g), circulant(X.shape[-1]))
    return from_numpy(compiled(LOOPS).apply_kernel(*arrays, stokeslet_prefactor(mu), LOG_SIGN), like=X)


def on_own_curve(X: Array, f: Array, mu: float = 1.0) -> Array:
    """S[X, f] at the nodes of each curve itself (M, 2, N) for force densities f (M, 2, N), by the rule on 2 N nodes."""
    n = 2 * X.shape[-1]
    fine = resample(X - center_of_nodes(X), n)
    X_alpha = derivative(fine)
    ds = array_namespace(X).sqrt(dot(X_alpha, X_alpha)) * (2.0 * pi / n)
    return apply_single_layer(fine, X_alpha, resample(f, n) * ds[:, None, :], mu)[..., ::2]


def kernel_blocks(X: Array, X_alpha: Array, mu: float) -> Array:
    """K (M, 3, n, n) in array code; `kress_loop.kernel_blocks` is the same as a compiled loop."""
    xp = array_namespace(X)
    n = X.shape[-1]
    scale = stokeslet_prefactor(mu)
    G_xx, G_xy, G_yy = stokeslet(X[:, 0, :, None] - X[:, 0, None, :], X[:, 1, :, None] - X[:, 1, None, :], mu)
    speed2 = dot(X_alpha, X_alpha)
    log_speed = (0.5 * LOG_SIGN) * xp.log(speed2)
    identity = xp.eye(n, dtype=X.dtype, device=X.device)
    on_diagonal = lambda values: identity * (scale * values)[:, None, :]
    c = scale * constant(circulant_matrix, n, like=X)
    K_xx = G_xx + c + on_diagonal(log_speed + X_alpha[:, 0] ** 2 / speed2)
    K_xy = G_xy + on_diagonal(X_alpha[:, 0] * X_alpha[:, 1] / speed2)
    K_yy = G_yy + c + on_diagonal(log_speed + X_alpha[:, 1] ** 2 / speed2)
    return xp.stack([K_xx, K_xy, K_yy], axis=1)


@cache
def circulant(n: int) -> np.ndarray:
    """c_d (n,): weights over 2 pi/n of the quadrature of log|2 sin(alpha/2)|, less its values (no value at d = 0), times the log's sign."""
    k = np.arange(n // 2 + 1)
    weights = -0.5 * n * np.fft.irfft(np.where(k == 0, 0.0, 1.0 / np.maximum(k, 1)), n)
    values = np.zeros(n)
    values[1:] = np.log(2 * np.sin(np.pi * np.arange(1, n) / n))
    return LOG_SIGN * (weights - values)


def circulant_matrix(n: int) -> np.ndarray:
    """c_{i-j} (n, n)."""
    index = np.arange(n)
    return circulant(n)[(index[:, None] - index[None, :]) % n]
