"""Errors of many relaxation steps in a row: max |X - X_ref| / length after each step, every map with the corrections of the solver.

Reference: the flow of the resolved shape by exact maps at its nodes with n and n/2 steps in each dt, extrapolated (error of second order in
the step); the difference to the n steps alone is an estimate of their error, more than that of the extrapolation. After each step nodes are
redistributed, then area and length restored. A vesicle has diverged where that fails, values are not finite, or it is off by more than
DIVERGED.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from biem.backend import one_blas_thread
from biem.curves.conserve import restore_area_length
from biem.curves.curve import area, length
from biem.curves.fourier import resample
from biem.curves.reparam import redistribute
from biem.errors import NumericalFailure
from biem.membrane.maps import ExactMaps, MembraneMaps

DIVERGED = 0.25  # lengths: half of the longest vesicle
Tick = Callable[[], None]
Percentiles = dict[str, list[float | None]]


def reference(X: np.ndarray, dt: float, steps: int, substeps: int, points: int, tick: Tick) -> tuple[np.ndarray, np.ndarray]:
    """Shapes (steps + 1, n, 2, points) of the flow of resolved shapes X (n, 2, n_op), and the bound of their error (steps + 1, n).

    tick: called `steps` times.
    """
    exact = ExactMaps(points=X.shape[-1])
    with one_blas_thread():
        coarse = march(exact, X, dt, steps, substeps // 2, points, lambda: None)
        fine = march(exact, X, dt, steps, substeps, points, tick)
    f = substeps / (substeps // 2)
    best = (f * fine - coarse) / (f - 1.0)
    return best, np.abs(best - fine).max(axis=(2, 3))


def march(maps: MembraneMaps, X: np.ndarray, dt: float, steps: int, each: int, points: int, tick: Tick) -> np.ndarray:
    """Shapes (steps + 1, n, 2, points) after steps of dt, each by so many steps of the maps; NaN from where they have failed."""
    area_0, length_0 = area(X), length(X)
    states = np.full((steps + 1, len(X), 2, points), np.nan)
    states[0] = resample(X, points)
    alive = np.arange(len(X))
    for step in range(1, steps + 1):
        for _ in range(each):
            if not len(alive):
                break
            X, good = _corrected(maps.relax(X, dt / each), area_0[alive], length_0[alive])
            X, alive = X[good], alive[good]
        if len(alive):
            states[step, alive] = resample(X, points)
        tick()
    return states


def _corrected(X: np.ndarray, area_0: np.ndarray, length_0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corrected shapes, and which of them could be (n,) bool."""
    good = np.isfinite(X).all(axis=(1, 2))

    def correct(which: np.ndarray) -> None:
        if not len(which):
            return
        try:
            moved = redistribute(X[which])[0]
            X[which] = restore_area_length(moved, area_0[which], length_0[which])[0]
        except NumericalFailure:
            if len(which) == 1:
                good[which] = False
                return
            half = len(which) // 2
            correct(which[:half])
            correct(which[half:])

    X = X.copy()
    with np.errstate(all="ignore"):
        correct(np.flatnonzero(good))
    return X, good & np.isfinite(X).all(axis=(1, 2))


def errors_of_steps(states: np.ndarray, wanted: np.ndarray) -> dict[str, object]:
    """Percentiles over the vesicles after each step (from 0), those that diverged counting as infinite (None), and how many did."""
    e = np.abs(states - wanted).max(axis=(2, 3))
    e = np.where(np.isfinite(e) & (e <= DIVERGED), e, np.inf)
    e = np.where(np.logical_or.accumulate(np.isinf(e), axis=0), np.inf, e)
    rows = {"p05": 0.05, "median": 0.5, "p95": 0.95, "max": 1.0}
    found: dict[str, object] = {name: _listed(np.quantile(e, q, axis=1, method="higher")) for name, q in rows.items()}
    return found | {"diverged": int(np.isinf(e[-1]).sum()), "vesicles": e.shape[1]}


def _listed(values: np.ndarray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]
