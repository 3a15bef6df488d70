"""What each part of the method is worth: one thing left out or put in at a time, two vesicles passing in shear, one table a question.

python scripts/ablations.py                                 all of STUDIES, into out/ablations
python scripts/ablations.py networks order --reference out/pair/implicit.h5 --page docs/ablations.md

Runs are kept in OUTPUT/runs, and shared by the studies: a second call makes what is missing. Writes NAME.json and NAME.md of every study
and one page of all that are there. Differences are the largest up to the horizon, of a run's frames from the reference's at the same times
(`studies.differences`); what a run costs are CPU seconds of one thread per t_gamma, without compilation and start.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from studies.differences import MEANING, differences
from studies.rungs import MAPS, Rung, rung
from studies.runs import Kept, kept_all

from biem.cli import one_line_errors
from biem.membrane.maps import SLOTS
from biem.run.files import write_atomically
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.build import build
from biem.scene.config import Scene

SCENE = Path("configs/scenes/vesnet_pair.toml")
MEASURES = ("position", "shape", "energy", "separation")
SHOWN = {"position": "position, R", "shape": "shape, R", "energy": "energy", "separation": "separation, R"}
SPLIT = "split[time.order=2]"


@dataclass(frozen=True)
class Extent:
    """How much is run. nodes: of the vesicles where they are varied; steps: dt, in the unit of the scene; finest: dt of what these
    are compared with; kinds: of networks; reference: nodes of the reference."""

    horizon: str = "10 t_gamma"
    nodes: tuple[int, ...] = (32, 64, 128)
    steps: tuple[float, ...] = (1e-5, 2e-5, 5e-5, 1e-4)
    finest: float = 5e-6
    kinds: tuple[str, ...] = ("hybrid", "mlp", "ivnet")
    reference: int = 128


QUICK = Extent("1 t_gamma", (32,), (5e-5, 1e-4), 2e-5, ("hybrid",), 48)


@dataclass(frozen=True)
class Variant:
    """A run of a study. labels: what it is called in the table; against: the rung, of the same study, that it departs from."""

    labels: tuple[str, ...]
    rung: str
    against: str = ""


@dataclass(frozen=True)
class Row:
    """What a run is off from the reference (error) and from the rung that it departs from (own), by MEASURES.

    until: t_gamma reached; gap: smallest distance of the membranes, in arclength spacings; cost: CPU s per t_gamma.
    """

    labels: tuple[str, ...]
    rung: str
    failure: str
    until: float
    gap: float
    cost: float
    error: Mapping[str, float]
    own: Mapping[str, float]


@dataclass(frozen=True)
class Study:
    """One table. heads: of the labels; departs: what `own` is a difference from; share: whether it is also shown as a part of its sum."""

    title: str
    about: str
    heads: tuple[str, ...]
    variants: tuple[Variant, ...]
    says: Callable[[Sequence[Row]], str]
    departs: str = ""
    share: bool = False


def networks(extent: Extent) -> Study:
    """Networks swapped in one at a time."""
    layers = "split[time.order=2, solver.near_field=layers]"
    variants = [Variant(("exact", "none"), SPLIT), Variant(("exact, near by layers", "none"), layers, SPLIT)]
    for kind in extent.kinds:
        for slot in SLOTS:
            if (kind, slot) != ("hybrid", "near"):
                against = layers if slot == "near" else SPLIT
                variants.append(Variant((kind, slot), f'vesnet:exact[time.order=2, solver.maps={{{slot}="{kind}"}}]', against))
        variants.append(Variant((kind, "all"), f"vesnet:{kind}[time.order=2]", SPLIT))
    return Study(
        "Networks swapped in one at a time",
        "N = 32, order 2, dt = 2e-5; the maps that are not named are exact, built at 64 nodes. Networks of near layers are compared with "
        'exact layers, the others with the exact run. Share: of the sum of these differences over the maps of a kind; "all" is the run '
        "with all of them.",
        ("networks", "maps by networks"),
        tuple(variants),
        _say_networks,
        "exact",
        True,
    )


def _say_networks(rows: Sequence[Row]) -> str:
    exact = next(row for row in rows if row.rung == SPLIT)
    parts = [f"The exact run is {exact.error['position']:.2g} R off the reference in position."]
    for kind in dict.fromkeys(row.labels[0] for row in rows if row.labels[0] in MAPS):
        own = {row.labels[1]: row for row in rows if row.labels[0] == kind and row.own}
        shares = shares_of([row for row in own.values() if row.labels[1] != "all"])
        if not shares or "all" not in own:
            continue
        worst = max(shares, key=lambda labels: shares[labels])
        whole = own["all"]
        parts.append(
            f"Of {kind}, {worst[1]} moves the vesicles most, {own[worst[1]].own['position']:.2g} R{_ended(own[worst[1]])}, "
            f"{100 * shares[worst]:.0f} % of the sum; all of them together {whole.own['position']:.2g} R, which leaves "
            f"{whole.error['position']:.2g} R from the reference."
        )
    return " ".join(parts)


def near(extent: Extent) -> Study:
    """With and without the near-singular correction."""
    schemes = {"none": "none", "ying_zorin": "interpolated", "auto": "upsampled"}
    variants = [
        Variant((str(n), what), f"split[time.order=2, vesicles.points={n}, solver.near_field={scheme}]")
        for n in extent.nodes
        for scheme, what in schemes.items()
    ]
    return Study(
        "With and without near-singular correction",
        "Split solver, order 2, dt = 2e-5. none: the trapezoid rule at any distance; interpolated: near_field = ying_zorin; upsampled: "
        "near_field = auto, the default.",
        ("N", "correction"),
        tuple(variants),
        lambda rows: _say_pairs(rows, "none", "upsampled", "At N = {0} positions are off by {1} without a correction, by {2} with it{3}."),
    )


def layers(extent: Extent) -> Study:
    """One Gaussian fit across the membrane against one-sided polynomials."""
    schemes = {"layers_rbf": "RBF across", "layers": "one-sided", "auto": "no layers"}
    variants = [
        Variant((str(n), what), f"split[time.order=2, vesicles.points={n}, solver.near_field={scheme}]")
        for n in extent.nodes[:2]
        for scheme, what in schemes.items()
    ]
    return Study(
        "Radial basis functions across the membrane against one-sided layers",
        "Split solver, order 2, dt = 2e-5; exact values on five layers within one spacing of a membrane. RBF across: near_field = "
        "layers_rbf, one Gaussian fit over both sides, as in the paper; one-sided: near_field = layers; no layers: near_field = auto, "
        "upsampling down to contact.",
        ("N", "interpolation"),
        tuple(variants),
        lambda rows: _say_pairs(rows, "RBF across", "one-sided", "At N = {0} positions are off by {1} with RBF, by {2} one-sided{3}."),
    )


def order(extent: Extent) -> Study:
    """Order 1 against 2 in time."""
    variants = []
    for solver in ("split", "implicit"):
        finest = f"{solver}[time.order=2, time.dt={extent.finest:g}]"
        variants.append(Variant((solver, "2", f"{extent.finest:g}"), finest))
        for n in (1, 2):
            own = [(dt, f"{solver}[time.order={n}, time.dt={dt:g}]") for dt in extent.steps]
            variants += [Variant((solver, str(n), f"{dt:g}"), name, finest) for dt, name in own]
    return Study(
        "Order 1 against order 2 in time",
        f"N = 32. The error in time alone is the difference from the same solver at order 2 and dt = {extent.finest:g}; what is left of "
        "the error against the reference is that of 32 nodes. dt in mu L^3/kappa_b; t_gamma = 4.2e-4.",
        ("solver", "order", "dt"),
        tuple(variants),
        _say_order,
        "the smallest step",
    )


def _say_order(rows: Sequence[Row]) -> str:
    parts = []
    for solver in dict.fromkeys(row.labels[0] for row in rows):
        whole = [row for row in rows if row.labels[0] == solver and row.own and not row.failure]
        of = {n: [row for row in whole if row.labels[1] == n] for n in ("1", "2")}
        said = []
        for n, own in of.items():
            dts, errors = [float(row.labels[2]) for row in own], [row.own["position"] for row in own]
            rate = f", falling as dt^{np.polyfit(np.log(dts), np.log(errors), 1)[0]:.1f}" if len(own) > 1 else ""
            said.append(f"order {n} errs in time by {min(errors):.2g} to {max(errors):.2g} R{rate}" if own else f"order {n} never ended")
        beaten = [a for a in of["1"] if any(b.cost <= a.cost and b.own["position"] <= a.own["position"] for b in of["2"])]
        said.append(f"{len(beaten)} of the {len(of['1'])} runs of order 1 cost no less and err no less than one of order 2")
        parts.append(f"{solver}: " + "; ".join(said) + ".")
    return " ".join(parts)


def operators(extent: Extent) -> Study:
    """Operators built at N, 2 N and 4 N nodes."""
    variants = [
        Variant((solver, f"{'' if k == 1 else f'{k} '}N = {32 * k}"), f"{solver}[time.order=2, solver.operator_points={32 * k}]")
        for solver in ("split", "implicit")
        for k in (1, 2, 4)
    ]
    return Study(
        "Operators built at N, 2 N and 4 N",
        "N = 32, order 2, dt = 2e-5. A vesicle's operators on more nodes than it has: without the aliasing of the products in them.",
        ("solver", "operators at"),
        tuple(variants),
        _say_operators,
    )


def _say_operators(rows: Sequence[Row]) -> str:
    parts = []
    for solver in dict.fromkeys(row.labels[0] for row in rows):
        own = [row for row in rows if row.labels[0] == solver]
        told = ", ".join(f"{row.error['position']:.2g} R at {row.labels[1]}{_ended(row)}" for row in own)
        parts.append(f"{solver}: positions are off by {told}; {_times(own[1].cost, own[0].cost)} the cost of N at 2 N.")
    return " ".join(parts)


STUDIES: dict[str, Callable[[Extent], Study]] = {
    "networks": networks,
    "near": near,
    "layers": layers,
    "order": order,
    "operators": operators,
}


def _say_pairs(rows: Sequence[Row], without: str, with_it: str, sentence: str) -> str:
    """A sentence for every N of two rows."""
    parts = []
    for n in dict.fromkeys(row.labels[0] for row in rows):
        a, b = (next(row for row in rows if row.labels == (n, what)) for what in (without, with_it))
        off = [f"{row.error['position']:.2g} R{_ended(row)}" for row in (a, b)]
        whole = not (a.failure or b.failure)
        ratio = f", {_times(a.error['position'], b.error['position'])} less" if whole and b.error["position"] < a.error["position"] else ""
        parts.append(sentence.format(n, *off, ratio))
    return " ".join(parts)


def _ended(row: Row) -> str:
    return f" (until it ends at {row.until:.2g} t_gamma)" if row.failure else ""


def _times(a: float, b: float) -> str:
    return f"{a / b:.2g} times" if b else "infinitely many times"


def shares_of(rows: Sequence[Row]) -> dict[tuple[str, ...], float]:
    """Of the sum of the rows' own differences of position, by their labels."""
    total = sum(row.own["position"] for row in rows if row.own)
    return {row.labels: row.own["position"] / total for row in rows if row.own} if total else {}


