"""Files outside docs/ that pages link to, as pages of the site: on GitHub such links lead to the file, here to its text."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"(?<!!)\]\(((?:\.\./)+[^)#\s]+)(#[^)\s]*)?\)")
TABLE = re.compile(r"<!-- table: (\S+), (.+?) -->")
LANGUAGES = {".toml": "toml", ".py": "python", ".sh": "bash", ".json": "json", ".txt": "text", ".ipynb": "json"}


def outside_links(page: str, text: str) -> Iterator[tuple[str, str]]:
    """(link, path in the repository) of the links of a page in docs/ that leave docs/. page: its path there."""
    for found in LINK.finditer(text):
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), found[1]))
        if not path.startswith("docs/"):
            yield found[1], path


def source_page(path: str) -> str:
    """The page of a file or folder of the repository. Raises ValueError where there is none."""
    place = ROOT / path
    if place.is_dir():
        names = "\n".join(f"- `{file.name}`" for file in sorted(place.iterdir()) if not file.name.startswith((".", "__")))
        return f"# {path}\n\n{names}\n"
    if not place.is_file():
        raise ValueError(f"a page links to {path}, which is not in the repository")
    return f"# {path}\n\n````{LANGUAGES.get(place.suffix, 'text')}\n{place.read_text(encoding='utf-8').rstrip()}\n````\n"


def source_name(path: str) -> str:
    """Where the page of a file stands in the site."""
    return f"source/{path}.md"


def with_inner_links(page: str, text: str) -> str:
    """The text of a page with links that leave docs/ led to the pages of those files."""
    start = posixpath.dirname(page) or "."
    for link, path in set(outside_links(page, text)):
        text = text.replace(f"]({link}", f"]({posixpath.relpath(source_name(path), start)}")
    return text


def with_tables(text: str) -> str:
    """The text of a page with tables of other pages: <!-- table: trade.md, Presets --> stands for the first one below that heading.

    Raises ValueError where there is none.
    """
    return TABLE.sub(lambda found: table_of((ROOT / "docs" / found[1]).read_text(encoding="utf-8"), found[2]), text)


def table_of(text: str, heading: str) -> str:
    """The first table below a heading."""
    found = re.search(rf"^#+ {re.escape(heading)}\n(?:(?!#|\|).*\n)*?((?:\|.*\n)+)", text + "\n", re.MULTILINE)
    if found is None:
        raise ValueError(f'no table below a heading "{heading}"')
    return found[1]
