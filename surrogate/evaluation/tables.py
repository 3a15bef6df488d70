"""The results of an evaluation as Markdown tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Results = Mapping[str, Any]
SHOWN_STEPS = (1, 10, 30, 100)
TITLES = {"test": "held-out test runs", "taylor_green": "Taylor-Green suspension"}


def markdown(results: Results) -> str:
    """The report."""
    rungs = results["rungs"]
    lines = ["# Evaluation of the learned maps", ""]
    lines += ["Relative L2 errors; each cell: median / mean / 95th percentile / largest where nothing else is said.", ""]
    for name, maps in results.get("errors", {}).items():
        lines += _errors(name, maps, rungs)
    if results.get("velocities"):
        lines += _velocities(results["velocities"], rungs)
    for dt, found in results.get("relaxation", {}).items():
        lines += _relaxation(dt, found)
    for count, found in results.get("cost", {}).items():
        lines += _cost(count, found)
    lines += _trade(results)
    if results["notes"]:
        lines += ["## Left out", "", *(f"- {note}" for note in results["notes"]), ""]
    return "\n".join(lines)


def _errors(name: str, maps: Results, rungs: Sequence[str]) -> list[str]:
    lines = [f"## Errors on the {TITLES[name]}", ""]
    rows = []
    for title, found in maps.items():
        operator = any("operator" in f for f in found.values())
        rows.append([f"{title}, all modes" if operator else title, *(_cell(found.get(rung, {}).get("all")) for rung in rungs)])
        if operator:
            rows.append([f"{title}, operator", *(_cell(found.get(rung, {}).get("operator")) for rung in rungs)])
    counts = {f["all"]["n"] for found in maps.values() if not any("operator" in f for f in found.values()) for f in found.values()}
    lines += _table(["map", *rungs], rows)
    stepped = [[title, rung, _cell(f["all"])] for title, found in maps.items() for rung, f in found.items() if rung not in rungs]
    if stepped:
        lines += ["Relaxation by exact maps in several steps:", "", *_table(["map", "maps", "errors"], stepped)]
    if counts:
        lines += [f'{" to ".join(str(n) for n in sorted(counts))} shapes; "all modes": of pairs of a shape and a mode.', ""]
    for title, found in maps.items():
        modes = list(dict.fromkeys(k for f in found.values() for k in f.get("modes", {})))
        if modes:
            having = [rung for rung in rungs if "modes" in found.get(rung, {})]
            cells = [[k, *(_cell(found[rung]["modes"].get(k), ("median", "mean")) for rung in having)] for k in modes]
            lines += [f"### {title} by mode, {TITLES[name]}: median / mean", "", *_table(["k", *having], cells)]
    return lines


def _velocities(flows: Results, rungs: Sequence[str]) -> list[str]:
    rows = []
    for flow, slots in flows.items():
        for slot, found in slots.items():
            rows.append([flow, slot, *(_cell(found.get(rung), ("median", "mean", "p95")) for rung in rungs)])
    return ["## Velocities as they occur: median / mean / 95th percentile", "", *_table(["velocity", "map", *rungs], rows)]


def _relaxation(dt: str, found: Results) -> list[str]:
    names = [name for name in found if name != "reference"]
    last = max((len(found[name]["max"]) - 1 for name in names), default=0)
    steps = [s for s in SHOWN_STEPS if s < last] + [last]
    rows = []
    for name in names:
        cells = ["/".join(_number(found[name][what][s]) for what in ("median", "p95", "max")) for s in steps]
        rows.append([name, *cells, f"{found[name]['diverged']} of {found[name]['vesicles']}"])
    bound = found["reference"]
    rows.append(
        ["reference, changed by its extrapolation by", *(f"{_number(bound['median'][s])}/ /{_number(bound['max'][s])}" for s in steps), ""]
    )
    head = ["max node error / length after", *(f"{s} step{'s' * (s > 1)}" for s in steps), "diverged"]
    return [f"## Relaxation steps of dt = {dt}: median/95th percentile/largest", "", *_table(head, rows)]


def _cost(count: str, found: Results) -> list[str]:
    columns = list(next(iter(found.values())))
    rows = [[name, *("" if values[c] is None else f"{values[c]:.0f}" for c in columns)] for name, values in found.items()]
    return [f"## Microseconds a vesicle, {count} vesicles, one thread", "", *_table(["maps", *columns], rows)]


def trade(results: Results) -> list[tuple[str, str, str, float, dict[str, float]]]:
    """What errors cost: (quantity, column of the cost, rung) in turn, its median error and, by rung, the cost of that column."""
    if not results.get("cost"):
        return []
    count = max(results["cost"], key=int)
    cost = results["cost"][count]
    quantities: list[tuple[str, str, Results]] = []
    for flow, slots in (results.get("velocities") or {}).items():
        quantities += [(f"{slot}, {flow}", "advection and tensions", found) for slot, found in slots.items()]
    test = results.get("errors", {}).get("test", {})
    for title, found in test.items():
        if title == "self_tension":
            quantities.append((title, "advection and tensions", {rung: f["all"] for rung, f in found.items()}))
        if title.startswith("relax"):
            quantities.append((title, "relax", {rung: f["all"] for rung, f in found.items()}))
        if title == "near":
            quantities.append((title, "near", {rung: f["all"] for rung, f in found.items()}))
    rows = []
    for quantity, column, found in quantities:
        times = results.get("relaxations", {}).get(quantity, {})
        for rung, errors in found.items():
            costs = {name: values[column] * times.get(name, 1) for name, values in cost.items() if values[column] is not None}
            if errors["median"] is not None:
                rows.append((quantity, column, rung, float(errors["median"]), costs))
    return rows


def _trade(results: Results) -> list[str]:
    """Each kind against the cheapest exact maps that are at least as accurate."""
    rows = trade(results)
    table = []
    for quantity, _, rung, error, costs in rows:
        if rung.startswith("exact") or rung not in costs:
            continue
        exact = {r: (e, costs[r]) for q, _, r, e, _ in rows if q == quantity and r.startswith("exact") and r in costs}
        as_good = {r: c for r, (e, c) in exact.items() if e <= error}
        if as_good:
            best = min(as_good, key=lambda r: as_good[r])
            verdict = "exact" if as_good[best] <= costs[rung] else rung
            rival = f"{best}: {exact[best][0]:.1e}, {as_good[best]:.0f} us"
        else:
            verdict, rival = rung, "none is as accurate"
        table.append([quantity, rung, f"{error:.1e}", f"{costs[rung]:.0f} us", rival, verdict])
    if not table:
        return []
    count = max(results["cost"], key=int)
    head = ["median error of", "kind", "error", "cost a vesicle", "cheapest exact maps as accurate", "cheaper at that error"]
    about = f"Cost: of self-tension, two flow tensions and advection together, of relaxation, or of near layers; {count} vesicles, float64."
    return ["## At equal accuracy", "", about, "", *_table(head, table)]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *("| " + " | ".join(row) + " |" for row in rows), ""]


def _cell(stats: Results | None, what: Sequence[str] = ("median", "mean", "p95", "max")) -> str:
    return "" if not stats else " / ".join(_number(stats[name]) for name in what)


def _number(value: float | None) -> str:
    return "inf" if value is None else f"{value:.1e}"