def scene_of(path: Path, name: str, horizon: str) -> Rung:
    """The scene by a rung, with frames at the times at which the scene as it stands saves them."""
    frames = build(rung(path, SPLIT).scene)
    every = frames.dt * frames.scene.time.save_every
    found = rung(path, name, [f'time.horizon="{horizon}"'])
    time = found.scene.time.model_copy(update={"save_every": max(1, round(every / build(found.scene).dt))})
    return replace(found, scene=found.scene.model_copy(update={"time": time}))


def rows_of(study: Study, runs: Mapping[str, Kept], reference: Trajectory, unit: float) -> list[Row]:
    """The table of finished runs by rung. unit: t_gamma."""
    rows = []
    trajectories = {name: run.trajectory for name, run in runs.items()}
    for variant in study.variants:
        run, trajectory = runs[variant.rung].record, trajectories[variant.rung]
        own = differences(trajectory, trajectories[variant.against]).largest() if variant.against else {}
        rows.append(
            Row(
                labels=variant.labels,
                rung=variant.rung,
                failure=run.failure,
                until=run.until / unit,
                gap=float(trajectory.diagnostics["min_gap"].min() * trajectory.X.shape[-1] / _length(runs[variant.rung].scene)),
                cost=run.cpu_a_step * run.steps * unit / run.until if run.until else float("nan"),
                error={name: value for name, value in differences(trajectory, reference).largest().items() if name in MEASURES},
                own={name: value for name, value in own.items() if name in MEASURES},
            )
        )
    return rows


