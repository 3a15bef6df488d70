"""Docstrings as they were written: an extension of griffe that keeps Markdown from reading formulas as emphasis and links."""

from __future__ import annotations

import re
from typing import Any

import griffe

SPECIAL = re.compile(r"([\\*_\[\]<>#|])")
INDENTED = re.compile(r"^( {2,}\S)")


def plain(text: str) -> str:
    """The text with what is special to Markdown escaped; indented lines, which hold formulas and tables, become blocks of code."""
    lines: list[str] = []
    in_block = False
    for line in text.splitlines():
        indented = bool(INDENTED.match(line)) or (in_block and not line.strip())
        if indented and not in_block and lines and lines[-1].strip():
            lines.append("")
        if in_block and not indented and lines[-1].strip():
            lines.append("")
        lines.append(f"    {line}" if indented and line.strip() else "" if indented else _escaped(line))
        in_block = indented
    return "\n".join(lines)


def _escaped(line: str) -> str:
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(part if part.startswith("`") else SPECIAL.sub(r"\\\1", part) for part in parts)


class PlainDocstrings(griffe.Extension):
    """Escapes every docstring as it is collected."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = plain(obj.docstring.value)
