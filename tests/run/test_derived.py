"""What is made of a trajectory: it never takes a trajectory's place, and what is damaged, unfinished or unwritable is told in one line."""

import h5py
import numpy as np
import pytest
from scene_helpers import DT, PAIR, cli, scene_of, stop_after, the_error

from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory

MAKERS = {"observe": (), "field": ("--grid", "6"), "export": ("--vtkhdf", "--shapes")}


def ending(command):
    return "vtkhdf" if command == "export" else "h5"


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "out.h5"
    simulate(scene_of(PAIR, time={"horizon": 2 * DT}), path)
    return path


@pytest.mark.parametrize("command", ["observe", "field"])
@pytest.mark.parametrize("name", ["out.h5", "folder/../out.h5", "link.h5", "other.h5", "growing.h5"])
def test_no_trajectory_is_replaced(tmp_path, run, command, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.h5").symlink_to(run)
    simulate(scene_of(time={"horizon": DT}), tmp_path / "other.h5")
    (tmp_path / "growing.h5.frames").mkdir()
    message = the_error(cli(command, run, "-o", tmp_path / name, *MAKERS[command]), 2)
    assert "choose another name" in message
    assert len(read_trajectory(run)) == 3
    assert len(read_trajectory(tmp_path / "other.h5")) == 2
    assert (tmp_path / "link.h5").is_symlink()


def test_a_run_is_not_replaced_by_its_observables(tmp_path, run):
    assert cli("observe", run, "-o", tmp_path / "o.h5").exit_code == 0
    assert "is a trajectory, which is not replaced" in the_error(cli("observe", tmp_path / "o.h5", "-o", run), 2)
    assert cli("observe", run, "-o", tmp_path / "o.h5").exit_code == 0  # what it has made itself is made anew
    (tmp_path / "folder").mkdir()
    message = the_error(cli("observe", tmp_path / "o.h5", "-o", tmp_path / "folder" / ".." / "o.h5", "--quantities", "area"), 2)
    assert "is the file that it is made of" in message


@pytest.mark.parametrize("command", MAKERS)
def test_where_nothing_can_be_written_is_told_before_anything_is_computed(tmp_path, run, command, monkeypatch):
    monkeypatch.setattr("biem.observe.instant.instant", lambda *a, **k: pytest.fail("computed"))
    folder = tmp_path / f"folder.{ending(command)}"
    folder.mkdir()
    assert f"output {folder} is a folder" in the_error(cli(command, run, "-o", folder, *MAKERS[command]), 2)
    message = the_error(cli(command, run, "-o", f"/proc/a.{ending(command)}", *MAKERS[command]), 5)
    assert "its folder cannot be written to" in message
    assert sorted(path.name for path in tmp_path.iterdir() if path.suffix == ".parts") == []


@pytest.mark.parametrize("command", [*MAKERS, "plot"])
def test_a_damaged_frame_is_named(tmp_path, run, command):
    with h5py.File(run, "r+") as file:
        file["X"][1, 0, 1, 3] = np.nan
    more = MAKERS.get(command, ("--no-movie",))
    output = tmp_path / ("plots" if command == "plot" else f"made.{ending(command)}")
    message = the_error(cli(command, run, "-o", output, *more), 2)
    assert "at frame 1 vesicle 0 is not finite (1 of 3 frames have such vesicles); `biem verify`" in message
    assert not output.exists()


@pytest.mark.parametrize("command", MAKERS)
def test_that_a_run_is_unfinished_is_said(tmp_path, monkeypatch, command):
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        with pytest.raises(Stopped):
            simulate(scene_of(PAIR), tmp_path / "out.h5")
    done = cli(command, tmp_path / "out.h5", "-o", tmp_path / f"made.{ending(command)}", *MAKERS[command])
    assert done.exit_code == 0
    assert "notice: the run has not come to its horizon: it has committed 4 frame(s), to t = 0.000366211 of 0.000732422" in done.output


def test_a_row_alone_is_no_picture_but_no_error(tmp_path):
    simulate(scene_of(time={"horizon": DT}), tmp_path / "out.h5")
    done = cli("observe", tmp_path / "out.h5", "--every", 5, "--plots", tmp_path / "plots")
    assert done.exit_code == 0, done.output
    assert "notice: there is nothing to draw of 1 row(s)" in done.output
    assert "out.observables.csv" in done.output


def test_folders_are_no_trajectories_and_scenes_have_theirs(tmp_path, run):
    assert "is a folder: give the trajectory" in the_error(cli("field", tmp_path), 2)
    assert "--folder nowhere does not exist" in the_error(cli("field", run, "--folder", "nowhere"), 2)
