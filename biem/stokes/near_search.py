"""Which targets are close to which curve: true distance to the curve, not to its nodes. X: (M, 2, N), targets: (P, 2).

Cells of nodes propose (target, curve) pairs; Newton's method on the Fourier series gives the closest parameter, the signed distance
(positive outside) and from it the pair's resolution
    rho = |log(1 + c d)/c| / speed,      c: curvature at the closest point,
the distance from the real axis of the complex parameter at which the curve (taken as its osculating circle) passes through the
target. The n-node trapezoid rule errs there by about exp(-n rho) for smooth densities. Everything here runs in float64: arrays in the
CPU's memory in compiled loops (near_loop), arrays elsewhere in array code where they are. A curve with a node that is not finite is
close to nothing, nor is a target that is not finite.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf, log2, pi
from typing import Any

import numpy as np
from array_api_compat import device
from scipy.spatial import cKDTree

from biem.backend import Array, array_namespace, compiled, count, on_cpu, to_numpy
from biem.curves.curve import center_of_nodes, length
from biem.curves.fourier import coefficients, evaluate, resample
from biem.curves.lattice import Lattice

LOOPS = "biem.stokes.near_loop"
SEARCH_REFINEMENT = 4  # nodes in the cells per node of the curve
NEWTON_STEPS = 30
NEWTON_ACCURACY = 1e-13  # of the parameter
CLASSES = 30  # of curves by their reach, each half of the one before
ROW = 0x5E3779B97F4A7C15  # between the keys of a cell and of the next in x: products wrap around, keys that coincide cost time alone
FARTHEST = 2.0**52  # cells from the origin: beyond, positions are coarser than a cell
CHUNK = 1 << 24  # candidates, or values of a temporary, that array code holds at a time


@dataclass(frozen=True)
class NearPairs:
    """Pairs of a target and a curve near it, arrays of one length Q: NumPy, or on the accelerator of the points."""

    target: Array  # index of the target
    vesicle: Array  # index of the curve
    alpha: Array  # parameter of the closest point
    distance: Array  # signed, positive outside
    rho: Array  # resolution of the pair

    def __len__(self) -> int:
        return self.target.shape[0]

    def subset(self, which: Array) -> NearPairs:
        """The pairs selected by a mask or an index array."""
        return NearPairs(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    def to_numpy(self) -> NearPairs:
        """The pairs as NumPy arrays."""
        return NearPairs(*(to_numpy(getattr(self, name)) for name in self.__dataclass_fields__))


def find_near(X: Array, targets: Array, width: float, exclude: Array | None = None) -> NearPairs:
    """All (target, curve) pairs with |distance| <= width * h, h = length/N of the curve.

    exclude (P,): index of the curve that a target belongs to and is not tested against (-1: none). Pairs are sorted by target, then
    curve.
    """
    count("near_search")
    use_loops = on_cpu(X)
    if use_loops:
        X, targets, exclude = to_numpy(X), to_numpy(targets), None if exclude is None else to_numpy(exclude)
    return _within(float64(X), float64(targets), width / X.shape[-1] * _lengths(X), exclude, use_loops)


def locate(X: Array, targets: Array, target: Array, vesicle: Array, alpha: Array) -> NearPairs:
    """Closest points for given pairs, from starting parameters alpha (Q,), by Newton's method on |X(alpha) - target|^2."""
    if not on_cpu(X):
        return _locate(float64(X), float64(targets), target, vesicle, float64(alpha), _newton_by_arrays)
    X, targets, target, vesicle, alpha = (to_numpy(a) for a in (X, targets, target, vesicle, alpha))
    return _locate(float64(X), float64(targets), target, vesicle, float64(alpha), _newton_compiled)


