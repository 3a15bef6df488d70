"""Single layer S[X, f] within one spacing h = length/N of a curve, from its values on a few layers along it. X, f: (M, 2, N).

Layers are the curves X + o h n for offsets o along the outward normal n, values on them are (M, n_layers, 2, N).
`exact_layers` makes the values by quadrature: off the curve by the trapezoid rule on n nodes, error about e^{-n rho} (`near_search`),
    on it by Kress's rule (`kress`); any map with the same values, such as a learned one, can take its place.
`one_sided` (default) interpolates by polynomials in the distance d through the layers on the target's side, 0 included, and
    trigonometrically along them: S(alpha, d) at the closest point alpha. The normal derivative of S jumps at the curve, so that
`rbf`, one Gaussian fit across it, is O(h) at best.
`NearLayers` replaces the N-node trapezoid rule at near targets by the interpolated values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from array_api_compat import is_numpy_array
from scipy.linalg import lapack

from biem.backend import (
    Array,
    array_namespace,
    compiled,
    constant,
    count,
    from_numpy,
    irfft,
    on_cpu,
    parallel_map,
    rfft,
    scatter_add,
    to_numpy,
)
from biem.curves.curve import arclength_weights, center_of_nodes, cross, dot, length, normal
from biem.curves.fourier import coefficients, derivative, evaluate, resample
from biem.stokes.farfield_direct import own_sum, own_sum_of_arrays
from biem.stokes.kernels import LOG_SIGN, stokeslet_prefactor
from biem.stokes.kress import circulant
from biem.stokes.near import layer_values
from biem.stokes.near_search import SEARCH_REFINEMENT, NearPairs

LOOPS = "biem.stokes.layer_loop"
METHODS = ("layers", "layers_rbf")
UPSAMPLING = (2, 3, 4, 5, 6, 8, 12, 16)  # nodes of the trapezoid rule over N; points that need more go to `layer_values`
FALLBACK = 8  # times N, the nodes handed to `layer_values`, which asks for a resolved speed
RIDGE = 1e-10  # added to an RBF matrix (diagonal 1) that is not numerically positive definite, as where layers meet
CHUNK = 1 << 18  # values of one temporary: it stays in the cache


def layer_points(X: Array, offsets: Sequence[float]) -> Array:
    """Points X + o h n (M, n_layers, 2, N) for the offsets o, h = length/N."""
    xp = array_namespace(X)
    h_n = (length(X) / X.shape[-1])[:, None, None] * normal(X)
    return xp.stack([X + offset * h_n for offset in offsets], axis=1)


def exact_layers(X: Array, f: Array, mu: float, offsets: Sequence[float], tolerance: float = 1e-6) -> Array:
    """S[X, f] on the layers (M, n_layers, 2, N); error near tolerance times max |S|.

    Computed in float64 on the CPU whatever the dtype of X, in its own dtype on an accelerator. Raises ValueError where no offset is
    off the curve: the points there tell how many nodes a curve takes.
    """
    if not any(offsets):
        raise ValueError(f"layers at offsets {tuple(offsets)}: expected at least one that is not 0")
    if on_cpu(X):
        X64, f64 = (to_numpy(a).astype(np.float64, copy=False) for a in (X, f))
        return from_numpy(_exact_layers(X64, f64, mu, offsets, tolerance), like=X)
    return _exact_layers(X, f, mu, offsets, tolerance)


def one_sided(values: Array, X: Array, pairs: NearPairs, offsets: Sequence[float]) -> Array:
    """Layer values (M, n_layers, 2, N) at the pairs' targets (Q, 2): polynomial in the distance on the target's side, trigonometric along.

    Continuous across the curve. Raises ValueError where the offsets have no 0.
    """
    if 0.0 not in offsets:
        raise ValueError(f"one-sided interpolation across layers at offsets {tuple(offsets)}: expected 0 to be one of them")
    xp = array_namespace(X)
    M, n_layers, _, N = values.shape
    vesicle, alpha, distance = (_as(a, X) for a in (pairs.vesicle, pairs.alpha, pairs.distance))
    d = distance / (length(X) / N)[vesicle]
    outside, inside = (_lagrange(d, offsets, side) for side in (1.0, -1.0))
    weights = xp.where((distance < 0)[:, None], inside, outside)[:, None, :]
    stacked = xp.reshape(values, (M, n_layers, 2 * N))

    def at(chunk: slice) -> Array:
        mixed = xp.reshape(xp.matmul(weights[chunk], stacked[vesicle[chunk]]), (-1, 2, N))
        return evaluate(coefficients(mixed), alpha[chunk][:, None])[..., 0]

    return _in_chunks(at, len(pairs), 2 * n_layers * N, X)


def rbf(values: Array, X: Array, points: Array, pairs: NearPairs, offsets: Sequence[float], shape: float = 0.9) -> Array:
    """Layer values at points (Q, 2), one for each pair: sum_p a_p exp(-(shape |x - x_p|/h)^2) over all layer points x_p of a curve.

    The paper's interpolation: smooth across the curve, where S is not, and off by about 0.5 % for a constant whatever h is, because the
    Gaussians narrow with h. Computed in float64.
    """
    xp = array_namespace(X)
    if len(pairs) == 0:
        return xp.zeros_like(points)
    used, own = xp.unique_inverse(_as(pairs.vesicle, X))
    origin = center_of_nodes(X[used])
    nodes = xp.astype(_stack_layers(layer_points(X[used] - origin, offsets)), xp.float64)
    scale = xp.astype(shape * X.shape[-1] / length(X[used]), xp.float64)
    nodes = nodes * scale[:, None, None]
    x = xp.astype(points - origin[own][..., 0], xp.float64) * scale[own][:, None]
    a = _rbf_coefficients(nodes, xp.astype(_stack_layers(values[used]), xp.float64))

    def at(chunk: slice) -> Array:
        basis = _gaussian(x[chunk][:, :, None], nodes[own[chunk]])
        return xp.matmul(a[own[chunk]], basis[..., None])[..., 0]

    return xp.astype(_in_chunks(at, len(pairs), 4 * nodes.shape[-1], x), X.dtype)


@dataclass(frozen=True)
class NearLayers:
    """S[X, f] within h of a curve from its values on layers; replaces the N-node trapezoid rule there."""

    X: Array  # curves that have pairs (m, 2, N)
    used: Array  # their indices among all
    target: Array  # of each pair
    points: Array  # target of each pair (Q, 2)
    pairs: NearPairs  # `vesicle` counts within X
    mu: float
    method: str
    near_layers: Callable[[Array, Array], Array]
    offsets: tuple[float, ...]

    @classmethod
    def build(
        cls,
        X: Array,
        targets: Array,
        pairs: NearPairs,
        mu: float,
        method: str,
        near_layers: Callable[[Array, Array], Array],
        offsets: Sequence[float],
    ) -> NearLayers:
        """For targets (P, 2) and pairs with |distance| <= h times the largest offset.

        near_layers(X, f) gives the values on the layers at `offsets` (m, n_layers, 2, N) and is called with the curves that have pairs
        alone. Raises ValueError for an unknown method.
        """
        if method not in METHODS:
            raise ValueError(f'near layers by method "{method}": expected ' + ", ".join(f'"{name}"' for name in METHODS))
        vesicle, target = _as(pairs.vesicle, X), _as(pairs.target, X)
        used, own = array_namespace(X).unique_inverse(vesicle)
        local = NearPairs(pairs.target, own, pairs.alpha, pairs.distance, pairs.rho)
        return cls(X[used], used, target, targets[target], local, mu, method, near_layers, tuple(offsets))

    def add(self, u: Array, f: Array) -> Array:
        """u (P, 2) with [value from the layers - trapezoid rule on the N nodes] added at each pair's target. f: (M, 2, N)."""
        if len(self.pairs) == 0:
            return u
        count("near_layers", self.X.shape[0])
        f = f[self.used]
        values = self.near_layers(self.X, f)
        if self.method == "layers":
            near = one_sided(values, self.X, self.pairs, self.offsets)
        else:
            near = rbf(values, self.X, self.points, self.pairs, self.offsets)
        g = f * arclength_weights(self.X)[:, None, :]
        return scatter_add(u, self.target, near - curve_sum(self.points, self.pairs.vesicle, self.X, g, self.mu))


