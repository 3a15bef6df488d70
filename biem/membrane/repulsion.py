"""Short-range repulsion between membranes: a force density that grows linearly from 0 at a chosen gap to `strength` at contact.

Node i of one membrane at the distance d < reach outside another one, closest point alpha*, normal n there:

    f_i = strength (1 - d/reach) n,   and the opposite force f_i ds_i acts on the other membrane at alpha*,

spread over its nodes by its trigonometric interpolant. Total force and total torque vanish for every pair. X: (M, 2, N).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace

from biem.backend import Array, count, from_numpy, scatter_add, to_numpy
from biem.curves.curve import arclength_weights, length
from biem.curves.fourier import coefficients, evaluate, interpolation_matrix
from biem.stokes.near_search import find_near


@dataclass(frozen=True)
class Repulsion:
    """reach: gap at which it sets in, in the unit of X; strength: force per area of membrane at contact (kappa_b / length^3)."""

    reach: float
    strength: float

    def force(self, X: Array) -> Array | None:
        """Force density f (M, 2, N) of the repulsion, or None where no gap is below the reach."""
        M, _, N = X.shape
        if M < 2:
            return None
        xp = array_namespace(X)
        targets = xp.reshape(xp.permute_dims(X, (0, 2, 1)), (M * N, 2))
        owner = np.repeat(np.arange(M), N)
        width = self.reach * N / float(xp.min(length(X)))
        pairs = find_near(X, targets, width, from_numpy(owner, like=X)).to_numpy()
        pairs = pairs.subset(pairs.distance < self.reach)
        if len(pairs) == 0:
            return None
        count("repulsed_nodes", len(pairs))
        local = to_numpy(X) - to_numpy(X).mean(axis=-1, keepdims=True)
        X_alpha = evaluate(coefficients(local)[pairs.vesicle], pairs.alpha[:, None], 1)[..., 0]
        normal = np.stack([X_alpha[:, 1], -X_alpha[:, 0]], axis=1) / np.sqrt((X_alpha**2).sum(1))[:, None]
        ds = to_numpy(arclength_weights(X))
        F = (self.strength * (1.0 - pairs.distance / self.reach) * ds.ravel()[pairs.target])[:, None] * normal
        nodal = scatter_add(np.zeros((M, N, 2)), pairs.vesicle, -interpolation_matrix(pairs.alpha, N)[:, :, None] * F[:, None, :])
        nodal = scatter_add(nodal.reshape(M * N, 2), pairs.target, F).reshape(M, N, 2)
        return from_numpy(nodal.transpose(0, 2, 1) / ds[:, None, :], like=X)


def work_of(f: Array | None, X: Array, displacement: Array) -> dict[str, float]:
    """The diagnostic repulsion_work: sum over the membranes of int f . displacement ds; none without a force."""
    if f is None:
        return {}
    xp = array_namespace(X)
    return {"repulsion_work": float(xp.sum(arclength_weights(X)[:, None, :] * f * displacement))}
