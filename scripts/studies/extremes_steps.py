"""How large a time step may be: doubled until a run breaks, for every number of nodes, capillary number and rung. Two vesicles in shear.

A step is stable where the run to 2 t_gamma, and of 20 steps at least, is not rejected; accurate where positions and shapes are then
within 1 % of R of those by steps of 0.005 t_gamma of second order at as many nodes, over 2 t_gamma.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from biem.run.files import one_line, write_atomically
from biem.scene.config import make_scene
from studies.differences import differences
from studies.extremes_grid import RUNGS, STEP, by_rung, learned, merged, pair, radius, times
from studies.runs import Kept, kept

AXIS = "dt"
POINTS, CAPILLARIES = (16, 32, 128), (1.0, 5.0, 50.0, 500.0)
NETWORK_POINTS = 32
HORIZON, LEAST_STEPS = 2.0, 20  # t_gamma
FIRST, SMALLEST, LARGEST, REFERENCE = 0.02, 0.0025, 50.0, 0.005  # dt, t_gamma
ACCURATE = 0.01  # R
FRAMES = 20  # of a run, about
BOUND = 900.0  # s of a run
COLOURS = dict(zip(RUNGS, ("black", "tab:blue", "tab:green", "tab:orange", "tab:red"), strict=True))


@dataclass(frozen=True)
class Ladder:
    """Steps of one kind of run."""

    points: int
    capillary: float
    rung: str

    @property
    def unit(self) -> float:
        """t_gamma."""
        return radius() ** 3 / self.capillary


@dataclass(frozen=True)
class Tried:
    """A step dt, in t_gamma. error: R, None where the run broke; line: why."""

    dt: float
    stable: bool
    error: float | None
    line: str = ""


@dataclass(frozen=True)
class Measured:
    """All steps that were tried of a ladder."""

    ladder: Ladder
    tried: Sequence[Tried]

    @property
    def stable(self) -> float | None:
        """The largest step below which all are stable, t_gamma."""
        good = []
        for step in sorted(self.tried, key=lambda step: step.dt):
            if not step.stable:
                break
            good.append(step.dt)
        return good[-1] if good else None

    @property
    def accurate(self) -> float | None:
        """The largest accurate step, t_gamma."""
        return max((step.dt for step in self.tried if step.error is not None and step.error <= ACCURATE), default=None)


def ladders() -> list[Ladder]:
    """All, those of networks at their number of nodes alone."""
    return [
        Ladder(points, capillary, rung)
        for rung in RUNGS
        for points in POINTS
        for capillary in CAPILLARIES
        if not learned(rung) or points == NETWORK_POINTS
    ]


def measure(ladder: Ladder, folder: Path, again: bool = False) -> Measured:
    """Steps doubled until they break, and halved until they are accurate; from its file where that is there."""
    path = _path(ladder, folder)
    if path.exists() and not again:
        return _read(path)
    base = merged(pair(), {"vesicles": {"points": ladder.points}, "flow": {"capillary": ladder.capillary}})
    exact = by_rung(base, "implicit" if ladder.rung == "implicit" else "split")
    reference = _run(exact, REFERENCE * ladder.unit, HORIZON * ladder.unit, path.with_name("reference"), order=2)
    tried = []
    for dt in _upward(ladder):
        tried.append(_try(ladder, base, dt, reference, path))
        if not tried[-1].stable:
            break
    for dt in _downward(ladder):
        if any(step.error is not None and step.error <= ACCURATE for step in tried):
            break
        tried.append(_try(ladder, base, dt, reference, path))
    measured = Measured(ladder, tried)
    write_atomically(path, json.dumps(asdict(measured), indent=1).encode())
    return measured


def measured(folder: Path) -> list[Measured]:
    """All ladders that are there."""
    return [_read(path) for ladder in ladders() if (path := _path(ladder, folder)).exists()]


def measured_of(table: dict) -> Measured:
    """Inverse of `asdict`."""
    return Measured(Ladder(**table["ladder"]), [Tried(**step) for step in table["tried"]])


def draw(found: Sequence[Measured], path: Path) -> None:
    """A panel for every capillary number: largest stable step (open) and largest accurate one (filled) by nodes and rung."""
    figure = Figure(figsize=(3.2 * len(CAPILLARIES), 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(CAPILLARIES), sharey=True)
    for panel, capillary in zip(panels, CAPILLARIES, strict=True):
        for m in found:
            if m.ladder.capillary != capillary:
                continue
            x = POINTS.index(m.ladder.points) + 0.13 * (RUNGS.index(m.ladder.rung) - 2)
            colour = COLOURS[m.ladder.rung]
            if m.stable is not None:
                panel.plot(x, m.stable, "o", mfc="white", mec=colour, ms=8)
            if m.accurate is not None:
                panel.plot(x, m.accurate, "o", color=colour, ms=5)
            if m.stable is None and m.accurate is None:
                panel.plot(x, SMALLEST, "x", color=colour, ms=7)
            elif m.stable is not None and m.accurate is not None:
                panel.plot([x, x], [m.accurate, m.stable], color=colour, lw=0.8)
        panel.set_title(f"Ca = {capillary:g}")
        panel.set_xticks(range(len(POINTS)), [f"N = {points}" for points in POINTS])
        panel.set_xlim(-0.5, len(POINTS) - 0.5)
        panel.set_yscale("log")
        panel.grid(axis="y", alpha=0.3)
    panels[0].set_ylabel(r"dt / $t_\gamma$")
    marks = [Line2D([], [], marker="o", ls="", color=COLOURS[rung], label=rung) for rung in RUNGS]
    marks.append(Line2D([], [], marker="o", ls="", mfc="white", mec="grey", ms=8, label="largest stable"))
    marks.append(Line2D([], [], marker="o", ls="", color="grey", ms=5, label=f"largest within {ACCURATE:.0%} of R"))
    marks.append(Line2D([], [], marker="x", ls="", color="grey", ms=7, label="no step is"))
    figure.legend(handles=marks, loc="outside lower center", ncols=len(marks) // 2, frameon=False)
    figure.savefig(path, dpi=110)


def _upward(ladder: Ladder) -> Iterator[float]:
    """Steps, t_gamma: by doubling from the first one; of networks multiples of the step that they were trained for."""
    dt = STEP / ladder.unit if learned(ladder.rung) else FIRST
    while dt < FIRST:
        dt *= 2
    while dt <= max(LARGEST, STEP / ladder.unit):
        yield dt
        dt *= 2


def _downward(ladder: Ladder) -> Iterator[float]:
    dt = 0.5 * next(_upward(ladder))
    while dt >= (STEP / ladder.unit * (1 - 1e-9) if learned(ladder.rung) else SMALLEST):
        yield dt
        dt *= 0.5


def _try(ladder: Ladder, base: dict, dt: float, reference: Kept | str, path: Path) -> Tried:
    steps = max(round(HORIZON / dt), LEAST_STEPS)
    found = _run(by_rung(base, ladder.rung), dt * ladder.unit, steps * dt * ladder.unit, path.with_name(f"{path.stem}-{dt:.4g}"))
    if isinstance(found, str) or found.record.failure:
        return Tried(dt, False, None, found if isinstance(found, str) else found.record.failure)
    error = None
    if isinstance(reference, Kept) and not reference.record.failure:
        largest = differences(found.trajectory, reference.trajectory).largest()  # at the times that the reference reaches
        reached = found.trajectory.t[1] <= HORIZON * ladder.unit * (1 + 1e-9)
        error = max(largest["position"], largest["shape"]) if reached else None
    return Tried(dt, True, error)


def _run(tables: dict, dt: float, horizon: float, path: Path, order: int = 1) -> Kept | str:
    """The run, or why there is none."""
    every = max(1, round(horizon / dt / FRAMES))
    time = merged(tables, times(dt, horizon / dt, every), {"time": {"order": order}, "output": {"checkpoint_every": 10**6}})
    try:
        return kept(make_scene(time), path.with_suffix(path.suffix + ".h5"), timeout=BOUND)
    except (RuntimeError, TimeoutError) as error:
        return one_line(error)


def _path(ladder: Ladder, folder: Path) -> Path:
    exact = "implicit" if ladder.rung == "implicit" else "split"
    return folder / "steps" / f"N{ladder.points}-Ca{ladder.capillary:g}-{exact}" / f"{ladder.rung.replace(':', '_')}.json"


def _read(path: Path) -> Measured:
    return measured_of(json.loads(path.read_text()))
