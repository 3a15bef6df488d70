"""Presets of a scene's accuracy: settings measured together, for what they cost and how far they are off (docs/trade.md).

A preset fills in what the scene leaves open; on the command line (--accuracy) it replaces what the scene says, and --set wins over it.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Preset:
    """settings: tables of a scene file, dt apart; dt: in t_gamma, and in t_kappa where the flow has no rate; expect: in words."""

    settings: Mapping[str, Mapping[str, Any]]
    dt: tuple[float, float]
    expect: str


PRESETS = {
    "fast": Preset(
        {
            "vesicles": {"points": 32},
            "time": {"order": 2, "adaptive": True, "tolerance": 1e-3},
            "solver": {"kind": "split", "dtype": "float32", "near_tolerance": 1e-4, "far_tolerance": 1e-4},
        },
        (0.05, 0.0125),
        "positions within 1.5 % of R over 10 t_gamma for one or two vesicles, 40 to 94 times cheaper than reference",
    ),
    "balanced": Preset(
        {
            "vesicles": {"points": 48},
            "time": {"order": 2, "adaptive": True, "tolerance": 5e-4},
            "solver": {"kind": "split", "dtype": "float32", "near_tolerance": 1e-5, "far_tolerance": 1e-5},
        },
        (0.02, 0.005),
        "positions within 0.8 % of R over 10 t_gamma for one or two vesicles, 26 to 51 times cheaper than reference; in dense suspensions, "
        "where differences grow tenfold in 3 t_gamma, within 1 % of R over 1 t_gamma, and numbers of vesicles beyond",
    ),
    "reference": Preset(
        {
            "vesicles": {"points": 128},
            "time": {"order": 2, "adaptive": True, "tolerance": 1e-5},
            "solver": {"kind": "implicit", "tolerance": 1e-8},
        },
        (0.01, 0.0025),
        "positions within 4e-4 R over 10 t_gamma for one or two vesicles",
    ),
}
SUPERSEDED = {  # what a scene says for another solver: gone where a preset takes its place
    "time": ("dt_min",),
    "solver": (
        *("operator_points", "near_field", "far_field", "max_iterations", "tolerance", "near_tolerance", "far_tolerance"),
        *("device", "dtype", "maps", "weights", "out_of_distribution"),
    ),
}


def apply_accuracy(table: Mapping[str, Any], name: str | None = None) -> dict[str, Any]:
    """The table of a scene with the settings of a preset: of `name`, over the table's, or of its own solver.accuracy, beneath them.

    Raises ValueError for a preset that there is not.
    """
    scene = deepcopy(dict(table))
    solver = scene.get("solver", {})
    own = solver.get("accuracy") if isinstance(solver, dict) else None
    chosen = name or own
    if chosen is None:
        return scene
    if chosen not in PRESETS:
        raise ValueError(f'solver.accuracy = "{chosen}": expected one of {", ".join(PRESETS)}')
    preset = PRESETS[chosen]
    for key, settings in {**preset.settings, "time": {**preset.settings["time"], "dt": _first_step(scene, preset)}}.items():
        target = scene.setdefault(key, {})
        if not isinstance(target, dict):
            return scene  # which is refused
        if name:
            for unused in SUPERSEDED.get(key, ()):
                target.pop(unused, None)
        for setting, value in settings.items():
            if setting == "points" and "file" in target:
                continue
            if name or setting not in target:
                target[setting] = value
    scene["solver"]["accuracy"] = chosen
    return scene


def _first_step(table: Mapping[str, Any], preset: Preset) -> str:
    """A preset's dt, in the unit that the scene has."""
    flow = table.get("flow", {})
    kind = flow.get("kind", "quiescent") if isinstance(flow, dict) else "quiescent"
    still = "walls" not in table and (kind == "quiescent" or (kind == "custom" and "rate" not in flow))
    return f"{preset.dt[1]} t_kappa" if still else f"{preset.dt[0]} t_gamma"


def describe(scene: Mapping[str, Any]) -> list[str]:
    """Lines on the preset of a scene, given as its dictionary: what it chose, what the scene chose itself, what to expect of it."""
    name = scene["solver"]["accuracy"]
    if name is None:
        return []
    preset = PRESETS[name]
    chosen: list[str] = []
    own: list[str] = []
    for key, settings in preset.settings.items():
        for setting, value in settings.items():
            if setting == "points" and scene["vesicles"]["file"] is not None:
                continue
            text = f"{key}.{setting} = {_toml(scene[key][setting])}"
            (chosen if scene[key][setting] == value else own).append(text)
    lines = [f'accuracy "{name}": {", ".join(chosen)}']
    if own:
        lines.append(f"  but the scene says {', '.join(own)}")
    lines.append(f"  measured: {preset.expect}")
    return lines


def _toml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else f"{value:g}"