def minimum_gap(X: Array, lattice: Lattice | None = None) -> float:
    """Smallest distance of a node to another curve (M, 2, N); infinite where there are no two curves.

    lattice: the images of the curves, in a periodic box: the distance to an image, also of the node's own curve, counts as well.
    """
    X = float64(to_numpy(X))
    X = X[np.isfinite(_lengths(X))]
    if lattice is not None:
        reach, farthest = float(_lengths(X).max(initial=0.0)), lattice.width + lattice.height
        while True:
            gap = minimum_gap(lattice.with_images(X, reach)[0])
            if gap <= reach or not reach < farthest:
                return gap
            reach *= 2.0
    M, _, N = X.shape
    if M < 2:
        return inf
    nodes = X.transpose(0, 2, 1)
    # no larger than between the nodes of curves with neighbouring centres
    two = np.asarray(cKDTree(nodes.mean(axis=1)).query(nodes.mean(axis=1), k=2)[1])
    other = np.where(two[:, 0] == np.arange(M), two[:, 1], two[:, 0])
    bound = compiled(LOOPS).smallest_node_distance(X, other)
    pairs = _within(X, nodes.reshape(M * N, 2), np.full(M, bound * (1 + 1e-9)), np.repeat(np.arange(M), N), True)
    return float(np.abs(pairs.distance).min(initial=bound))


def float64(a: Array) -> Array:
    """The values in double precision, without a copy where they are."""
    return array_namespace(a).astype(a, array_namespace(a).float64, copy=False)


def _lengths(X: Array) -> Array:
    """Perimeters (M,); not finite where a node is not."""
    with np.errstate(invalid="ignore", over="ignore"):
        return length(float64(X))


def _within(X: Array, targets: Array, reach: Array, exclude: Array | None, use_loops: bool) -> NearPairs:
    """Pairs with |distance| <= reach (M,) of the curve; curves whose reach is not finite have none. X, targets: float64."""
    xp = array_namespace(X)
    n = SEARCH_REFINEMENT * X.shape[-1]
    usable = xp.isfinite(reach)
    X = xp.where(usable[:, None, None], X, xp.zeros_like(X))
    center = center_of_nodes(X)
    nodes = resample(X - center, n)
    origin = xp.mean(center, axis=0, keepdims=True)
    edge = nodes - xp.roll(nodes, 1, axis=-1)
    # a point of the curve is half an edge, more or less, from a node: a whole one is safe
    margin = reach + xp.sqrt(xp.max(edge[:, 0] ** 2 + edge[:, 1] ** 2, axis=-1))
    nodes = xp.permute_dims(nodes + (center - origin), (0, 2, 1))
    klass, size = _classes(xp.where(usable, margin, -xp.ones_like(margin)))
    if exclude is None:
        exclude = xp.full((targets.shape[0],), -1, dtype=xp.int64, device=device(X))
    propose = _propose_compiled if use_loops else _propose_by_sorting
    target, node = propose(nodes, targets - origin[..., 0], margin, klass, size, exclude)
    newton = _newton_compiled if use_loops else _newton_by_arrays
    vesicle = node // n
    pairs = _locate(X, targets, target, vesicle, (2 * pi / n) * float64(node - n * vesicle), newton)
    return pairs.subset(xp.abs(pairs.distance) <= reach[vesicle])


def _classes(margin: Array) -> tuple[Array, list[float]]:
    """Class of every curve (-1 where the margin is negative) and the width of each class's cells, no less than its margins."""
    xp = array_namespace(margin)
    widest = float(xp.max(margin)) if margin.shape[0] else -1.0
    if widest <= 0.0:
        return xp.full(margin.shape, -1, dtype=xp.int64, device=device(margin)), []
    smaller = xp.maximum(margin, xp.full_like(margin, widest * 2.0**-CLASSES)) / widest
    power = xp.astype(xp.floor(-xp.log2(smaller)), xp.int64)
    used = sorted({int(k) for k in to_numpy(xp.unique_values(power[margin >= 0.0]))})
    klass = xp.full(margin.shape, -1, dtype=xp.int64, device=device(margin))
    for k, p in enumerate(used):
        klass = xp.where((power == p) & (margin >= 0.0), xp.full_like(klass, k), klass)
    return klass, [widest * (1 + 1e-12) * 2.0**-p for p in used]