def curve_sum(points: Array, own: Array, X: Array, weighted_force: Array, mu: float) -> Array:
    """Velocity (Q, 2) at points (Q, 2) of the point forces f ds (M, 2, N) at the nodes X of curve own[q] alone; 0 from coincident nodes."""
    origin = center_of_nodes(X)
    x, y = points - origin[own][..., 0], X - origin
    if not on_cpu(X):
        return own_sum_of_arrays(x, y, weighted_force, own, mu)
    x64, y64, g64 = (to_numpy(a).astype(np.float64, copy=False) for a in (x, y, weighted_force))
    return from_numpy(own_sum(x64, y64, g64, to_numpy(own), mu), like=X)


def _exact_layers(X: Array, f: Array, mu: float, offsets: Sequence[float], tolerance: float) -> Array:
    xp = array_namespace(X)
    M, _, N = X.shape
    n_layers = len(offsets)
    X = X - center_of_nodes(X)
    points = xp.reshape(xp.permute_dims(layer_points(X, offsets), (0, 1, 3, 2)), (-1, 2))
    vesicle, layer = np.repeat(np.arange(M), n_layers * N), np.tile(np.repeat(np.arange(n_layers), N), M)
    off = np.flatnonzero(np.asarray(offsets)[layer] != 0.0)
    nodes = log(1.0 / tolerance) / _resolution(X, points[_as(off, X)], vesicle[off]) + 0.5 * N  # modes up to N/2 alias
    step = np.searchsorted(np.asarray(UPSAMPLING) * N, nodes)
    # the curve itself takes the most nodes that a point beside it takes
    step_on = np.zeros(M, dtype=np.int64)
    np.maximum.at(step_on, vesicle[off], np.minimum(step, len(UPSAMPLING) - 1))

    u = xp.zeros((M * n_layers * N, 2), dtype=X.dtype, device=X.device)
    on_layers = [k for k in range(n_layers) if offsets[k] == 0.0]
    for s, factor in enumerate(UPSAMPLING):
        index = off[step == s]
        on = np.flatnonzero(step_on == s) if on_layers else np.zeros(0, dtype=np.int64)
        used = np.union1d(vesicle[index], on)
        if len(used) == 0:
            continue
        X_up, f_up = (resample(a[_as(used, X)], factor * N) for a in (X, f))
        g = f_up * arclength_weights(X_up)[:, None, :]
        if len(index):
            own = _as(np.searchsorted(used, vesicle[index]), X)
            u[_as(index, X)] = curve_sum(points[_as(index, X)], own, X_up, g, mu)
        if len(on):
            at = _as(np.searchsorted(used, on), X)
            u_on = xp.reshape(_on_curve(X_up[at], g[at], factor, mu), (-1, 2))
            for k in on_layers:
                u[_as(((on[:, None] * n_layers + k) * N + np.arange(N)).ravel(), X)] = u_on
    index = off[step == len(UPSAMPLING)]
    if len(index):
        where, j = _as(index, X), _as(vesicle[index], X)
        count("layer_points_too_close", len(index))
        X_up, f_up = (resample(a[j], FALLBACK * N) for a in (X, f))
        u[where] = layer_values(X_up, f_up, points[where][:, None, :], mu, tolerance)[:, 0]
    return xp.permute_dims(xp.reshape(u, (M, n_layers, N, 2)), (0, 1, 3, 2))


