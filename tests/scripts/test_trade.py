"""Sweeps: what they stand for, which runs are on the front, what a failed one is worth; rungs, kept runs, an end before the horizon."""

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import trade
from comparison_cases import kept_all_here, moving
from scene_helpers import DT, PAIR, scene_of, write_scene
from studies.pareto import front
from studies.rungs import rung, split_list
from studies.runs import Kept, Record, kept, read_record, resolved, run, same_scene, weights_digest
from studies.steady import Steady

from biem.curves.shapes import ellipse
from biem.run.trajectory import read_trajectory
from biem.scene.config import load_scene


def test_a_sweep_is_all_combinations():
    names = trade.combinations("split|implicit[vesicles.points=32|48, time.dt=0.01 t_gamma|0.02 t_gamma]")
    assert len(names) == len(set(names)) == 8
    assert "implicit[vesicles.points=48, time.dt=0.01 t_gamma]" in names
    assert trade.combinations("fast") == ["fast"]
    with pytest.raises(ValueError, match="expected a solver"):
        trade.combinations("[time.order=2]")


def test_every_rung_of_the_sweeps_is_a_scene():
    names = [name for sweep in trade.SWEEPS for name in trade.combinations(sweep.format(u="t_gamma"))]
    assert len(names) > 40
    for name in names:
        assert rung(Path("configs/scenes/shear_pair.toml"), name).scene.time.horizon == "20 t_gamma"


def test_lists_are_split_outside_brackets_and_quotes():
    assert split_list('a[x=[1, 2], y={p=1, q=2}], b, "c, d"') == ["a[x=[1, 2], y={p=1, q=2}]", "b", '"c, d"']


def test_a_rung_drops_what_belongs_to_other_solvers(tmp_path):
    path = write_scene(tmp_path, {"solver": {"kind": "vesnet", "maps": "mlp", "out_of_distribution": "exact"}})
    assert rung(path, "implicit").scene.solver.maps == load_scene(path, ['solver.maps="hybrid"']).solver.maps
    assert rung(path, "ivnet").scene.solver.maps.relax == "ivnet"
    assert rung(path, "split[vesicles.points=24]", ["vesicles.points=20"]).scene.vesicles.points == 24
    assert rung(path, "reference").scene.solver.accuracy == "reference"
    with pytest.raises(ValueError, match='solver "spilt": expected one of implicit, split'):
        rung(path, "spilt")


def test_front():
    assert front([1.0, 2.0, 3.0, 4.0, 0.5], [0.1, 0.2, 0.05, np.inf, np.nan]) == [0, 2]
    assert front([1.0, 1.0], [0.2, 0.1]) == [1]


def test_a_lone_vesicle_is_steady_when_it_no_longer_moves_across():
    steady, shape = Steady(width=2.0, unit=0.5), ellipse(32, 0.8, 1.0)
    ends = [steady(0.5 * t, (shape + np.array([[t], [2.0 * 0.3 * np.exp(-t / 5.0)]]))[None]) for t in range(100)]
    first = ends.index(True)  # when 0.3 (e^{-(t - 20)/5} - e^{-t/5}) is below 5e-4
    assert first == int(np.ceil(20 + 5 * np.log(0.3 * (1 - np.exp(-4)) / 5e-4)))


class Twice:
    """Ends a run at its third saved frame, those before a restart included."""

    def __init__(self, scene, earlier):
        self.seen = 0 if earlier is None else len(earlier)

    def __call__(self, t, X):
        self.seen += 1
        return self.seen >= 3


def test_runs_are_kept_and_may_end_early(tmp_path):
    scene, path = scene_of(time={"save_every": 1}), tmp_path / "a.h5"
    record = run(scene, path, Twice)
    assert (record.steps, record.failure, record.code) == (3, "", 0)
    assert record.until == pytest.approx(3 * DT)
    assert record.cpu_a_step > 0
    assert record.peak_bytes > 1e7
    again = kept(scene, path)  # from its files: no process is started
    assert again.record == record
    assert read_record(scene_of(time={"save_every": 2}), path) is None


