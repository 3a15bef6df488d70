"""Rigid no-slip walls by the completed double layer: one outer wall, and bodies inside it. Nodes on wall k: X_k (2, N_k).

The velocity in the fluid that takes the values g on the walls is

    u(x) = sum_k +-D_k[tau](x) + sum over the bodies of G(x - c_k) lambda_k + xi_k (x - c_k)^perp / (4 pi mu |x - c_k|^2)

with normals that point out of the fluid (the sign), and the force and torque of each body on the fluid tied to its density,

    lambda_k = 4 pi mu/l_k int tau ds,      xi_k = 4 pi mu/l_k int tau.(x - c_k)^perp ds,      l_k its length.

On the walls  -tau/2 + (principal value and the sources) + n int n.tau ds / l_0 = g,  the last term on the outer wall, where it lifts the
null space: g has no net flux. Of the second kind, factorised once. Power & Miranda, SIAM J. Appl. Math. 47 (1987).

A plane flow past bodies that no outer wall surrounds has no solution in general (Stokes' paradox): the outer wall is obligatory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import pi

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial import cKDTree

from biem.backend import Array, all_blas_threads, array_namespace, count, from_numpy, to_numpy
from biem.stokes.cauchy import Curve
from biem.stokes.kernels import double_layer, stokeslet
from biem.stokes.near_search import locate


@dataclass(frozen=True)
class Walls:
    """Curves (2, N_k), counterclockwise, the outer wall first; centers (K, 2): a point inside each. mu: viscosity.

    driven: velocity (P, 2) of the walls at `nodes`, or None where they stand still.
    """

    curves: tuple[np.ndarray, ...]
    centers: np.ndarray
    mu: float
    driven: np.ndarray | None = None

    @cached_property
    def parts(self) -> tuple[Curve, ...]:
        return tuple(Curve(X, k == 0) for k, X in enumerate(self.curves))

    @cached_property
    def nodes(self) -> np.ndarray:
        """All nodes (P, 2), wall after wall."""
        return np.concatenate([X.T for X in self.curves])

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each wall's nodes are among all."""
        ends = np.cumsum([0, *(X.shape[1] for X in self.curves)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def _moments(self) -> np.ndarray:
        """(K-1, 3, 2P): lambda_x, lambda_y and xi of every body from the density [tau_x; tau_y]."""
        P = len(self.nodes)
        rows = np.zeros((len(self.curves) - 1, 3, 2, P))
        for row, part, here, a in zip(rows, self.parts[1:], self.slices[1:], self.centers[1:], strict=True):
            weight = 4.0 * pi * self.mu * part.ds / part.ds.sum()
            r = part.X - a[:, None]
            row[0, 0, here] = row[1, 1, here] = weight
            row[2, 0, here], row[2, 1, here] = -weight * r[1], weight * r[0]
        return rows.reshape(-1, 3, 2 * P)

    @cached_property
    def _factors(self) -> tuple[np.ndarray, np.ndarray]:
        """LU factors (2P, 2P) of the equations for [tau_x; tau_y]."""
        count("wall_factorization")
        P = len(self.nodes)
        A = np.empty((2 * P, 2 * P))
        blocks = A.reshape(2, P, 2, P)
        x, y = self.nodes.T
        for k, (part, here) in enumerate(zip(self.parts, self.slices, strict=True)):
            rx, ry = x[:, None] - part.X[0], y[:, None] - part.X[1]
            on_itself = np.arange(P)[here], np.arange(part.X.shape[1])
            rx[on_itself] = 1.0
            D_xx, D_xy, D_yy = double_layer(rx, ry, *part.normal)
            t = np.stack([-part.normal[1], part.normal[0]])
            bend = -part.curvature / (2.0 * pi)
            D_xx[on_itself], D_xy[on_itself], D_yy[on_itself] = bend * t[0] ** 2, bend * t[0] * t[1], bend * t[1] ** 2
            weight = part.ds if k == 0 else -part.ds
            blocks[0, :, 0, here], blocks[1, :, 1, here] = weight * D_xx, weight * D_yy
            blocks[0, :, 1, here] = blocks[1, :, 0, here] = weight * D_xy
        A[np.arange(2 * P), np.arange(2 * P)] -= 0.5
        for source, moments in zip(self._sources(self.nodes), self._moments, strict=True):
            A += source.transpose(1, 0, 2).reshape(2 * P, 3) @ moments
        outer, n = self.parts[0], np.zeros((2, P))
        n[:, self.slices[0]] = outer.normal
        weighted = np.zeros((2, P))
        weighted[:, self.slices[0]] = outer.normal * outer.ds / outer.ds.sum()
        A += np.outer(n.ravel(), weighted.ravel())
        with all_blas_threads():
            return lu_factor(A, overwrite_a=True, check_finite=False)

    def density(self, g: np.ndarray) -> np.ndarray:
        """tau (P, 2) for the velocity g (P, 2) at the nodes; its net flux through the outer wall, if any, is left out."""
        return lu_solve(self._factors, g.T.ravel(), check_finite=False).reshape(2, -1).T

    def velocity(self, points: Array, tau: np.ndarray) -> Array:
        """u (Q, 2) at points (Q, 2) in the fluid, as close to the walls as may be, for the density tau (P, 2)."""
        count("wall_velocity")
        xp = array_namespace(points)
        u = xp.zeros_like(points)
        for k, (part, here) in enumerate(zip(self.parts, self.slices, strict=True)):
            of_wall = part.velocity(points, tau[here].T)
            u = u + of_wall if k == 0 else u - of_wall
        for source, moments in zip(self._sources(points), self._moments, strict=True):
            u = u + xp.matmul(source, from_numpy(moments @ tau.T.ravel(), like=points))
        return u

    def answer(self, points: Array, u: Array) -> Array:
        """Velocity (Q, 2) at points (Q, 2) of the flow that cancels u (P, 2), the velocity of everything else, at the nodes."""
        return self.velocity(points, self.density(-to_numpy(u)))

    def flow(self, X: Array, t: float = 0.0) -> Array:
        """Velocity (M, 2, N) at X (M, 2, N) of the fluid that the walls' own motion drives."""
        xp = array_namespace(X)
        M, _, N = X.shape
        points = xp.reshape(xp.permute_dims(X, (0, 2, 1)), (M * N, 2))
        return xp.permute_dims(xp.reshape(self.velocity(points, self._driving_density), (M, N, 2)), (0, 2, 1))

    def loads(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force (K-1, 2) and torque (K-1,) about its center that each body exerts on the fluid."""
        values = self._moments @ tau.T.ravel()
        return values[:, :2], values[:, 2]

    def distance(self, points: Array) -> np.ndarray:
        """Distance (Q,) of points (Q, 2) to the closest wall, positive in the fluid."""
        x = to_numpy(points)
        closest = np.full(len(x), np.inf)
        for k, X in enumerate(self.curves):
            nearest = cKDTree(X.T).query(x)[1]
            zero = np.zeros(len(x), dtype=np.int64)
            d = locate(X[None], x, np.arange(len(x)), zero, 2.0 * pi * nearest / X.shape[1]).distance
            d = -d if k == 0 else d
            closest = np.where(np.abs(d) < np.abs(closest), d, closest)
        return closest

    @cached_property
    def _driving_density(self) -> np.ndarray:
        return np.zeros_like(self.nodes) if self.driven is None else self.density(self.driven)

    def _sources(self, points: Array) -> list[Array]:
        """Of every body, velocity (Q, 2, 3) at points (Q, 2) of a unit force in x, in y and a unit torque at its center."""
        xp = array_namespace(points)
        sources = []
        for center in self.centers[1:]:
            rx, ry = points[:, 0] - float(center[0]), points[:, 1] - float(center[1])
            G_xx, G_xy, G_yy = stokeslet(rx, ry, self.mu)
            scale = 1.0 / (4.0 * pi * self.mu * (rx * rx + ry * ry))
            rows = [xp.stack([G_xx, G_xy, -scale * ry], axis=-1), xp.stack([G_xy, G_yy, scale * rx], axis=-1)]
            sources.append(xp.stack(rows, axis=-2))
        return sources
