"""Single layer S[X, f] on the curve itself as a matrix, by Alpert's hybrid Gauss-trapezoid rule. X: (M, 2, n).

    (S f)(x_i) = sum_p w_p h G(x_i - X(alpha_i + chi_p h)) f(alpha_i + chi_p h) speed   +   trapezoid sum over |j - i| >= a

f at the auxiliary nodes is its trigonometric interpolant; relative to node i that interpolation is the same for every i, so the
auxiliary part is one product (n x 2m)(2m x n) in the index (i, j - i). Alpert (1999); tables in `alpert_tables`.
"""

from __future__ import annotations

import numpy as np

from biem.backend import Array, array_namespace, constant, count, irfft, rfft
from biem.curves.curve import center_of_nodes, speed
from biem.curves.fourier import _all_wavenumbers, _wavenumbers, interpolation_matrix
from biem.stokes.alpert_tables import RULES
from biem.stokes.kernels import stokeslet


def default_order(n: int) -> int:
    """16 where the rule's corrected zone (10 nodes on either side) fits on n nodes, else 8."""
    return 16 if n >= 2 * RULES[16][0] else 8


def single_layer_blocks(X: Array, mu: float = 1.0, order: int | None = None) -> Array:
    """Blocks xx, xy, yy of S on the curve, arclength weights included: (M, 3, n, n).

    order: 8 or 16 (default: 16 from n = 20 on). Raises ValueError if the rule does not fit on n nodes.
    """
    xp = array_namespace(X)
    M, _, n = X.shape
    order = default_order(n) if order is None else order
    if order not in RULES:
        raise ValueError(f"Alpert rule of order {order}: the orders are {sorted(RULES)}")
    a = RULES[order][0]
    if n < 2 * a:
        raise ValueError(f"Alpert's rule of order {order} needs at least {2 * a} nodes, got {n}: use order 8 or more nodes")
    count("single_layer_matrix", M)

    h = 2.0 * xp.pi / n
    r0 = X - center_of_nodes(X)

    # auxiliary nodes: (M, 2, 2m, n), point p beside node i
    X_hat = rfft(r0)[:, :, None, :]
    phases = constant(_shift_phases, n, order, like=X[0, 0])
    phases = phases[0] + 1j * phases[1]
    X_aux = irfft(X_hat * phases, n)
    X_aux_alpha = irfft(X_hat * (1j * constant(_wavenumbers, n, like=X[0, 0])) * phases, n)
    weight = constant(_aux_weights, n, order, like=X[0, 0])[:, None]
    weight = weight * xp.sqrt(X_aux_alpha[:, 0] ** 2 + X_aux_alpha[:, 1] ** 2)
    G = stokeslet(r0[:, 0, None, :] - X_aux[:, 0], r0[:, 1, None, :] - X_aux[:, 1], mu)
    aux = xp.stack([weight * g for g in G], axis=1)  # (M, 3, 2m, n)
    by_offset = xp.matmul(xp.permute_dims(aux, (0, 1, 3, 2)), constant(_aux_interpolation, n, order, like=X[0, 0]))

    # trapezoid part: node i against node i + d, d = a..n-a
    far = constant(_far_index, n, a, like=X)
    r_far = xp.reshape(xp.take(r0, xp.reshape(far, (-1,)), axis=-1), (M, 2, n, n - 2 * a + 1))
    ds = speed(X) * h
    ds_far = xp.reshape(xp.take(ds, xp.reshape(far, (-1,)), axis=-1), (M, n, n - 2 * a + 1))
    G = stokeslet(r0[:, 0, :, None] - r_far[:, 0], r0[:, 1, :, None] - r_far[:, 1], mu)
    by_offset[..., a : n - a + 1] += xp.stack([ds_far * g for g in G], axis=1)

    index = constant(_offset_to_column, n, like=X)
    return xp.reshape(xp.take(xp.reshape(by_offset, (M, 3, n * n)), index, axis=-1), (M, 3, n, n))


def full_matrix(blocks: Array) -> Array:
    """(M, 3, n, n) blocks xx, xy, yy of a symmetric-in-components operator -> (M, 2n, 2n) on stacked [x; y]."""
    xp = array_namespace(blocks)
    top = xp.concat([blocks[:, 0], blocks[:, 1]], axis=-1)
    return xp.concat([top, xp.concat([blocks[:, 1], blocks[:, 2]], axis=-1)], axis=-2)


def _offsets(n: int, order: int) -> np.ndarray:
    _, chi, _ = RULES[order]
    return np.concatenate([chi, -chi]) * (2.0 * np.pi / n)


def _shift_phases(n: int, order: int) -> np.ndarray:
    phase = _offsets(n, order)[:, None] * _all_wavenumbers(n)
    return np.stack([np.cos(phase), np.sin(phase)])


def _aux_weights(n: int, order: int) -> np.ndarray:
    w = RULES[order][2]
    return np.concatenate([w, w]) * (2.0 * np.pi / n)


def _aux_interpolation(n: int, order: int) -> np.ndarray:
    return interpolation_matrix(_offsets(n, order), n)


def _far_index(n: int, a: int) -> np.ndarray:
    return (np.arange(n)[:, None] + np.arange(a, n - a + 1)[None, :]) % n


def _offset_to_column(n: int) -> np.ndarray:
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    return (i * n + (j - i) % n).ravel()
