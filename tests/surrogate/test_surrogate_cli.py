"""python -m surrogate: train, merge, grid, run; wrong input ends in one line."""

import json

import numpy as np
import pytest
from surrogate_cases import N
from typer.testing import CliRunner

from biem.run.trajectory import read_trajectory
from surrogate.__main__ import app
from surrogate.weights import read_card

QUICK = ["--set", "training.samples=64", "--set", "training.batch=16", "--set", "training.every=2", "--set", "network.width=8"]
SCENE = """
[vesicles]
points = 32
[time]
dt = 1e-5
horizon = 5e-5
[solver]
corrections = []
"""


def call(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def weights(pairs_path, tmp_path_factory):
    """MLPs of all maps, and two modes of an IVNet, trained by the command line and merged."""
    folder = tmp_path_factory.mktemp("cli")
    done = call("train", "--all", "--data", pairs_path, "-o", folder / "runs" / "mlp", "--quiet", *QUICK)
    assert done.exit_code == 0, done.output
    options = ["--arch", "ivnet", "--map", "advection", "--quiet", *QUICK]
    for mode in (0, 3):
        assert call("train", "--data", pairs_path, "-o", folder / "runs" / "ivnet", "--mode", mode, *options).exit_code == 0
    done = call("merge", folder / "runs", "-o", folder / "weights")
    assert done.exit_code == 0, done.output
    return folder


def test_a_training_leaves_its_log_curve_and_weights_and_a_merge_their_cards(weights):
    run = weights / "runs" / "mlp" / "advection"
    assert {path.name for path in run.iterdir()} == {"run.json", "log.jsonl", "checkpoint.pt", "curve.png", "weights.safetensors"}
    assert [json.loads(line)["step"] for line in (run / "log.jsonl").read_text().splitlines()] == [2, 4]
    names = sorted(str(path.relative_to(weights / "weights")) for path in (weights / "weights").rglob("*.safetensors"))
    maps = ["advection", "flow_tension", "near", "relax-1e-05", "self_tension"]
    assert names == ["ivnet/advection.safetensors", *(f"mlp/{name}.safetensors" for name in maps)]
    assert read_card(weights / "weights" / "ivnet" / "advection.safetensors").network.modes == (0, 3)


def test_a_scene_runs_by_trained_maps(weights, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    done = call("run", tmp_path / "scene.toml", "-o", tmp_path / "out.h5", "--weights", weights / "weights", "--maps", "mlp", "--quiet")
    trajectory = read_trajectory(tmp_path / "out.h5")
    assert trajectory.X.shape[-1] == N
    assert np.isfinite(trajectory.X).all()
    assert trajectory.attributes["solver"] == "vesnet"
    assert done.exit_code in (0, 3)  # four steps of training: the guard may refuse where they lead


def test_missing_modes_another_reduced_area_and_another_step_are_one_line(weights, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE)
    base = ["run", tmp_path / "scene.toml", "-o", tmp_path / "out.h5", "--weights", weights / "weights", "--quiet"]
    flow = ["--set", "flow.kind=shear", "--set", "flow.capillary=1"]
    for arguments, words in (
        ([*flow, "--set", 'solver.maps={advection="ivnet"}'], "all of 0 to 16 are needed: merge them"),
        (["--maps", "mlp", "--set", "vesicles.reduced_area=0.7"], "they are for reduced area 0.65, the scene has 0.7"),
        (["--maps", "mlp", "--set", "vesicles.points=64"], "they are for 32 nodes, the scene has vesicles.points = 64"),
        (["--maps", "mlp", "--set", "time.dt=2e-5"], "relax weights are for dt kappa_b/(mu L^3) = 1e-05, the scene asks for 2e-05"),
        (["--maps", "hybrid"], "has no weights of relax for solver.maps = 'hybrid'"),
    ):
        done = call(*base, *arguments)
        assert done.exit_code == 2, done.output
        assert words in done.output
        assert len(done.output.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--data", "none.h5", "--all"], "none.h5 does not exist: make it with `python -m datagen label`"),
        (["train", "--data", "PAIRS"], "give either --map, with or without --mode, or --all"),
        (["train", "--data", "PAIRS", "--map", "near", "--set", "training.sampels=3"], "did you mean samples?"),
        (["train", "--data", "PAIRS", "--map", "near", "--set", "map.near.sampels=3"], "map.near.sampels is not known"),
        (["train", "--data", "PAIRS", "--map", "near", "--device", "cuda:99"], "--device"),
        (["merge", "nowhere", "-o", "out"], "nowhere does not exist"),
        (["grid", "--data", "PAIRS", "--map", "near", "--mode", "1", "--levels", "0"], "--levels 0: expected whole numbers from 1"),
        (["evaluate", "--data", "none.h5"], "none.h5 does not exist"),
    ],
)
def test_wrong_input_is_one_line(pairs_path, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    done = call(*(str(pairs_path) if a == "PAIRS" else a for a in arguments))
    assert done.exit_code == 2, done.output
    assert message in done.output
    assert len(done.output.strip().splitlines()) == 1


def test_the_grid_prints_a_table_and_goes_on(pairs_path, tmp_path):
    options = ["grid", "--data", pairs_path, "--map", "self_tension", "-o", tmp_path, "--blocks", "1", "--widths", "4,8", "--levels", "1"]
    own = ["--set", "map.self_tension.width=6"]  # what the training says for this map does not hold the grid's back
    first = call(*options, "--quiet", *QUICK, *own)
    assert first.exit_code == 0, first.output
    assert {line[:9] for line in first.output.splitlines() if line.startswith("| 1 |")} == {"| 1 | 4 |", "| 1 | 8 |"}
    assert call(*options, "--quiet", *QUICK, *own).output == first.output


def test_parts_of_a_grid_share_its_variants(pairs_path, tmp_path):
    options = ["grid", "--data", pairs_path, "--map", "self_tension", "-o", tmp_path, "--blocks", "1", "--widths", "4,8", "--levels", "1"]
    for k, there in ((2, {"b1-w8-l1"}), (1, {"b1-w4-l1", "b1-w8-l1"})):
        done = call(*options, "--part", f"{k}/2", "--quiet", *QUICK)
        assert done.exit_code == 0, done.output
        assert {path.parents[1].name for path in tmp_path.rglob("weights.safetensors")} == there
