"""Scene files: every key is validated; a refusal is one line that names the key by its path and says what to do."""

import json
import re
from typing import get_args

import pytest
from pydantic import BaseModel
from scene_helpers import scene_of, write_scene

from biem.scene.build import build
from biem.scene.config import Scene, load_scene, make_scene

# For every key of the schema, values that must be refused with the key in the message.
REFUSED = {
    "name": '"two words" | "" | 3',
    "physics.kappa_b": '0 | -1.0 | nan | "stiff" | true',
    "physics.mu": "0.0 | inf | [1.0]",
    "vesicles.file": '3 | "missing.h5"',
    "vesicles.placement": '"heap"',
    "vesicles.shape": '"star"',
    "vesicles.reduced_area": "0 | 1.0001 | -0.5 | nan",
    "vesicles.points": '17 | 14 | 0 | -32 | 32.5 | "32" | true',
    "vesicles.length": "0 | inf",
    "vesicles.seed": "-1 | 0.5",
    "vesicles.centers": "[] | [[0.0, nan]] | [[0.0, 0.0, 0.0]] | [0.0, 0.0]",
    "vesicles.angles": "[inf] | [0.0, 1.0]",
    "vesicles.unit": '"mm"',
    "vesicles.count": "0 | 1.5",
    "vesicles.area_fraction": "0 | 1.0 | nan",
    "vesicles.box": "[1.0] | [1.0, inf]",
    "vesicles.corner": "[0.0]",
    "vesicles.gap": "-0.1 | nan",
    "vesicles.contrast": '0 | -2 | [1.0, 0.0] | [] | true | "a" | inf | 2e5',
    "flow.kind": '"sheer"',
    "flow.rate": '"fast" | nan',
    "flow.u_max": "inf",
    "flow.capillary": "nan",
    "flow.width": "0 | -1",
    "flow.confinement": "0 | inf",
    "flow.function": "3",
    "walls.kind": '"box"',
    "walls.radius": '0 | -1.0 | "1"',
    "walls.inner_radius": "0",
    "walls.omega": 'nan | "fast"',
    "walls.inner_omega": "inf",
    "walls.length": "0",
    "walls.width": "-1.0",
    "walls.u_max": "nan",
    "walls.capillary": "inf",
    "walls.file": "3",
    "walls.spacing": "0",
    "walls.obstacles.shape": '"cube"',
    "walls.obstacles.center": "[0.0] | 1.0",
    "walls.obstacles.size": "0 | nan",
    "walls.obstacles.angle": '"up"',
    "walls.obstacles.aspect": "0.0 | 1.5",
    "walls.obstacles.sides": "2 | 3.5",
    "walls.obstacles.omega": "nan",
    "domain.periodic": '2.0 | [2.0] | [2.0, 0] | [-1.0, 1.0] | [1.0, inf] | [1.0, 2.0, 3.0] | ["1", 2.0] | "x" | [true, 2.0]',
    "time.dt": '0 | -1e-4 | nan | inf | true | [1] | "0.01 furlongs" | "t_gamma" | "1 2 t_gamma" | "" | "-1 t_gamma" | "nan"',
    "time.horizon": '0 | -1.0 | "inf t_kappa" | inf',
    "time.save_every": "0 | 2.5",
    "time.order": "0 | 3 | true",
    "time.adaptive": '1 | "yes"',
    "time.tolerance": '0 | -1e-3 | 1.0 | nan | "1e-3 t_gamma"',
    "time.dt_min": '0 | -1e-6 | inf | true | [1] | "1e-4 furlongs" | ""',
    "solver.kind": '"exact"',
    "solver.accuracy": '"best" | 3 | true',
    "solver.tolerance": "0 | 1",
    "solver.max_iterations": "0",
    "solver.operator_points": "8 | 33",
    "solver.near_field": '"far"',
    "solver.near_tolerance": "-1e-8 | nan",
    "solver.device": '"gpu" | "cuda:x" | 0',
    "solver.dtype": '"float16" | 32',
    "solver.maps.relax": '"net" | 3 | true',
    "solver.maps.self_tension": '"Exact"',
    "solver.maps.advection": '["mlp"]',
    "solver.maps.flow_tension": '""',
    "solver.maps.near": '"layers"',
    "solver.weights": '3 | "missing"',
    "solver.out_of_distribution": '"ignore" | true',
    "solver.far_field": '"fmm"',
    "solver.far_tolerance": "0 | 1 | nan",
    "solver.repulsion.reach": '0 | -1 | "near"',
    "solver.repulsion.strength": "0 | nan",
    "solver.corrections": '["areas"] | "area_length"',
    "solver.max_error": "0 | nan",
    "output.trajectory": "5",
    "output.checkpoint_every": "0",
    "output.tension": "3",
    "observe.every": "0 | 1.5",
    "observe.quantities": '"stress" | [3]',
    "observe.bins": "0 | 2.5",
    "tracers.file": '3 | "missing"',
    "tracers.count": "0 | 1.5",
    "tracers.box": "[1.0] | [1.0, inf] | 1.0",
    "tracers.corner": '[0.0] | [nan, 0.0] | "left"',
    "tracers.region": '"middle" | 1',
    "tracers.seed": "-1 | 0.5",
}


