"""Pages made from the schema and the files of scenes: every key, and the scenes to begin with."""

from __future__ import annotations

import re
from collections.abc import Mapping

from biem.scene.new import scene_names, scene_text
from biem.scene.reference import Key, Keys, tables

INTRODUCTION = """# Keys of a scene

A scene is a TOML file. Unknown keys are refused, with the nearest known one; every key can be overridden on the command line with
`--set table.key=value`, and `biem new NAME --all-keys` writes a scene with all of them. This page is made from the schema,
`biem/scene/config.py`, each time the site is built.

"""


def scene_page() -> str:
    """Every table with its keys, as Markdown."""
    every = tables()
    subjects = {table.path: table.about.partition("\n")[0] for table in every}
    return INTRODUCTION + "\n\n".join(_section(table, subjects) for table in every) + "\n"


def _section(table: Keys, subjects: Mapping[str, str]) -> str:
    """subjects: by path, what each table is."""
    brackets = f"[[{table.path}]]" if table.many else f"[{table.path}]"
    title = f"## `{brackets}` {{ #{anchor(table.path)} }}" if table.path else "## The file itself { #file }"
    rows = ["| key | takes | default | what it is |", "|---|---|---|---|", *(_row(key, subjects) for key in table.keys)]
    return "\n\n".join([title, prose(table.about) if table.path else "", "\n".join(rows)])


def _row(key: Key, subjects: Mapping[str, str]) -> str:
    takes = f"[table](#{anchor(key.table)})" if key.table else code_words(key.takes)
    takes += f", {key.bounds}" if key.bounds else ""
    default = "**required**" if key.required else f"`{key.default}`" if key.default and not key.table else ""
    about = key.about or subjects.get(key.table or "-", "")
    return f"| `{key.name}` | {cell(takes)} | {cell(default)} | {cell(prose(about))} |"


def anchor(path: str) -> str:
    """Where a table stands on the page."""
    return path.replace(".", "-")


def code_words(text: str) -> str:
    """Values in quotes as code."""
    return re.sub(r'"[^"]*"', lambda found: f"`{found[0]}`", text)


def prose(text: str) -> str:
    """What the source says, safe as Markdown: code stays code, the rest is taken literally."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([\\*_\[\]<>|])", r"\\\1", part) for part in parts)


def cell(text: str) -> str:
    """Text that may stand in a cell of a table."""
    return re.sub(r"(?<!\\)\|", r"\\|", text).replace("\n", " ")


def starters_page() -> str:
    """The scenes of configs/scenes: what they are, and their text."""
    parts = [
        "# Scenes to begin with",
        "`biem new NAME` writes one of these into the folder that you are in. They are the files of `configs/scenes`.",
    ]
    for name, about in scene_names().items():
        parts += [f"## {name}", prose(about), f"```toml\n{scene_text(name).rstrip()}\n```"]
    return "\n\n".join(parts) + "\n"
