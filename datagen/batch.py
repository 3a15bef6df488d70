"""Many vesicles, each in a fluid of its own, advanced as one array, on as many nodes as each shape needs. mu = kappa_b = length = 1.

A shape is resolved on N nodes where little of it is in the highest third of their modes, with z = x + i y = sum_k c_k e^{i k alpha}:

    tail(X, N)^2 = sum_{|k| > N/3} |c_k|^2 / sum_{k /= 0} |c_k|^2  <=  tolerance^2

A run that is not resolved at the end of an interval, or that fails in it, repeats it on the next finer nodes, as long as there are any;
one that the next coarser nodes resolve, with a margin, goes on with those.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from biem.backend import Array, array_namespace, count, from_numpy, to_numpy
from biem.curves.crossing import self_crossings
from biem.curves.fourier import remove_nyquist, resample
from biem.errors import NumericalFailure
from biem.membrane.maps import ExactMaps
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import Flow, State, StepResult

OPERATOR_POINTS = {32: 64, 64: 96}  # nodes that operators are built at, by nodes of the membrane; else as many as `operator_points` says
MARGIN = 0.2  # of the tolerance: below it on the next coarser nodes, a run goes on with those
MAX_ERROR = 1e-2  # relative, of area and length in a step


@dataclass(frozen=True)
class Group:
    """Runs (their positions in the batch, ascending) that are on one number of nodes, and their state."""

    runs: np.ndarray
    state: State

    @property
    def points(self) -> int:
        return int(self.state.X.shape[-1])

    def of(self, members: np.ndarray) -> Group:
        """The members where the mask (B,) is true."""
        chosen = np.flatnonzero(members)
        return Group(self.runs[chosen], _each(lambda f: f[from_numpy(chosen, f)], self.state))

    def on(self, points: int) -> Group:
        """The same on other nodes."""
        return replace(self, state=_each(lambda f: remove_nyquist(resample(f, points)), self.state))


@dataclass(frozen=True)
class Batch:
    """How runs are advanced. flow(runs, like): velocity of these runs, for arrays like that; area: of every membrane.

    ladder: numbers of nodes, ascending.
    """

    flow: Callable[[np.ndarray, Array], Flow | None]
    area: float
    ladder: tuple[int, ...]
    tolerance: float

    def start(self, X: Array) -> list[Group]:
        """The shapes X (B, 2, n) on the fewest nodes that resolve them."""
        left, groups = Group(np.arange(X.shape[0]), State(0.0, X)), []
        for n in self.ladder:
            enough = (tail(left.state.X, n) <= self.tolerance) | (n == self.ladder[-1])
            groups += [left.of(enough).on(n)] if enough.any() else []
            left = left.of(~enough)
        return groups

    def advance(self, groups: list[Group], dt: float, steps: int) -> list[Group]:
        """The groups after an interval of so many steps; runs that failed on the finest nodes are left out."""
        todo, done = list(groups), []
        while todo:
            group = todo.pop()
            finer = min((n for n in self.ladder if n > group.points), default=None)
            for before, after in self._attempts(group, dt, steps):
                kept = np.zeros(len(before.runs), dtype=bool)
                if after is not None:
                    kept = (tail(after.state.X, group.points) <= self.tolerance) | (finer is None)
                    done += self._coarsened(after.of(kept))
                if finer is not None and not kept.all():
                    count("intervals_repeated", int((~kept).sum()))
                    todo.append(before.of(~kept).on(finer))
        return [_joined([g for g in done if g.points == n]) for n in self.ladder if any(g.points == n for g in done)]

    def _coarsened(self, group: Group) -> list[Group]:
        coarser = max((n for n in self.ladder if n < group.points), default=group.points)
        enough = tail(group.state.X, coarser) <= MARGIN * self.tolerance
        return [group.of(members).on(n) for members, n in ((enough, coarser), (~enough, group.points)) if members.any()]

    def _attempts(self, group: Group, dt: float, steps: int) -> Iterator[tuple[Group, Group | None]]:
        """Parts of the group before and after the steps, after: None of a single run that fails; a group that fails is halved."""
        after = self._marched(group, dt, steps)
        if after is not None or len(group.runs) == 1:
            yield group, after
            return
        first = np.arange(len(group.runs)) < len(group.runs) // 2
        for half in (first, ~first):
            yield from self._attempts(group.of(half), dt, steps)

    def _marched(self, group: Group, dt: float, steps: int) -> Group | None:
        """The group after the steps, None where any of its runs fails."""
        maps = ExactMaps(points=OPERATOR_POINTS.get(group.points))
        inner = SplitStepper(maps, 1.0, 1.0, self.flow(group.runs, group.state.X), interacting=False)
        ones = np.ones(len(group.runs))
        stepper, state = Corrected(inner, CORRECTIONS, self.area * ones, ones), group.state
        try:
            with np.errstate(all="ignore"):  # what is not finite is rejected
                for _ in range(steps):
                    state = _accepted(stepper.step(state, dt))
        except (NumericalFailure, np.linalg.LinAlgError):
            return None
        return None if self_crossings(state.X) else replace(group, state=state)


def tail(X: Array, points: int) -> np.ndarray:
    """Share (B,) of the shapes X (B, 2, n) in the highest third of the modes of `points` nodes, and beyond."""
    values = to_numpy(X)
    n = values.shape[-1]
    power = np.abs(np.fft.fft(values[:, 0] + 1j * values[:, 1])) ** 2
    k = np.abs(np.fft.fftfreq(n, 1.0 / n))
    return np.sqrt(power[:, k > points / 3].sum(axis=1) / power[:, k > 0].sum(axis=1))


def _accepted(result: StepResult) -> State:
    """The state after a step. Raises NumericalFailure where it is not finite, or area or length of a vesicle were lost."""
    X = result.state.X
    xp = array_namespace(X)
    error = max(result.diagnostics["area_error"], result.diagnostics["length_error"])
    if not (error <= MAX_ERROR and bool(xp.all(xp.isfinite(X)))):
        raise NumericalFailure(f"area or length is off by {error:.1e}")
    return result.state


def _each(function: Callable[..., Array], *states: State) -> State:
    """One state, at the time of the first, whose arrays are function(those of all states)."""
    first = states[0]
    coupling = first.coupling
    if coupling is not None:
        velocities, rates = zip(*((s.coupling[1], s.coupling[2]) for s in states if s.coupling is not None), strict=True)
        coupling = (coupling[0], function(*velocities), function(*rates))
    return State(first.t, function(*(s.X for s in states)), None, coupling)


def _joined(groups: list[Group]) -> Group:
    """Groups on the same nodes as one, its runs in order."""
    runs = np.concatenate([g.runs for g in groups])
    order = np.argsort(runs)
    joined = _each(lambda *f: array_namespace(f[0]).concat(f, axis=0)[from_numpy(order, f[0])], *(g.state for g in groups))
    return Group(runs[order], joined)