def test_other_weights_are_another_run(tmp_path):
    (tmp_path / "w" / "mlp").mkdir(parents=True)
    file = tmp_path / "w" / "mlp" / "relax.safetensors"
    file.write_bytes(b"one")
    scene = scene_of(folder=tmp_path, solver={"kind": "vesnet", "maps": "mlp", "weights": "w"})
    path = tmp_path / "a.h5"
    record = Record(resolved(scene), "refused", weights=weights_digest(scene))
    path.with_suffix(".json").write_text(json.dumps(asdict(record)))
    assert read_record(scene, path).weights == record.weights != ""
    file.write_bytes(b"two")
    assert read_record(scene, path) is None
    assert weights_digest(scene_of()) == ""


def test_a_run_does_not_go_on_with_other_networks(tmp_path):
    scene, path = scene_of(), tmp_path / "a.h5"
    run(scene, path, Twice)
    first = read_trajectory(path).attributes["run"]
    run(scene, path)
    assert read_trajectory(path).attributes["run"] == first
    path.with_suffix(".weights").write_text("of others")
    run(scene, path)
    assert read_trajectory(path).attributes["run"] != first


def test_a_scene_from_before_a_key_is_the_same_scene():
    scene = scene_of()
    stored = scene.model_dump(mode="json")
    del stored["solver"]["accuracy"]
    assert same_scene(json.dumps(stored), scene)
    stored["vesicles"]["points"] += 2
    assert not same_scene(json.dumps(stored), scene)
    assert not same_scene("{}", scene)


def test_from_sweeps_to_the_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(trade, "kept_all", kept_all_here)
    path = write_scene(tmp_path, PAIR)
    rungs = f"split[time.dt={DT}|{6 * DT}], split[solver.max_error=1e-9], balanced"

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["trade.py", *map(str, arguments)])
        trade.main()

    call(path, "-o", tmp_path, "--solvers", rungs, "--reference", f"implicit[time.order=2, time.dt={DT}]")
    printed = capsys.readouterr().out
    rows = {r["rung"]: r for r in json.loads((tmp_path / "tiny" / "trade.json").read_text())["rows"]}
    fine, coarse = rows[f"split[time.dt={DT}]"], rows[f"split[time.dt={6 * DT}]"]
    assert 0 < fine["error"] < coarse["error"] < 0.1
    assert (fine["steps"], coarse["steps"]) == (6, 1)
    failed = rows["split[solver.max_error=1e-9]"]
    assert failed["error"] is None
    assert "ended at 0 t_gamma: step 1 rejected" in printed
    call("--page", tmp_path / "trade.md", "-o", tmp_path)
    page = (tmp_path / "trade.md").read_text()
    assert "## tiny" in page
    assert "| tiny | balanced |" in page
    assert (tmp_path / "images" / "trade_tiny.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["missing.toml"], "error: scene missing.toml does not exist"),
        ([], "error: no scene"),
        (["configs/scenes/relaxation.toml", "--solvers", "spilt"], 'error: solver "spilt"'),
        (["--page", "x.md", "-o", "nowhere"], "error: nowhere holds no trade.json"),
        (["configs/scenes/relaxation.toml", "--solvers", "split", "--reference", "none.h5"], "error: trajectory none.h5 does not exist"),
    ],
)
def test_bad_input_is_one_line(monkeypatch, arguments, expected):
    monkeypatch.setattr(sys, "argv", ["trade.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        trade.main()
    assert str(ended.value.code).startswith(expected)
    assert "\n" not in str(ended.value.code)


def test_the_cost_is_without_output(tmp_path):
    moving(tmp_path / "a.h5")
    record = Record("", until=0.03, steps=300, cpu_a_step=0.05, seconds={"output": 0.02})
    made = Kept(scene_of(), tmp_path / "a.h5", record)
    found = trade.row("a", made, made.trajectory, "position", 0.01, 0.03)
    assert found["cost"] == pytest.approx(0.03 * 100)  # 100 steps a t_gamma
    assert found["error"] < 1e-12


def test_where_no_centroid_moves_the_shapes_are_compared(tmp_path):
    moving(tmp_path / "a.h5")
    moved = read_trajectory(tmp_path / "a.h5")
    assert trade.moves(moved)
    assert not trade.moves(replace(moved, X=np.repeat(moved.X[:1], len(moved), axis=0)))
