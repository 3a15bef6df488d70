"""Periodic functions by their values f_j = f(2 pi j / n), j = 0..n-1, n even, along the last axis.

The trigonometric interpolant carries the Nyquist mode as cos(n alpha / 2); derivatives and shortening drop it, so that no
derivative ever sees it. Trefethen, Spectral Methods in MATLAB (2000), chapter 3.
"""

from __future__ import annotations

import numpy as np
from array_api_compat import device

from biem.backend import Array, array_namespace, compiled, constant, from_numpy, irfft, on_cpu, rfft, to_numpy

COMPILED_ABOVE = 100_000  # cosines in one `evaluate`, from which the compiled loop is worth loading


def _wavenumbers(n: int) -> np.ndarray:
    """0..n/2 with the Nyquist mode set to zero: the factor of d/dalpha over i."""
    k = np.arange(n // 2 + 1, dtype=np.float64)
    k[-1] = 0.0
    return k


def derivative(f: Array) -> Array:
    """df/dalpha, same shape as f (..., n)."""
    n = f.shape[-1]
    return irfft(1j * constant(_wavenumbers, n, like=f) * rfft(f), n)


def resample(f: Array, n: int) -> Array:
    """Values (..., n) of the interpolant of f (..., m): exact at common nodes for n > m, low-passed to |k| < n/2 for n < m."""
    m = f.shape[-1]
    if n == m:
        return f
    xp = array_namespace(f)
    f_hat = rfft(f) * (n / m)
    if n < m:
        kept = f_hat[..., : n // 2]
        pad = 1
    else:
        kept = xp.concat([f_hat[..., : m // 2], 0.5 * f_hat[..., m // 2 : m // 2 + 1]], axis=-1)
        pad = n // 2 - m // 2
    zeros = xp.zeros((*f.shape[:-1], pad), dtype=kept.dtype, device=device(f))
    return irfft(xp.concat([kept, zeros], axis=-1), n)


def read_back(f: Array, n: int) -> Array:
    """Values (..., n) of the interpolant of f (..., m), m >= n, at n nodes: no mode is cut off, unlike `resample` to fewer nodes."""
    m = f.shape[-1]
    if m % n == 0:
        return f[..., :: m // n]
    return array_namespace(f).matmul(f, constant(read_back_matrix, n, m, like=f).T)


def remove_nyquist(f: Array) -> Array:
    """f without its Nyquist mode: derivatives do not see that mode, so nothing would ever damp it."""
    xp = array_namespace(f)
    sign = constant(_alternating, f.shape[-1], like=f)
    return f - xp.mean(f * sign, axis=-1, keepdims=True) * sign


def shift(f: Array, offset: Array) -> Array:
    """f(alpha + offset) at the nodes; offset broadcasts against f.shape[:-1]."""
    xp = array_namespace(f)
    n = f.shape[-1]
    phase = offset[..., None] * constant(_all_wavenumbers, n, like=f)
    return irfft(rfft(f) * (xp.cos(phase) + 1j * xp.sin(phase)), n)


def coefficients(f: Array) -> Array:
    """One-sided coefficients c (..., n/2 + 1): f(alpha) = Re sum_k c_k e^{i k alpha}."""
    n = f.shape[-1]
    return rfft(f) * constant(_one_sided, n, like=f)


def evaluate(c: Array, alpha: Array, order: int = 0) -> Array:
    """Derivative of the given order of Re sum_k c_k e^{i k alpha}. c: (Q, C, K), alpha: (Q, P) -> (Q, C, P)."""
    xp = array_namespace(alpha)
    n = 2 * (c.shape[-1] - 1)
    if order:
        c = c * (1j * constant(_wavenumbers, n, like=alpha)) ** order
    if alpha.shape[0] * alpha.shape[1] * n > COMPILED_ABOVE and on_cpu(alpha) and alpha.dtype == xp.float64:
        values = compiled("biem.curves.fourier_loop").evaluate(to_numpy(c), np.ascontiguousarray(to_numpy(alpha)))
        return from_numpy(values, like=alpha)
    phase = constant(_all_wavenumbers, n, like=alpha)[:, None] * alpha[:, None, :]
    return xp.matmul(xp.real(c), xp.cos(phase)) - xp.matmul(xp.imag(c), xp.sin(phase))


def differentiation_matrix(n: int) -> np.ndarray:
    """D (n, n): D f = df/dalpha at the nodes, Nyquist mode annihilated."""
    return np.ascontiguousarray(derivative(np.eye(n)).T)


def resampling_matrix(n: int, m: int) -> np.ndarray:
    """(n, m): `resample` from m to n values."""
    return np.ascontiguousarray(resample(np.eye(m), n).T)


def read_back_matrix(n: int, m: int) -> np.ndarray:
    """(n, m): `read_back` from m to n values."""
    return interpolation_matrix(2 * np.pi * np.arange(n) / n, m)


def interpolation_matrix(alpha: np.ndarray, n: int) -> np.ndarray:
    """(P, n): values of the interpolant of n nodes at the parameters alpha (P,)."""
    c = coefficients(np.eye(n))[None]
    return np.ascontiguousarray(evaluate(c, np.asarray(alpha)[None, :])[0].T)


def _alternating(n: int) -> np.ndarray:
    return 1.0 - 2.0 * (np.arange(n) % 2)


def _all_wavenumbers(n: int) -> np.ndarray:
    return np.arange(n // 2 + 1, dtype=np.float64)


def _one_sided(n: int) -> np.ndarray:
    scale = np.full(n // 2 + 1, 2.0 / n)
    scale[0] = scale[-1] = 1.0 / n
    return scale