def _on_curve(X: Array, g: Array, factor: int, mu: float) -> Array:
    """S at every factor-th node (m, n / factor, 2) for forces g = f ds, by `kress.single_layer_kernel` without forming it."""
    xp = array_namespace(X)
    m, _, n = X.shape
    N = n // factor
    own = _as(np.repeat(np.arange(m), N), X)
    x = xp.reshape(xp.permute_dims(X[..., ::factor], (0, 2, 1)), (-1, 2))
    others = xp.permute_dims(xp.reshape(curve_sum(x, own, X, g, mu), (m, N, 2)), (0, 2, 1))
    X_alpha = derivative(X)
    speed2 = dot(X_alpha, X_alpha)
    itself = (0.5 * LOG_SIGN) * xp.log(speed2)[:, None, :] * g + (dot(X_alpha, g) / speed2)[:, None, :] * X_alpha
    itself = itself + irfft(rfft(g) * constant(_circulant_symbol, n, like=X), n)
    return xp.permute_dims(others + stokeslet_prefactor(mu) * itself[..., ::factor], (0, 2, 1))


def _circulant_symbol(n: int) -> np.ndarray:
    return np.ascontiguousarray(np.fft.rfft(circulant(n)).real)


def _resolution(X: Array, points: Array, own: np.ndarray) -> np.ndarray:
    """Half width (Q,) of the strip of complex parameters in which the integrand of S at the points of curve own[q] is smooth.

    The least of rho at the nearest of some nodes, by the osculating circle where it is less than by the tangent, and of
    |X_alpha|/|X_alphaalpha| over the curve, an estimate of the distance to the zeros of the speed.
    """
    xp = array_namespace(X)
    curve = resample(X, SEARCH_REFINEMENT * X.shape[-1])
    X_a = derivative(curve)
    X_aa = derivative(X_a)
    speed2 = dot(X_a, X_a)
    j = _as(own, X)
    node = compiled(LOOPS).nearest_node(points, own, curve, speed2) if on_cpu(X) else _nearest_node(points, j, curve, speed2)
    speed = xp.sqrt(speed2)
    curvature = (cross(X_a, X_aa) / speed**3)[j, node]
    normal_speed = xp.stack([X_a[:, 1], -X_a[:, 0]], axis=1)
    d = xp.sum((points - curve[j, :, node]) * normal_speed[j, :, node], axis=-1) / speed[j, node]
    bend = xp.abs(d * curvature) * (d * curvature > 0)
    bend = xp.where(bend > 1e-6, bend, xp.zeros_like(bend) + 1e-6)
    rho = xp.abs(d) / speed[j, node] * xp.log(1.0 + bend) / bend
    smooth = xp.sqrt(xp.min(speed2 / dot(X_aa, X_aa), axis=-1))[j]
    return np.maximum(to_numpy(xp.where(rho < smooth, rho, smooth)), 1e-30)


