"""Presets of accuracy: beneath what the scene's file says, from the command line over it, beneath --set; `plan` tells what they chose."""

import json

import pytest
from scene_helpers import PAIR, cli, scene_of, table, the_error, write_scene

from biem.run.simulate import simulate
from biem.scene.accuracy import PRESETS, apply_accuracy, describe
from biem.scene.build import build
from biem.scene.config import load_scene, make_scene

BARE = {"name": "bare", "flow": {"kind": "shear", "capillary": 5.0}, "time": {"horizon": "0.1 t_gamma"}}


def value(scene, key, setting):
    return getattr(getattr(scene, key), setting)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_fills_in_all_that_the_scene_leaves_open(name):
    preset = PRESETS[name]
    scene = make_scene({**BARE, "solver": {"accuracy": name}})
    for key, settings in preset.settings.items():
        for setting, expected in settings.items():
            assert value(scene, key, setting) == expected, (key, setting)
    problem = build(scene)
    assert problem.dt == pytest.approx(preset.dt[0] * problem.flow.time_scale)


@pytest.mark.parametrize("name", PRESETS)
def test_without_a_flow_the_first_step_is_in_times_of_bending(name):
    problem = build(make_scene({"name": "rest", "time": {"horizon": 1e-4}, "solver": {"accuracy": name}}))
    assert problem.dt == pytest.approx(PRESETS[name].dt[1] * problem.t_kappa)


def test_what_the_file_says_wins_over_its_own_preset():
    scene = make_scene({**BARE, "vesicles": {"points": 40}, "time": {**BARE["time"], "dt": 1e-6}, "solver": {"accuracy": "reference"}})
    assert (scene.vesicles.points, scene.time.dt) == (40, 1e-6)
    assert (scene.solver.kind, scene.time.order) == ("implicit", PRESETS["reference"].settings["time"]["order"])


def test_from_the_command_line_it_replaces_what_the_file_says_and_set_wins_over_it(tmp_path):
    changes = {
        "vesicles": {"points": 20},
        "time": {"dt": 1e-6, "dt_min": 1e-9},
        "solver": {"kind": "split", "dtype": "float32", "near_tolerance": 1e-3, "operator_points": 20},
    }
    path = write_scene(tmp_path, PAIR, changes)
    scene = load_scene(path, ["vesicles.points=24"], accuracy="reference")
    assert (scene.vesicles.points, scene.solver.kind, scene.solver.dtype) == (24, "implicit", "float64")
    assert (scene.solver.near_tolerance, scene.solver.operator_points, scene.time.dt_min) == (None, None, None)
    assert scene.vesicles.centers == load_scene(path).vesicles.centers
    assert scene.solver.accuracy == "reference"


def test_a_resolved_scene_stays_as_it_is():
    scene = make_scene({**BARE, "vesicles": {"points": 40}, "solver": {"accuracy": "balanced"}})
    assert make_scene(scene.model_dump(mode="json")) == scene


def test_vesicles_from_a_file_keep_their_nodes():
    applied = apply_accuracy({"vesicles": {"file": "shapes.h5"}, "time": {"horizon": 1.0}}, "reference")
    assert applied["vesicles"] == {"file": "shapes.h5"}


def test_the_given_table_is_not_changed():
    given = table(PAIR)
    before = json.dumps(given)
    apply_accuracy(given, "fast")
    assert json.dumps(given) == before


def test_a_wrong_name_is_refused_in_one_line(tmp_path):
    path = write_scene(tmp_path)
    for arguments in (["--accuracy", "best"], ["--set", "solver.accuracy=best"]):
        assert 'solver.accuracy = "best": expected one of fast, balanced, reference' in the_error(cli("plan", path, *arguments), 2)


def test_plan_says_what_was_chosen_and_what_the_scene_chose_itself(tmp_path):
    path = write_scene(tmp_path, PAIR)
    printed = cli("plan", path, "--accuracy", "fast", "--set", "time.tolerance=0.5", "--no-measure").stdout
    assert 'accuracy "fast": vesicles.points = ' in printed
    assert "but the scene says time.tolerance = 0.5" in printed
    assert PRESETS["fast"].expect in printed
    assert describe(scene_of(PAIR).model_dump()) == []


def test_presets_are_cheaper_the_less_they_promise():
    """Of the pair over a tenth of t_gamma: nodes, and the work that was counted."""
    counts = {}
    for name in PRESETS:
        scene = make_scene({**BARE, **PAIR, "solver": {"accuracy": name}})
        assert build(scene).X.shape == (2, 2, PRESETS[name].settings["vesicles"]["points"])
        if name != "reference":
            run = simulate(scene)
            counts[name] = run.trajectory.step[-1] * PRESETS[name].settings["vesicles"]["points"] ** 3
            assert run.trajectory.t[-1] == pytest.approx(0.1 * build(scene).flow.time_scale)
    assert counts["fast"] < counts["balanced"]


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_says_what_to_expect(name):
    assert "R" in PRESETS[name].expect
