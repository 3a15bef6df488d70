"""Scenes of solver.kind = "vesnet": their keys, what they refuse in one line, and what `plan` says of their maps."""

import json
import re

import pytest
from scene_helpers import DT, PAIR, cli, scene_of, the_error, write_scene

from biem.membrane.maps import SLOTS
from biem.scene.build import build
from biem.scene.config import MapsTable, Solver, load_scene, make_scene
from biem.scene.plan import memory_estimate, required_maps

VESNET = {"solver": {"kind": "vesnet"}}
REST = {"flow": {"kind": "quiescent", "rate": None}}
TENSION = {"output": {"tension": True}}
WALLS = {"flow": {"kind": None, "rate": None}, "walls": {"kind": "circle", "radius": 0.8, "omega": 100.0, "spacing": 0.2}}
LEARNED = {"solver": {"kind": "vesnet", "maps": "mlp"}}
TENSIONS = {"self_tension", "flow_tension"}


def kinds_of(scene):
    return scene.solver.maps.model_dump()


def test_the_slots_are_those_of_the_maps():
    assert tuple(MapsTable.model_fields) == SLOTS
    assert tuple(kinds_of(scene_of(VESNET))) == SLOTS


def test_maps_of_one_kind_or_one_by_one(tmp_path):
    path = write_scene(tmp_path, VESNET)
    every = lambda kind: dict.fromkeys(SLOTS, kind)
    assert kinds_of(load_scene(path)) == every("hybrid")
    assert kinds_of(load_scene(path, ["solver.maps=mlp"])) == kinds_of(load_scene(path, ['solver.maps="mlp"'])) == every("mlp")
    assert kinds_of(load_scene(path, ["solver.maps.relax=mlp"])) == {**every("exact"), "relax": "mlp"}
    table = {"relax": "ivnet", "near": "mlp"}
    assert kinds_of(load_scene(path, ['solver.maps={relax = "ivnet", near = "mlp"}'])) == {**every("exact"), **table}
    assert kinds_of(load_scene(path, ["solver.maps.relax=ivnet", "solver.maps.near=mlp"])) == {**every("exact"), **table}
    path.write_text(path.read_text() + '[solver.maps]\nrelax = "ivnet"\nnear = "mlp"\n')
    assert kinds_of(load_scene(path)) == {**every("exact"), **table}


def test_near_hybrid_counts_as_exact_and_other_solvers_have_exact_maps():
    assert scene_of(VESNET).solver.map_kinds == {**dict.fromkeys(SLOTS, "hybrid"), "near": "exact"}
    assert scene_of(LEARNED).solver.map_kinds == dict.fromkeys(SLOTS, "mlp")
    assert Solver(kind="split").map_kinds == dict.fromkeys(SLOTS, "exact")


@pytest.mark.parametrize(("near", "method"), [("ivnet", "layers"), ("mlp", "layers"), ("hybrid", "auto"), ("exact", "auto")])
def test_auto_is_layers_for_a_near_network(near, method):
    solver = lambda near_field: scene_of(solver={"kind": "vesnet", "maps": {"near": near}, "near_field": near_field}).solver
    assert solver("auto").near_method == method
    assert [solver(n).near_method for n in ("upsample", "layers_rbf", "none")] == ["upsample", "layers_rbf", "none"]


def test_the_resolved_scene_is_a_scene_again_and_tolerances_are_those_of_split():
    scene = scene_of(solver={"kind": "vesnet", "maps": {"relax": "mlp"}, "out_of_distribution": "refuse"})
    assert make_scene(json.loads(json.dumps(scene.model_dump(mode="json")))) == scene
    for dtype in ("float64", "float32"):
        assert Solver(kind="vesnet", dtype=dtype).tolerances == Solver(kind="split", dtype=dtype).tolerances


