"""Which targets are close to which curve: true distance to the curve, not to its nodes. X: (M, 2, N), targets: (P, 2).

A tree over the nodes proposes (target, curve) pairs; Newton's method on the Fourier series gives the closest parameter, the signed
distance (positive outside) and from it the pair's resolution
    rho = |log(1 + c d)/c| / speed,      c: curvature at the closest point,
the distance from the real axis of the complex parameter at which the curve (taken as its osculating circle) passes through the
target. The n-node trapezoid rule errs there by about exp(-n rho) for smooth densities. Everything here runs in float64 NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from biem.backend import Array, count, to_numpy
from biem.curves.curve import length
from biem.curves.fourier import coefficients, evaluate, resample

SEARCH_REFINEMENT = 4  # nodes of the tree per node of the curve


@dataclass(frozen=True)
class NearPairs:
    """Pairs of a target and a curve near it, NumPy arrays of one length Q."""

    target: np.ndarray  # index of the target
    vesicle: np.ndarray  # index of the curve
    alpha: np.ndarray  # parameter of the closest point
    distance: np.ndarray  # signed, positive outside
    rho: np.ndarray  # resolution of the pair

    def __len__(self) -> int:
        return len(self.target)

    def subset(self, which: np.ndarray) -> NearPairs:
        """The pairs selected by a mask or an index array."""
        return NearPairs(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def locate(X: Array, targets: Array, target: np.ndarray, vesicle: np.ndarray, alpha: np.ndarray) -> NearPairs:
    """Closest points for given pairs, from starting parameters alpha (Q,), by Newton's method on |X(alpha) - target|^2."""
    X = to_numpy(X).astype(np.float64)
    x = to_numpy(targets).astype(np.float64)[target][:, :, None]
    origin = X.mean(axis=-1, keepdims=True)[vesicle]
    c = coefficients(X - X.mean(axis=-1, keepdims=True))[vesicle]
    alpha = alpha.copy()
    for _ in range(8):
        r = (evaluate(c, alpha[:, None]) + (origin - x))[..., 0]
        X_a = evaluate(c, alpha[:, None], 1)[..., 0]
        X_aa = evaluate(c, alpha[:, None], 2)[..., 0]
        speed2 = (X_a**2).sum(-1)
        slope = speed2 + (r * X_aa).sum(-1)
        # beyond the centre of curvature the closest point is a maximum: keep the Gauss-Newton slope there
        step = -(r * X_a).sum(-1) / np.where(slope > 0.25 * speed2, slope, speed2)
        step = np.clip(step, -0.5, 0.5)
        alpha += step
        if np.all(np.abs(step) < 1e-13):
            break
    r = (origin - x + evaluate(c, alpha[:, None]))[..., 0]
    X_a = evaluate(c, alpha[:, None], 1)[..., 0]
    X_aa = evaluate(c, alpha[:, None], 2)[..., 0]
    speed = np.sqrt((X_a**2).sum(-1))
    outside = r[:, 1] * X_a[:, 0] - r[:, 0] * X_a[:, 1]  # -(r . normal) speed
    distance = np.copysign(np.sqrt((r**2).sum(-1)), outside)
    curvature = (X_a[:, 0] * X_aa[:, 1] - X_a[:, 1] * X_aa[:, 0]) / speed**3
    bend = np.maximum(curvature * distance, -0.999)
    shrink = np.where(np.abs(bend) > 1e-8, np.log1p(bend) / np.where(bend == 0, 1, bend), 1.0)
    return NearPairs(target, vesicle, np.mod(alpha, 2 * np.pi), distance, np.abs(distance) * shrink / speed)


def find_near(X: Array, targets: Array, width: float, exclude: Array | None = None) -> NearPairs:
    """All (target, curve) pairs with |distance| <= width * h, h = length/N of the curve.

    exclude (P,): index of the curve that a target belongs to and is not tested against (-1: none). Pairs are sorted by target.
    """
    count("near_search")
    X = to_numpy(X).astype(np.float64)
    targets = to_numpy(targets).astype(np.float64)
    M, _, N = X.shape
    n = SEARCH_REFINEMENT * N
    origin = X.mean(axis=(0, 2))
    nodes = (resample(X, n) - origin[:, None]).transpose(0, 2, 1).reshape(M * n, 2)
    reach = width * length(X) / N
    node_gap = np.sqrt(((nodes.reshape(M, n, 2) - np.roll(nodes.reshape(M, n, 2), 1, axis=1)) ** 2).sum(-1)).max()
    near = cKDTree(targets - origin).sparse_distance_matrix(cKDTree(nodes), reach.max() + node_gap, output_type="ndarray")
    target, vesicle, k = near["i"], near["j"] // n, near["j"] % n
    keep = near["v"] <= (reach + node_gap)[vesicle]
    if exclude is not None:
        keep &= to_numpy(exclude)[target] != vesicle
    target, vesicle, k, gap = target[keep], vesicle[keep], k[keep], near["v"][keep]
    order = np.lexsort((gap, vesicle, target))
    target, vesicle, k = target[order], vesicle[order], k[order]
    first = np.ones(len(target), dtype=bool)
    first[1:] = (target[1:] != target[:-1]) | (vesicle[1:] != vesicle[:-1])
    pairs = locate(X, targets, target[first], vesicle[first], 2 * np.pi * k[first] / n)
    return pairs.subset(np.abs(pairs.distance) <= reach[pairs.vesicle])


def minimum_gap(X: Array) -> float:
    """Smallest distance of a node to another curve (M, 2, N); infinite for one curve."""
    X = to_numpy(X)
    M, _, N = X.shape
    if M < 2:
        return float("inf")
    targets, owner = X.transpose(0, 2, 1).reshape(M * N, 2), np.repeat(np.arange(M), N)
    width = 1.0
    while True:
        distance = find_near(X, targets, width, owner).distance
        if len(distance):
            return float(np.abs(distance).min())
        width *= 2.0
