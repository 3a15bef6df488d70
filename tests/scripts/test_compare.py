"""Comparisons of solvers: what is run, the numbers, the summary, and the command with runs of its own."""

import json
import math

import compare
import numpy as np
import pytest
import typer
from comparison_cases import UNIT, comparison, kept_all_here, ran
from scene_helpers import DT, PAIR, error_line, the_error, write_scene
from studies import compared as numbers
from studies.fitting import MOST_FRAMES, coarser, entry, reference_name
from studies.pareto import front
from typer.testing import CliRunner

from biem.run.trajectory import read_trajectory
from biem.scene.build import build

PAIR_SCENE = "configs/scenes/shear_pair.toml"
TINY = "implicit[vesicles.points=16, time.order=2]"


@pytest.fixture
def here(monkeypatch, request):
    """The root of the repository as the working folder."""
    monkeypatch.chdir(request.config.rootpath)
    return request.config.rootpath


@pytest.fixture
def at_once(monkeypatch):
    """Runs in this process, in place of one each."""
    begun = []

    def all_here(tasks, *_, **__):
        begun.extend(tasks)
        return kept_all_here(tasks)

    monkeypatch.setattr(compare, "kept_all", all_here)
    return begun


def command(*arguments):
    """`python scripts/compare.py` with these arguments, in this process."""
    app = typer.Typer()
    app.command()(compare.main)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_front_keeps_what_no_other_one_beats():
    costs = [1.0, 2.0, 2.0, 3.0, 4.0, 5.0, math.nan]
    errors = [0.5, 0.3, 0.2, 0.2, 0.1, 0.4, 0.0]
    assert front(costs, errors) == [0, 2, 4]
    assert front([1.0, 1.0], [0.2, 0.2]) == [0]
    assert front([], []) == []


def test_networks_get_their_nodes_and_steps(here):
    found = entry(here / PAIR_SCENE, "vesnet:mlp")
    assert (found.rung.scene.vesicles.points, found.rung.scene.time.order, found.rung.scene.time.dt) == (32, 2, 2e-5)
    assert "vesicles.points = 32" in found.notes[0]
    assert "time.dt = 2e-05" in found.notes[0]
    assert entry(here / "configs/scenes/vesnet_pair.toml", "vesnet:mlp").notes == ()
    own = entry(here / PAIR_SCENE, "vesnet:mlp[time.dt=1e-5, time.order=1]")
    assert (own.rung.scene.time.dt, own.rung.scene.time.order, own.rung.scene.vesicles.points) == (1e-5, 1, 32)
    larger = ["vesicles.length=2.0", "physics.mu=3.0", "physics.kappa_b=0.5"]  # dt kappa_b / (mu length^3) is what they know
    assert entry(here / PAIR_SCENE, "hybrid", larger).rung.scene.time.dt == pytest.approx(2e-5 * 3.0 * 8.0 / 0.5, rel=1e-6)
    assert entry(here / PAIR_SCENE, "vesnet:exact").notes == ()
    lost = entry(here / PAIR_SCENE, "vesnet:mlp[solver.weights='nowhere']")
    assert "nowhere" in lost.refused


