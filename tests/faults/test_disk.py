"""Outputs that are there already, cannot be made, or outgrow the disk: one line, and what was on disk before is intact."""

import resource
import shutil

import numpy as np
import pytest
from scene_helpers import (
    DT,
    PAIR,
    assert_prefix,
    assert_same_frames,
    cli,
    error_line,
    finish,
    scene_of,
    start_cli,
    the_error,
    write_scene,
)

from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory


def contents(folder):
    """All files of a folder, byte for byte."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def results(tmp_path):
    """A folder with a finished run in it."""
    folder = tmp_path / "results"
    simulate(scene_of(), folder / "out.h5")
    return folder


def test_existing_output_is_refused_and_untouched(tmp_path, results):
    before = contents(results)
    message = the_error(cli("run", write_scene(tmp_path, flow={"rate": 10.0}), "-o", results / "out.h5"), 2)
    assert "exists" in message
    assert "--force" in message
    assert "--resume" in message
    assert contents(results) == before


def test_leftovers_of_a_killed_run_count_as_existing(tmp_path, results):
    (results / "other.h5.frames").mkdir()
    assert "exists" in the_error(cli("run", write_scene(tmp_path), "-o", results / "other.h5"), 2)
    assert (results / "other.h5.frames").exists()


def test_force_replaces(tmp_path, results):
    path = write_scene(tmp_path, PAIR, time={"horizon": 3 * DT})
    assert cli("run", path, "-o", results / "out.h5", "--force", "--quiet").exit_code == 0
    fresh = simulate(scene_of(PAIR, time={"horizon": 3 * DT})).trajectory
    assert_same_frames(read_trajectory(results / "out.h5"), fresh)
    assert read_checkpoint(checkpoint_path(results / "out.h5")).state.X.shape[0] == 2
    assert sorted(contents(results)) == ["out.h5", "out.h5.checkpoint", "out.h5.checkpoint.previous"]


@pytest.mark.parametrize(
    "change", [{"vesicles": {"points": 17}}, {"flow": {"kind": "poiseuille"}}, {"vesicles": {"centers": [[0, 0], [0.1, 0]]}}]
)
def test_force_with_a_bad_scene_touches_nothing(tmp_path, results, change):
    before = contents(results)
    the_error(cli("run", write_scene(tmp_path, change), "-o", results / "out.h5", "--force"), 2)
    assert contents(results) == before


@pytest.mark.parametrize("output", ["out.h5/x.h5", "out.h5/deeper/x.h5", ".", "/proc/none/x.h5"])
def test_output_that_cannot_be_made_is_one_line(tmp_path, results, output):
    before = contents(results)
    for option in ([], ["--force"]):
        message = the_error(cli("run", write_scene(tmp_path), "-o", results / output, *option), 2, 5)
        assert str(results / output).split("/x.h5")[0].rstrip("/.").split("/deeper")[0] in message
    assert contents(results) == before


def test_plot_into_a_file_is_one_line(results):
    the_error(cli("plot", results / "out.h5", "-o", results / "out.h5"), 2, 5)
    the_error(cli("plot", results / "out.h5", "-o", results / "out.h5" / "pictures"), 2, 5)


def limit_files(size):
    """No file of this process may outgrow `size` bytes; Python has SIGXFSZ ignored, so that writing beyond fails."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def limited_run(folder, size, *arguments):
    log = folder / "log"
    return finish(start_cli(["run", *arguments, "--quiet"], log, None, limit_files, (size,)), log)


@pytest.mark.parametrize("size", [0, 1000, 5000])
def test_force_without_room_for_the_first_frame_leaves_the_old_run(tmp_path, results, size):
    before = contents(results)
    exit_code, printed = limited_run(tmp_path, size, write_scene(tmp_path), "-o", results / "out.h5", "--force")
    assert exit_code != 0
    assert contents(results) == before
    if size > 0:  # with no room for one byte there is none for the message either
        error_line(printed, exit_code, 5)


def test_run_without_room_for_merging_keeps_its_frames_and_resumes(tmp_path):
    steps = 66  # merging begins with 64 frames, and is tried again when the run ends
    path, out = write_scene(tmp_path, time={"horizon": steps * DT}), tmp_path / "out.h5"
    whole = simulate(scene_of(time={"horizon": steps * DT})).trajectory
    exit_code, printed = limited_run(tmp_path, 16_000, path, "-o", out)  # room for a checkpoint or a frame, not for all frames
    kept = read_trajectory(out)
    assert_prefix(kept, whole)
    assert len(kept) >= 60
    assert read_checkpoint(checkpoint_path(out)).step >= kept.step[-1] - 1
    assert cli("run", path, "-o", out, "--resume", "--quiet").exit_code == 0
    assert_same_frames(read_trajectory(out), whole)
    assert "out.h5" in error_line(printed, exit_code, 5)


def test_disk_full_on_the_way_keeps_what_was_written_and_resumes(tmp_path, small_disk):
    path, out = write_scene(tmp_path, time={"horizon": 20 * DT}), small_disk / "out.h5"
    whole = simulate(scene_of(time={"horizon": 20 * DT})).trajectory
    result = cli("run", path, "-o", out, "--quiet")
    kept = read_trajectory(out)
    assert 2 < len(kept) < 21
    assert_prefix(kept, whole)
    checkpoint = read_checkpoint(checkpoint_path(out))
    assert np.array_equal(checkpoint.state.X, whole.X[checkpoint.step])
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(small_disk, elsewhere)  # to a disk with room
    assert cli("run", path, "-o", elsewhere / "out.h5", "--resume", "--quiet").exit_code == 0
    assert_same_frames(read_trajectory(elsewhere / "out.h5"), whole)
    assert "space" in the_error(result, 5)


def test_full_disk_is_refused_before_the_old_run_is_touched(tmp_path, small_disk):
    assert cli("run", write_scene(tmp_path), "-o", small_disk / "out.h5", "--quiet").exit_code == 0
    before = contents(small_disk)
    (small_disk / "rest").write_bytes(bytes(shutil.disk_usage(small_disk).free))
    the_error(cli("run", write_scene(tmp_path, flow={"rate": 10.0}), "-o", small_disk / "out.h5", "--force", "--quiet"), 2, 5)
    (small_disk / "rest").unlink()
    assert contents(small_disk) == before


def test_what_does_not_fit_is_told_before_the_first_step(tmp_path, small_disk):
    path = write_scene(tmp_path, time={"horizon": 1000 * DT})
    message = the_error(cli("run", path, "-o", small_disk / "out.h5"), 2)
    assert "MB" in message
    assert not (small_disk / "out.h5").exists()
