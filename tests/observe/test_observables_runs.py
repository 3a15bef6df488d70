"""Observables of runs: during them and from their files, over restarts and ranks; CSV and HDF5; the command line and what it refuses."""

import json
import signal
from dataclasses import replace

import h5py
import numpy as np
import pytest
from PIL import Image
from scene_helpers import DT, PAIR, cli, die_at, finish, scene_of, start_cli, stop_after, the_error, write_flow, write_scene
from thread_ranks import on_threads

from biem.backend import counting
from biem.errors import NumericalFailure
from biem.observe import view
from biem.run import observe as module
from biem.run.observations import ObservationWriter, read_observations, write_observations
from biem.run.observe import observables_path, observe, observe_file, problem_of
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory

OBSERVED = {"observe": {"every": 1}}
SPLIT = {"solver": {"kind": "split"}}
CHANNEL = {"flow": {"kind": "poiseuille", "width": 0.6}}


def assert_same_rows(a, b, rtol=0.0):
    assert a.step.tolist() == b.step.tolist()
    assert np.array_equal(a.t, b.t)
    assert list(a.values) == list(b.values)
    for name, value in a.values.items():
        assert value.shape == b.values[name].shape, name
        np.testing.assert_allclose(value, b.values[name], rtol=rtol, atol=rtol * np.nanmax(np.abs(value), initial=0.0), err_msg=name)