def _length(scene: Scene) -> float:
    return build(scene).length


def table(study: Study, rows: Sequence[Row]) -> str:
    """In Markdown; the smallest of each kind of error is bold, a run that ended early in italics."""
    whole = [row for row in rows if not row.failure]
    best = {name: min((row.error[name] for row in whole), default=None) for name in MEASURES}
    shares: dict[tuple[str, ...], float] = {}
    for kind in dict.fromkeys(row.labels[0] for row in rows) if study.share else ():
        shares |= shares_of([row for row in rows if row.labels[0] == kind and row.labels[-1] not in ("all", "none")])
    heads = [*study.heads, *SHOWN.values()]
    heads += [f"position from {study.departs}, R", f"shape from {study.departs}, R"] if study.departs else []
    heads += ["share"] if study.share else []
    heads += ["smallest gap, h", "CPU s a t_gamma", "until, t_gamma"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(study.heads) + "--:|" * (len(heads) - len(study.heads))]
    for row in rows:
        cells = list(row.labels)
        cells += [f"**{row.error[n]:.2g}**" if not row.failure and row.error[n] == best[n] else f"{row.error[n]:.2g}" for n in MEASURES]
        if study.departs:
            cells += [f"{row.own['position']:.2g}", f"{row.own['shape']:.2g}"] if row.own else ["", ""]
        if study.share:
            cells.append(f"{100 * shares[row.labels]:.0f} %" if row.labels in shares else "")
        cells += [f"{row.gap:.2g}", f"{row.cost:.3g}", f"{row.until:.3g}" if not row.failure else f"*{row.until:.3g}*"]
        lines.append("| " + " | ".join(cells) + " |")
    notes = [f"- {', '.join(row.labels)} ended at {row.until:.3g} t_gamma: {row.failure}" for row in rows if row.failure]
    return "\n".join(lines + (["", *notes] if notes else []))


