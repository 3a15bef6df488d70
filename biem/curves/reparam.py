"""Redistribution of the nodes to equal arclength. X: (M, 2, N).

The new parameters solve  alpha~ + g(alpha~)/v_0 = alpha_k,  where speed = v_0 + g', g periodic of mean zero: no node is distinguished
(re-indexing commutes with it) and on average nothing is shifted along the membrane. X is then its own Fourier series at alpha~.
"""

from __future__ import annotations

from biem.backend import Array, array_namespace, constant
from biem.curves.curve import center_of_nodes, speed
from biem.curves.fourier import _all_wavenumbers, coefficients, evaluate, remove_nyquist, resample
from biem.errors import NumericalFailure

REFINEMENT = 2  # the speed has twice the modes of X and is sampled so


def equal_arclength_parameters(X: Array, first: int = 0) -> Array:
    """alpha~ (M, N): parameters of N points equally spaced in arclength. Raises NumericalFailure where Newton fails.

    first: the number by which an error names the first vesicle.
    """
    xp = array_namespace(X)
    N = X.shape[-1]
    c = coefficients(speed(resample(X - center_of_nodes(X), REFINEMENT * N)))[:, None, :]
    v_0 = xp.real(c[..., 0])
    k = constant(_all_wavenumbers, REFINEMENT * N, like=X)
    periodic = c / (1j * xp.where(k == 0, xp.ones_like(k), k))  # coefficients of g
    both = xp.concat([c, xp.where(k == 0, xp.zeros_like(periodic), periodic)], axis=1) / v_0[..., None]
    alpha_k = xp.arange(N, dtype=X.dtype, device=X.device) * (2.0 * xp.pi / N)
    alpha = alpha_k + xp.zeros((X.shape[0], N), dtype=X.dtype, device=X.device)
    tolerance = 1e-13 if X.dtype == xp.float64 else 1e-6
    for _ in range(30):
        values = evaluate(both, alpha)
        slope, ahead = values[:, 0], values[:, 1]
        step = (alpha + ahead - alpha_k) / xp.where(slope > 0.05, slope, xp.ones_like(slope))
        alpha = alpha - step
        if float(xp.max(xp.abs(step))) < tolerance:
            return alpha
    worst = int(xp.argmax(xp.max(xp.abs(step), axis=-1)))
    raise NumericalFailure(f"redistribution of vesicle {first + worst} did not converge: its nodes are too unevenly spaced")


def redistribute(X: Array, *fields: Array, first: int = 0) -> tuple[Array, ...]:
    """X and fields (M, N) on it, at nodes equally spaced in arclength. first: the number by which an error names the first vesicle."""
    alpha = equal_arclength_parameters(X, first)
    origin = center_of_nodes(X)
    moved = [origin + remove_nyquist(evaluate(coefficients(X - origin), alpha))]
    moved += [evaluate(coefficients(f)[:, None, :], alpha)[:, 0] for f in fields]
    return tuple(moved)
