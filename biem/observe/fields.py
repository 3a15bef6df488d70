"""The flow of a suspension at one instant, at any points x (P, 2): velocity, pressure, vorticity, stress, and what is inside of what.

    outside     v = u_inf + sum_j S_j f_j + (1 - lambda_j) D_j u_j + the walls' answer           (lambda_j: viscosity inside over outside)
    inside j    u = v / lambda_j, and the stress of v with the outer viscosity is that of u with the inner one

f, u_j from `instant`; layers by `stokes.layer_fields`, walls as double layers, with the forces and torques of their bodies; u_inf by
`background`. On a membrane, values are the limits from outside. The pressure is 0 far away in an unbounded fluid (of u_inf: at the
origin); between walls it is determined up to a constant, and is the one of the layers; in a periodic box the layers' mean is 0, and the
points stand for their images. The stress is s = -p I + 2 mu E.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi

import numpy as np

from biem.backend import count
from biem.observe.background import background_gradient, background_velocity
from biem.observe.instant import Instant
from biem.scene.build import Problem
from biem.stokes.farfield import far_field_bytes, far_scheme
from biem.stokes.layer_fields import Layers

QUANTITIES = ("velocity", "pressure", "vorticity", "stress")
SIZES = {"velocity": 2, "pressure": 1, "vorticity": 1, "stress": 4}  # values a point
FLUID, WALL = -1, -2  # what a point is in, if not in a vesicle
CHUNK = 1 << 18  # points in work at a time
CHUNK_VALUES = 150  # float64 values in work a point of a chunk


@dataclass(frozen=True)
class Values:
    """At P points. inside (P,): the vesicle that the point is in, FLUID outside of all, WALL beyond a wall, where the rest is not a number.

    velocity (P, 2), pressure (P,), vorticity dv/dx - du/dy (P,), stress (P, 2, 2), each None where it was not asked for.
    """

    inside: np.ndarray
    velocity: np.ndarray | None = None
    pressure: np.ndarray | None = None
    vorticity: np.ndarray | None = None
    stress: np.ndarray | None = None


@dataclass(frozen=True)
class FlowField:
    """The flow around and in the membranes `at` an instant of the problem's scene.

    tolerance: aimed-at error over the largest values. disturbance: what the vesicles add to the flow that there is without them.
    """

    problem: Problem
    at: Instant
    tolerance: float = 1e-6
    disturbance: bool = False

    def values(self, points: np.ndarray, quantities: Sequence[str] = ("velocity",)) -> Values:
        """At points (P, 2). Raises ValueError for a quantity that is unknown, or that a custom flow does not have."""
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise ValueError(f"points of shape {points.shape}: expected finite numbers (P, 2)")
        unknown = [name for name in quantities if name not in QUANTITIES]
        if unknown:
            raise ValueError(f'quantity "{unknown[0]}": expected ' + ", ".join(QUANTITIES))
        count("field_points", len(points))
        parts = [self._values(points[k : k + CHUNK], quantities, len(points)) for k in range(0, max(1, len(points)), CHUNK)]
        found = [name for name in Values.__dataclass_fields__ if getattr(parts[0], name) is not None]
        return Values(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in found})

    def inside(self, points: np.ndarray) -> np.ndarray:
        """What each of points (P, 2) is in (P,): `Values.inside` alone."""
        inside = self._vesicles.inside(points)
        return inside if self.problem.walls is None else np.where(self.problem.walls.distance(points) < 0.0, WALL, inside)

    def _values(self, x: np.ndarray, quantities: Sequence[str], of: int) -> Values:
        velocity, stress = "velocity" in quantities, "stress" in quantities
        gradient = stress or "pressure" in quantities or "vorticity" in quantities
        mu, flow, walls = self.problem.scene.physics.mu, self.problem.flow, self.problem.walls
        beyond = np.zeros(len(x), dtype=bool) if walls is None else walls.distance(x) < 0.0
        fluid = x[~beyond]
        layers = self._vesicles.values(fluid, velocity, gradient, stress, of)
        u, phi, D = layers.velocity, layers.phi, layers.D
        if walls is None:
            if velocity and not self.disturbance:
                u = u + background_velocity(flow, fluid, self.at.t)
            if gradient and not self.disturbance:
                F, d = background_gradient(flow, mu, fluid)
                phi, D = phi + 0.5 * F, D + d if stress else D
        else:
            if velocity:
                u = u + walls.velocity(fluid, self._wall_density)
            if gradient:
                of_walls = self._wall_gradient(fluid)
                phi, D = phi + of_walls[0], D + of_walls[1] if stress else D

        thicker = np.ones(len(fluid)) if self.problem.contrast is None else np.append(self.problem.contrast, 1.0)[layers.inside]
        found: dict[str, np.ndarray] = {"inside": layers.inside}
        if velocity:
            found["velocity"] = u / thicker[:, None]
        if gradient:
            p = 2.0 * phi.real
            found |= {"pressure": p, "vorticity": -2.0 * phi.imag / (mu * thicker)}
        if stress:
            rows = [np.stack([D.real - p, -D.imag], axis=-1), np.stack([-D.imag, -D.real - p], axis=-1)]
            found["stress"] = np.stack(rows, axis=-2)
        kept = {name: values for name, values in found.items() if name in quantities or name == "inside"}
        return Values(**{name: _spread(values, ~beyond, WALL if name == "inside" else np.nan) for name, values in kept.items()})

    @cached_property
    def _vesicles(self) -> Layers:
        contrast = self.problem.contrast
        double = None if contrast is None else (1.0 - contrast)[:, None, None] * self.at.velocity
        lattice = None if self.problem.box is None else self.problem.box.at(self.at.t)
        return Layers(self.at.X, self.problem.scene.physics.mu, self.at.force, double, self.tolerance, lattice=lattice)

    @cached_property
    def _wall_density(self) -> np.ndarray:
        """tau (P, 2) at the nodes of the walls, of what drives them and of their answer to the vesicles."""
        walls = self.problem.walls
        assert walls is not None
        u = self._vesicles.values(walls.nodes, True, False, False).velocity
        return walls.density(-u if self.disturbance or walls.driven is None else walls.driven - u)

    def _wall_gradient(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """phi and D of the walls: their double layers, the forces lambda and the torques xi in their bodies."""
        walls, tau = self.problem.walls, self._wall_density
        assert walls is not None
        phi, D = np.zeros((2, len(x)), dtype=np.complex128)
        for k, (X, here) in enumerate(zip(walls.curves, walls.slices, strict=True)):
            sign = 1.0 if k == 0 else -1.0
            part = Layers(X[None], walls.mu, None, sign * tau[here].T[None], self.tolerance, "direct").values(x, False)
            phi, D = phi + part.phi, D + part.D
        for center, force, torque in zip(walls.centers[1:], *walls.loads(tau), strict=True):
            r, q = (x - center) @ np.array([1.0, 1.0j]), (force[0] + 1j * force[1]) / (4.0 * pi)
            phi = phi + q / r
            D = D - r.conj() * q / r**2 - q.conj() / r + 1j * torque / (2.0 * pi * r**2)
        return phi, D


def field_bytes(problem: Problem, points: float, quantities: Sequence[str], tolerance: float = 1e-6) -> float:
    """Memory of fields at so many points: their coordinates and values, twice while they are put together, and the work on a chunk."""
    M, _, N = problem.X.shape
    values = 3 + sum(SIZES[name] for name in quantities)
    at_once = min(points, CHUNK)
    n = N * max(1, -(-128 // N))
    scheme = far_scheme("auto", max(1, int(at_once)), M * n, tolerance)
    extent = np.maximum(np.ptp(problem.X, axis=(0, 2)), 1e-9)
    far = far_field_bytes(int(at_once), M, n, scheme, tolerance, (float(extent[0]), float(extent[1])))
    return 8.0 * (2.0 * values * points + CHUNK_VALUES * at_once) + 3.0 * far


def _spread(values: np.ndarray, where: np.ndarray, fill: float) -> np.ndarray:
    """values at the points `where` (P,), `fill` at the others."""
    if where.all():
        return values
    out = np.full((len(where), *values.shape[1:]), fill, dtype=values.dtype)
    out[where] = values
    return out
