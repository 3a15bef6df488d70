"""What a scene requires, and what ran: every part of `biem.scene.plan` against counters, with the time of each stage and the memory.

python scripts/requires.py                                                  all scenes of configs/scenes, onto docs/requires.md
python scripts/requires.py configs/scenes/shear_pair.toml -o out/pair.md --solvers "as written,split[solver.near_field=none]" --steps 5

Each scene takes a few steps by each solver, as its file says it and by other rungs (`studies.rungs`), in a process of its own; a solver
that refuses the scene is named with its reason. Nothing is kept from call to call: what is checked is the program as it is. Ends with exit
code 3 and a line where a part ran that the plan does not need, a needed one did not, or a near network was read that no gap asked for.
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import typer
from studies.rungs import rung, split_list
from tqdm import tqdm

from biem.backend import count, threads, timing
from biem.cli import one_line_errors
from biem.errors import NumericalFailure
from biem.membrane import contrast, maps
from biem.membrane.repulsion import Repulsion
from biem.run import simulate as loop
from biem.run.files import write_atomically
from biem.scene.build import Problem, build
from biem.scene.config import Scene, load_scene, make_scene
from biem.scene.plan import memory_estimate, required_parts
from biem.steppers import corrections
from biem.steppers.control import Controller
from biem.steppers.order import Extrapolated
from biem.stokes import interaction

AS_WRITTEN = "as written"
NETWORKS = "[vesicles.points=32, time.dt=1e-5, time.order=1]"  # nodes and a time step that the shipped ones know
SOLVERS = f"{AS_WRITTEN}, split, vesnet:hybrid{NETWORKS}, vesnet:mlp{NETWORKS}"
METHODS = {"relax": "relax", "self_tension": "self_tension", "advection": "advect", "flow_tension": "flow_tension", "near": "near_layers"}
EVIDENCE = {  # of each part: counters, of `biem.backend.count` and of the calls that `watched` counts
    "relaxation": ("relaxation_matrix", "relax_network", "coupled_response"),
    "background flow": ("call of the flow",),
    "advection": ("call of advection",),
    "tension": ("call of self_tension", "call of flow_tension", "frames with tension"),
    "vesicle-vesicle coupling": ("pair sums among vesicles",),
    "far field": ("pair_sum", "ewald_sum"),
    "near field": ("call of the near search", "near_sums", "near_rows", "near_layers"),
    "viscosity contrast": ("contrast_matrix", "double_layer_matrix", "double_layer_sum"),
    "repulsion": ("call of the repulsion", "repulsed_nodes"),
    "area and length correction": ("call of the area and length correction", "area_length_restored"),
    "redistribution of nodes": ("call of the redistribution", "redistributed"),
    "extrapolation": ("call of the extrapolation",),
    "step size control": ("call of the step size control",),
    "walls": ("wall_factorization", "wall_velocity"),
    **{f"map {slot}": (f"call of {slot}", f"{slot}_network") for slot in METHODS},
}
DEMANDED = {"near field": ("near_sums", "near_rows", "near_layers"), "map near": ("call of near",)}  # what a part on demand is when it runs
NEAR_NETWORK = "near_networks_loaded"
RAN, READY, UNNEEDED = "ran", "not called", "not needed"
MARKS = {RAN: "x", READY: "o", UNNEEDED: ""}
IN_SOLVERS = ("relaxation", "response", "advection", "self-tension", "flow tension", "far", "near", "double layers", "walls")
STAGES = (*IN_SOLVERS, "redistribution", "area and length")
MEGABYTE = 1e6


@dataclass(frozen=True)
class Ran:
    """A first step of a scene and `steps` more. parts: by name, RAN, READY (on demand, no demand) or UNNEEDED. wrong: what is not so.

    seconds: wall time of a later step by stage, "all" of it; bytes: planned for a step, measured beyond what was there before it, and of
    the whole process at most.
    """

    scene: str
    solver: str
    vesicles: int
    nodes: int
    steps: int
    parts: Mapping[str, str]
    wrong: tuple[str, ...]
    counts: Mapping[str, int]
    seconds: Mapping[str, float]
    planned_bytes: float
    measured_bytes: float
    process_bytes: float


@contextmanager
def watched(kinds_of_maps: Sequence[type]) -> Iterator[None]:
    """Counts the calls of the parts' entries, within `counting()`, where the program itself counts only what they do."""
    entries: list[tuple[Any, str, str]] = [
        (Repulsion, "force", "the repulsion"),
        (Controller, "accept", "the step size control"),
        (interaction, "find_near", "the near search"),
        (corrections, "restore_area_length", "the area and length correction"),
        (corrections, "redistribute", "the redistribution"),
        *((kind, method, slot) for kind in kinds_of_maps for slot, method in METHODS.items() if method in vars(kind)),
    ]
    with ExitStack() as stack:
        for owner, name, what in entries:
            stack.enter_context(patch.object(owner, name, _counted(getattr(owner, name), what)))
        step = Extrapolated.step
        extrapolated = _counted(step, "the extrapolation")
        stack.enter_context(patch.object(Extrapolated, "step", lambda self, *a: (extrapolated if self.order == 2 else step)(self, *a)))

        def with_counted_flow(scene: Scene) -> Problem:
            problem = build(scene)
            return replace(problem, flow=replace(problem.flow, velocity=_counted(problem.flow.velocity, "the flow")))

        stack.enter_context(patch.object(loop, "build", with_counted_flow))
        yield


