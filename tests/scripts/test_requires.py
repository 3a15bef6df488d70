"""Every scene runs the parts that its plan needs and no other; a part that runs unasked is found, and ends the script with exit code 3."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import requires
import typer
from scene_helpers import DT, PAIR, scene_of, write_scene
from studies.rungs import split_list
from typer.testing import CliRunner

from biem.scene import build as placement
from biem.scene.build import build
from biem.scene.config import load_scene

SCENES = sorted((Path(__file__).parents[2] / "configs/scenes").glob("*.toml"))
NETWORKS = ("vesnet:hybrid", "vesnet:mlp")
FEW = {  # vesicles and walls of the large scenes
    "periodic_shear": ["vesicles.count=6", "domain.periodic=[1.0, 1.0]"],
    "poiseuille_100": ["vesicles.count=6", "vesicles.box=[1.2, 1.2]"],
    "poiseuille_2000": ["vesicles.count=6", "vesicles.box=[1.2, 1.2]"],
    "taylor_green_32": ["vesicles.count=6"],
    "vesnet_taylor_green_32": ["vesicles.count=6"],
    "couette_obstacles": ["vesicles.count=4", "walls.spacing=0.1", "walls.obstacles=[]"],
}
LONE = {"relaxation", "area and length correction", "redistribution of nodes"}
COUPLED = LONE | {"background flow", "tension", "vesicle-vesicle coupling", "far field"}
FAR = {"vesicles": {"points": 32, "reduced_area": 0.65, "centers": [[-0.7, 0.0], [0.7, 0.0]], "angles": [1.57, 1.57]}}
MLP = {"solver": {"kind": "vesnet", "maps": "mlp"}, "time": {"dt": 1e-5}}


def ran(row):
    return {name for name, what in row.parts.items() if what == requires.RAN}


@pytest.fixture
def packed_once(monkeypatch):
    """A random packing is the same for every solver of a scene: made once."""
    own, made = placement.random_packing, {}

    def packing(shapes, box, gap, *rest, **more):
        key = (len(shapes), box, gap)
        if key not in made:
            made[key] = own(shapes, box, gap, *rest, **more)
        return made[key]

    monkeypatch.setattr(placement, "random_packing", packing)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_scene_runs_what_it_requires_by_every_solver(path, packed_once):
    left_out = NETWORKS[SCENES.index(path) % 2]  # each kind has every other scene
    solvers = ",".join(name for name in split_list(requires.SOLVERS) if left_out not in name)
    cases, notes = requires.scenes_of([path], solvers, ["vesicles.points=32", *FEW.get(path.stem, [])])
    by_networks = [note for note in notes if "networks are for a contrast of 1" in note]
    assert notes == by_networks
    assert len(by_networks) == (1 if path.stem == "tumbling" else 0)
    assert len(cases) + len(notes) in (2, 3)
    for name, scene in cases:
        row = requires.measure(scene, name, 1)
        assert row.wrong == (), name
        expected = COUPLED if row.vesicles > 1 else LONE | ({"background flow"} if scene.flow.kind != "quiescent" else set())
        assert expected <= ran(row), name
        assert ("advection" in ran(row)) == (scene.solver.kind != "implicit" and "background flow" in expected)
        assert ("walls" in ran(row)) == (scene.walls is not None)
        assert ("map relax" in ran(row)) == (scene.solver.kind == "vesnet")


WAYS = {
    "order 2": ({"time": {"order": 2}}, {"extrapolation"}),
    "adaptive": ({"time": {"adaptive": True}}, {"step size control"}),
    "adaptive, order 2": ({"time": {"adaptive": True, "order": 2}}, {"extrapolation", "step size control"}),
    "repulsion": ({"solver": {"repulsion": {"reach": 0.6}}}, {"repulsion"}),
    "no corrections": ({"solver": {"corrections": []}}, set()),
}


@pytest.mark.parametrize("kind", ["split", "implicit"])
@pytest.mark.parametrize("way", WAYS)
def test_options_run_their_parts_alone(way, kind):
    change, more = WAYS[way]
    row = requires.measure(scene_of(PAIR, change, {"solver": {"kind": kind}}), kind, 1)
    expected = COUPLED | more | ({"advection"} if kind == "split" else set())
    if way == "no corrections":
        expected -= {"area and length correction", "redistribution of nodes"}
    assert row.wrong == ()
    assert ran(row) == expected
    assert row.parts["near field"] == requires.READY  # 0.3 lengths apart


@pytest.mark.parametrize("solver", [{"near_field": "none"}, {"near_field": "none", "repulsion": {"reach": 0.6}}])
def test_no_search_for_near_pairs_without_a_near_field(solver):
    row = requires.measure(scene_of(PAIR, solver={"kind": "split", **solver}), "split", 1)
    assert (row.wrong, row.parts["near field"]) == ((), requires.UNNEEDED)
    assert ("near_search" in row.counts) == ("repulsion" in solver)


def test_near_networks_wait_for_a_gap():
    far, close = (requires.measure(scene_of(FAR, MLP, vesicles={"centers": [[-x, 0.0], [x, 0.0]]}), "vesnet:mlp", 1) for x in (0.7, 0.0775))
    assert (far.wrong, far.parts["map near"], far.parts["near field"]) == ((), requires.READY, requires.READY)
    assert requires.NEAR_NETWORK not in far.counts
    assert (close.wrong, close.parts["map near"], close.parts["near field"]) == ((), requires.RAN, requires.RAN)
    assert close.counts[requires.NEAR_NETWORK] == 1


def test_what_is_not_as_planned_is_said():
    problem = build(scene_of(PAIR, solver={"kind": "split"}))
    counts = requires.measure(problem.scene, "split", 1).counts
    assert requires.judged(problem, counts)[1] == ()
    alone = build(scene_of(solver={"kind": "split"}))
    lines = requires.judged(alone, counts)[1]
    assert {line.partition(" ran")[0] for line in lines} == {"tension", "vesicle-vesicle coupling", "far field", "near field"}
    (line,) = requires.judged(problem, {**counts, "pair_sum": 0, "ewald_sum": 0})[1]
    assert line.startswith("far field did not run, which the plan needs")
    (line,) = requires.judged(problem, {**counts, "near_networks_loaded": 1})[1]
    assert line == "near networks were read 1 times, and no gap asked for them"


def command(arguments):
    app = typer.Typer()
    app.command()(requires.main)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def in_this_process(cases, steps):
    return [requires.measure(scene, name, steps) for name, scene in cases]


def test_a_part_that_runs_unasked_ends_with_exit_code_3(tmp_path, monkeypatch):
    needed = requires.required_parts
    unneeded = lambda problem: [replace(part, needed=part.needed and part.name != "far field") for part in needed(problem)]
    monkeypatch.setattr(requires, "measured", in_this_process)
    path = write_scene(tmp_path, PAIR, solver={"kind": "split"})
    assert command([path, "-o", tmp_path / "a.md", "--solvers", "as written", "--steps", 1]).exit_code == 0
    assert "In all 1 rows every part that ran is one that the plan needs" in (tmp_path / "a.md").read_text()
    monkeypatch.setattr(requires, "required_parts", unneeded)
    found = command([path, "-o", tmp_path / "a.md", "--solvers", "as written", "--steps", 1])
    assert found.exit_code == 3
    assert re.search(r"error: tiny by split, as written: far field ran, which the plan does not need .*pair_sum \d+", found.output)
    assert "1 parts are not as the plan says:\n- tiny by split" in (tmp_path / "a.md").read_text()


def test_what_cannot_be_is_bad_input_or_named(tmp_path):
    for arguments in (["none.toml"], [SCENES[0], "--set", "vesicles.points=31"]):
        found = command([*arguments, "-o", tmp_path / "a.md"])
        assert found.exit_code == 2
        assert found.output.count("\n") == 1
    cases, notes = requires.scenes_of([write_scene(tmp_path, PAIR)], "as written, implicit, vesnet:mlp, splot", [])
    assert [name for name, _ in cases] == ["implicit, as written", "vesnet:mlp"]  # implicit is what the file says
    assert len(notes) == 1
    assert 'solver "splot"' in notes[0]


def test_memory_and_time_of_a_process_of_its_own(tmp_path):
    path = write_scene(tmp_path, PAIR, solver={"kind": "split"}, time={"dt": DT})
    ((name, scene),) = requires.scenes_of([path], "as written", [])[0]
    (row,) = requires.measured([(name, scene)], 2)
    assert (row.scene, row.vesicles, row.nodes, row.steps) == ("tiny", 2, 16, 2)
    assert 0 < row.planned_bytes < row.process_bytes < 1e9
    assert row.measured_bytes < 0.5 * row.process_bytes
    assert 0 < sum(row.seconds[name] for name in requires.STAGES if name in row.seconds) < row.seconds["all"]
    text = requires.page([row], ["tiny by mlp: no"])
    table = [line for line in text.splitlines() if line.startswith("| tiny |")]
    assert len(table) == 3
    assert "Not run:\n\n- tiny by mlp: no" in text
    assert load_scene(path).name == row.scene