def _propose_compiled(
    nodes: np.ndarray, x: np.ndarray, margin: np.ndarray, klass: np.ndarray, size: list[float], exclude: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Target and node m n + k of every target x (P, 2) and curve m with a node k closer than margin[m], the closest; sorted."""
    if not size or not len(x):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    loops = compiled(LOOPS)
    M, n, _ = nodes.shape
    mask = (1 << ceil(log2(M * n))) - 1
    cells = loops.cell_list(nodes, klass, np.array(size), mask)
    return loops.candidates(np.ascontiguousarray(x), exclude.astype(np.int64, copy=False), cells, n, np.array(size), margin)


def _propose_by_sorting(nodes: Array, x: Array, margin: Array, klass: Array, size: list[float], exclude: Array) -> tuple[Array, Array]:
    """`_propose_compiled` in array code: nodes sorted by cell, the three rows of cells about each target found by bisection."""
    xp = array_namespace(nodes)
    M, n, _ = nodes.shape
    flat = xp.reshape(nodes, (M * n, 2))
    index = xp.arange(M * n, dtype=xp.int64, device=device(nodes))
    p = xp.arange(x.shape[0], dtype=xp.int64, device=device(nodes))
    parts = [(index[:0], index[:0], flat[:0, 0])]
    for k, width in enumerate(size):
        cell, label = _cells(flat, index, width)
        cell, label = (a[klass[label // n] == k] for a in (cell, label))
        order = xp.argsort(cell)
        cell, label = cell[order], label[order]
        at, target = _cells(x, p, width)
        at, target = xp.concat([at - ROW, at, at + ROW]), xp.concat([target, target, target])
        first = xp.searchsorted(cell, at - 1, side="left")
        number = xp.searchsorted(cell, at + 1, side="right") - first
        for t, s in _ranges(target, first, number):
            node = label[s]
            r = flat[node] - x[t]
            r2 = r[:, 0] * r[:, 0] + r[:, 1] * r[:, 1]
            m = node // n
            near = (m != exclude[t]) & (r2 <= margin[m] * margin[m])
            parts.append((t[near], node[near], r2[near]))
    t, node, r2 = (xp.concat(list(column)) for column in zip(*parts, strict=True))
    order = xp.argsort(node, stable=True)
    order = order[xp.argsort(r2[order], stable=True)]
    order = order[xp.argsort((t * M + node // n)[order], stable=True)]
    t, node = t[order], node[order]
    pair = t * M + node // n
    closest = xp.concat([xp.ones_like(pair[:1], dtype=xp.bool), pair[1:] != pair[:-1]])
    return t[closest], node[closest]


def _cells(x: Array, index: Array, width: float) -> tuple[Array, Array]:
    """Key of the cell of every x (P, 2) that has one, and its entry of index (P,)."""
    xp = array_namespace(x)
    cell = xp.floor(x / width)
    inside = xp.all(xp.abs(cell) < FARTHEST, axis=-1)
    cell = xp.astype(cell[inside], xp.int64)
    return cell[:, 0] * ROW + cell[:, 1], index[inside]


def _ranges(owner: Array, first: Array, number: Array) -> Iterator[tuple[Array, Array]]:
    """Every owner with each of first, first + 1, ..., first + number - 1, about CHUNK of them at a time."""
    xp = array_namespace(owner)
    if not owner.shape[0]:
        return
    total = xp.cumulative_sum(number)
    wanted = xp.arange(1, int(total[-1]) // CHUNK + 1, dtype=total.dtype, device=device(total)) * CHUNK
    ends = [0, *to_numpy(xp.searchsorted(total, wanted)).tolist(), owner.shape[0]]
    for begin, end in pairwise(ends):
        here = number[begin:end]
        o = xp.repeat(owner[begin:end], here)
        before = total[begin:end] - here - (total[begin] - number[begin] if end > begin else 0)
        yield o, xp.arange(o.shape[0], dtype=first.dtype, device=device(o)) + xp.repeat(first[begin:end] - before, here)


def _locate(X: Array, targets: Array, target: Array, vesicle: Array, alpha: Array, newton: Any) -> NearPairs:
    xp = array_namespace(X)
    center = center_of_nodes(X)
    r, X_a, X_aa, alpha = newton(coefficients(X - center), targets[target] - center[vesicle][..., 0], vesicle, alpha)
    speed = xp.sqrt(xp.sum(X_a**2, axis=-1))
    outside = r[:, 1] * X_a[:, 0] - r[:, 0] * X_a[:, 1]  # -(r . normal) speed
    distance = xp.copysign(xp.sqrt(xp.sum(r**2, axis=-1)), outside)
    curvature = (X_a[:, 0] * X_aa[:, 1] - X_a[:, 1] * X_aa[:, 0]) / speed**3
    bend = xp.clip(curvature * distance, -0.999, None)
    straight = xp.abs(bend) <= 1e-8
    shrink = xp.where(straight, xp.ones_like(bend), xp.log1p(bend) / xp.where(straight, xp.ones_like(bend), bend))
    return NearPairs(target, vesicle, alpha % (2 * pi), distance, xp.abs(distance) * shrink / speed)


def _newton_compiled(
    c: np.ndarray, x: np.ndarray, vesicle: np.ndarray, alpha: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """r = X - x, X_alpha, X_alphaalpha (Q, 2) and alpha (Q,) at the closest points to x (Q, 2); c (M, 2, K): coefficients."""
    if not len(alpha):
        return x, x, x, alpha
    M, _, K = c.shape
    values = np.ascontiguousarray(c.transpose(0, 2, 1)).view(np.float64).reshape(M, K, 4)
    return compiled(LOOPS).closest_points(values, x, vesicle, alpha, NEWTON_STEPS, NEWTON_ACCURACY)


def _newton_by_arrays(c: Array, x: Array, vesicle: Array, alpha: Array) -> tuple[Array, Array, Array, Array]:
    """`_newton_compiled` in array code."""
    xp = array_namespace(c)
    step = max(1, CHUNK // (8 * c.shape[-1]))
    parts = [_newton_chunk(c[vesicle[q : q + step]], x[q : q + step], alpha[q : q + step]) for q in range(0, x.shape[0], step)]
    return tuple(xp.concat(list(column)) for column in zip(*parts, strict=True)) if parts else (x, x, x, alpha)


def _newton_chunk(c: Array, x: Array, alpha: Array) -> tuple[Array, Array, Array, Array]:
    xp = array_namespace(c)
    for _ in range(NEWTON_STEPS):
        r, X_a, X_aa = (evaluate(c, alpha[:, None], order)[..., 0] for order in (0, 1, 2))
        r = r - x
        speed2 = xp.sum(X_a**2, axis=-1)
        slope = speed2 + xp.sum(r * X_aa, axis=-1)
        # beyond the centre of curvature the closest point is a maximum: there the Gauss-Newton slope, or steps could be long
        gradient = xp.sum(r * X_a, axis=-1)
        step = -gradient / xp.where((slope > 0.25 * speed2) | (xp.abs(gradient) < 0.05 * slope), slope, speed2)
        alpha = alpha + xp.clip(step, -0.5, 0.5)
        if xp.all(xp.abs(step) < NEWTON_ACCURACY):
            break
    r, X_a, X_aa = (evaluate(c, alpha[:, None], order)[..., 0] for order in (0, 1, 2))
    return r - x, X_a, X_aa, alpha