def _kinds_of_maps(scene: Scene) -> list[type]:
    """What a stepper of the scene may be given as maps; no network's library is loaded for a scene without networks."""
    if scene.solver.kind != "vesnet":
        return [maps.ExactMaps, contrast.ContrastMaps]
    from surrogate.provider import SlotMaps

    return [maps.ExactMaps, SlotMaps]


def _counted(function: Callable[..., Any], what: str) -> Callable[..., Any]:
    def call(*arguments: Any, **options: Any) -> Any:
        count(f"call of {what}")
        return function(*arguments, **options)

    return call


def measure(scene: Scene, solver: str, steps: int) -> Ran:
    """Runs `steps` steps of the scene's dt, after one that is thrown away. Raises ValueError, NumericalFailure."""
    problem = build(scene)
    kinds_of_maps = _kinds_of_maps(scene)
    _run(scene, problem.dt)
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status("VmRSS")
    first: dict[str, float] = {}
    with watched(kinds_of_maps), timing() as seconds:
        done = _run(scene, (steps + 1) * problem.dt, lambda t, X: bool(first.update({} if first else {**seconds, "": 0.0})))
    later = int(done.trajectory.step[-1]) - 1
    counts = dict(done.counts)
    if len(problem.X) > 1:
        counts["pair sums among vesicles"] = counts.get("pair_sum", 0)
    if done.trajectory.sigma is not None:
        counts["frames with tension"] = len(done.trajectory)
    parts, wrong = judged(problem, counts)
    wall = done.trajectory.diagnostics["wall_seconds"][2:]
    each = {name: (value - first.get(name, 0.0)) / later for name, value in seconds.items()}
    return Ran(
        scene=scene.name,
        solver=solver,
        vesicles=len(problem.X),
        nodes=problem.X.shape[-1],
        steps=later,
        parts=parts,
        wrong=wrong,
        counts=counts,
        seconds={**each, "all": float(wall.mean())},
        planned_bytes=memory_estimate(problem),
        measured_bytes=max(0.0, _status("VmHWM") - before),
        process_bytes=_status("VmHWM"),
    )