def schema(model=Scene, prefix=""):
    """All keys of a scene file by their paths."""
    for name, field in model.model_fields.items():
        inner = [a for a in (field.annotation, *get_args(field.annotation)) if isinstance(a, type) and issubclass(a, BaseModel)]
        if inner:
            yield from schema(inner[0], f"{prefix}{name}.")
        elif name != "folder":
            yield prefix + name


def setting(key, value):
    """The override of a key, also of one in a list of tables."""
    return f"walls.obstacles=[{{{key.split('.')[-1]}={value}}}]" if key.startswith("walls.obstacles.") else f"{key}={value}"


def in_list(key):
    """The key as an error names it."""
    return key.replace("walls.obstacles.", "walls.obstacles.0.")


def refusal(path, *overrides):
    with pytest.raises(ValueError) as caught:
        build(load_scene(path, overrides))
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in REFUSED.items() for value in values.split(" | ")])
def test_bad_value_is_refused_with_its_key(tmp_path, key, value):
    assert in_list(key) in refusal(write_scene(tmp_path), setting(key, value))


def test_every_key_of_the_schema_has_bad_values_above():
    assert set(schema()) == set(REFUSED)


@pytest.mark.parametrize("key", sorted(schema()))
def test_misspelt_key_names_its_path_and_the_nearest_key(tmp_path, key):
    wrong = key + key[-1]
    message = refusal(write_scene(tmp_path), setting(wrong, 1))
    hint = message.partition(f"unknown key {in_list(wrong)}: ")[2]
    assert re.search(rf"did you mean {key.split('.')[-1]}\?", hint), message


def test_unknown_tables_and_keys_far_from_any_name(tmp_path):
    path = write_scene(tmp_path)
    assert "did you mean vesicles?" in refusal(path, "vesicle.points=16")
    assert "kappa_b, mu" in refusal(path, "physics.zzz=1")  # no name is near: the valid ones are listed


def test_where_a_scene_lies_is_no_key_of_it(tmp_path):
    assert "unknown key folder" in refusal(write_scene(tmp_path), 'folder="elsewhere"')


ADAPTIVE = {
    "time.dt longer than the horizon": ({"dt": 2.0, "horizon": 1.0}, ["time.dt = 2", "time.horizon = 1"]),
    "time.dt_min above dt": ({"dt": 0.1, "dt_min": "0.2", "horizon": 1.0}, ["time.dt_min = 0.2", "time.dt = 0.1"]),
    "time.tolerance below precision": ({"dt": 0.1, "horizon": 1.0, "tolerance": 1e-10}, ["time.tolerance = 1e-10", "1e-09", "rounding"]),
}


