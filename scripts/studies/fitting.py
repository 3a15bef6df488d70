"""Rungs of a comparison: networks with the nodes and steps that they were trained for, frames enough of every run, and the reference."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from biem.scene.build import Problem, build
from biem.scene.config import Scene
from studies.rungs import Rung, rung, split_list
from surrogate.learned import composition
from surrogate.library import SHIPPED, find, kind_of

MOST_FRAMES = 200  # of a run of fixed steps; it has at least half as many if it has as many steps
ADAPTIVE_GROWTH = 4  # adaptive steps are expected to grow to so many times the first one, at most
REFERENCE_DT = {"t_gamma": 0.05, "t_kappa": 0.01}  # the latter in a fluid at rest
MOST_GROWTH = 2.5  # of the step from the scene's own to the reference's
REFERENCE_POINTS = 128


@dataclass(frozen=True)
class Entry:
    """A rung that is to be run. notes: what was set for it that the scene does not say; refused: why it cannot be run, or nothing."""

    rung: Rung
    notes: tuple[str, ...] = ()
    refused: str = ""
    work: float = 0.0  # in no unit: to begin with the longest

    @property
    def name(self) -> str:
        return self.rung.name


def entry(path: Path, name: str, overrides: Sequence[str] = (), weights: Path | None = None) -> Entry:
    """A rung with what it needs. Raises ValueError for what is no rung or no scene."""
    found = rung(path, name, overrides, weights)
    try:
        changes = _for_networks(found.scene, _keys(name))
    except (ValueError, FileNotFoundError) as error:
        return Entry(found, refused=str(error))
    if changes:
        solver, own = _parts(name)
        found = replace(rung(path, f"{solver}[{','.join([*changes, *own])}]", overrides, weights), name=found.name)
    notes = (f"{', '.join(_readable(change) for change in changes)}, as the networks need",) if changes else ()
    try:
        problem = build(found.scene)
    except ValueError as error:
        return Entry(found, notes, str(error))
    return Entry(replace(found, scene=with_frames(problem)), notes, work=_work(problem))


def reference_name(path: Path, overrides: Sequence[str]) -> str:
    """A scene's default reference: implicit, N = 128, order 2, steps of REFERENCE_DT, or MOST_GROWTH of the scene's own.

    Raises ValueError.
    """
    scene = rung(path, "implicit", overrides).scene
    problem = build(scene)
    unit, scale = ("t_gamma", problem.flow.time_scale) if problem.flow.time_scale else ("t_kappa", problem.t_kappa)
    settings = ["time.order=2", "time.adaptive=false", f"time.dt={min(REFERENCE_DT[unit], MOST_GROWTH * problem.dt / scale):.4g} {unit}"]
    if scene.vesicles.file is None:
        settings.insert(0, f"vesicles.points={max(REFERENCE_POINTS, scene.vesicles.points)}")
    return f"implicit[{', '.join(settings)}, solver.tolerance=1e-8]"


def coarser(path: Path, name: str, overrides: Sequence[str], weights: Path | None) -> tuple[Entry, float, str]:
    """The reference with larger steps, by how much the difference between the two is divided for the reference's own error, and in words.

    Adaptive steps: at four times the tolerance, and the whole difference. Raises ValueError.
    """
    fine = entry(path, name, overrides, weights)
    solver, own = _parts(name)
    time = fine.rung.scene.time
    if time.adaptive:
        factor, change = 1.0, f"time.tolerance={4.0 * time.tolerance!r}"
        words = f"its difference from a run at tolerance {4.0 * time.tolerance:g}"
    else:
        problem = build(fine.rung.scene)
        factor, change = 2.0**time.order - 1.0, f"time.dt={2.0 * problem.dt!r}"
        words = "its difference from a run at twice the step" + (f", over {factor:g} for order {time.order}" if factor > 1 else "")
    found = entry(path, f"{solver}[{','.join([*own, change])}]", overrides, weights)
    return replace(found, rung=replace(found.rung, name=f"{name}, coarser in time")), factor, words


def with_frames(problem: Problem) -> Scene:
    """The scene of a problem with a save_every that gives its run some MOST_FRAMES frames."""
    time = problem.scene.time
    most = MOST_FRAMES * (ADAPTIVE_GROWTH if time.adaptive else 1)
    return problem.scene.model_copy(update={"time": time.model_copy(update={"save_every": max(1, math.ceil(problem.steps / most))})})


def _for_networks(scene: Scene, own: set[str]) -> list[str]:
    """Settings that networks need and the scene, or the rung itself, does not have. own: the keys in the rung's brackets."""
    kinds = scene.solver.map_kinds
    learned = {kind for kind in kinds.values() if kind != "exact"}
    if not learned:
        return []
    folder = SHIPPED if scene.solver.weights is None else scene.folder / scene.solver.weights
    cards = [card for _, card in find(folder) if kind_of(card) in learned]
    changes = []
    points = {card.network.points for card in cards}
    if len(points) == 1 and "vesicles.points" not in own and scene.vesicles.file is None and scene.vesicles.points not in points:
        changes.append(f"vesicles.points={points.pop()}")
    known = [card.dt for card in cards if kind_of(card) == kinds["relax"] and card.network.map == "relax" and card.dt]
    if known and not own & {"time.dt", "time.order", "time.adaptive"}:
        problem = build(scene)
        unit = scene.physics.mu * problem.length**3 / scene.physics.kappa_b
        steps = [problem.dt / unit] + ([0.5 * problem.dt / unit] if scene.time.order == 2 else [])
        if scene.time.adaptive or any(composition(dt, known)[1] for dt in steps):
            changes += ["time.order=2", "time.adaptive=false", f"time.dt={float(f'{2.0 * min(known) * unit:.12g}')!r}"]
    return changes


def _parts(name: str) -> tuple[str, list[str]]:
    """The solver and the settings in brackets."""
    found = re.fullmatch(r"([\w:]+)(?:\[(.*)\])?", name.strip())
    assert found is not None  # `rung` has read it
    return found[1], split_list(found[2] or "")


def _keys(name: str) -> set[str]:
    return {setting.partition("=")[0].strip() for setting in _parts(name)[1]}


def _readable(setting: str) -> str:
    return setting.replace("=", " = ")


def _work(problem: Problem) -> float:
    """For the order in which runs begin."""
    time, kind = problem.scene.time, problem.scene.solver.kind
    passes = 3.0 if time.order == 2 or time.adaptive else 1.0
    return {"implicit": 4.0, "vesnet": 3.0, "split": 1.0}[kind] * passes * problem.steps * problem.X.shape[-1]
