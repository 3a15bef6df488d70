"""Hooks of mkdocs (mkdocs.yml): pages made from the source, the parts of the navigation that follow from the files, formulas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from website.formulas import draw_formulas
from website.quantities_page import quantities_page
from website.scene_pages import scene_page, starters_page
from website.sources import ROOT, outside_links, source_name, source_page, with_inner_links, with_tables

PACKAGES = ("biem", "surrogate", "datagen")
PUBLIC = {
    "biem.load_scene": "biem.scene.config.load_scene",
    "biem.simulate": "biem.run.simulate.simulate",
    "biem.read_trajectory": "biem.run.trajectory.read_trajectory",
    "biem.single_layer": "biem.stokes.single_layer.single_layer",
    "biem.ExactMaps": "biem.membrane.maps.ExactMaps",
    "biem.MembraneMaps": "biem.membrane.maps.MembraneMaps",
    "surrogate.load_maps": "surrogate.library.load_maps",
    "datagen.shards.open_joined": "datagen.shards.open_joined",
}
MEASURED = ("reproduction", "extremes", "trade", "ablations", "requires", "evaluation", "training", "measurements", "dataset")
WITHOUT_PAGE = ("__main__", "_loop", "_tables")  # ends of names of modules that explain themselves in others


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The open parts of the navigation: the folders cookbook/ and method/, measured pages, what no entry names, the packages."""
    docs = Path(config.docs_dir)
    named = {*(entry for entry in _names(config.nav) if entry.endswith(".md")), *(f"{name}.md" for name in MEASURED)}
    config.nav = _filled(
        config.nav,
        {
            "./": [*(path.name for path in sorted(docs.glob("*.md")) if path.name not in named), "quantities.md"],
            "measured/": [f"{name}.md" for name in MEASURED if (docs / f"{name}.md").exists()],
            "cookbook/": [f"cookbook/{path.name}" for path in sorted(docs.glob("cookbook/*.md"))],
            "method/": [f"method/{path.name}" for path in sorted(docs.glob("method/*.md"))],
            "api/": ["api/index.md", *(f"api/{name}.md" for name in api_pages())],
        },
    )
    return config


def _names(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    inner = nav.values() if isinstance(nav, dict) else nav
    return [name for value in inner for name in _names(value)]


def _filled(nav: Any, folders: dict[str, list[str]]) -> Any:
    """The navigation with folders replaced by their pages."""
    if isinstance(nav, str):
        return folders.get(nav, nav)
    if isinstance(nav, dict):
        return {title: _filled(value, folders) for title, value in nav.items()}
    return [_filled(value, folders) for value in nav]


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds the pages that are made."""
    made = {
        "scene.md": scene_page(),
        "scenes.md": starters_page(),
        "quantities.md": quantities_page(),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        "notebook.md": notebook_page(ROOT / "notebooks" / "results.ipynb"),
        "api/index.md": api_index(),
        **{f"api/{name}.md": text for name, text in api_pages().items()},
    }
    for page in list(files.documentation_pages()):
        for _, path in outside_links(page.src_uri, page.content_string):
            made[source_name(path)] = source_page(path)
    for name, text in made.items():
        file = File.generated(config, name, content=text)
        if name.startswith("source/"):
            file.inclusion = type(file.inclusion).NOT_IN_NAV
        files.append(file)
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links that leave docs/ lead to pages of the files; tables of other pages are put in; what can be folded is Markdown too."""
    text = with_tables(with_inner_links(page.file.src_uri, markdown))
    return text.replace("<details><summary>", '<details markdown="1"><summary>')


def on_page_content(html: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas are drawn."""
    try:
        return draw_formulas(html)
    except ValueError as error:
        raise SystemExit(f"error: {page.file.src_uri}: {error}") from None


def api_pages() -> dict[str, str]:
    """By folder of modules, its page: the folder's docstring and that of each module with its public names."""
    pages: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if not parts[-1].endswith(WITHOUT_PAGE) and path.read_text(encoding="utf-8").strip():
                pages.setdefault(".".join(parts[:-1]), []).append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return {name: f"# {name}\n\n" + "\n\n".join(f"::: {module}" for module in modules) + "\n" for name, modules in pages.items()}


def api_index() -> str:
    """What a program of one's own calls, and where the rest is."""
    face = "\n".join(f"- [`{short}`][{full}]" for short, full in PUBLIC.items())
    rest = "\n".join(f"- [{name}]({name}.md)" for name in api_pages())
    return f"# Reference of the code\n\nWhat a program of one's own calls:\n\n{face}\n\nAll of it, from the docstrings:\n\n{rest}\n"


def notebook_page(path: Path) -> str:
    """The cells of a notebook, as Markdown."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"]).rstrip()
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    where = path.relative_to(ROOT).as_posix()
    return "\n\n".join([parts[0], f"This is `{where}`; open it with Jupyter, beside the trajectory that it names.", *parts[1:]]) + "\n"
