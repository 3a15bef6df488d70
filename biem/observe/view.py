"""Membranes at one time, with what observables take from them, each computed when first asked for. X: (M, 2, N)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from biem.curves import curve
from biem.curves.lattice import Lattice
from biem.observe.instant import Instant, instant, repulsion_of
from biem.observe.stress import contrast_stresslets, repulsive_stress, stresslets
from biem.scene.build import Problem


@dataclass(frozen=True)
class View:
    """Membranes X of the problem's scene at t. sigma (M, N): their tension as a run keeps it; solve: without it, find the tension.

    start (M, 2): the first centroids; edges (B + 1,): of the bins in y; reference_area: what stresses are per.
    """

    problem: Problem
    X: np.ndarray
    t: float
    sigma: np.ndarray | None
    solve: bool
    start: np.ndarray
    edges: np.ndarray
    reference_area: float

    @cached_property
    def tension(self) -> np.ndarray | None:
        """sigma (M, N), or None where it is neither known nor to be found."""
        return self.instant.sigma if self.sigma is None and self.solve else self.sigma

    @cached_property
    def instant(self) -> Instant:
        assert self.solve or self.sigma is not None
        return instant(self.problem, self.X, self.t, self.sigma)

    @property
    def force(self) -> np.ndarray:
        return self.instant.force

    @property
    def velocity(self) -> np.ndarray:
        return self.instant.velocity

    @cached_property
    def area(self) -> np.ndarray:
        return curve.area(self.X)

    @cached_property
    def centroid(self) -> np.ndarray:
        return curve.centroid(self.X)

    @property
    def lattice(self) -> Lattice | None:
        """The images of a periodic box at t."""
        box = self.problem.box
        return None if box is None else box.at(self.t)

    @cached_property
    def stresslets(self) -> np.ndarray:
        """S_m (M, 2, 2)."""
        repulsive = self._repulsive
        return self._pushed_by_none if repulsive is None else self._pushed_by_none + repulsive[0]

    @cached_property
    def stress(self) -> np.ndarray:
        """Sigma_p (2, 2)."""
        repulsive = self._repulsive
        whole = self._pushed_by_none.sum(axis=0) + (0.0 if repulsive is None else repulsive[1])
        return whole / self.reference_area

    @cached_property
    def _pushed_by_none(self) -> np.ndarray:
        """S_m (M, 2, 2) without repulsion."""
        assert self.tension is not None
        physics, contrast = self.problem.scene.physics, self.problem.contrast
        S = stresslets(self.X, self.tension, physics.kappa_b)
        return S if contrast is None else S + contrast_stresslets(self.X, self.velocity, contrast, physics.mu)

    @cached_property
    def _repulsive(self) -> tuple[np.ndarray, np.ndarray] | None:
        repulsion = repulsion_of(self.problem)
        return None if repulsion is None else repulsive_stress(repulsion, self.X, self.lattice)
