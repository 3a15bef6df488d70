"""Reproductions: what runs count as, numbers read off trajectories, near-singular errors, tables and the report, one real run."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import reflect
from reproduce import app, report
from reproductions import lateral, near, poiseuille, scatter, shear, study, taylor_green
from studies.rungs import rung
from typer.testing import CliRunner

from biem.curves.curve import area, centroid, length
from biem.curves.shapes import equilibrium, perturbed, place
from biem.membrane.maps import ExactMaps
from biem.run.trajectory import Trajectory, TrajectoryWriter
from biem.scene.build import build

R = 0.128314817


def trajectory(scene, centers, times, unit=1.0, width=2.5, points=32):
    """Equilibrium shapes at centers (F, M, 2) and times (F,) in t_gamma."""
    one = equilibrium(points, 0.65)
    X = np.array([[place(one, c, 0.0) for c in frame] for frame in centers])
    F = len(times)
    zeros = dict.fromkeys(("area_error", "length_error", "bending_energy", "gmres_iterations", "wall_seconds", "min_gap"), np.zeros(F))
    attributes = {"schema": 1, "scene": json.dumps(scene.model_dump(mode="json")), "t_gamma": unit, "flow_width": width}
    return Trajectory(np.asarray(times) * unit, np.arange(F), X, None, zeros, attributes)


def write(path, made):
    path.parent.mkdir(parents=True, exist_ok=True)
    TrajectoryWriter(path, made.attributes, [made]).close()


def invoke(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_unknown_experiments_and_rungs_are_refused_in_one_line(tmp_path):
    for arguments in (["bubbles"], ["poiseuille", "--solvers", "magic"], ["timing", "--solvers", "magic"]):
        result = invoke(*arguments, "-o", tmp_path, "--quick")
        assert result.exit_code == 2
        assert len(result.stderr.strip().splitlines()) == 1
        assert "expected one of" in result.stderr


def test_options_that_an_experiment_has_not_are_refused(tmp_path):
    for arguments in (["near", "--solvers", "split"], ["shear", "--steps", 5], ["poiseuille", "--device", "cuda"]):
        result = invoke(*arguments, "-o", tmp_path, "--quick")
        assert result.exit_code == 2
        assert "goes with" in result.stderr


def test_a_run_counts_as_what_it_is(tmp_path):
    made = rung(study.SCENES / "shear_pair.toml", "split", ['time.horizon="2 t_gamma"'])
    task = study.Task(made, tmp_path / "a.h5")
    assert study.found(task).state == study.MISSING
    centers = np.zeros((3, 2, 2)) + np.array([[-0.3, 0.0], [0.3, 0.0]])
    write(task.path, trajectory(made.scene, centers, [0.0, 0.5, 1.0]))
    part = study.found(task)
    assert part.state == study.UNFINISHED
    assert part.summary()["until"] == 1.0
    write(task.path, trajectory(made.scene, centers, [0.0, 1.0, 2.0]))
    assert study.found(task).state == study.FINISHED
    record = {"scene": json.dumps(made.scene.model_dump(mode="json")), "failure": "vesicles 0 and 1 cross"}
    task.path.with_suffix(".json").write_text(json.dumps(record))
    rejected = study.found(task)
    assert rejected.state == study.REJECTED
    assert study.ended(rejected.summary()) == "**rejected** at 2"
    other = rung(study.SCENES / "shear_pair.toml", "split", ['time.horizon="3 t_gamma"'])
    assert study.found(replace(task, rung=other)).state == study.MISSING  # a trajectory of another scene is none of this run


def test_vesicles_left_in_the_cell_are_counted_by_centroids_at_even_times():
    scene = rung(study.SCENES / "taylor_green_32.toml", "split").scene
    t = np.linspace(0.0, 3.0, 13)
    leaving = np.stack([2.5 - 0.62 + 0.5 * t, 1.0 + 0 * t], axis=-1)  # crosses x = 2.5 at t = 1.24
    staying = np.broadcast_to([1.0, 1.0], leaving.shape)
    times, count = taylor_green.left(trajectory(scene, np.stack([leaving, staying], axis=1), t, unit=4e-4))
    assert times.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    assert count.tolist() == [2, 2, 2, 1, 1, 1, 1]


def test_rest_position_and_residual_velocity():
    scene = rung(study.SCENES / "poiseuille_single.toml", "split").scene
    t = np.arange(41.0)
    y = 0.1 + 0.3 * np.exp(-t / 5.0)
    y[-6:] = y[-6] + 1e-3 * np.arange(6)
    found = poiseuille.at_rest(trajectory(scene, np.stack([0.5 * t, y], axis=-1)[:, None], t, unit=2e-4, width=0.5))
    assert found["y"] == pytest.approx(y[-1] / 0.5, rel=1e-9)
    assert found["change"] == pytest.approx(np.ptp(y[t >= 20]) / 0.5, rel=1e-6)
    assert found["residual"] == pytest.approx(1e-3 / 0.5, rel=1e-4)


def test_how_fast_a_run_comes_to_the_centre_line():
    scene, t = rung(study.SCENES / "poiseuille_single.toml", "split").scene, np.arange(61.0)
    path = lambda y: trajectory(scene, np.stack([t, 0.5 * y], axis=-1)[:, None], t, unit=2e-4, width=0.5)
    assert poiseuille.approach(path(0.02 * np.exp(-t / 40.0))) == pytest.approx(40.0, rel=1e-6)
    assert poiseuille.approach(path(0.05 + 0.02 * np.exp(-t / 40.0))) is None
    assert poiseuille.approach(path(0.001 * np.exp(t / 40.0))) is None


def test_lateral_velocities_need_nodes_and_change_sign_in_a_mirror():
    X = place(perturbed(128, 0.65, modes=3, seed=1), (0.0, 0.01), 0.4)[None]
    true = lateral._across(ExactMaps(points=256), X, 0.5, 2e-4, 4)
    assert abs(true) > 1e-4
    assert lateral._across(ExactMaps(points=128), X, 0.5, 2e-4, 4) == pytest.approx(true, abs=1e-6)
    assert lateral._across(ExactMaps(points=256), reflect(X), 0.5, 2e-4, 4) == pytest.approx(-true, abs=1e-8)


@pytest.mark.parametrize(("ca", "order"), [(10, 2), (20, 2), (30, 1), (50, 1)])
def test_networks_get_steps_that_they_know_and_that_are_short(ca, order):
    scene = poiseuille.scene("vesnet:hybrid", 0.4, ca).scene
    t_gamma = 2 * R**3 / ca
    assert (scene.time.order, scene.time.dt) == (order, order * 1e-5)
    assert scene.time.dt <= 0.1201 * t_gamma
    assert scene.time.save_every * scene.time.dt == pytest.approx(t_gamma, rel=0.06)
    assert scene.vesicles.points == 32


def test_scenes_are_those_that_long_runs_were_made_with():
    made = poiseuille.scene("implicit[vesicles.points=128]", 0.2, 20)
    assert made.file == "implicit_vesicles.points=128"
    time = made.scene.time
    assert (time.dt, time.order, time.save_every, time.horizon) == ("0.1 t_gamma", 2, 10, "1200 t_gamma")
    assert made.scene.vesicles.centers == [(0.0, 2.5)]


def test_rungs_start_at_the_reference_with_its_area_and_length(tmp_path):
    X = place(equilibrium(128, 0.65), (3.0, 0.04), 0.7)[None]
    start = poiseuille.start_file(X, tmp_path / "starts" / "a.h5")
    scene = poiseuille.scene("vesnet:hybrid", 0.4, 30, start).scene
    own = build(scene).X
    assert own.shape == (1, 2, 32)
    assert area(own) == pytest.approx(area(X), rel=1e-10)
    assert length(own) == pytest.approx(length(X), rel=1e-10)
    assert centroid(own)[0] == pytest.approx([3.0, 0.04], abs=1e-5)
    assert scene.time.horizon == f"{poiseuille.FROM_REST} t_gamma"


def test_copies_begin_as_far_aside_as_is_said_and_their_growth_is_found():
    X = np.stack([place(equilibrium(32, 0.65), c, 0.3) for c in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))])
    moved = centroid(scatter.shifted(X, 1e-3, 1)) - centroid(X)
    assert np.linalg.norm(moved, axis=1) == pytest.approx(1e-3 * R, rel=1e-6)
    assert np.abs(scatter.shifted(X, 1e-3, 2) - scatter.shifted(X, 1e-3, 1)).max() > 1e-4 * R
    t = np.arange(0.0, 20.5, 0.5)
    apart = np.minimum(1e-6 * 10 ** (t / 3.0), 2.0)
    assert scatter.tenfold(t, apart) == pytest.approx(3.0, rel=1e-6)
    assert np.isnan(scatter.tenfold(t, np.full_like(t, 1e-6)))


def test_uncorrected_rungs():
    assert shear.uncorrected("vesnet:mlp") == 'vesnet:mlp[solver.near_field="none"]'
    assert shear.uncorrected("split[vesicles.points=32]") == 'split[vesicles.points=32,solver.near_field="none"]'


def test_near_singular_schemes_err_as_they_should_on_a_circle():
    points = 64
    t = 2 * np.pi * np.arange(points) / points
    X = 0.16 * np.stack([np.cos(t), np.sin(t)])[None]
    d = np.array([-0.4, 0.4, 1.2])
    targets = near.lines(X, d).reshape(-1, 2)
    expected = near.converged(X, targets)
    schemes = near.schemes(points)
    error = {
        name: np.abs(scheme(X, near.force(points), targets) - expected).max() / np.abs(expected).max() for name, scheme in schemes.items()
    }
    assert error["adaptive upsampling"] < 1e-6
    assert error["five layers, one-sided"] < 2e-3
    assert error["five layers, RBF"] > 5 * error["five layers, one-sided"]
    assert error["three layers outside, RBF"] > error["five layers, RBF"]
    outside = np.hypot(*(targets - 0).T) > 0.16
    assert outside.tolist() == [False, True, True] * 3


def test_a_quick_run_is_kept_and_reported_with_what_is_missing(tmp_path):
    output = tmp_path / "out"
    rungs = 'implicit[vesicles.points=32,solver.near_field="none"]'
    result = invoke("shear", "--quick", "--solvers", rungs, "-o", output)
    assert result.exit_code == 0, result.stderr
    folder = output / "quick" / "shear"
    results = json.loads((folder / "results.json").read_text())
    row = results["rows"][rungs]
    assert row["state"] == "finished"
    assert row["until"] == pytest.approx(0.2)
    assert row["separation"][0] == pytest.approx(np.hypot(2.3, 0.3), rel=1e-6)
    assert results["rows"]["split[vesicles.points=128]"]["state"] == "not run"
    before = next(folder.glob("*.h5")).stat().st_mtime_ns
    path = report(study.Study(output, collect=True, quick=True), tmp_path / "docs")
    assert next(folder.glob("*.h5")).stat().st_mtime_ns == before
    text = path.read_text()
    assert '| implicit, N=32, near_field="none" | finished |' in text
    assert text.count("## ") == 9
    assert "Not run yet." in text  # of timing
    for picture in set(part.partition(")")[0] for part in text.split("](")[1:] if part.startswith("images/")):
        assert (tmp_path / "docs" / picture).stat().st_size > 1000
    again = report(study.Study(tmp_path / "elsewhere", collect=True, quick=True), tmp_path / "docs")
    assert again.read_text() == text  # what is said of experiments whose runs are not there stays
