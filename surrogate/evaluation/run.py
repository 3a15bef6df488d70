"""How wrong the learned maps are, and how fast, beside exact maps at few nodes: tables, pictures and all numbers as JSON.

errors       of each map and mode on held-out test runs, and on a suspension of another kind       `errors`
velocities   advection and flow tension of velocities as they occur                                `velocities`
relaxation   a hundred relaxation steps in a row                                                   `relaxation`
cost         microseconds a vesicle                                                                `cost`
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from tqdm import tqdm

from biem.curves.fourier import resample
from biem.membrane.maps import ExactMaps, MembraneMaps
from biem.run.files import write_atomically
from surrogate.evaluation.cost import costs
from surrogate.evaluation.errors import map_errors, test_rows
from surrogate.evaluation.parts import Parts, file_digest, resolved_shapes
from surrogate.evaluation.plots import draw
from surrogate.evaluation.relaxation import errors_of_steps, march, reference
from surrogate.evaluation.rungs import Rung, exact_rungs, learned_rungs, stepped_rungs
from surrogate.evaluation.tables import markdown
from surrogate.evaluation.velocities import SLOTS, velocity_errors
from surrogate.library import KINDS, Need, find
from surrogate.pairs import Pairs, open_pairs
from surrogate.targets import TARGETS

VERSION = 1  # of the measurements
RESOLVED = 128  # nodes of reference shapes
Results = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """What is measured. Parts without their data are left out, with a line.

    data: pairs of all maps; flows: pairs with `relax` by the converged flow, one a time step (default: those of data). shapes: what the
    rows `shape` of the data are of, resolved; for velocities and relaxation steps. taylor_green: pairs of another suspension, and beside
    them NAME-flow*.h5. weights: a folder, or None for the shipped ones. samples: test shapes, at most (None: all). substeps: of a reference
    step, even. counts: vesicles of a timing. only: parts, of PARTS.
    """

    data: Path
    out: Path
    flows: tuple[Path, ...] = ()
    shapes: Path | None = None
    taylor_green: Path | None = None
    weights: Path | None = None
    kinds: tuple[str, ...] = KINDS
    points: tuple[int, ...] = (32, 48, 64)
    samples: int | None = None
    velocity_shapes: int = 512
    relaxation_shapes: int = 96
    steps: int = 100
    substeps: int = 8
    counts: tuple[int, ...] = (32, 512)
    rounds: int = 5
    seed: int = 0
    only: tuple[str, ...] = ()
    quiet: bool = False


PARTS = ("errors", "velocities", "relaxation", "cost")


@dataclass(frozen=True)
class Report:
    """results: as in evaluate.json; text: evaluate.md; files: all that were written."""

    results: Results
    text: str
    files: tuple[Path, ...]


def evaluate(options: Options) -> Report:
    """Measures, or reads again what was measured before of the same weights and data, and writes evaluate.json, evaluate.md and pictures.

    Raises FileNotFoundError, ValueError for data that are missing or wrong.
    """
    _check(options)
    data = open_pairs(options.data)
    flows = [open_pairs(path) for path in options.flows] or ([data] if "relax" in data.maps else [])
    learned, notes = learned_rungs(options.kinds, options.weights, Need(data.points, data.reduced_area))
    rungs = [*learned, *exact_rungs(options.points)]
    stepped = stepped_rungs(options.points[len(options.points) // 2])
    session = _Session(options, data, flows, rungs, stepped, Parts(options.out / "parts", VERSION), notes)
    results: Results = {"rungs": [rung.name for rung in session.rungs], "data": data.digest}
    wanted = options.only or PARTS
    if "errors" in wanted:
        results["errors"] = session.errors()
    if "velocities" in wanted:
        results["velocities"] = session.velocities()
    if "relaxation" in wanted:
        results["relaxation"] = session.relaxation()
    if "cost" in wanted:
        results["cost"] = session.cost()
        results["relaxations"] = {f"relax {flow.dt:g}": session.relaxations(flow.dt) for flow in flows}
    results["notes"] = session.notes
    text = markdown(results)
    options.out.mkdir(parents=True, exist_ok=True)
    files = [options.out / "evaluate.json", options.out / "evaluate.md"]
    write_atomically(files[0], json.dumps(results, indent=1, allow_nan=False).encode())
    write_atomically(files[1], text.encode())
    return Report(results, text, (*files, *draw(results, options.out)))


def _check(options: Options) -> None:
    unknown = [name for name in options.only if name not in PARTS] + [kind for kind in options.kinds if kind not in KINDS]
    if unknown:
        raise ValueError(f"there is no {unknown[0]!r} to evaluate: parts are {', '.join(PARTS)}, kinds {', '.join(KINDS)}")
    if options.weights is not None:
        find(options.weights)
    if options.substeps < 2 or options.substeps % 2:
        raise ValueError(f"substeps = {options.substeps}: expected an even number, the reference takes all of them and half of them")


@dataclass(frozen=True)
class _Session:
    """One evaluation. stepped: exact maps that relax by several steps. notes: lines for the report, added to as parts are left out."""

    options: Options
    data: Pairs
    flows: Sequence[Pairs]
    rungs: Sequence[Rung]
    stepped: Sequence[Rung]
    parts: Parts
    notes: list[str]

    def errors(self) -> Results:
        """By set of shapes, map and rung."""
        sets = {"test": (self.data, self.flows)}
        path = self.options.taylor_green
        if path is None:
            self.notes.append("no Taylor-Green shapes were given: make them by scripts/taylor_green_shapes.py")
        else:
            beside = sorted(path.parent.glob(f"{path.stem}-flow*.h5"))
            sets["taylor_green"] = (open_pairs(path), [open_pairs(flow) for flow in beside])
        return {name: self._errors_on(name, pairs, flows) for name, (pairs, flows) in sets.items()}

    def _errors_on(self, set_name: str, pairs: Pairs, flows: Sequence[Pairs]) -> Results:
        works = [("relax", flow) for flow in flows] + [(name, pairs) for name in TARGETS if name != "relax" and name in pairs.maps]
        found: Results = {}
        for name, of in works:
            title = f"relax {of.dt:g}" if name == "relax" else name
            every = [*self.rungs, *self.stepped]
            having = [rung for rung in every if name in rung.slots and (name != "relax" or rung.knows(of.dt))]
            inputs = {rung.name: self._inputs(rung, [name], of) | {"samples": self.options.samples} for rung in having}
            stored = {rung.name: self.parts.get(f"{set_name} {title} {rung.name}", inputs[rung.name]) for rung in having}
            missing = [rung for rung in having if stored[rung.name] is None]
            if missing:
                rows = test_rows(of, self.options.samples, self.options.seed)
                with self._bar(f"{set_name}: {title}", len(rows), "shape") as bar:
                    made = map_errors(of, name, missing, rows, bar.update)
                for rung in missing:
                    key = rung.name
                    stored[key] = self.parts.put(f"{set_name} {title} {key}", inputs[key], made[key])
            found[title] = stored
        return found

    def velocities(self) -> Results:
        """By flow, slot and rung."""
        options = self.options
        if options.shapes is None:
            self.notes.append("velocities and relaxation steps need the resolved shapes: none were given")
            return {}
        inputs = {
            "rungs": {rung.name: [rung.digests.get(slot) for slot in SLOTS] for rung in self.rungs},
            "data": self.data.digest,
            "shapes": file_digest(options.shapes),
            "n": options.velocity_shapes,
            "seed": options.seed,
        }

        def make() -> Results:
            with self._bar("velocities", 1, "part") as bar:
                found = velocity_errors(self._resolved(options.velocity_shapes), self.rungs, self.data.points, options.seed)
                bar.update()
            return found

        return self.parts.of("velocities", inputs, make)

    def relaxation(self) -> Results:
        """By time step and rung: errors of steps; by "reference", the bound of its own error."""
        options = self.options
        if options.shapes is None or not self.flows:
            return {}
        common = {"shapes": file_digest(options.shapes), "data": self.data.digest, "n": options.relaxation_shapes, "seed": options.seed}
        common |= {"steps": options.steps, "substeps": options.substeps}
        steps = sorted(flow.dt for flow in self.flows)
        X = self._resolved(options.relaxation_shapes)
        return {f"{dt:g}": self._relaxed(X, dt, round(dt / steps[0]), common | {"dt": dt}) for dt in steps}

    def _relaxed(self, X: np.ndarray, dt: float, ratio: int, inputs: Results) -> Results:
        """Every rung by steps of dt, and networks and the finest exact maps by dt/ratio too."""
        wanted, bound = self._reference(X, dt, inputs)
        few = resample(X, self.data.points)
        found: Results = {"reference": _bound(bound)}
        ways = [(rung, 1) for rung in (*self.rungs, *self.stepped)]
        if ratio > 1:
            ways += [(rung, ratio) for rung in self.rungs if rung.points is None or rung is self.rungs[-1]]
        for rung, each in ways:
            if "relax" not in rung.slots or not rung.knows(dt / each):
                continue
            name = rung.name if each == 1 else f"{rung.name}, {each} steps of {dt / each:g}"
            make = partial(self._steps, f"relaxation {dt:g}: {name}", rung.maps, few, dt, each, wanted)
            digest = {"each": each, "rung": rung.digests["relax"]}
            found[name] = self.parts.of(f"relaxation {dt:g} {rung.name} {each}", inputs | digest, make)
        return found

    def _steps(self, name: str, maps: MembraneMaps, few: np.ndarray, dt: float, each: int, wanted: np.ndarray) -> Results:
        with self._bar(name, self.options.steps, "step") as bar:
            return errors_of_steps(march(maps, few, dt, self.options.steps, each, self.data.points, bar.update), wanted)

    def _reference(self, X: np.ndarray, dt: float, inputs: Results) -> tuple[np.ndarray, np.ndarray]:
        def make() -> tuple[np.ndarray, np.ndarray]:
            with self._bar(f"relaxation {dt:g}: reference", self.options.steps, "step") as bar:
                return reference(X, dt, self.options.steps, self.options.substeps, self.data.points, bar.update)

        wanted, bound = self.parts.arrays(f"relaxation {dt:g} reference", inputs, make)
        return wanted, bound

    def relaxations(self, dt: float) -> dict[str, int]:
        """By rung, its own steps in one of dt."""
        return {rung.name: rung.relaxations(dt) for rung in self.rungs if "relax" in rung.slots and rung.knows(dt)}

    def cost(self) -> Results:
        """By number of vesicles and rung, exact maps and their corrections also in single precision."""
        options = self.options
        dt = min((flow.dt for flow in self.flows), default=self.data.dt)
        makers: dict[str, tuple[MembraneMaps, frozenset[str], float]] = {}
        single, _ = learned_rungs([k for k in options.kinds if k == "hybrid"], options.weights, self._need, ExactMaps(precision="float32"))
        for rung in (*self.rungs, *self.stepped):
            slots = rung.slots if rung.knows(dt) else rung.slots - {"relax"}
            makers[rung.name] = (rung.maps, slots, dt)
            if rung in self.stepped:
                continue
            if isinstance(rung.maps, ExactMaps):
                makers[f"{rung.name}, float32"] = (replace(rung.maps, precision="float32"), slots - {"near"}, dt)
            elif rung.name == "hybrid":
                makers["hybrid, float32"] = (single[0].maps, slots, dt)
        exact_near = [name for name in makers if name.startswith(("hybrid", "exact"))]
        inputs = {"makers": {rung.name: rung.digests for rung in self.rungs}, "counts": list(options.counts), "rounds": options.rounds}
        inputs |= {"dt": dt, "data": self.data.digest, "seed": options.seed, "names": list(makers)}

        def make() -> Results:
            rows = test_rows(self.data, max(options.counts), options.seed)
            shapes = self.data.read("X_std", rows).astype(np.float64)
            shapes = np.resize(shapes, (max(options.counts), *shapes.shape[1:]))
            with self._bar("cost", len(options.counts) * len(makers) * (options.rounds + 1), "timing") as bar:
                return {str(M): costs(makers, exact_near, shapes[:M], options.rounds, bar.update) for M in options.counts}

        return self.parts.of("cost", inputs, make)

    @property
    def _need(self) -> Need:
        return Need(self.data.points, self.data.reduced_area)

    def _inputs(self, rung: Rung, slots: Sequence[str], pairs: Pairs) -> Results:
        return {"rung": [rung.digests[slot] for slot in slots], "data": pairs.digest, "seed": self.options.seed}

    def _resolved(self, most: int) -> np.ndarray:
        """Test shapes X (n, 2, RESOLVED)."""
        assert self.options.shapes is not None
        rows = test_rows(self.data, most, self.options.seed)
        with h5py.File(self.data.path, "r") as file:
            which = file["shape"][()][rows]
        return resolved_shapes(self.options.shapes, which, RESOLVED)

    def _bar(self, name: str, total: int, unit: str) -> Any:
        return tqdm(total=total, desc=name, unit=unit, disable=self.options.quiet, leave=False)


def _bound(bound: np.ndarray) -> Results:
    finite = np.where(np.isfinite(bound), bound, np.inf)
    rows = {"median": np.median(finite, axis=1), "max": finite.max(axis=1)}
    return {name: [float(v) if np.isfinite(v) else None for v in values] for name, values in rows.items()}
