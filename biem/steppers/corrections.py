"""The two corrections after a step, as a stepper around a stepper; each use is counted in the diagnostics.

area_error and length_error in the diagnostics are the largest relative errors that the step left, before it was corrected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from biem.backend import Array, array_namespace, count, from_numpy, on_cpu, parallel_map, shares, stage, to_numpy
from biem.curves.conserve import restore_area_length
from biem.curves.curve import area, length
from biem.curves.reparam import redistribute
from biem.ranks import ALONE, Ranks
from biem.steppers.stepper import State, Stepper, StepResult

REDISTRIBUTE = "redistribute"
AREA_LENGTH = "area_length"
LEAST, MOST = 256, 2048  # vesicles that one thread corrects at a time; on fewer, threads wait for each other
CORRECTIONS = (REDISTRIBUTE, AREA_LENGTH)


@dataclass(frozen=True)
class Corrected:
    """`inner`, then nodes redistributed to equal arclength, then area and length restored to area_0, length_0 (M,).

    What a solver predicts the coupling velocity from stays with its node: redistribution is part of a node's motion.
    """

    inner: Stepper
    corrections: tuple[str, ...]
    area_0: Array
    length_0: Array
    ranks: Ranks = ALONE

    def step(self, state: State, dt: float) -> StepResult:
        result = self.inner.step(state, dt)
        X, sigma = result.state.X, result.state.sigma
        xp = array_namespace(X)
        area_0, length_0 = (from_numpy(to_numpy(a), like=X) for a in (self.area_0, self.length_0))
        diagnostics = dict(result.diagnostics)
        for name, error in (("area", xp.abs(area(X) / area_0 - 1.0)), ("length", xp.abs(length(X) / length_0 - 1.0))):
            worst = int(xp.argmax(error))
            diagnostics[f"{name}_error"] = float(error[worst])
            diagnostics[f"{name}_error_vesicle"] = worst
        if not self.corrections or not bool(xp.all(xp.isfinite(X))):  # what is not finite is the guard's to reject
            return StepResult(result.state, diagnostics)

        if REDISTRIBUTE in self.corrections:

            def redistributed(which: slice) -> tuple[Array, int]:
                moved = redistribute(X[which], *([] if sigma is None else [sigma[which]]), first=which.start)
                return xp.concat([moved[0], *(f[:, None, :] for f in moved[1:])], axis=1), which.stop - which.start

            with stage("redistribution"):
                both, moved = self._by_chunk(X, redistributed)
            count("redistributed", moved)
            X, sigma = both[:, :2], None if sigma is None else both[:, 2]
        if AREA_LENGTH in self.corrections:
            Y = X
            restore = lambda which: restore_area_length(Y[which], area_0[which], length_0[which], first=which.start)
            with stage("area and length"):
                X, restored = self._by_chunk(Y, restore)
            count("area_length_restored", restored)
        return StepResult(replace(result.state, X=X, sigma=sigma), diagnostics)

    def _by_chunk(self, X: Array, correct: Callable[[slice], tuple[Array, int]]) -> tuple[Array, int]:
        """What `correct` makes of slices of the vesicles, joined, and the sum of its counts."""
        xp = array_namespace(X)

        def all_of(mine: slice) -> tuple[Array, int]:
            if not on_cpu(X):
                return correct(mine)
            parts = parallel_map(correct, shares(mine.start, mine.stop, LEAST, MOST))
            return xp.concat([part for part, _ in parts], axis=0), sum(n for _, n in parts)

        joined, counts = self.ranks.gather_all(X.shape[0], all_of)
        return joined, sum(counts)
