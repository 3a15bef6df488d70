"""Short-range repulsion between membranes: a force density that grows linearly from 0 at a chosen gap to `strength` at contact.

Node i of one membrane at the distance d < reach outside another one, closest point alpha*, normal n there:

    f_i = strength (1 - d/reach) n,   and the opposite force f_i ds_i acts on the other membrane at alpha*,

spread over its nodes by its trigonometric interpolant. Total force and total torque vanish for every pair. X: (M, 2, N).
Walls repel likewise; what acts on them does not move them. In a periodic box so do images, those of a membrane's own included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from biem.backend import Array, array_namespace, count, from_numpy, scatter_add, to_numpy
from biem.curves.curve import arclength_weights, length
from biem.curves.fourier import coefficients, evaluate, interpolation_matrix
from biem.curves.lattice import Lattice
from biem.stokes.near_search import NearPairs, find_near
from biem.stokes.walls import Walls


@dataclass(frozen=True)
class Repulsion:
    """reach: gap at which it sets in, in the unit of X; strength: force per area of membrane at contact (kappa_b / length^3)."""

    reach: float
    strength: float
    walls: Walls | None = None

    def force(self, X: Array, lattice: Lattice | None = None) -> Array | None:
        """Force density f (M, 2, N) of the repulsion, or None where no gap is below the reach. lattice: the images, in a periodic box."""
        if self.walls is None:
            return self._between(X, lattice)
        of_walls = self._of_walls(to_numpy(X), self.walls)
        between = self._between(X)
        if of_walls is None:
            return between
        return from_numpy(of_walls, like=X) + (0.0 if between is None else between)

    def _of_walls(self, X: np.ndarray, walls: Walls) -> np.ndarray | None:
        """Of the walls on the membranes; where the fluid is inside the curve, its distance and its normal change sign."""
        M, _, N = X.shape
        x = X.transpose(0, 2, 1).reshape(M * N, 2)
        f = np.zeros((M * N, 2))
        for curve, side in zip(walls.curves, (-1.0, *([1.0] * (len(walls.curves) - 1))), strict=True):
            pairs = find_near(curve[None], x, self.reach * curve.shape[1] / float(length(curve[None])[0]))
            pairs = pairs.subset(side * pairs.distance < self.reach)
            count("repulsed_nodes", len(pairs))
            size = self.strength * (1.0 - side * pairs.distance / self.reach)
            np.add.at(f, pairs.target, (side * size)[:, None] * _normals(curve[None], pairs))
        return f.reshape(M, N, 2).transpose(0, 2, 1) if f.any() else None

    def contacts(self, X: Array, lattice: Lattice | None = None) -> tuple[NearPairs, np.ndarray] | None:
        """Nodes within reach of another membrane, and the forces (Q, 2) on them; None where there are none.

        pairs.vesicle: the membrane that takes the opposite force, or of whose image the node is within reach.
        """
        M, _, N = X.shape
        if M < 2 and lattice is None:
            return None
        xp = array_namespace(X)
        width = self.reach * N / float(xp.min(length(X)))
        curves, source = (X, None) if lattice is None else lattice.with_images(X, width * float(xp.max(length(X))) / N)
        X = curves[:M]
        targets = xp.reshape(xp.permute_dims(X, (0, 2, 1)), (M * N, 2))
        owner = np.repeat(np.arange(M), N)
        pairs = find_near(curves, targets, width, from_numpy(owner, like=X)).to_numpy()
        pairs = pairs.subset(pairs.distance < self.reach)
        if source is not None:
            pairs = replace(pairs, vesicle=to_numpy(source)[pairs.vesicle])
        if len(pairs) == 0:
            return None
        count("repulsed_nodes", len(pairs))
        ds = to_numpy(arclength_weights(X))
        size = self.strength * (1.0 - pairs.distance / self.reach) * ds.ravel()[pairs.target]
        return pairs, size[:, None] * _normals(to_numpy(X), pairs)

    def _between(self, X: Array, lattice: Lattice | None = None) -> Array | None:
        """Of the membranes on each other."""
        found = self.contacts(X, lattice)
        if found is None:
            return None
        pairs, F = found
        M, _, N = X.shape
        ds = to_numpy(arclength_weights(X))
        nodal = scatter_add(np.zeros((M, N, 2)), pairs.vesicle, -interpolation_matrix(pairs.alpha, N)[:, :, None] * F[:, None, :])
        nodal = scatter_add(nodal.reshape(M * N, 2), pairs.target, F).reshape(M, N, 2)
        return from_numpy(nodal.transpose(0, 2, 1) / ds[:, None, :], like=X)


def _normals(X: np.ndarray, pairs: NearPairs) -> np.ndarray:
    """Outward normals (Q, 2) of the curves X at the pairs' closest points."""
    local = X - X.mean(axis=-1, keepdims=True)
    X_alpha = evaluate(coefficients(local)[pairs.vesicle], pairs.alpha[:, None], 1)[..., 0]
    return np.stack([X_alpha[:, 1], -X_alpha[:, 0]], axis=1) / np.sqrt((X_alpha**2).sum(1))[:, None]


def work_of(f: Array | None, X: Array, displacement: Array) -> dict[str, float]:
    """The diagnostic repulsion_work: sum over the membranes of int f . displacement ds; none without a force."""
    if f is None:
        return {}
    xp = array_namespace(X)
    return {"repulsion_work": float(xp.sum(arclength_weights(X)[:, None, :] * f * displacement))}
