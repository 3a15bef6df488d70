"""Single layer S[X, f] close to a curve, as rows that act on the nodal density. X: (M, 2, N).

"upsample" (default): curve and density are interpolated to as many nodes as the target's distance asks for and the trapezoid rule is
    used there; below that, Gauss-Legendre panels refined dyadically towards the closest point. Error near the tolerance at any distance.
"ying_zorin": value on the curve by the singular rule, values at five points along the normal outside the near zone by the trapezoid
    rule on N^(3/2) nodes, Lagrange interpolation between. Ying, Biros & Zorin, J. Comput. Phys. 219 (2006); Quaife & Biros (2014).
"""

from __future__ import annotations

from math import log, pi

import numpy as np

from biem.backend import Array, array_namespace, constant, count, from_numpy, scatter_add, to_numpy
from biem.curves.curve import center_of_nodes, speed
from biem.curves.fourier import coefficients, evaluate, interpolation_matrix, resample, resampling_matrix, shift
from biem.stokes.kernels import stokeslet
from biem.stokes.near_search import NearPairs, find_near, locate
from biem.stokes.quadrature import single_layer_blocks

SCHEMES = ("upsample", "ying_zorin", "none")
LEVELS = (2, 4, 8, 16)  # upsampling factors; beyond the last, graded panels are cheaper
PANEL_NODES = 16
CHUNK = 1 << 18  # values of one temporary: it stays in the cache
YING_ZORIN_POINTS = 5
YING_ZORIN_SPACING = 1.1  # of the points along the normal, in h


def near_width(scheme: str, tolerance: float) -> float:
    """Half width of the near zone in arclength spacings h: outside it the trapezoid rule on the N nodes is used."""
    if scheme == "ying_zorin":
        return 1.0
    # a density's modes up to N/4 alias with the kernel's: error exp(-2 pi (3/4) d/h)
    return log(1.0 / tolerance) / (1.5 * pi)


def near_correction(X: Array, targets: Array, pairs: NearPairs, mu: float, scheme: str, tolerance: float) -> Array:
    """Rows (Q, 2, 2, N): [accurate - trapezoid rule on the N nodes] velocity at the pair's target is rows . f of the pair's curve."""
    count("near_rows", len(pairs))
    pairs = pairs.to_numpy()
    points = targets[from_numpy(pairs.target, like=targets)]
    rows = accurate_rows(X, points, pairs, mu, scheme, tolerance) - _trapezoid_rows(X, points, pairs.vesicle, X.shape[-1], mu)
    xp = array_namespace(X)
    return xp.stack([rows[:, (0, 1), :], rows[:, (1, 2), :]], axis=1)


def apply_rows(u: Array, rows: Array, pairs: NearPairs, f: Array) -> Array:
    """u (P, 2) with rows . f added at the pairs' targets. f: (M, 2, N)."""
    xp = array_namespace(u)
    pairs = pairs.to_numpy()
    f_pair = f[from_numpy(pairs.vesicle, like=f)]
    values = xp.sum(rows * f_pair[:, None, :, :], axis=(-2, -1))
    return scatter_add(u, from_numpy(pairs.target, like=u), values)


def accurate_rows(X: Array, points: Array, pairs: NearPairs, mu: float, scheme: str, tolerance: float) -> Array:
    """Components xx, xy, yy (Q, 3, N) of the accurate rows. points: (Q, 2), one for each pair."""
    if scheme == "ying_zorin":
        return _ying_zorin_rows(X, points, pairs, mu)
    xp = array_namespace(X)
    N = X.shape[-1]
    rows = xp.zeros((len(pairs), 3, N), dtype=X.dtype, device=X.device)
    factor = upsampling(pairs.rho, N, tolerance)
    for level in LEVELS:
        index = np.flatnonzero(factor == level)
        if len(index):
            rows[from_numpy(index, like=X)] = _trapezoid_rows(X, points[from_numpy(index, like=X)], pairs.vesicle[index], level * N, mu)
    index = np.flatnonzero(factor == 0)
    if len(index):
        index = index[np.argsort(pairs.rho[index])]  # neighbours in a chunk share their panels
        rows[from_numpy(index, like=X)] = _graded_rows(X, points[from_numpy(index, like=X)], pairs.subset(index), mu)
    return rows


def upsampling(rho: Array, N: int, tolerance: float) -> Array:
    """The smallest of LEVELS (Q,) that resolves pairs of resolution rho (Q,); 0 where none does."""
    xp = array_namespace(rho)
    factor = xp.zeros_like(rho, dtype=xp.int64)
    for level in reversed(LEVELS):
        factor = xp.where((level - 0.25) * N * rho >= log(1.0 / tolerance), xp.full_like(factor, level), factor)
    return factor


