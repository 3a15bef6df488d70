"""Seconds of a time step, M = 48, 504, 1020, 2000, N = 32, by stage: `scripts/bench_step.py`, each case kept."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import product
from pathlib import Path

from tqdm import tqdm

from biem.errors import NumericalFailure
from reproductions.pictures import color, figure, label, save
from reproductions.study import ROOT, Results, Study, read_results, table, write_results

NAME = "timing"
COUNTS = (48, 504, 1020, 2000)
SOLVERS = ("split", "vesnet:hybrid", "vesnet:mlp", "vesnet:ivnet", "implicit")
PAPER = {  # a row of its table: the stages that it is, and its seconds
    "near-singular integral": (("near",), (0.05, 0.10, 0.18, 0.34)),
    "direct evaluation of the single layer (x 2)": (("far",), (0.00, 0.05, 0.17, 0.66)),
    "velocity-related tension": (("flow tension",), (0.02, 0.04, 0.07, 0.13)),
    "self-tension": (("self-tension",), (0.01, 0.01, 0.01, 0.02)),
    "advection": (("advection",), (0.02, 0.04, 0.08, 0.15)),
    "relaxation": (("relaxation",), (0.01, 0.01, 0.01, 0.02)),
    "equal arclengths (x 3)": (("redistribution",), (0.03, 0.03, 0.03, 0.04)),
}
PAPER_TOTAL = {"VesNet": (0.14, 0.29, 0.56, 1.37), "BIEM, N = 32": (0.53, 1.44, 3.68, 12.88)}
LIMIT = 1800  # seconds a case


def measure(study: Study) -> Results:
    """Cases that are not there, results.json, picture."""
    folder = study.folder(NAME)
    if study.collect:
        return read_results(study, NAME) or {}
    counts, repeat = ((8,), 1) if study.quick else (COUNTS, 5)
    solvers = study.solvers or SOLVERS
    unknown = [solver for solver in solvers if solver not in SOLVERS]
    if unknown:
        raise ValueError(f'there is no timing of solver "{unknown[0]}": expected one of {", ".join(SOLVERS)}')
    cases = list(product(solvers, counts))
    for solver, count in tqdm(cases, desc="timing", unit="case", dynamic_ncols=True):
        _bench(solver, count, study.device, repeat if solver != "implicit" else min(repeat, 2), _file(folder, solver, count, study.device))
    rows = {path.stem: _read(path) for path in sorted(folder.glob("*_*.json"))}
    found = {"counts": list(counts), "rows": {name: row for name, row in rows.items() if row}}
    return write_results(study, NAME, {**found, "pictures": [_picture(found, folder / "steps.png")]})


def _file(folder: Path, solver: str, count: int, device: str) -> Path:
    return folder / f"{solver.replace(':', '-')}_{count}_{device.replace(':', '-') if solver != 'implicit' else 'cpu'}.json"


def _bench(solver: str, count: int, device: str, repeat: int, path: Path) -> None:
    """One case by the benchmark, unless it is there. Raises NumericalFailure."""
    if path.exists():
        return
    command = [sys.executable, str(ROOT / "scripts" / "bench_step.py"), "--solvers", solver, "--counts", str(count), "--limit", str(LIMIT)]
    command += ["--devices", device, "--dtypes", "float32", "--repeat", str(repeat), "--json", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if done.returncode:
        raise NumericalFailure(f"{solver}, M = {count}: {(done.stderr.strip().splitlines() or ['no word'])[-1]}")


def _read(path: Path) -> Results | None:
    """The one step in a file; None where the case was over its limit."""
    found = json.loads(path.read_text())
    if not found["steps"]:
        return None
    step = found["steps"][0]
    kept = ("solver", "M", "device", "dtype", "seconds", "stages", "memory_bytes", "gmres_iterations")
    return {**{name: step[name] for name in kept}, "machine": found["machine"]}


def _picture(found: Results, path: Path) -> str:
    made, axes = figure(6.5, 4.2)
    panel = axes[0, 0]
    for solver, device in dict.fromkeys((r["solver"], r["device"]) for r in found["rows"].values()):
        mine = sorted((r["M"], r["seconds"]) for r in found["rows"].values() if (r["solver"], r["device"]) == (solver, device))
        panel.loglog(*zip(*mine, strict=True), "o-" if device == "cpu" else "s--", color=color(solver), label=f"{label(solver)}, {device}")
    for name, style in (("VesNet", ":"), ("BIEM, N = 32", "-.")):
        panel.loglog(COUNTS, PAPER_TOTAL[name], style, color="0.5", label=f"paper, {name}, GH200")
    panel.set(xlabel="vesicles", ylabel="seconds a step")
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)
    return save(made, path)


def section(results: Results) -> str:
    """Statement, finding, difference."""
    rows, counts = list(results["rows"].values()), results["counts"]
    text = []
    by = {(r["solver"], r["device"], r["M"]): r for r in rows}
    kinds = list(dict.fromkeys((r["solver"], r["device"]) for r in rows))
    paper = [
        [f"paper, {name}, GH200", "float32", *(dict(zip(COUNTS, v, strict=True)).get(M) for M in counts)] for name, v in PAPER_TOTAL.items()
    ]
    own = [
        [
            f"{label(s)}, {d}",
            next(r["dtype"] for r in rows if (r["solver"], r["device"]) == (s, d)),
            *(by.get((s, d, M), {}).get("seconds") for M in counts),
        ]
        for s, d in kinds
    ]
    text.append(table(["seconds a step", "precision", *(f"M = {M}" for M in counts)], [*own, *paper]))
    for solver, device in kinds:
        if solver == "implicit":
            continue
        lines = []
        for title, (stages, seconds) in PAPER.items():
            line: list[object] = [title]
            for M in counts:
                r = by.get((solver, device, M))
                line += [
                    None if r is None else float(sum(r["stages"].get(s, 0.0) for s in stages)),
                    dict(zip(COUNTS, seconds, strict=True)).get(M),
                ]
            lines.append(line)
        text.append(f"{label(solver)} on {device}, by the rows of the paper's table; beside each the paper's seconds:")
        text.append(table(["stage", *(head for M in counts for head in (f"M = {M}", "paper"))], lines))
    last = max(counts)
    quick = [(s, d, by[s, d, last]["seconds"]) for s, d in kinds if s != "implicit" and (s, d, last) in by]
    if quick:
        name, device, seconds = min(quick, key=lambda item: item[2])
        text.append(f"The fastest step of {last} vesicles: {label(name)} on {device}, {seconds:.3g} s.")
        slow = by.get(("implicit", "cpu", last))
        if slow:
            text[-1] += (
                f" The implicit solver takes {slow['seconds'] / seconds:.3g} times as long ({slow['gmres_iterations']} GMRES "
                f"iterations in its last step)."
            )
    machines = sorted({f"{r['machine']['cores']} cores, {r['machine']['threads']} threads" for r in rows})
    return "\n\n".join(
        [
            "**The paper**: on a GH200, float32, a step of 2,000 vesicles takes 1.37 s by VesNet and 12.88 s by BIEM.",
            f"**Found** (`scripts/bench_step.py`, {'; '.join(machines)}; BIEM in float64):",
            *text,
            "**Why they differ**: other machines; the far field here is a fast sum above some thousand points, not the direct one of "
            "all pairs; exact operators of 64 "
            "nodes are small dense matrices, which a processor's caches hold; and the implicit solver's layers are by quadrature, not "
            "by RBF.",
        ]
    )
