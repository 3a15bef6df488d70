"""Observables of a suspension, frame by frame, and the rows that they make up. Quantities: biem.observe.quantities.

Rows come from the shapes alone, with the tension found anew (as accurate as the shapes are), or from shapes and the tension that the
solver kept, which in the split solver lags by up to a step and is not known at the first frame: there its quantities are NaN.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod

import numpy as np

from biem.backend import count
from biem.curves.curve import centroid
from biem.observe import motion
from biem.observe.quantities import Quantity, select
from biem.observe.stress import reference_area
from biem.observe.view import View
from biem.scene.build import Problem

BINS = 20


@dataclass(frozen=True)
class Observations:
    """Rows: t (F,), step (F,), values: name -> (F, ...) with the shape of the quantity behind F; quantities: what they are.

    edges (B + 1,): of the bins in y, pairs (P, 2): vesicles of each pair, both empty where no quantity has them.
    about: what the rows were made of and how, in words, by name; header lines and attributes of the files.
    """

    t: np.ndarray
    step: np.ndarray
    values: Mapping[str, np.ndarray]
    quantities: tuple[Quantity, ...]
    edges: np.ndarray
    pairs: np.ndarray
    about: Mapping[str, str | float]

    def __len__(self) -> int:
        return len(self.t)

    def where(self, keep: np.ndarray) -> Observations:
        """The rows selected by a mask (F,) or by indices."""
        return replace(self, t=self.t[keep], step=self.step[keep], values={name: v[keep] for name, v in self.values.items()})


def join(parts: Sequence[Observations]) -> Observations:
    """Rows of all parts in turn; the parts are of the same quantities."""
    t, step = (np.concatenate([getattr(p, name) for p in parts]) for name in ("t", "step"))
    return replace(parts[0], t=t, step=step, values={name: np.concatenate([p.values[name] for p in parts]) for name in parts[0].values})


@dataclass(frozen=True)
class Observer:
    """What is observed of a problem. start (M, 2): the centroids at the first frame; solve: find the tension, do not take the solver's."""

    problem: Problem
    quantities: tuple[Quantity, ...]
    start: np.ndarray
    solve: bool
    edges: np.ndarray
    pairs: np.ndarray
    area: float
    about: Mapping[str, str | float]

    @classmethod
    def of(
        cls, problem: Problem, names: Iterable[str] | None = None, *, solve: bool = True, running: bool = False, bins: int = BINS
    ) -> Observer:
        """The observer of a problem whose X is the first frame. names, running: as of `select`. Raises ValueError as that does."""
        chosen = select(problem, names, running)
        places = {q.place for q in chosen}
        width, M = motion.channel_width(problem), len(problem.X)
        edges = np.linspace(-width, width, bins + 1) if "bins" in places and width is not None else np.zeros(0)
        pairs = motion.pairs(M) if "pairs" in places else np.zeros((0, 2), dtype=np.int64)
        area, name, _ = reference_area(problem)
        physics = problem.scene.physics
        about: dict[str, str | float] = {
            "scene_name": problem.scene.name,
            "units": "of the scene: length as vesicles.length, kappa_b, mu, time; kappa_b = mu length^3 / time",
            "kappa_b": physics.kappa_b,
            "mu": physics.mu,
            "flow": problem.flow.kind,
            "rate": problem.flow.rate or 0.0,
            "reference_area": area,
            "reference_area_is": name,
            "tension": "found anew from the shapes" if solve else "as the solver kept it (NaN at the first frame, which has none)",
        }
        return cls(problem, chosen, centroid(problem.X), solve, edges, pairs, area, about)

    def row(self, X: np.ndarray, t: float, step: int, sigma: np.ndarray | None = None) -> Observations:
        """One row, of membranes X (M, 2, N) with the tension sigma (M, N) that a run has kept, if it is to be taken."""
        count("observed")
        view = self._view(X, t, None if self.solve else sigma)
        values = {q.name: q.evaluate(view)[None] for q in self.quantities}
        return replace(self.nothing(), t=np.array([t]), step=np.array([step]), values=values)

    def nothing(self) -> Observations:
        """No row yet."""
        empty = {name: np.zeros((0, *shape)) for name, shape in self._shapes().items()}
        return Observations(np.zeros(0), np.zeros(0, dtype=np.int64), empty, self.quantities, self.edges, self.pairs, self.about)

    @property
    def bytes(self) -> int:
        """Of a row, with its time and step."""
        return 8 * (2 + sum(prod(shape) for shape in self._shapes().values()))

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        view = self._view(self.problem.X, 0.0, None)
        return {q.name: q.shape(view) for q in self.quantities}

    def _view(self, X: np.ndarray, t: float, sigma: np.ndarray | None) -> View:
        return View(self.problem, X, t, sigma, self.solve, self.start, self.edges, self.area)