def section(study: Study, rows: Sequence[Row]) -> str:
    """Title, what was found, table."""
    return f"## {study.title}\n\n{study.says(rows)}\n\n{study.about}\n\n{table(study, rows)}\n"


def page(folder: Path, about: str) -> str:
    """All sections that are there, in the order of STUDIES."""
    sections = [(folder / f"{name}.md").read_text() for name in STUDIES if (folder / f"{name}.md").exists()]
    meaning = "; ".join(f"{name}: {MEANING[name]}" for name in MEASURES)
    return (
        f"# Ablations\n\nWritten by `python scripts/ablations.py`. {about}\n\nColumns, largest over time: {meaning}, all against the "
        "reference where no other run is named. R: radius of the circle of a vesicle's area; h: arclength spacing of its nodes. Bold: the "
        "smallest of a column; in italics: runs that ended early.\n\n" + "\n".join(sections)
    )


def run_all(names: Sequence[str], path: Path, output: Path, extent: Extent, reference: Path | None) -> tuple[dict[str, list[Row]], str]:
    """The rows of the studies, written into `output`, and what the reference is. Raises ValueError, RuntimeError."""
    unknown = [name for name in names if name not in STUDIES]
    if unknown:
        raise ValueError(f"there is no ablation {unknown[0]}: expected some of {', '.join(STUDIES)}")
    studies = {name: STUDIES[name](extent) for name in names or STUDIES}
    unit = build(rung(path, SPLIT).scene).flow.time_scale
    if unit is None:
        raise ValueError(f"{path}: the fluid is at rest; ablations are of a scene in a flow")

    def run(names: Sequence[str], desc: str) -> dict[str, Kept]:
        rungs = {name: scene_of(path, name, extent.horizon) for name in names}
        tasks = {name: (found.scene, output / "runs" / f"{found.file}.h5") for name, found in rungs.items()}
        return kept_all(tasks, desc=desc)

    if reference is None:
        own = f"implicit[vesicles.points={extent.reference}, time.order=2]"
        exact = run([own], "reference")[own].trajectory
    else:
        exact = read_trajectory(reference)
    found = {}
    for name, study in studies.items():
        runs = run(list(dict.fromkeys(variant.rung for variant in study.variants)), name)
        rows = found[name] = rows_of(study, runs, exact, unit)
        described = {"about": study.about, "says": study.says(rows), "rows": [asdict(row) for row in rows]}
        write_atomically(output / f"{name}.json", json.dumps(described, indent=1).encode())
        write_atomically(output / f"{name}.md", section(study, rows).encode())
    scene = json.loads(exact.attributes["scene"])
    what = f"{scene['solver']['kind']}, N = {exact.X.shape[-1]}, order {scene['time']['order']}, dt = {scene['time']['dt']}"
    about = f"Scene {path.name} over {extent.horizon}; the reference: {what}."
    return found, about


def main(
    names: Annotated[list[str] | None, typer.Argument(help=f"Some of {', '.join(STUDIES)}; default all.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of runs and tables.")] = Path("out/ablations"),
    scene: Annotated[Path, typer.Option(help="Two vesicles in a flow, with steps that the networks know.")] = SCENE,
    reference: Annotated[Path | None, typer.Option(help="A trajectory of the scene to compare with; default a run of its own.")] = None,
    page_file: Annotated[Path | None, typer.Option("--page", help="Where the page of all tables goes; default in OUTPUT.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A short horizon, few variants: to see that everything works.")] = False,
) -> None:
    """One table each of what the parts of the method are worth."""
    with one_line_errors():
        output.mkdir(parents=True, exist_ok=True)
        _, about = run_all(names or [], scene, output, QUICK if quick else Extent(), reference)
        whole = page(output, about)
        write_atomically(page_file or output / "ablations.md", whole.encode())
        typer.echo(whole)


if __name__ == "__main__":
    typer.run(main)
