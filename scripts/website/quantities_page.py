"""The page of observables, made from their table in the source."""

from __future__ import annotations

from biem.observe.quantities import QUANTITIES
from website.scene_pages import cell, prose

INTRODUCTION = """# Observables by name

What `biem observe` and `[observe]` compute ([how](observables.md)). Units are those of the scene. This page is made from
`biem/observe/quantities.py` each time the site is built.
"""
PLACES = {
    "suspension": "Of the suspension",
    "vesicles": "Of each vesicle",
    "pairs": "Of each pair",
    "bins": "Over the width of the flow",
}


def quantities_page() -> str:
    """The observables by where they belong, as Markdown."""
    parts = [INTRODUCTION]
    for place, title in PLACES.items():
        rows = ["| name | unit | definition |", "|---|---|---|"]
        for quantity in QUANTITIES.values():
            if quantity.place == place:
                names = f"`{quantity.name}`" + (f" ({', '.join(quantity.components)})" if quantity.components else "")
                rows.append(f"| {names} | {cell(prose(quantity.unit))} | {cell(prose(quantity.definition))} |")
        parts.append(f"## {title}\n\n" + "\n".join(rows))
    return "\n\n".join(parts) + "\n"
