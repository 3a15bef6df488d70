"""Cost of one step's maps: microseconds a vesicle on one thread, the best of a few rounds in which all maps take turns.

One step: self-tension, flow tension twice and advection of one X, relaxation of another; near layers beside. What exact maps share between
the maps of one X, the first of them pays, the self-tension; what networks share, the pose and the operator, the first that asks for it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import torch

from biem.backend import one_blas_thread
from biem.membrane.maps import MembraneMaps

ORDER = ("self_tension", "flow_tension", "flow_tension again", "advection", "relax", "near")
Cost = dict[str, float | None]


def costs(
    makers: Mapping[str, tuple[MembraneMaps, frozenset[str], float]],
    exact_near: Sequence[str],
    X: np.ndarray,
    rounds: int,
    tick: Callable[[], None],
) -> dict[str, Cost]:
    """By name of the maps: microseconds a vesicle of each call, "step" (all but near) and "step with near"; None where a map is missing.

    makers: maps, the slots that they have, and the time step of relaxation. exact_near: those whose near layers are the exact ones, which
    depend on neither the nodes of the operators nor the precision: they are taken of the first that has them. X (M, 2, N). tick: called
    once for each of makers and rounds, and of a round before them.
    """
    u = np.stack([X[:, 1], 0.0 * X[:, 0]], axis=1)
    best: dict[str, dict[str, float]] = {name: {} for name in makers}
    with one_thread(), one_blas_thread(), torch.no_grad():
        for round_ in range(rounds + 1):
            for name, (maps, slots, dt) in makers.items():
                found = {what: 1e6 * seconds / len(X) for what, seconds in _timed(maps, slots, dt, X, u).items()}
                if round_ == 1:  # the one before has loaded and compiled what there is
                    best[name] = found
                elif round_ > 1:
                    best[name] = {what: min(value, best[name][what]) for what, value in found.items()}
                tick()
    near = next((best[name]["near"] for name in exact_near if "near" in best[name]), None)
    for name in exact_near:
        if near is not None and "advection" in best[name]:
            best[name]["near"] = near
    return {name: _summed(found) for name, found in best.items()}


def _timed(maps: MembraneMaps, slots: frozenset[str], dt: float, X: np.ndarray, u: np.ndarray) -> dict[str, float]:
    X, X_star = X.copy(), X.copy()  # what maps remember of an array is not of these
    calls: dict[str, Callable[[], object]] = {
        "self_tension": lambda: maps.self_tension(X),
        "flow_tension": lambda: maps.flow_tension(X, u),
        "flow_tension again": lambda: maps.flow_tension(X, u),
        "advection": lambda: maps.advect(X, u),
        "relax": lambda: maps.relax(X_star, dt),
        "near": lambda: maps.near_layers(X, u),
    }
    seconds = {}
    for name in ORDER:
        if name.removesuffix(" again") not in slots:
            continue
        begin = time.perf_counter()
        calls[name]()
        seconds[name] = time.perf_counter() - begin
    return seconds


def _summed(found: Mapping[str, float]) -> Cost:
    operators = None if any(name not in found for name in ORDER[:4]) else sum(found[name] for name in ORDER[:4])
    step = None if operators is None or "relax" not in found else operators + found["relax"]
    both = None if step is None or "near" not in found else step + found["near"]
    return {**{name: found.get(name) for name in ORDER}, "advection and tensions": operators, "step": step, "step with near": both}


@contextmanager
def one_thread() -> Iterator[None]:
    """Everything on one thread inside the block."""
    before, torch_before = os.environ.get("OMP_NUM_THREADS"), torch.get_num_threads()
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(torch_before)
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before