def judged(problem: Problem, counts: Mapping[str, int]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Of each part what became of it, and a line for each that is not as the plan says."""
    found, wrong = {}, []
    for part in required_parts(problem):
        used = {name: counts[name] for name in EVIDENCE[part.name] if counts.get(name)}
        told = ", ".join(f"{name} {times}" for name, times in used.items())
        demanded = any(counts.get(name) for name in DEMANDED.get(part.name, EVIDENCE[part.name]))
        found[part.name] = UNNEEDED if not part.needed else RAN if demanded else READY
        if used and not part.needed:
            wrong.append(f"{part.name} ran, which the plan does not need ({part.why}): {told}")
        if part.needed and not demanded and "on demand" not in part.why:
            wrong.append(f"{part.name} did not run, which the plan needs ({part.why})")
    if counts.get(NEAR_NETWORK) and not counts.get("near_network"):
        wrong.append(f"near networks were read {counts[NEAR_NETWORK]} times, and no gap asked for them")
    return found, tuple(wrong)


def _run(scene: Scene, horizon: float, enough: loop.Enough | None = None) -> loop.Run:
    time = scene.time.model_copy(update={"horizon": horizon, "save_every": 1})
    return loop.simulate(scene.model_copy(update={"time": time}), enough=enough)


def _status(name: str) -> float:
    """Bytes that the kernel tells of this process."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{name}:"))
    return 1024.0 * float(line.split()[1])


def scenes_of(paths: Sequence[Path], solvers: str, overrides: Sequence[str]) -> tuple[list[tuple[str, Scene]], list[str]]:
    """Scenes by solver, none of them twice, and a line for each that cannot be. Raises ValueError for a bad file."""
    cases: list[tuple[str, Scene]] = []
    notes = []
    for path in paths:
        own = load_scene(path, overrides)
        seen: list[Scene] = []
        for name in split_list(solvers):
            try:
                scene = own if name == AS_WRITTEN else rung(path, name, overrides).scene
                build(scene)
            except (ValueError, FileNotFoundError) as error:
                if name == AS_WRITTEN:
                    raise
                notes.append(f"{own.name} by {name}: {error}")
                continue
            if scene not in seen:
                cases.append((_short(name, scene), scene))
            seen.append(scene)
    return cases, notes


def _short(name: str, scene: Scene) -> str:
    """Without the settings that all networks have."""
    if name == AS_WRITTEN:
        kinds = set(scene.solver.maps.model_dump().values())
        return scene.solver.kind + (f":{kinds.pop()}" if scene.solver.kind == "vesnet" and len(kinds) == 1 else "") + ", as written"
    return name.removesuffix(NETWORKS)