def table(path):
    """A CSV by its columns."""
    lines = path.read_text().splitlines()
    return np.genfromtxt([line for line in lines if not line.startswith("#")], delimiter=",", names=True)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A trajectory of two vesicles with its observables, four steps with a frame each second one."""
    path = tmp_path_factory.mktemp("run") / "out.h5"
    run = simulate(scene_of(PAIR, OBSERVED, time={"horizon": 4 * DT, "save_every": 2}), path)
    return path, run


@pytest.mark.parametrize("changes", [{}, SPLIT, CHANNEL], ids=["implicit", "split", "channel"])
@pytest.mark.parametrize("pair", [{}, PAIR], ids=["M=1", "M=2"])
def test_rows_of_a_run_are_those_of_its_file_with_the_stored_tension(tmp_path, changes, pair):
    names = ["tank_treading_frequency", "power", "velocity"]
    run = simulate(scene_of(pair, changes, OBSERVED, time={"horizon": 3 * DT}), tmp_path / "out.h5")
    frames = read_trajectory(tmp_path / "out.h5")
    problem = problem_of(frames, tmp_path)
    again = observe(frames, problem, [q.name for q in run.observations.quantities], stored_tension=True)
    assert_same_rows(run.observations, again)
    assert_same_rows(read_observations(observables_path(tmp_path / "out.h5")), again)
    assert np.isnan(again.values["stress"][0]).all()  # no tension at the start
    assert np.isfinite(again.values["stress"][1:]).all()
    asked = simulate(scene_of(pair, changes, observe={"every": 1, "quantities": names}, time={"horizon": 3 * DT}))
    assert_same_rows(asked.observations, observe(frames, problem, names, stored_tension=True), rtol=1e-9)


def test_found_tension_is_near_the_stored_one(done):
    frames = read_trajectory(done[0])
    names = ["stress", "intrinsic_viscosity"]
    found, stored = (observe(frames, problem_of(frames, done[0].parent), names, stored_tension=s).values["stress"] for s in (False, True))
    assert np.isfinite(found).all()
    lag = np.abs(found[1:] - stored[1:]).max() / np.abs(found[1:]).max()
    assert 1e-6 < lag < 0.1


def test_a_run_without_the_table_pays_nothing(tmp_path):
    plain, observed = scene_of(PAIR), scene_of(PAIR, OBSERVED)
    a, b = simulate(plain, tmp_path / "a.h5"), simulate(observed, tmp_path / "b.h5")
    assert a.observations is None
    assert a.counts["observed"] == 0
    assert b.counts.pop("observed") == 6
    assert a.counts == b.counts  # nothing else was computed
    assert not observables_path(tmp_path / "a.h5").exists()
    assert np.array_equal(a.trajectory.X, b.trajectory.X)
    assert np.array_equal(a.trajectory.sigma, b.trajectory.sigma)


def test_a_resumed_run_has_the_rows_of_the_whole_one(tmp_path, monkeypatch):
    scene = scene_of(PAIR, OBSERVED, time={"horizon": 7 * DT, "save_every": 3}, output={"checkpoint_every": 2})
    whole = simulate(scene, tmp_path / "whole.h5")
    assert whole.observations.step.tolist() == list(range(8))
    with monkeypatch.context() as patch:
        stop_after(patch, 5)
        with pytest.raises(Stopped):
            simulate(scene, tmp_path / "parts.h5")
    assert read_observations(observables_path(tmp_path / "parts.h5")).step.tolist() == list(range(6))
    parts = simulate(scene, tmp_path / "parts.h5", resume=True)
    assert_same_rows(parts.observations, whole.observations)
    assert not list(tmp_path.glob("*.rows"))


def test_rows_fall_every_so_many_steps_and_at_the_end(tmp_path):
    run = simulate(scene_of(observe={"every": 3}, time={"horizon": 7 * DT, "save_every": 2}))
    assert run.observations.step.tolist() == [0, 3, 6, 7]
    assert simulate(scene_of(observe={}, time={"horizon": 5 * DT, "save_every": 2})).observations.step.tolist() == [0, 2, 4, 5]


@pytest.mark.parametrize("event", [23, 37, 61, 71])  # before the file is there; rows not yet written; before the checkpoint; in the merge
def test_a_killed_run_can_be_resumed(tmp_path, event, done):
    path, out = write_scene(tmp_path, PAIR, OBSERVED, time={"horizon": 4 * DT, "save_every": 2}), tmp_path / "out.h5"
    run = ["run", path, "-o", out, "--quiet"]
    killed = start_cli(run, tmp_path / "log", prepare=die_at, prepare_arguments=(event, str(tmp_path)))
    assert finish(killed, tmp_path / "log")[0] == -signal.SIGKILL
    resumed = cli(*run, "--resume")
    assert resumed.exit_code == 0, resumed.output
    assert_same_rows(read_observations(observables_path(out)), done[1].observations)


def test_ranks_share_one_file(tmp_path, done):
    scene = scene_of(PAIR, OBSERVED, SPLIT, time={"horizon": 3 * DT})
    alone = simulate(scene).observations
    first, second = on_threads(2, lambda ranks: simulate(scene, tmp_path / "out.h5", ranks=ranks).observations)
    assert second is None
    assert_same_rows(first, alone, rtol=1e-9)


def test_hdf5_reads_back(tmp_path, done):
    rows = observe_file(done[0], tmp_path / "o.h5").rows
    assert_same_rows(read_observations(tmp_path / "o.h5"), rows)
    with h5py.File(tmp_path / "o.h5") as file:
        assert file["suspension/stress"].attrs["unit"] == "kappa_b/length^3"
        assert "-int sym[x f^T] ds" in file["suspension/stress"].attrs["definition"]
        assert file["suspension/stress"].attrs["components"].tolist() == ["xx", "xy", "yy"]
        assert file["pairs/index"][:].tolist() == [[0, 1]]
        assert file.attrs["run"] == done[1].trajectory.attributes["run"]


def test_csv_reads_back(tmp_path, done):
    rows = observe_file(done[0], tmp_path / "o.csv").rows
    whole, vesicles, pairs = (table(tmp_path / name) for name in ("o.csv", "o.vesicles.csv", "o.pairs.csv"))
    assert whole["t"].tolist() == rows.t.tolist()
    for k, c in enumerate(("xx", "xy", "yy")):
        assert whole[f"stress_{c}"].tolist() == rows.values["stress"][:, k].tolist()
    assert vesicles["vesicle"].tolist() == [0, 1] * 3
    assert vesicles["step"].tolist() == [0, 0, 2, 2, 4, 4]
    assert vesicles["centroid_y"].tolist() == rows.values["centroid"][..., 1].ravel().tolist()
    assert vesicles["inclination"].tolist() == rows.values["inclination"].ravel().tolist()
    assert pairs["pair_distance"].tolist() == rows.values["pair_distance"].ravel().tolist()
    header = [line for line in (tmp_path / "o.vesicles.csv").read_text().splitlines() if line.startswith("# ")]
    assert "# area [length^2]: area inside" in header
    assert any(line.startswith("# stresslet_xx, stresslet_xy, stresslet_yy [kappa_b/length]: ") for line in header)
    assert f"# reference_area: {rows.about['reference_area']}" in header
    assert any(line.startswith("# vesicle [1]: ") for line in header)


def test_csv_of_bins(tmp_path):
    simulate(scene_of(CHANNEL, time={"horizon": 2 * DT}), tmp_path / "out.h5")
    done = observe_file(tmp_path / "out.h5", tmp_path / "o.csv", names=["velocity_profile", "lateral_distribution"], bins=5)
    assert [file.name for file in done.files] == ["o.csv"]  # of one place
    bins = table(tmp_path / "o.csv")
    assert len(bins) == 3 * 5
    assert bins["bin_low"][:5] == pytest.approx([-0.6, -0.36, -0.12, 0.12, 0.36])
    assert np.isnan(bins["velocity_profile"][[0, 4]]).all()  # no membrane there
    assert bins["velocity_profile"][2] > 0
    assert bins["lateral_distribution"][2] == pytest.approx(1 / 0.24)


def test_rows_of_a_growing_file_are_read(tmp_path, done):
    rows, path = done[1].observations, tmp_path / "o.h5"
    writer = ObservationWriter(path, rows.where(rows.step < 1))
    for k in range(1, 5):
        writer.append(rows.where(rows.step == k))
        assert_same_rows(read_observations(path), rows.where(rows.step <= k))
    (tmp_path / "o.h5.rows" / "000000000007.h5").write_bytes((tmp_path / "o.h5.rows" / "000000000004.h5").read_bytes())
    write_observations(tmp_path / "foreign.h5", replace(rows.where(rows.step == 4), about={**rows.about, "run": "another"}))
    (tmp_path / "foreign.h5").replace(tmp_path / "o.h5.rows" / "000000000007.h5")
    assert_same_rows(read_observations(path), rows)  # not those of another run
    writer.close()
    assert_same_rows(read_observations(path), rows)
    assert not (tmp_path / "o.h5.rows").exists()


def test_command_writes_tables_and_pictures(tmp_path, done):
    result = cli("observe", done[0], "-o", tmp_path / "o.csv", "--plots", tmp_path / "plots")
    assert result.exit_code == 0, result.output
    tables = {"o.csv", "o.vesicles.csv", "o.pairs.csv"}
    assert {f.name for f in tmp_path.iterdir()} == tables | {"plots"}  # nothing is left of the work
    pictures = sorted((tmp_path / "plots").iterdir())
    assert [f.name for f in pictures] == ["displacement.png", "distances.png", "paths.png", "rheology.png", "shapes.png"]
    for file in pictures:
        with Image.open(file) as image:
            shown = np.asarray(image.convert("RGB"), dtype=float)
        assert min(shown.shape[:2]) > 200
        assert shown.std() > 3


def test_command_takes_what_a_run_has_written(tmp_path, done):
    path = observables_path(done[0])
    result = cli("observe", path, "-o", tmp_path / "o.csv", "--quantities", "inclination,stress", "--every", 2, "--json", "--quiet")
    report = json.loads(result.output)
    assert report["quantities"] == ["stress", "inclination"]
    assert report["rows"] == 3
    assert table(tmp_path / "o.vesicles.csv")["inclination"].tolist() == read_observations(path).values["inclination"][::2].ravel().tolist()
    assert "velocity is not among" in the_error(cli("observe", path, "--quantities", "velocity"), 2)
    assert "are for trajectories" in the_error(cli("observe", path, "--stored-tension"), 2)


def test_channel_has_a_picture_across(tmp_path):
    simulate(scene_of(CHANNEL, time={"horizon": 2 * DT}), tmp_path / "out.h5")
    done = observe_file(tmp_path / "out.h5", tmp_path / "o.h5", tmp_path / "plots")
    assert "across.png" in {file.name for file in done.files}


def test_what_is_committed_of_an_unfinished_run_is_observed(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        with pytest.raises(Stopped):
            simulate(scene_of(PAIR), tmp_path / "out.h5")
    result = cli("observe", tmp_path / "out.h5", "--quiet")
    assert result.exit_code == 0
    assert "notice: the run has not come to its horizon: it has committed 4 frame(s), to t = 0.000366211 of 0.000732422" in result.output
    assert len(table(tmp_path / "out.observables.csv")) == 4


def test_an_interrupted_call_is_gone_on_with(tmp_path, done, monkeypatch):
    frames, partial = read_trajectory(done[0]), tmp_path / "partial.h5"
    problem, names = problem_of(frames, tmp_path), ["velocity", "area"]
    whole = observe(frames, problem, names)
    real, calls = view.instant, iter(range(100))

    def failing(*arguments):
        if next(calls) == 2:
            raise NumericalFailure("no more")
        return real(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(view, "instant", failing)
        with pytest.raises(NumericalFailure):
            observe(frames, problem, names, partial=partial)
    assert read_observations(partial).step.tolist() == [0, 2]
    with counting() as counts:
        rest = observe(frames, problem, names, partial=partial)
    assert counts["observed"] == 1
    assert_same_rows(rest, whole)
    with counting() as counts:  # of something else
        observe(frames, problem, ["velocity", "length"], partial=partial)
    assert counts["observed"] == 3
    monkeypatch.setattr(module, "COMMIT_AFTER", -1.0)
    observe(frames, problem, names, partial=partial)
    assert read_observations(partial).step.tolist() == [0, 2, 4]


REFUSED = (
    (["--quantities", "strss"], 'unknown quantity "strss": did you mean stress?'),
    (["--quantities", "velocity_profile"], "velocity_profile takes a width"),
    (["--quantities", "effective_viscosity"], "effective_viscosity takes an area of the suspension"),
    (["--quantities", ","], "no quantity is named"),
    (["-o", "o.txt"], "ends in .csv or .h5, not to o.txt"),
)


def test_places_that_cannot_be_written_to_are_told_before_anything_is_computed(tmp_path, done):
    (tmp_path / "file").write_text("not a folder")
    for options in (["--plots", tmp_path / "file"], ["-o", tmp_path / "file" / "o.csv"]):
        with counting() as counts:
            assert "file cannot be made (" in the_error(cli("observe", done[0], *options), 5)
        assert counts["observed"] == 0
    assert (tmp_path / "file").read_text() == "not a folder"


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_bad_input_is_one_line(done, options, message):
    assert message in the_error(cli("observe", done[0], *options), 2)


def test_files_that_are_no_trajectories(tmp_path, done):
    assert the_error(cli("observe", tmp_path / "none.h5"), 2).endswith("none.h5 does not exist")
    (tmp_path / "text.h5").write_text("no HDF5")
    assert "cannot be read as HDF5" in the_error(cli("observe", tmp_path / "text.h5"), 2)


def test_shear_alone_and_tensions_that_are_not_kept(tmp_path):
    still = {"flow": {"kind": "quiescent", "rate": None}}
    simulate(scene_of(still), tmp_path / "out.h5")
    message = the_error(cli("observe", tmp_path / "out.h5", "--quantities", "intrinsic_viscosity"), 2)
    assert message == 'intrinsic_viscosity is defined in flow.kind = "shear" alone, this scene has "quiescent"'
    assert "keeps no tension" in the_error(cli("observe", tmp_path / "out.h5", "--stored-tension"), 2)
    assert cli("observe", tmp_path / "out.h5", "--stored-tension", "--quantities", "area", "--quiet").exit_code == 0


def test_a_custom_flow_is_found_in_its_folder(tmp_path):
    flow = write_flow(tmp_path, "def shear(x, y, t):\n    return 100.0 * y, 0.0 * x\n")
    custom = {"kind": "custom", "rate": None, "function": f"{flow}.shear"}
    simulate(scene_of(flow=custom, folder=tmp_path), tmp_path / "out.h5")
    assert "--folder says where the files of the scene are" in the_error(cli("observe", tmp_path / "out.h5"), 2)
    assert cli("observe", tmp_path / "out.h5", "--folder", tmp_path, "--quiet").exit_code == 0


def test_flows_are_those_of_the_time(tmp_path):
    flow = write_flow(tmp_path, "def wind(x, y, t):\n    return 1e4 * t + 0.0 * x, 0.0 * x\n")
    custom = {"kind": "custom", "rate": None, "function": f"{flow}.wind"}
    run = simulate(scene_of(flow=custom, folder=tmp_path, observe={"every": 1, "quantities": ["velocity"]}), tmp_path / "out.h5")
    rows = observe_file(tmp_path / "out.h5", tmp_path / "o.h5", names=["velocity"], folder=tmp_path).rows
    for velocity in (rows.values["velocity"], run.observations.values["velocity"]):
        assert velocity[1:, 0, 0] == pytest.approx(1e4 * rows.t[1:], rel=1e-6)


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        ({"quantities": ["stres"]}, 'unknown quantity "stres": did you mean stress?'),
        ({"quantities": ["velocity_profile"]}, "velocity_profile takes a width"),
        ({"every": 0}, "observe.every = 0"),
        ({"often": 1}, "unknown key observe.often: the keys there are every, quantities, bins"),
    ],
)
def test_bad_tables_are_refused_before_anything_is_written(tmp_path, observed, message):
    path = write_scene(tmp_path, observe=observed)
    assert message in the_error(cli("run", path, "-o", tmp_path / "out" / "o.h5"), 2)
    assert message in the_error(cli("plan", path, "--quiet"), 2)
    assert not (tmp_path / "out").exists()


def test_a_run_keeps_the_tension_that_it_observes(tmp_path):
    assert simulate(scene_of(OBSERVED)).trajectory.sigma is not None
    with pytest.raises(ValueError, match=r"stress takes the tension, which this run does not keep: leave out output\.tension = false"):
        simulate(scene_of(observe={"quantities": ["stress"]}, output={"tension": False}))
    assert simulate(scene_of(observe={"quantities": ["area"]}, output={"tension": False})).trajectory.sigma is None


def test_files_of_others_are_not_replaced(tmp_path):
    path = observables_path(tmp_path / "out.h5")
    path.write_text("mine")
    with pytest.raises(ValueError, match=r"out\.observables\.h5 exists, without its trajectory"):
        simulate(scene_of(OBSERVED), tmp_path / "out.h5")
    assert path.read_text() == "mine"
    simulate(scene_of(OBSERVED), tmp_path / "out.h5", force=True)
    path.unlink()
    with pytest.raises(ValueError, match="do not exist; a run goes on with the rows before it alone"):
        simulate(scene_of(OBSERVED, time={"horizon": 8 * DT}), tmp_path / "out.h5", resume=True)