def test_runs_have_frames_enough(here):
    for steps in (50, 199, 200, 201, 423, 1000, 12345):
        found = entry(here / PAIR_SCENE, "split", [f"time.horizon={steps * 0.02} t_gamma"]).rung.scene
        frames = build(found).steps / found.time.save_every
        assert min(steps, MOST_FRAMES // 2) <= frames <= MOST_FRAMES, steps


def test_reference_and_its_own_error(here):
    name = reference_name(here / PAIR_SCENE, [])
    fine = entry(here / PAIR_SCENE, name).rung.scene
    assert (fine.solver.kind, fine.vesicles.points, fine.time.order, fine.time.dt) == ("implicit", 128, 2, "0.05 t_gamma")
    twice, factor, words = coarser(here / PAIR_SCENE, name, [], None)
    assert build(twice.rung.scene).dt == pytest.approx(2 * build(fine).dt, rel=1e-12)
    assert factor == 3.0
    assert "over 3 for order 2" in words
    assert build(entry(here / PAIR_SCENE, reference_name(here / PAIR_SCENE, ["time.dt=0.005 t_gamma"])).rung.scene).dt == pytest.approx(
        0.625 * build(entry(here / PAIR_SCENE, "implicit").rung.scene).dt
    )
    assert "t_kappa" in reference_name(here / "configs/scenes/relaxation.toml", [])
    first = coarser(here / PAIR_SCENE, "implicit", [], None)
    assert first[1] == 1.0
    adaptive, factor, _ = coarser(here / PAIR_SCENE, "implicit[time.adaptive=true, time.tolerance=1e-3]", [], None)
    assert (adaptive.rung.scene.time.tolerance, factor) == (4e-3, 1.0)


def test_errors_and_costs_of_known_motions(tmp_path):
    found = numbers.results(comparison(tmp_path), 3.0 * UNIT)
    rows = {row["name"]: row for row in found["rungs"]}
    assert found["vesicles"] == 2
    assert found["until"] == pytest.approx(3.0)
    assert found["reference"]["worst"]["position"] == pytest.approx(0.003 * 3.0 / 3.0, rel=1e-6)  # the coarse run's, over 3
    assert rows["good"]["worst"]["position"] == pytest.approx(0.002 * 3.0, rel=1e-6)
    assert rows["cheap"]["end"]["separation"] == pytest.approx(0.3, rel=0.05)
    assert rows["good"]["worst"]["shape"] < 1e-9
    assert rows["good"]["cost"] == {"cpu": pytest.approx(0.02 * 100), "wall": pytest.approx(0.02 * 100)}  # 300 steps in 3 t_gamma
    assert rows["broken"]["cost"]["cpu"] == pytest.approx(0.001 * 100)
    assert not rows["broken"]["complete"]
    assert rows["unfit"]["cost"] is None
    assert found["front"]["position"]["cpu"] == ["cheap", "good"]  # not the one that failed
    assert "lateral" not in found["meaning"]  # the flow has no width
    assert "tension" not in found["meaning"]  # none was kept
    different = found["settings"]["different"]
    assert different["solver.kind"] == ["implicit", "split", "split", "implicit", "split", "split"]
    assert different["solver.tolerance"][1] is None  # of the implicit solver alone


def test_summary_says_what_the_numbers_say(tmp_path):
    text = "\n".join(numbers.results(comparison(tmp_path), 3.0 * UNIT)["summary"])
    assert "Fastest within 1% of R: good, 20 times as fast as the reference (2 against 40 CPU seconds a t_gamma)" in text
    assert "No rung beats cheap and good" in text
    assert "Cheapest: cheap, 40 times as fast as the reference, off by 0.3 R" in text
    assert "broken failed at 1 t_gamma: step 100: vesicles cross" in text
    assert "unfit was refused: they are for 32 nodes" in text
    assert "good ran with N = 32, as it likes" in text
    assert "off by about 0.003 R" in text


def test_summary_where_nothing_is_good(tmp_path):
    far = [ran(tmp_path, "cheap", 0.5, off=-0.1), ran(tmp_path, "worse", 0.1, off=0.2)]
    text = "\n".join(numbers.results(comparison(tmp_path, far, coarse=0.05), 3.0 * UNIT)["summary"])
    assert "No rung keeps all centroids within 1% of R. The closest is cheap, 1.2 times slower than the reference" in text
    assert "That is more than 1%" in text
    assert "Fastest" not in text


def test_compares_with_runs_of_their_own(tmp_path, monkeypatch):
    scene = write_scene(tmp_path, PAIR, vesicles={"points": 32}, time={"horizon": 4 * DT})
    solvers = "split[vesicles.points=16], vesnet:mlp"
    arguments = [scene, "--solvers", solvers, "--reference", TINY, "-o", tmp_path / "out"]
    done = command(*arguments)
    assert done.exit_code == 0, done.output
    folder = tmp_path / "out"
    files = {path.name for path in folder.glob("*.*")}
    assert {"report.html", "compare.json", "error_time.png", "paths.png", "membranes.png", "reference-run.h5"} <= files
    found = json.loads((folder / "compare.json").read_text())
    split, learned = found["rungs"]
    assert (split["nodes"], split["steps"], split["failure"]) == (16, 4, "")
    assert 0.0 < split["worst"]["position"] < 0.05
    assert split["peak_bytes"] > 5e7
    assert split["stages"]["relaxation"] > 0
    assert "reduced area" in learned["failure"]
    assert learned["cost"] is None
    assert f"vesnet:mlp was refused: {learned['failure']}" in done.output
    assert done.output.strip().endswith("report.html")
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    monkeypatch.setattr("studies.pictures.draw_all", lambda *_: None)  # drawn above
    again = command(*arguments)
    assert again.exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == before
    assert json.loads((folder / "compare.json").read_text())["rungs"][0] == split


def test_one_vesicle_in_a_fluid_at_rest(tmp_path, at_once):
    scene = write_scene(
        tmp_path,
        vesicles={"shape": "perturbed", "points": 16, "seed": 2},
        flow={"kind": "quiescent", "rate": None},
        time={"horizon": 8 * DT},
    )
    done = command(scene, "--solvers", "split", "--reference", TINY, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert found["unit"] == "unit of time"
    assert found["horizon"] == pytest.approx(8 * DT)
    assert found["front"]["position"]["cpu"] == ["split"]
    assert "separation" not in found["meaning"]
    assert found["rungs"][0]["worst"]["shape"] < 0.05
    assert at_once[0] == "reference-run"  # the longest first


def test_failed_rungs_are_told_and_the_rest_is_compared(tmp_path, at_once, monkeypatch):
    monkeypatch.setattr("studies.pictures.draw_all", lambda *_: None)  # they take longer than the runs
    scene = write_scene(tmp_path, PAIR, time={"horizon": 4 * DT})
    strict = "split[solver.max_error=1e-9, solver.corrections=[]]"
    done = command(scene, "--solvers", f"split, {strict}", "--reference", TINY, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    good, bad = json.loads((tmp_path / "out" / "compare.json").read_text())["rungs"]
    assert good["complete"]
    assert "error" in bad["failure"]
    assert bad["cost"] is None
    assert np.isfinite(read_trajectory(tmp_path / "out" / "split.h5").X).all()


def test_a_reference_that_fails_is_an_error(tmp_path, at_once):
    scene = write_scene(tmp_path, PAIR, time={"horizon": 4 * DT})
    failing = "implicit[solver.max_error=1e-12, solver.corrections=[]]"
    assert "made no step" in the_error(command(scene, "--solvers", "split", "--reference", failing, "-o", tmp_path / "out"), 3)
    assert (tmp_path / "out" / "split.h5").exists()  # what was computed is kept


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--solvers", "splitt"], 'solver "splitt": expected one of implicit, split'),
        (["--solvers", "split[time.odrer=2]"], "did you mean order"),
        (["--solvers", " , "], "expected rungs"),
        (["--solvers", "split, split"], "split is there twice"),
        (["--reference", "vesnet:mlp"], "the reference vesnet:mlp is refused"),
        (["--set", "vesicles.points"], "expected key=value"),
    ],
)
def test_bad_input_is_one_line(tmp_path, at_once, arguments, expected):
    scene = write_scene(tmp_path, PAIR, vesicles={"points": 16}, solver={"weights": None})
    if "vesnet:mlp" in arguments:
        arguments = [*arguments, "--weights", tmp_path / "nowhere"]
    assert expected in the_error(command(scene, "-o", tmp_path / "out", *arguments), 2)
    assert at_once == []
    assert not (tmp_path / "out").exists()


def test_missing_scene(tmp_path):
    result = command(tmp_path / "none.toml")
    assert "does not exist" in error_line(result.output, result.exit_code, 2)