@pytest.mark.parametrize("case", ADAPTIVE)
def test_adaptive_times_that_contradict_each_other_are_refused_in_one_line(case):
    time, fragments = ADAPTIVE[case]
    with pytest.raises(ValueError) as caught:
        build(scene_of(time={**time, "adaptive": True}))
    assert all(fragment in str(caught.value) for fragment in fragments), str(caught.value)
    assert "\n" not in str(caught.value)
    assert build(scene_of(time=time)).dt == time["dt"]  # equal steps care for none of it


def test_dt_min_has_units_and_is_a_thousandth_of_dt():
    time = {"dt": "0.01 t_gamma", "adaptive": True}
    assert build(scene_of(time=time)).dt_min == pytest.approx(1e-7, rel=1e-12)
    assert build(scene_of(time={**time, "dt_min": "1e-4 t_gamma"})).dt_min == pytest.approx(1e-6, rel=1e-12)


@pytest.mark.parametrize("missing", ["time.dt", "time.horizon"])
def test_missing_key_is_named(missing):
    with pytest.raises(ValueError, match=rf"key {missing} is missing"):
        scene_of(time={missing.split(".")[1]: None})


def test_pairs_of_other_than_two_numbers_are_shown():
    for name in ("box", "corner"):
        with pytest.raises(ValueError, match=rf"vesicles\.{name} = \[1\.0\]: expected two numbers"):
            scene_of(vesicles={name: [1.0]})


def test_missing_table_is_named():
    with pytest.raises(ValueError, match=r"time.* missing"):
        make_scene({"name": "no_time"})


@pytest.mark.parametrize(
    ("name", "content", "fragment"),
    [
        ("missing.toml", None, "does not exist"),
        ("folder.toml", "folder", "is a folder"),
        ("bad.toml", b"[time]\ndt = = 1\n", "line 2"),
        ("twice.toml", b"[time]\ndt = 1\ndt = 2\n", "not valid TOML"),
        ("latin.toml", b'name = "caf\xe9"\n', "not valid TOML"),
        ("empty.toml", b"", "time"),
    ],
)
def test_a_file_that_is_no_scene(tmp_path, name, content, fragment):
    path = tmp_path / name
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    message = refusal(path)
    assert fragment in message
    assert name in message or content == b""


@pytest.mark.parametrize("override", ["vesicles.points", "=32", " ", "name.first=1", "time.dt.unit=1"])
def test_set_without_key_or_value_is_refused(tmp_path, override):
    assert f"--set {override}" in refusal(write_scene(tmp_path), override)


def test_overrides_take_numbers_lists_strings_and_times(tmp_path):
    path = write_scene(tmp_path)
    numbers = ["vesicles.points=32", "vesicles.points=48", "vesicles.centers=[[1, 2.5]]"]
    scene = load_scene(path, [*numbers, "flow.kind=extensional", "time.dt=0.01 t_gamma", "output.tension=true"])
    assert (scene.vesicles.points, scene.vesicles.centers, scene.flow.kind) == (48, [(1.0, 2.5)], "extensional")
    assert (scene.time.dt, scene.output.tension) == ("0.01 t_gamma", True)
    assert load_scene(path).vesicles.points == 16


def test_name_is_the_files_unless_given(tmp_path):
    path = tmp_path / "my_scene.toml"
    path.write_text("[time]\ndt = 1\nhorizon = 2\n")
    assert load_scene(path).name == "my_scene"
    assert load_scene(path, ["name=other"]).name == "other"


def test_resolved_scene_is_a_scene_again():
    scene = scene_of(time={"dt": "0.01 t_gamma"}, solver={"corrections": []})
    again = make_scene(json.loads(json.dumps(scene.model_dump(mode="json"))), scene.folder)
    assert again == scene
    assert (build(again).X == build(scene).X).all()
