"""Rungs of the ladder: a solver with settings of its own, as a scene.

implicit, split, vesnet:hybrid, vesnet:mlp, vesnet:ivnet, vesnet:exact          the last four also without "vesnet:", but exact
split[time.order=2, vesicles.points=48]                                           settings in brackets, as of --set
fast, balanced, reference                                                         presets, as of --accuracy
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from biem.scene.accuracy import PRESETS
from biem.scene.build import SOLVERS_WITH
from biem.scene.config import Scene, load_scene, make_scene
from biem.scene.tables import override, read_toml

MAPS = ("hybrid", "mlp", "ivnet")
KNOWN = ("implicit", "split", *(f"vesnet:{maps}" for maps in (*MAPS, "exact")), *PRESETS)
OPEN, CLOSE = "[{(", "]})"


@dataclass(frozen=True)
class Rung:
    """A name as it was given, and the scene that it stands for."""

    name: str
    scene: Scene

    @property
    def file(self) -> str:
        """A file's name for it."""
        return re.sub(r"[^\w.=+-]+", "_", self.name).strip("_")


def split_list(text: str) -> list[str]:
    """The parts between commas, those within brackets or quotes apart."""
    parts, depth, quoted = [""], 0, False
    for sign in text:
        quoted ^= sign == '"'
        if not quoted:
            depth += (sign in OPEN) - (sign in CLOSE)
        if sign == "," and depth == 0 and not quoted:
            parts.append("")
        else:
            parts[-1] += sign
    return [part.strip() for part in parts if part.strip()]


def rung(path: Path, name: str, overrides: Sequence[str] = (), weights: Path | None = None) -> Rung:
    """The scene in the file by one rung: its own settings win over `overrides`, and these over the file's. Raises ValueError."""
    found = re.fullmatch(r"([\w:]+)(?:\[(.*)\])?", name.strip())
    solver = found[1] if found else name
    solver = f"vesnet:{solver}" if solver in MAPS else solver
    if found is None or solver not in KNOWN:
        raise ValueError(f'solver "{name}": expected one of {", ".join(KNOWN)}, with KEY=VALUE,... in brackets, as in split[time.order=2]')
    own = split_list(found[2] or "")
    if solver in PRESETS:
        return Rung(name.strip(), load_scene(path, [*overrides, *own], accuracy=solver))
    kind, _, maps = solver.partition(":")
    chosen = [f'solver.kind="{kind}"']
    if kind == "vesnet":
        chosen.append(f'solver.maps="{maps}"')
        chosen += [f"solver.weights={json.dumps(str(weights.absolute()))}"] if weights else []
    table = read_toml(path, "scene", "configs/scenes/shear_pair.toml", [*overrides, *chosen])
    for key, kinds in SOLVERS_WITH.items():  # what the file says for other solvers
        if kind not in kinds:
            table["solver"].pop(key, None)
    for setting in own:
        override(table, setting)
    table.setdefault("name", path.stem)
    return Rung(name.strip(), make_scene(table, path.parent))