KINDS = ["ivnet", "mlp", "hybrid", "exact"]
WRONG = {  # settings, and the words that the message must have
    "unknown kind": (["solver.maps=mpl"], ["solver.maps = 'mpl'", *KINDS, *SLOTS]),
    "number": (["solver.maps=3"], ["solver.maps = 3", *KINDS]),
    "list": (['solver.maps=["mlp"]'], ["solver.maps = ['mlp']", *KINDS]),
    "unknown kind of one": (["solver.maps.relax=mpl"], ["solver.maps.relax = 'mpl'", *KINDS]),
    "unknown slot": (['solver.maps={advect = "mlp"}'], ["unknown key solver.maps.advect: did you mean advection?"]),
    "slot of a string": (["solver.maps=mlp", "solver.maps.relax=exact"], ["--set solver.maps.relax=exact", "maps is not a table"]),
    "weights that are not there": (["solver.weights=nets"], ["solver.weights", "nets", "relative to the scene"]),
    "weights that are a file": (["solver.weights=scene.toml"], ["solver.weights", "scene.toml", "folder"]),
    "unknown policy": (["solver.out_of_distribution=stop"], ["solver.out_of_distribution", "stop", "flag", "exact", "refuse"]),
    "tolerance": (["solver.tolerance=1e-8"], ["solver.tolerance", 'solver.kind = "implicit"']),
    "iterations": (["solver.max_iterations=10"], ["solver.max_iterations", 'solver.kind = "implicit"']),
    "far tolerance in float32": (["solver.dtype=float32", "solver.far_tolerance=1e-9"], ["solver.far_tolerance", "at least 1e-05"]),
    "maps with split": (["solver.kind=split", "solver.maps=mlp"], ["solver.maps", 'solver.kind = "vesnet"']),
    "maps with implicit": (["solver.kind=implicit", "solver.maps.near=exact"], ["solver.maps", 'solver.kind = "vesnet"']),
    "weights with split": (["solver.kind=split", "solver.weights=nets"], ["solver.weights", 'solver.kind = "vesnet"']),
    "policy with split": (["solver.kind=split", "solver.out_of_distribution=exact"], ["solver.out_of_distribution", '"vesnet"']),
    "device with implicit": (["solver.kind=implicit", "solver.device=torch"], ['solver.kind = "split" or "vesnet"']),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_keys_and_values_are_told_in_one_line(tmp_path, case):
    settings, words = WRONG[case]
    path = write_scene(tmp_path, PAIR, VESNET)
    arguments = [argument for setting in settings for argument in ("--set", setting)]
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5", *arguments), 2)
    assert [word for word in words if word not in message] == [], message
    assert [file.name for file in tmp_path.iterdir()] == ["scene.toml"]
    assert the_error(cli("plan", path, *arguments), 2) == message


def test_a_kind_that_a_solver_does_not_use_passes_where_it_is_the_default():
    build(scene_of(solver={"kind": "split", "maps": "hybrid", "out_of_distribution": "flag"}))


NEEDED = {  # changes of the scene, maps needed
    "rest": (REST, {"relax"}),
    "flow": ({}, {"relax", "advection"}),
    "tension": (TENSION, {"relax", "advection", *TENSIONS}),
    "tension at rest": ({**REST, **TENSION}, {"relax", "self_tension"}),  # nothing flows whose tension could be asked for
    "pair": (PAIR, set(SLOTS)),
    "pair at rest": ({**PAIR, **REST}, set(SLOTS)),
    "pair, upsample": ({**PAIR, "solver": {"near_field": "upsample"}}, set(SLOTS) - {"near"}),
    "pair, ying_zorin": ({**PAIR, "solver": {"near_field": "ying_zorin"}}, set(SLOTS) - {"near"}),
    "pair, none": ({**PAIR, "solver": {"near_field": "none"}}, set(SLOTS) - {"near"}),
    "pair, hybrid": ({**PAIR, "solver": {"maps": "hybrid"}}, set(SLOTS) - {"near"}),
    "pair, layers by the exact map": ({**PAIR, "solver": {"maps": "hybrid", "near_field": "layers"}}, set(SLOTS)),
    "walls": (WALLS, set(SLOTS)),
}


@pytest.mark.parametrize("case", NEEDED)
def test_plan_lists_the_maps_that_are_needed_with_their_kind_and_why_others_are_not(tmp_path, case):
    changes, needed = NEEDED[case]
    scene = scene_of(LEARNED, changes)
    assert {part.name for part in required_maps(build(scene)) if part.needed} == needed
    result = cli("plan", write_scene(tmp_path, LEARNED, changes), "--no-measure")
    assert result.exit_code == 0, result.output
    rows = {name: (mark, why) for mark, name, why in re.findall(r"^  (yes| - )  map (\w+) +(.+)$", result.output, re.MULTILINE)}
    assert tuple(rows) == SLOTS
    for slot, (mark, why) in rows.items():
        assert (mark == "yes") == (slot in needed), slot
        assert why.startswith(f"{scene.solver.map_kinds[slot]}: ") == (slot in needed), why
        assert len(why) > 8


WHY_NOT = {
    "rest": {"advection": "nothing moves the vesicle", "self_tension": "not asked for", "near": "one vesicle"},
    "flow": {"self_tension": "not asked for", "flow_tension": "not asked for", "near": "one vesicle"},
    "tension at rest": {"flow_tension": "nothing moves the vesicle"},
    "pair, upsample": {"near": 'solver.near_field = "upsample"'},
    "pair, hybrid": {"near": 'solver.near_field = "auto", that is upsample'},
}


@pytest.mark.parametrize("case", WHY_NOT)
def test_the_reason_why_a_map_is_not_needed(case):
    parts = {part.name: part for part in required_maps(build(scene_of(LEARNED, NEEDED[case][0])))}
    for slot, why in WHY_NOT[case].items():
        assert not parts[slot].needed
        assert why in parts[slot].why


def test_plan_of_other_solvers_lists_no_maps(tmp_path):
    for kind in ("implicit", "split"):
        assert "  map " not in cli("plan", write_scene(tmp_path, PAIR), "--no-measure", "--solver", kind).output


def test_memory_of_exact_maps_is_that_of_split_and_networks_keep_no_factors():
    crowd = {"vesicles": {"placement": "grid", "points": 32, "count": 400, "area_fraction": 0.2}}
    memory = lambda **solver: memory_estimate(build(scene_of(crowd, solver=solver, time={"horizon": DT})))
    split = memory(kind="split")
    assert memory(kind="vesnet", maps="exact") == split
    assert memory(kind="vesnet", maps={"relax": "mlp"}) == split
    networks = memory(kind="vesnet", maps="mlp", near_field="upsample")
    near = memory(kind="vesnet", maps="mlp")
    hybrid = memory(kind="vesnet", maps="hybrid")
    assert 0.3 * split < networks < hybrid < 2 * split
    matrix = 4.0 * 400 * 64**2
    assert near - networks == pytest.approx(5 * matrix)
    assert hybrid - split == pytest.approx(1.5 * matrix)