def layer_values(X: Array, f: Array, points: Array, mu: float, tolerance: float = 1e-9) -> Array:
    """S[X_m, f_m] at points (M, Q, 2) about each curve m, on it, inside or outside -> (M, Q, 2)."""
    xp = array_namespace(X)
    M, Q, _ = points.shape
    flat = xp.reshape(points, (M * Q, 2))
    vesicle = np.repeat(np.arange(M), Q)
    x, nodes = to_numpy(points), to_numpy(X).transpose(0, 2, 1)
    nearest = np.argmin(((x[:, :, None, :] - nodes[:, None, :, :]) ** 2).sum(-1), axis=-1).ravel()
    start = (np.arange(M * Q), vesicle, 2 * pi * nearest / X.shape[-1])
    pairs = locate(X, flat, *(from_numpy(a, like=X) for a in start)).to_numpy()
    rows = accurate_rows(X, flat, pairs, mu, "upsample", tolerance)
    rows = xp.stack([rows[:, (0, 1), :], rows[:, (1, 2), :]], axis=1)
    return xp.reshape(xp.sum(rows * f[from_numpy(vesicle, like=X)][:, None], axis=(-2, -1)), (M, Q, 2))


def _trapezoid_rows(X: Array, points: Array, vesicle: np.ndarray, n: int, mu: float) -> Array:
    """Trapezoid rule on n >= N nodes of the interpolated curve, pulled back to the N nodal values (Q, 3, N)."""
    xp = array_namespace(X)
    N = X.shape[-1]
    used, own = np.unique(vesicle, return_inverse=True)
    X_used = X[from_numpy(used, like=X)]
    origin = center_of_nodes(X_used)
    X_up = resample(X_used - origin, n)
    ds = speed(X_up) * (2.0 * pi / n)
    pull_back = constant(resampling_matrix, n, N, like=X) if n > N else None
    parts = []
    step = max(1, CHUNK // n)
    for start in range(0, len(vesicle), step):
        j = from_numpy(own[start : start + step], like=X)
        x = points[start : start + step][:, :, None] - origin[j]
        curve = X_up[j]
        w = ds[j]
        G = stokeslet(x[:, 0] - curve[:, 0], x[:, 1] - curve[:, 1], mu)
        rows = xp.stack([w * g for g in G], axis=1)
        parts.append(rows if pull_back is None else xp.matmul(rows, pull_back))
    return xp.concat(parts, axis=0) if parts else xp.zeros((0, 3, N), dtype=X.dtype, device=X.device)


def _graded_rows(X: Array, points: Array, pairs: NearPairs, mu: float) -> Array:
    """Gauss-Legendre panels about each pair's closest point, halved towards it down to the pair's distance (Q, 3, N).

    The curve is shifted so that the closest point is at parameter 0: one set of panels serves a whole chunk. Shifts are made on 2 N
    nodes, where the Nyquist mode of the N nodes is one like any other.
    """
    xp = array_namespace(X)
    N = X.shape[-1]
    parts = []
    start = 0
    while start < len(pairs):
        finest = max(-30, int(np.floor(np.log2(max(pairs.rho[start], 1e-30)))))
        w = constant(_panel_weights, N, finest, like=X)
        E = constant(_panel_interpolation, N, finest, like=X)
        chunk = slice(start, min(len(pairs), start + max(1, CHUNK // w.shape[0])))
        start = chunk.stop
        alpha = from_numpy(pairs.alpha[chunk], like=X)
        curve = X[from_numpy(pairs.vesicle[chunk], like=X)]
        origin = center_of_nodes(curve)
        curve = shift(resample(curve - origin, 2 * N), alpha[:, None])
        at = xp.matmul(curve, E.T)
        tangent = xp.matmul(curve, constant(_panel_derivative, N, finest, like=X).T)
        weight = w * xp.sqrt(tangent[:, 0] ** 2 + tangent[:, 1] ** 2)
        x = points[chunk][:, :, None] - origin
        G = stokeslet(x[:, 0] - at[:, 0], x[:, 1] - at[:, 1], mu)
        rows = xp.matmul(xp.stack([weight * g for g in G], axis=1), E)
        parts.append(xp.matmul(shift(rows, -alpha[:, None]), constant(resampling_matrix, 2 * N, N, like=X)))
    return xp.concat(parts, axis=0)


def _ying_zorin_rows(X: Array, points: Array, pairs: NearPairs, mu: float) -> Array:
    xp = array_namespace(X)
    N = X.shape[-1]
    n = 2 * int(np.ceil(N**1.5 / 2))
    used, own = np.unique(pairs.vesicle, return_inverse=True)
    j = from_numpy(own, like=X)
    X_used = X[from_numpy(used, like=X)]
    alpha = from_numpy(pairs.alpha, like=X)
    # on the curve: the rows of S interpolated to the closest point
    S = single_layer_blocks(X_used, mu)[j]
    dirichlet = _dirichlet_rows(alpha, N)
    rows_on = xp.matmul(dirichlet[:, None, None, :], S)[:, :, 0, :]
    # along the normal, towards the target's side
    c = coefficients(X_used - center_of_nodes(X_used))[j]
    x0 = evaluate(c, alpha[:, None])[..., 0] + center_of_nodes(X_used)[j][..., 0]
    X_alpha = evaluate(c, alpha[:, None], 1)[..., 0]
    speed_0 = xp.sqrt(X_alpha[:, 0] ** 2 + X_alpha[:, 1] ** 2)
    side = from_numpy(np.where(pairs.distance < 0, -1.0, 1.0), like=X)
    n0 = (side / speed_0)[:, None] * xp.stack([X_alpha[:, 1], -X_alpha[:, 0]], axis=-1)
    h = from_numpy(to_numpy(xp.sum(speed(X_used), axis=-1)) * 2 * pi / N**2, like=X)[j]
    d = from_numpy(np.abs(pairs.distance), like=X) / (YING_ZORIN_SPACING * h)
    rows = _lagrange(d, 0)[:, None, None] * rows_on
    for k in range(1, YING_ZORIN_POINTS + 1):
        x_k = x0 + (k * YING_ZORIN_SPACING * h)[:, None] * n0
        rows = rows + _lagrange(d, k)[:, None, None] * _trapezoid_rows(X, x_k, pairs.vesicle, n, mu)
    return rows


def _lagrange(d: Array, k: int) -> Array:
    """Lagrange polynomial of node k on the nodes 0..YING_ZORIN_POINTS at d."""
    value = 1.0 + 0.0 * d
    for m in range(YING_ZORIN_POINTS + 1):
        if m != k:
            value = value * (d - m) / (k - m)
    return value


def _dirichlet_rows(alpha: Array, N: int) -> Array:
    """(Q, N): interpolation weights of the N nodes at parameters alpha (Q,)."""
    xp = array_namespace(alpha)
    identity = xp.zeros((alpha.shape[0], N), dtype=alpha.dtype, device=alpha.device)
    identity[:, 0] = 1.0
    return shift(identity, -alpha)


def _panels(N: int, finest: int) -> np.ndarray:
    """Panel ends on [-pi, pi]: dyadic from 2^finest about 0, none longer than resolves N/2 modes with PANEL_NODES."""
    longest = 8 * pi / N
    ends = [0.0]
    size = 2.0**finest
    while ends[-1] < pi:
        ends.append(min(pi, ends[-1] + min(size, longest)))
        size = max(size, ends[-1])
    half = np.array(ends)
    if len(half) > 2 and half[-1] - half[-2] < 0.25 * longest:  # no sliver at the far end
        half = np.delete(half, -2) if half[-1] - half[-3] <= 1.5 * longest else half
    return np.concatenate([-half[:0:-1], half])


def _panel_rule(N: int, finest: int) -> tuple[np.ndarray, np.ndarray]:
    x, w = np.polynomial.legendre.leggauss(PANEL_NODES)
    ends = _panels(N, finest)
    half, middle = np.diff(ends) / 2, (ends[1:] + ends[:-1]) / 2
    return (middle[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()


def _panel_nodes(N: int, finest: int) -> np.ndarray:
    return _panel_rule(N, finest)[0]


def _panel_weights(N: int, finest: int) -> np.ndarray:
    return _panel_rule(N, finest)[1]


def _panel_interpolation(N: int, finest: int) -> np.ndarray:
    return interpolation_matrix(_panel_nodes(N, finest), 2 * N)


def _panel_derivative(N: int, finest: int) -> np.ndarray:
    c = coefficients(np.eye(2 * N))[None]
    return np.ascontiguousarray(evaluate(c, _panel_nodes(N, finest)[None, :], 1)[0].T)


__all__ = ["SCHEMES", "accurate_rows", "apply_rows", "find_near", "layer_values", "near_correction", "near_width"]
