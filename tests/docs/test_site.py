"""The site of the documentation: it is built without a warning, needs no network, and holds in a browser what its pages promise."""

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urljoin, urlparse

import pytest
from browsers import browser
from limits import LIMIT
from website import sources
from website.formulas import draw_formulas, formula
from website.plain_docstrings import plain
from website.scene_pages import scene_page

from biem.scene.config import Scene
from biem.scene.new import scene_names
from biem.scene.reference import tables

ROOT = Path(__file__).parents[2]
WRITTEN = re.compile(r"\$\$.*?\$\$|(?<![\\$`])\$[^$`\n]+\$", re.DOTALL)


@pytest.fixture(scope="module")
def formulas():
    """How many the pages have that the site is made of."""
    pages = [page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md")]
    return sum(len(WRITTEN.findall(re.sub(r"```.*?```", "", text, flags=re.DOTALL))) for text in pages)


@pytest.fixture(scope="module")
def site(tmp_path_factory, formulas):
    """The folder of the site, built with warnings as errors."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {"PYTHONPATH": f"{ROOT / 'scripts'}:{ROOT}", "PATH": str(Path(sys.executable).parent), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


class Page(HTMLParser):
    """Addresses, anchors and pictures of a page, and what it would fetch."""

    FETCHED = (("script", "src"), ("link", "href"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("video", "src"))

    def __init__(self, path):
        super().__init__()
        self.links, self.anchors, self.fetched = [], set(), []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        fetched = next((given.get(name) for kind, name in self.FETCHED if kind == tag), None)
        if fetched and given.get("rel") not in ("canonical", "prev", "next"):
            self.fetched.append(fetched)


@pytest.fixture(scope="module")
def pages(site):
    """All pages by path, but the one for what is not found."""
    return {path: Page(path) for path in sorted(site.rglob("*.html")) if path.name != "404.html"}


def place_of(page, link):
    """(file, anchor) of a link within the site, or None for one that leads out of it."""
    parts = urlparse(link)
    if parts.scheme in ("http", "https", "mailto"):
        return None
    address, anchor = urldefrag(urljoin(page.as_uri(), link))
    return Path(unquote(urlparse(address).path)), unquote(anchor)


def test_every_link_leads_somewhere(pages):
    broken, outside = [], set()
    for path, page in pages.items():
        for link in page.links:
            place = place_of(path, link)
            if place is None:
                outside.add(link)
            elif not place[0].is_file() or (place[1] and place[0] in pages and place[1] not in pages[place[0]].anchors):
                broken.append(f"{path.name}: {link}")
    assert not broken
    assert outside <= {"https://squidfunk.github.io/mkdocs-material/"}, outside


def test_every_page_is_reached_from_the_first_one(site, pages):
    seen, todo = set(), [site / "index.html"]
    while todo:
        path = todo.pop()
        if path in pages and path not in seen:
            seen.add(path)
            todo += [place[0] for link in pages[path].links if (place := place_of(path, link))]
    assert seen == set(pages)
    assert len(seen) > 40


def test_nothing_is_fetched_from_elsewhere(site, pages):
    for path, page in pages.items():
        for address in page.fetched:
            assert urlparse(address).scheme in ("", "data"), f"{path.name} fetches {address}"
    for style in site.rglob("*.css"):
        assert not re.search(r"@import|url\(\s*[\"']?(https?:)?//", style.read_text(encoding="utf-8")), style.name


def test_every_key_of_a_scene_is_explained():
    page = scene_page()
    for table in tables():
        assert not table.path or f"`[{table.path}]`" in page or f"`[[{table.path}]]`" in page
        for key in table.keys:
            assert re.search(rf"^\| `{key.name}` \| .+ \|$", page, re.MULTILINE), key.name
    assert "| `points` | integer, >= 16, a multiple of 2 | `64` |" in page
    assert "| `dt` | a positive, finite number" in page
    assert {table.path.split(".")[0] for table in tables() if table.path} == {
        name for name, field in Scene.model_fields.items() if name != "name"
    }


def test_the_site_has_keys_scenes_code_and_changes(site):
    text = lambda name: (site / name).read_text(encoding="utf-8")
    assert 'id="solver-repulsion"' in text("scene.html")
    assert all(f'id="{name}"' in text("scenes.html") for name in scene_names())
    assert 'id="biem.run.simulate.simulate"' in text("api/biem.run.html")
    assert "Raises ValueError for input that is wrong" in text("api/biem.run.html")
    assert "0.1.0" in text("changelog.html")
    assert "open it with Jupyter" in text("notebook.html")
    presets = re.findall(r"^\| \w+ \| fast \| [^|]+\| ([\d.]+) \|", (ROOT / "docs" / "trade.md").read_text(), re.MULTILINE)
    assert presets
    assert all(f">{cost}<" in text("ladder.html") for cost in presets)


def test_formulas_are_drawings_with_their_text_beside_them():
    found = draw_formulas('<p>a <span class="arithmatex">\\(x_j &lt; \\frac{1}{2}\\)</span></p>')
    svg = ET.fromstring(found[found.index("<svg") : found.index("</svg>") + 6])
    assert svg.attrib["aria-label"] == r"x_j < \frac{1}{2}"
    assert len(svg.findall("path")) >= 5  # x, j, <, 1, 2, and the bar
    height = lambda tex: float(re.search(r"height:([\d.]+)em", formula(tex, False))[1])
    assert height(r"\frac{a}{b}") > 1.5 * height("a")
    assert "vertical-align:-0" in formula("x_j", True)  # it goes below the line
    for wrong in (r"\notacommand x", r"\frac{a"):
        with pytest.raises(ValueError, match="formula"):
            formula(wrong, False)


def test_docstrings_stay_as_they_are_written():
    text = "Sum of S[X, f](x), u_i * v_i*w.\n\n    u = sum_j *S_j*\n\nThen `a_b` and <c>."
    written = plain(text)
    assert r"S\[X, f\](x)" in written
    assert r"u\_i \* v\_i\*w" in written
    assert "\n        u = sum_j *S_j*\n" in written  # a block of code, literal
    assert "`a_b`" in written


def test_links_out_of_the_folder_become_pages():
    text = "see [a](../configs/scenes/shear_pair.toml), [b](trade.md#presets), ![c](images/x.png)"
    assert [path for _, path in sources.outside_links("dataset.md", text)] == ["configs/scenes/shear_pair.toml"]
    assert "(source/configs/scenes/shear_pair.toml.md)" in sources.with_inner_links("dataset.md", text)
    assert "capillary = 5.0" in sources.source_page("configs/scenes/shear_pair.toml")
    with pytest.raises(ValueError, match="not in the repository"):
        sources.source_page("configs/none.toml")
    with pytest.raises(ValueError, match="no table"):
        sources.with_tables("<!-- table: trade.md, Nothing -->")


LOOK = """
const math = [...document.querySelectorAll('svg.math')].map(s => {
  const outer = s.getBoundingClientRect(), box = s.getBBox();
  return outer.width > 2 && outer.height > 2 && box.width > 0 && box.height > 0 && s.querySelectorAll('path').length > 0;
});
const article = document.querySelector('article');
const prose = article.cloneNode(true);
prose.querySelectorAll('code, pre').forEach(part => part.remove());
return {
  math,
  images: [...document.images].map(i => [i.getAttribute('src'), i.complete, i.naturalWidth]),
  fetched: performance.getEntriesByType('resource').map(r => r.name),
  prose: prose.textContent,
  wide: document.documentElement.scrollWidth,
  heading: article.querySelector('h1').textContent,
};
"""


@pytest.fixture(scope="module")
def opened(site, tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as driver:
        driver.set_window_size(1300, 900)
        yield driver


def test_pages_in_a_browser(opened, site, pages, formulas):
    drawn = 0
    for path in pages:
        opened.get_log("browser")
        opened.get(path.as_uri())
        seen = opened.execute_script(LOOK)
        name = path.relative_to(site).as_posix()
        assert opened.get_log("browser") == [], name
        assert all(seen["math"]), f"{name}: a formula is empty"
        drawn += len(seen["math"])
        missing = [source for source, complete, width in seen["images"] if not (complete and width > 0)]
        assert not missing, f"{name}: {missing}"
        assert all(address.startswith("file:") for address in seen["fetched"]), name
        if not name.startswith("api/"):  # docstrings are shown as they are
            assert not re.search(r"\$\$|\\frac|\\sum|\\\(|\]\(", seen["prose"]), f"{name}: Markdown or LaTeX is shown as it is"
        assert seen["wide"] <= 1300, f"{name} is wider than the window"
        assert seen["heading"].strip()
    assert drawn == formulas > 100


def test_search_works_from_the_disk(opened, site):
    opened.get((site / "index.html").as_uri())
    field = opened.find_element("css selector", "input.md-search__input")
    field.click()
    field.send_keys("repulsion")
    from selenium.webdriver.support.ui import WebDriverWait

    found = lambda driver: [a.get_attribute("href") for a in driver.find_elements("css selector", "a.md-search-result__link")]
    WebDriverWait(opened, 20).until(lambda driver: any("scene.html" in link for link in found(driver)))
    assert opened.get_log("browser") == []
