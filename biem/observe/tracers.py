"""Points without size that the flow carries along with the membranes, by Heun's rule on the run's own steps.

    y = x + dt u(t, x; X),     x_next = x + dt/2 (u(t, x; X) + u(t + dt, y; X_next)),     u: `fields`, from the shapes alone

It is of second order; a step solves for the tension once. A tracer belongs to a vesicle, or to the fluid between, for good: where the
membrane as it was stepped passes over it, it is put back to its side, onto the normal of the closest point. So is one that a wall
would take, but for an opening (where the wall moves outwards, as at the end of a channel): there it has left, and is not a number.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi

import numpy as np

from biem.backend import count
from biem.curves.curve import length, normal
from biem.curves.fourier import interpolation_matrix
from biem.observe.fields import FLUID, WALL, FlowField
from biem.observe.grid import box_around
from biem.observe.instant import Instant, instant
from biem.scene.build import Problem
from biem.scene.config import TracersTable
from biem.scene.tracers import tracers_from_file
from biem.stokes.near_search import locate

TOLERANCE = 1e-8  # of forces and velocities
OPENING = 1e-9  # of the largest velocity of the walls: one that moves outwards faster than that lets the fluid out
BESIDE = 1e-6  # lengths from the membrane where a tracer is put back
MOST_DRAWS = 100_000  # random places for one that is where tracers are asked for
DRAWN_AT_ONCE = 1000  # at least


@dataclass(frozen=True)
class Tracers:
    """x (P, 2), not a number where a tracer has left; vesicle (P,): where each belongs, FLUID for the fluid between."""

    x: np.ndarray
    vesicle: np.ndarray


def place_tracers(problem: Problem, most: int | None = None) -> Tracers | None:
    """The tracers of a scene at the start, of random ones not more than `most`; None where it has none.

    Raises ValueError where there is no place for them.
    """
    table = problem.scene.tracers
    if table is None:
        return None
    still = FlowField(problem, Instant(0.0, problem.X, 0.0 * problem.X[:, 0], 0.0 * problem.X, 0.0 * problem.X))
    if table.file is not None:
        x = tracers_from_file(problem.scene.folder / table.file)
        inside = still.inside(x)
        beyond = np.flatnonzero(inside == WALL)
        if len(beyond):
            raise ValueError(f"tracers.file {table.file}: point {beyond[0]} is not in the fluid: move it between the walls")
        return Tracers(x, inside)
    assert table.count is not None
    wanted = table.count if most is None else min(table.count, most)
    corner, sides = _box(table, problem)
    rng = np.random.default_rng([table.seed, 2])
    x, inside = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    tried = 0
    while tried <= MOST_DRAWS * (1 + len(x)):
        drawn = corner + sides * rng.random((max(wanted, DRAWN_AT_ONCE), 2))
        tried += len(drawn)
        at = still.inside(drawn)
        here = (at != WALL) & ((table.region == "all") | ((at == FLUID) == (table.region == "outside")))
        x, inside = np.concatenate([x, drawn[here]]), np.concatenate([inside, at[here]])
        if len(x) >= wanted:
            return Tracers(x[:wanted], inside[:wanted])
    raise ValueError(f'tracers: no place for {table.count} of them in the box, region = "{table.region}": choose a box with more of it')


@dataclass
class Carrier:
    """Moves the tracers of a run. It keeps the flow after a step, which is the one before the next."""

    problem: Problem
    _flow: FlowField | None = field(default=None, init=False)

    def carry(self, tracers: Tracers, X: np.ndarray, t: float, X_next: np.ndarray, t_next: float) -> Tracers:
        """Tracers after the step from membranes X at t to X_next at t_next, each (M, 2, N). Raises NumericalFailure as `instant` does."""
        count("tracer_steps")
        before, after = self._at(X, t), self._at(X_next, t_next)
        self._flow = after
        here = np.isfinite(tracers.x).all(axis=1)
        x, vesicle, dt = tracers.x[here], tracers.vesicle[here], t_next - t
        u = _velocity(before, x)
        y = self._keep(before, x + dt * u, vesicle)  # at t, where a predicted point may be beyond a wall
        there = np.isfinite(y).all(axis=1)
        u[there] = 0.5 * (u[there] + _velocity(after, y[there]))
        out = tracers.x.copy()
        out[here] = self._keep(after, x + dt * u, vesicle)
        return Tracers(out, tracers.vesicle)

    def _at(self, X: np.ndarray, t: float) -> FlowField:
        known = self._flow
        if known is not None and known.at.t == t and np.array_equal(known.at.X, X):
            return known
        return FlowField(self.problem, instant(self.problem, X, t, tolerance=TOLERANCE), TOLERANCE)

    def _keep(self, flow: FlowField, x: np.ndarray, vesicle: np.ndarray) -> np.ndarray:
        """Points (P, 2) on the sides where they belong; not a number where they have left."""
        inside = flow.inside(x)
        wrong = np.flatnonzero((inside != vesicle) & np.isfinite(x).all(axis=1))
        if not len(wrong):
            return x
        x = x.copy()
        for p in wrong:
            if inside[p] == WALL:
                x[p] = self._off_the_wall(x[p])
            else:
                m = vesicle[p] if vesicle[p] != FLUID else inside[p]
                near = self._image_at(flow, x[p], m)
                x[p] += _beside(flow.at.X[m], near, -1.0 if vesicle[p] != FLUID else 1.0) - near
        count("tracers_put_back", int(np.isfinite(x[wrong]).all(axis=1).sum()))
        return x

    def _image_at(self, flow: FlowField, x: np.ndarray, m: int) -> np.ndarray:
        """The image of the point x (2,) that is at vesicle m, in a periodic box."""
        box, center = self.problem.box, flow.at.X[m].mean(axis=-1)
        return x if box is None else center + box.at(flow.at.t).wrapped((x - center)[None])[0]

    def _off_the_wall(self, x: np.ndarray) -> np.ndarray:
        """Back in the fluid, or not a number where there is an opening."""
        walls = self.problem.walls
        assert walls is not None
        squares = [((X - x[:, None]) ** 2).sum(axis=0) for X in walls.curves]
        k = int(np.argmin([square.min() for square in squares]))
        outwards = 1.0 if k == 0 else -1.0
        if walls.driven is not None:
            node = int(squares[k].argmin())
            through = walls.driven[walls.slices[k]][node] @ (outwards * walls.parts[k].normal[:, node])
            if through > OPENING * np.abs(walls.driven).max():
                return np.full(2, np.nan)
        return _beside(walls.curves[k], x, -outwards)


def _velocity(flow: FlowField, x: np.ndarray) -> np.ndarray:
    u = flow.values(x).velocity
    assert u is not None
    return u


def _beside(X: np.ndarray, x: np.ndarray, side: float) -> np.ndarray:
    """The point (2,) on the curve X (2, N) closest to x (2,), moved outwards (side 1) or inwards (-1)."""
    nearest = ((X - x[:, None]) ** 2).sum(axis=0).argmin()
    zero = np.zeros(1, dtype=np.int64)
    alpha = locate(X[None], x[None], zero, zero, np.array([2.0 * pi * nearest / X.shape[1]])).alpha
    at = interpolation_matrix(alpha, X.shape[1])[0]
    outwards = normal(X[None])[0] @ at
    return X @ at + side * BESIDE * float(length(X[None])[0]) * outwards / np.hypot(*outwards)


def _box(table: TracersTable, problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Corner and sides (2,) of where tracers are drawn: the table's box, or all of the fluid that there is around the membranes."""
    if table.box is None:
        x0, y0, x1, y1 = box_around(problem.X, () if problem.walls is None else problem.walls.curves)
        return np.array([x0, y0]), np.array([x1 - x0, y1 - y0])
    sides = np.asarray(table.box)
    return np.asarray(table.corner) if table.corner is not None else -0.5 * sides, sides
