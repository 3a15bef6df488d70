"""The package as others get it: source archive and wheel, built from a copy, installed beside nothing of this repository, and run."""

import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import biem

ROOT = Path(__file__).parents[2]
LEFT_OUT = ("data", "out", "dist", "build")  # of the repository's own folder: not part of it
CACHES = shutil.ignore_patterns(".git", ".venv", ".ci", "*cache*", "__pycache__", "*.egg-info", ".benchmarks", ".hypothesis")
SEMANTIC = r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)(-[0-9A-Za-z.-]+)?"


def run(*command, folder, **options):
    done = subprocess.run([str(c) for c in command], cwd=folder, capture_output=True, text=True, timeout=300, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(source archive, wheel made from it)."""
    folder = tmp_path_factory.mktemp("package")
    ignored = lambda path, names: CACHES(path, names) | (set(LEFT_OUT) if Path(path) == ROOT else set())
    shutil.copytree(ROOT, folder / "copy", symlinks=True, ignore=ignored)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist", folder=folder / "copy")
    archive, wheel = sorted((folder / "dist").iterdir(), key=lambda path: path.suffix)
    return archive, wheel


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """The programs of an environment with the wheel and, for what it depends on, the packages of this one."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "env")
    scripts = folder / "env" / "bin"
    site = Path(run(scripts / "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", folder=folder).strip())
    (site / "others.pth").write_text("\n".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}) + "\n")
    pip = (sys.executable, "-m", "pip", "--python", scripts / "python", "install", "--no-deps", "--no-index", "--ignore-installed")
    run(*pip, "--disable-pip-version-check", "--quiet", built[1], folder=folder)
    return scripts, site, folder


def test_source_archive_has_what_is_needed(built):
    with tarfile.open(built[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames() if not archive.getmember(name).isdir()}
        assert not [member.name for member in archive.getmembers() if member.issym() or member.islnk()]
    assert built[0].name == f"vesnet-{biem.__version__}.tar.gz"
    needed = {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile", "constraints.txt", "mkdocs.yml"}
    assert needed <= names
    kinds = {"biem": "*.py", "configs": "*.toml", "docs": "*.md", "tests": "*.py", "scripts": "*.py", "notebooks": "results.ipynb"}
    for folder, pattern in kinds.items():
        there = {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob(pattern)}
        assert there <= names, sorted(there - names)
    assert not [name for name in names if re.match(r"(data|out)/|.*(__pycache__|\.venv)", name)]


def test_wheel_has_the_packages_their_scenes_and_weights(built):
    with zipfile.ZipFile(built[1]) as wheel:
        names = set(wheel.namelist())
        for scene in (ROOT / "configs" / "scenes").glob("*.toml"):
            assert wheel.read(f"biem/scene/examples/{scene.name}") == scene.read_bytes()
        metadata = wheel.read(f"vesnet-{biem.__version__}.dist-info/METADATA").decode()
        entries = wheel.read(f"vesnet-{biem.__version__}.dist-info/entry_points.txt").decode()
    for package in ("biem", "surrogate", "datagen"):
        assert {path.relative_to(ROOT).as_posix() for path in (ROOT / package).rglob("*.py")} <= names
    assert {path.relative_to(ROOT).as_posix() for path in (ROOT / "surrogate" / "shipped").rglob("*.safetensors")} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests", "scripts", "docs"))]
    assert f"\nVersion: {biem.__version__}\n" in metadata
    assert "biem = biem.__main__:app" in entries


def test_installed_package_makes_and_runs_a_scene(installed):
    programs, site, folder = installed
    find = "from importlib.util import find_spec; print(*(find_spec(name).origin for name in ('biem', 'surrogate', 'datagen')))"
    where = run(programs / "python", "-c", find, folder=folder).split()
    assert [Path(file).parents[1] for file in where] == [site] * 3
    assert run(programs / "biem", "--version", folder=folder) == f"vesnet {biem.__version__}\n"
    run(programs / "biem", "new", "shear_single", folder=folder)
    assert (folder / "shear_single.toml").read_text() == (ROOT / "configs" / "scenes" / "shear_single.toml").read_text()
    small = ("--set", "time.horizon=0.1 t_gamma", "--set", "vesicles.points=16")  # one vesicle: nothing has to be compiled first
    assert "out/shear_single.h5" in run(programs / "biem", "run", "shear_single.toml", *small, folder=folder)
    assert "ok      area kept" in run(programs / "biem", "verify", "out/shear_single.h5", folder=folder)


def test_installed_networks_find_their_weights(installed):
    programs, site, folder = installed
    scene = site / "biem" / "scene" / "examples" / "relaxation.toml"
    small = ("--solver", "vesnet", "--set", "vesicles.points=32", "--set", "time.horizon=2e-5")
    run(programs / "biem", "run", scene, *small, folder=folder)
    assert (folder / "out" / "relaxation.h5").exists()


def test_the_version_has_one_home():
    assert re.fullmatch(SEMANTIC, biem.__version__)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "biem.__version__"}
    assert version("vesnet") == biem.__version__, "installed from older sources: pip install -e ."
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == biem.__version__
    latest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert latest[1] == biem.__version__


def test_the_citation_has_what_its_format_asks_for():
    """https://github.com/citation-file-format/citation-file-format, 1.2.0."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    allowed = {"cff-version", "message", "title", "authors", "type", "abstract", "version", "license", "keywords", "references"}
    assert {"cff-version", "message", "title", "authors"} <= set(cited) <= allowed
    assert cited["cff-version"] == "1.2.0"
    assert cited["type"] == "software"
    assert cited["license"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"]
    assert cited["authors"]
    for author in (*cited["authors"], *(author for reference in cited["references"] for author in reference["authors"])):
        assert set(author) in ({"name"}, {"family-names", "given-names"})
        assert all(isinstance(text, str) and text for text in author.values())
    for reference in cited["references"]:
        assert {"type", "title", "authors"} <= set(reference)