def page(rows: Sequence[Ran], notes: Sequence[str]) -> str:
    """The three tables in Markdown."""
    names = [name for name in EVIDENCE if any(name in row.parts for row in rows)]
    short = {name: name.replace("vesicle-vesicle ", "").replace(" of nodes", "").replace(" correction", "") for name in names}
    marks = [[*_labels(row), *(MARKS[row.parts.get(name, UNNEEDED)] for name in names)] for row in rows]
    stages = [name for name in STAGES if any(row.seconds.get(name) for row in rows)]
    times = [
        [
            *_labels(row),
            f"{row.vesicles} x {row.nodes}",
            f"{1e3 * row.seconds['all']:.3g}",
            *(f"{1e3 * row.seconds[name]:.2g}" if row.seconds.get(name) else "" for name in stages),
            f"{row.planned_bytes / MEGABYTE:.3g}",
            f"{row.measured_bytes / MEGABYTE:.3g}",
            f"{row.process_bytes / MEGABYTE:.3g}",
        ]
        for row in rows
    ]
    kinds = {"pair sums": ("pair_sum",), "of them Ewald": ("ewald_sum",), "near pairs": ("near_sums", "near_rows")}
    kinds |= {"curves with layers": ("near_layers",), "matrices": ("tension_matrix", "relaxation_matrix", "coupled_response")}
    kinds |= {"curves by networks": tuple(f"{slot}_network" for slot in METHODS), "near networks read, in all": (NEAR_NETWORK,)}
    amounts = []
    for row in rows:
        total = {head: sum(row.counts.get(name, 0) for name in counters) for head, counters in kinds.items()}
        each = [f"{n / (1 if 'in all' in head else row.steps + 1):.3g}" if n else "" for head, n in total.items()]
        amounts.append([*_labels(row), str(row.steps + 1), *each])
    wrong = [f"- {row.scene} by {row.solver}: {line}" for row in rows for line in row.wrong]
    verdict = (
        "\n".join([f"{len(wrong)} parts are not as the plan says:", *wrong])
        if wrong
        else f"In all {len(rows)} rows every part that ran is one that the plan needs, and every needed part ran or waits for a demand."
    )
    refused = ["", "Not run:", "", *(f"- {note}" for note in notes)] if notes else []
    return "\n".join(
        [
            "# What a scene requires",
            "",
            f"Written by `python scripts/requires.py`: the parts of `biem plan` against what ran in a few steps, on {threads()} thread(s).",
            "",
            verdict,
            "",
            "## Parts",
            "",
            "x: ran; o: on demand, and no gap asked for it; empty: not needed, and did not run. Maps by their slots, of VesNet.",
            "",
            _table(["scene", "solver", *(short[name] for name in names)], marks, 2, ":-:"),
            "",
            "## Time and memory",
            "",
            "ms of a step, all of it, then by stage; not of the first one, which finds the tension by iteration. MB: the plan's estimate "
            "of a step's arrays, the measured growth of the process during the steps, and its peak, the libraries included.",
            "",
            _table(["scene", "solver", "M x N", "step", *stages, "MB planned", "MB measured", "MB process"], times, 3, "--:"),
            "",
            "## How much of it",
            "",
            "Of a step, from the counters, the first one included.",
            "",
            _table(["scene", "solver", "steps", *kinds], amounts, 2, "--:"),
            *refused,
            "",
        ]
    )


def _labels(row: Ran) -> list[str]:
    return [row.scene, row.solver]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], left: int, align: str) -> str:
    rule = "|" + "---|" * left + f"{align}|" * (len(heads) - left)
    return "\n".join(["| " + " | ".join(heads) + " |", rule, *("| " + " | ".join(row) + " |" for row in rows)])


def measured(cases: Sequence[tuple[str, Scene]], steps: int) -> list[Ran]:
    """Each in a process of its own, one at a time."""
    rows = []
    with tqdm(cases, unit="run", dynamic_ncols=True) as bar:
        for name, scene in bar:
            bar.set_description(f"{scene.name} by {name}")
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                rows.append(pool.submit(_measure, scene.model_dump(mode="json"), str(scene.folder), name, steps).result())
    return rows


def _measure(table: dict[str, Any], folder: str, name: str, steps: int) -> Ran:
    return measure(make_scene(table, folder), name, steps)


def main(
    scenes: Annotated[list[Path] | None, typer.Argument(help="Scene files; default all of configs/scenes.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="The page.")] = Path("docs/requires.md"),
    solvers: Annotated[str, typer.Option(help="Rungs, with commas between them.")] = SOLVERS,
    steps: Annotated[int, typer.Option(min=1, help="Steps of a run.")] = 3,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="KEY=VALUE for all scenes.")] = None,
) -> None:
    """Tables of what scenes require, and what ran."""
    with one_line_errors():
        cases, notes = scenes_of(scenes or sorted(Path("configs/scenes").glob("*.toml")), solvers, overrides or [])
        rows = measured(cases, steps)
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, page(rows, notes).encode())
        typer.echo(str(output))
        wrong = [f"{row.scene} by {row.solver}: {line}" for row in rows for line in row.wrong]
        if wrong:
            raise NumericalFailure(f"{wrong[0]} (and {len(wrong) - 1} more, in {output})")


if __name__ == "__main__":
    typer.run(main)
