"""Scenes to begin with: `new` writes those of configs/scenes, whole or with every key as a comment; the keys are read off the schema."""

import re
import tomllib
from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field
from scene_helpers import cli, the_error

from biem.run.trajectory import read_trajectory
from biem.scene.config import Scene, load_scene
from biem.scene.new import scene_names, scene_text, with_all_keys
from biem.scene.reference import as_toml, tables
from biem.scene.tables import Table

FOLDER = Path(__file__).parents[2] / "configs" / "scenes"
NAMES = sorted(path.stem for path in FOLDER.glob("*.toml"))


def test_the_scenes_of_the_package_are_those_of_the_repository():
    assert list(scene_names()) == NAMES
    for name in NAMES:
        assert scene_text(name) == (FOLDER / f"{name}.toml").read_text()
    listed = cli("new")
    assert listed.exit_code == 0
    assert [line.split()[0] for line in listed.output.splitlines()] == NAMES
    assert "Two vesicles in shear pass over each other" in listed.output


def test_a_scene_is_written_and_runs_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = cli("new", "shear_pair")
    assert result.exit_code == 0
    assert "biem run shear_pair.toml" in result.output
    assert cli("run", "shear_pair.toml", "--quiet", "--set", "time.horizon=0.04 t_gamma", "--solver", "split").exit_code == 0
    assert read_trajectory(tmp_path / "out" / "shear_pair.h5").X.shape == (2, 2, 2, 64)
    assert cli("new", "relaxation", "-o", "some/where/mine.toml").exit_code == 0
    assert load_scene(tmp_path / "some" / "where" / "mine.toml").vesicles.points == 128


def test_nothing_is_overwritten_and_unknown_names_are_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shear_pair.toml").write_text("mine")
    assert "shear_pair.toml exists: choose another name with -o" in the_error(cli("new", "shear_pair"), 2)
    assert (tmp_path / "shear_pair.toml").read_text() == "mine"
    message = the_error(cli("new", "sheer_pair"), 2)
    assert "did you mean shear_pair?" in message
    assert all(name in message for name in NAMES)
    assert [path.name for path in tmp_path.iterdir()] == ["shear_pair.toml"]
    assert "file error" in the_error(cli("new", "relaxation", "-o", "shear_pair.toml/x.toml"), 5)


def uncommented(text):
    """The text with those defaults taken in whose table is there."""
    lines = []
    live = False
    for line in text.splitlines():
        if line.startswith(("[", "# [")):
            live = line.startswith("[") and not line.startswith("[[")
        lines.append(line[2:] if live and re.match(r"# \w+ = ", line) else line)
    return "\n".join(lines)


@pytest.mark.parametrize("name", NAMES)
def test_all_keys_are_there_and_their_defaults_change_nothing(tmp_path, name):
    text = scene_text(name, all_keys=True)
    assert tomllib.loads(text) == tomllib.loads(scene_text(name))
    (tmp_path / f"{name}.toml").write_text(uncommented(text))
    scene = load_scene(tmp_path / f"{name}.toml")
    assert scene.model_dump() == load_scene(FOLDER / f"{name}.toml").model_dump()
    given = sum(len(getattr(scene, table).model_fields_set) for table in ("vesicles", "time", "solver"))
    assert given > 12  # the defaults really were taken in
    for table in (table for table in tables() if table.path and "." not in table.path):
        section = re.search(rf"^(?:# )?\[{table.path}\].*?$(.*?)(?=^(?:# )?\[|\Z)", text, re.MULTILINE | re.DOTALL)[1]
        for key in table.keys:
            if key.table is None:
                assert re.search(rf"^(# )?{key.name}( = |:|\s*=)", section, re.MULTILINE), f"{table.path}.{key.name}"


class Inner(Table):
    """What is inside."""

    size: float = Field(gt=0, le=2.5)  # of the inside


class Outer(Table):
    """An example.

    More of it.
    """

    # asked for most of all
    kind: Literal["a", "b"] = "a"
    points: int = Field(64, ge=16, multiple_of=2, description="from the field")  # not this
    pair: tuple[float, float] | None = None
    many: list[Inner] = Field([])
    one: Inner | None = None  # only
    names: list[str] = Field(["x", "y"])
    time: float | str


def test_keys_are_read_off_a_schema():
    outer, many, one = tables(Outer)
    assert (outer.path, many.path, one.path) == ("", "many", "one")
    assert (many.many, one.many) == (True, False)
    assert outer.about == "An example.\n\nMore of it."
    keys = {key.name: key for key in outer.keys}
    assert (keys["kind"].takes, keys["kind"].default, keys["kind"].about) == ('"a" or "b"', '"a"', "asked for most of all")
    assert (keys["points"].bounds, keys["points"].default) == (">= 16, a multiple of 2", "64")
    assert keys["points"].about == "from the field"
    assert (keys["pair"].takes, keys["pair"].default) == ("[number, number]", None)
    assert (keys["one"].takes, keys["one"].table, keys["one"].about) == ("table", "one", "only")
    assert (keys["names"].takes, keys["names"].default) == ("list of text", '["x", "y"]')
    assert (keys["time"].takes, keys["time"].required) == ("number or text", True)
    assert (one.keys[0].bounds, one.keys[0].required, one.keys[0].about) == ("> 0, <= 2.5", True, "of the inside")


def test_defaults_are_written_as_toml():
    for table in tables():
        for key in table.keys:
            if key.default is not None:
                tomllib.loads(f"value = {key.default}")
    assert as_toml(0.1 + 0.2) == "0.30000000000000004"
    assert as_toml(1e-10) == "1e-10"
    assert as_toml({"a": True, "b": None, "c": [1.0, "é"]}) == '{a = true, c = [1, "é"]}'


def test_every_key_says_what_it_is():
    """A description, or a docstring of the table that names it."""
    silent = [
        f"{table.path}.{key.name}"
        for table in tables()
        for key in table.keys
        if table.path and not key.about and not key.table and not re.search(rf"\b{key.name}\b", table.about)
    ]
    assert silent == []


def test_comments_of_a_scene_survive():
    text = '# top\nname = "x"\n\n[time]  # when\ndt = 1.0  # a step\nhorizon = 2.0\n'
    whole = with_all_keys(text)
    assert whole.startswith('# top\nname = "x"\n')
    assert "[time]  # when\ndt = 1.0  # a step\nhorizon = 2.0\n# save_every = 1" in whole
    assert isinstance(Scene.model_validate(tomllib.loads(whole)), Scene)