def _nearest_node(x: Array, own: Array, y: Array, speed2: Array) -> Array:
    xp = array_namespace(x)

    def at(chunk: slice) -> Array:
        r = x[chunk][:, :, None] - y[own[chunk]]
        return xp.argmin(dot(r, r) / speed2[own[chunk]], axis=-1)

    return _in_chunks(at, x.shape[0], 4 * y.shape[-1], x)


def _lagrange(d: Array, offsets: Sequence[float], side: float) -> Array:
    """(Q, n_layers): weights at distances d of the polynomial through the offsets on one side (1 or -1) and 0; 0 for the others."""
    xp = array_namespace(d)
    nodes = [o for o in offsets if side * o >= 0]
    columns = []
    for o in offsets:
        weight = xp.ones_like(d) if o in nodes else xp.zeros_like(d)
        for other in nodes:
            if other != o:
                weight = weight * ((d - other) / (o - other))
        columns.append(weight)
    return xp.stack(columns, axis=-1)


def _rbf_coefficients(nodes: Array, values: Array) -> Array:
    """a (m, 2, n) with sum_p a_p exp(-|x_q - x_p|^2) = values (m, 2, n) at nodes (m, 2, n), by Cholesky's factorization.

    A matrix that is not numerically positive definite gets RIDGE on its diagonal, counted as "rbf_ridge".
    """
    xp = array_namespace(nodes)
    m, _, n = nodes.shape
    if on_cpu(nodes):
        x, b = to_numpy(nodes), to_numpy(values)
        A = lambda i: _gaussian(x[[i], :, :, None], x[[i], :, None, :])[0]
        solved = parallel_map(lambda i: _solve_positive(A(i), b[i]), range(m))
        return from_numpy(np.stack(solved), like=nodes)
    parts = []
    step = max(1, 64 * CHUNK // n**2)
    for start in range(0, m, step):
        x = nodes[start : start + step]
        A = _gaussian(x[:, :, :, None], x[:, :, None, :])
        b = xp.permute_dims(values[start : start + step], (0, 2, 1))
        factor, info = xp.linalg.cholesky_ex(A)
        failed = info > 0
        if failed.any():
            count("rbf_ridge", int(xp.sum(failed)))
            factor = xp.linalg.cholesky(A + RIDGE * failed[:, None, None] * xp.eye(n, dtype=A.dtype, device=A.device))
        parts.append(xp.permute_dims(xp.cholesky_solve(b, factor), (0, 2, 1)))
    return xp.concat(parts, axis=0)


def _solve_positive(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A^-1 b for one matrix (n, n) and right-hand sides b (2, n): LAPACK's Cholesky solver, which knows no batches."""
    _, x, info = lapack.dposv(A, b.T)
    if info > 0:
        count("rbf_ridge")
        _, x, info = lapack.dposv(A + RIDGE * np.eye(len(A)), b.T)
    assert info == 0, info
    return x.T


def _gaussian(x: Array, y: Array) -> Array:
    """exp(-|x - y|^2) for x, y (m, 2, ...) that broadcast against one another."""
    xp = array_namespace(x)
    return xp.exp(-xp.sum((x - y) ** 2, axis=1))


def _stack_layers(values: Array) -> Array:
    """(m, n_layers, 2, N) -> (m, 2, n_layers N)."""
    xp = array_namespace(values)
    return xp.reshape(xp.permute_dims(values, (0, 2, 1, 3)), (values.shape[0], 2, -1))


def _in_chunks(function: Callable[[slice], Array], n: int, size: int, like: Array) -> Array:
    """Results of function(slice) for all of range(n), whose temporaries take `size` values a row."""
    xp = array_namespace(like)
    step = max(1, CHUNK // size)
    parts = [function(slice(start, min(n, start + step))) for start in range(0, n, step)]
    return xp.concat(parts, axis=0) if parts else xp.zeros((0, 2), dtype=like.dtype, device=like.device)


def _as(a: Array, like: Array) -> Array:
    return from_numpy(a, like) if is_numpy_array(a) else a


__all__ = ["METHODS", "NearLayers", "curve_sum", "exact_layers", "layer_points", "one_sided", "rbf"]
