"""Scenes to begin with: those of configs/scenes, which are part of the package, as text with comments."""

from __future__ import annotations

import difflib
import re
from importlib.resources import files

from biem.scene.reference import Key, Keys, tables

FOLDER = "examples"  # in this package: configs/scenes
HEADER = re.compile(r"^\[\[?([\w.]+)\]\]?", re.MULTILINE)
MEANING_AT = 39  # column, where there is room


def scene_names() -> dict[str, str]:
    """By name, what each scene is, in the words of its first comment."""
    found = {file.name.removesuffix(".toml"): file for file in (files("biem.scene") / FOLDER).iterdir() if file.name.endswith(".toml")}
    return {name: _about(found[name].read_text(encoding="utf-8")) for name in sorted(found)}


def _about(text: str) -> str:
    """The comment at the top, in one line."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# ").rstrip())
    return " ".join(lines)


def scene_text(name: str, all_keys: bool = False) -> str:
    """The text of a scene. all_keys: with every key that it leaves out, as a comment. Raises ValueError for a name that there is not."""
    names = scene_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ValueError(f'there is no scene "{name}": {hint}expected one of {", ".join(names)}')
    text = (files("biem.scene") / FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    return with_all_keys(text) if all_keys else text


def with_all_keys(text: str) -> str:
    """The text of a scene with the keys that it leaves out: commented out, each with its default, or what it takes, and its meaning.

    Lines that begin with "# key = " hold the default; taking the "# " away changes nothing.
    """
    headers = list(HEADER.finditer(text))
    ends = [*(header.start() for header in headers[1:]), len(text)]
    sections = [(header[1], text[header.start() : end].rstrip()) for header, end in zip(headers, ends, strict=True)]
    parts = [text[: headers[0].start()].rstrip()]
    known = {table.path: table for table in tables()}
    for table in (table for path, table in known.items() if path and "." not in path):
        own = [body for name, body in sections if name == table.path]
        within = [(name, body) for name, body in sections if name.startswith(f"{table.path}.")]
        begin = own[0] if own else f"# {table.about.splitlines()[0]}\n# [{table.path}]"
        given = {*re.findall(r"^(\w+)\s*=", begin, re.MULTILINE), *(name.split(".")[1] for name, _ in within)}
        lines = [begin, *(_line(key, known) for key in table.keys if key.name not in given)]
        parts += ["\n".join(lines), *(body for _, body in within)]
    return "\n\n".join(parts) + "\n"


def _line(key: Key, known: dict[str, Keys]) -> str:
    """A commented line for a key."""
    inner = known[key.table] if key.table else None
    if key.default is not None:
        line = f"# {key.name} = {key.default}"
    elif inner is not None:
        line = f"# {key.name}: {{{', '.join(f'{k.name} = {k.default or k.takes}' for k in inner.keys)}}}"
    else:
        line = f"# {key.name}: {key.takes}"
    choices = key.takes if key.default is not None and inner is None and '"' in key.takes else ""
    about = key.about or (inner.about.splitlines()[0] if inner is not None else "")
    meaning = "; ".join(text for text in (choices, about) if text)
    return f"{line:<{MEANING_AT}} # {meaning}" if meaning else line
