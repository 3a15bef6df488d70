"""Trajectory files: every committed frame is readable at every moment; closed, they are one plain file."""

import json
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from scene_helpers import PAIR, assert_prefix, assert_same_frames, scene_of

from biem.run import growing
from biem.run import trajectory as module
from biem.run.simulate import simulate
from biem.run.trajectory import TrajectoryWriter, exists, join, one_frame, read_trajectory

OLD_NAMES = ("area_error", "length_error", "bending_energy", "gmres_iterations", "wall_seconds", "min_gap")
NAMES = (*OLD_NAMES, "dt", "error_estimate", "rejected", "repulsion_work")


def frame(k, tension=True):
    X = np.random.default_rng(k).normal(size=(2, 2, 16))
    return one_frame(0.1 * k, k, X, X[:, 0] + k if tension else None, {name: k + 0.5 * i for i, name in enumerate(NAMES)})


def frames(n):
    return join([frame(k) for k in range(n)], {})


@pytest.fixture
def writer(tmp_path, monkeypatch):
    monkeypatch.setattr(growing, "MERGE_AT", 3)
    return TrajectoryWriter(tmp_path / "out.h5", {"schema": 1, "seed": 7}, [frame(0)])


def test_frames_are_there_at_once_and_merged_in_the_end(tmp_path, writer):
    most = 0
    for k in range(1, 20):
        writer.append(frame(k))
        assert_same_frames(read_trajectory(tmp_path / "out.h5"), frames(k + 1))
        most = max(most, len(list((tmp_path / "out.h5.frames").glob("*"))))
    assert most < 19  # merged on the way too
    writer.close()
    assert [p.name for p in tmp_path.iterdir()] == ["out.h5"]
    again = read_trajectory(tmp_path / "out.h5")
    assert_same_frames(again, frames(20))
    for name in NAMES:
        assert np.array_equal(again.diagnostics[name], frames(20).diagnostics[name])
    assert again.attributes["seed"] == 7


def test_merging_costs_a_constant_factor(writer, monkeypatch):
    written, write = [], writer._write
    monkeypatch.setattr(writer, "_write", lambda path, part: (written.append(len(part)), write(path, part)))
    for k in range(1, 60):
        writer.append(frame(k))
    writer.close()
    assert sum(written) < 5 * 60


def test_writer_killed_while_merging_doubles_no_frame(tmp_path, writer, monkeypatch):
    for k in (1, 2):
        writer.append(frame(k))

    remove = Path.unlink

    def killed(path, **options):
        if path.name == "000000000002.h5":
            raise KeyboardInterrupt
        remove(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            writer.append(frame(3))
    assert len(list((tmp_path / "out.h5.frames").glob("*.h5"))) == 2  # in the file too by now
    assert_same_frames(read_trajectory(tmp_path / "out.h5"), frames(4))


@pytest.mark.parametrize("when", range(1, 6))
@pytest.mark.parametrize("late", [0, 2])
def test_reader_meets_a_merge_at_any_moment(tmp_path, writer, monkeypatch, when, late):
    """The writer merges, and appends `late` more, before the reader opens or lists: no frame is missed, none is doubled."""
    for k in (1, 2):
        writer.append(frame(k))
    moment, busy = 0, False

    def interrupted(call):
        def run(*arguments):
            nonlocal moment, busy
            moment += not busy
            if moment == when and not busy:
                busy = True
                writer.close()
                for k in range(3, 3 + late):
                    writer.append(frame(k))
                busy = False
            return call(*arguments)

        return run

    monkeypatch.setattr(module, "h5py", SimpleNamespace(File=interrupted(h5py.File)))
    monkeypatch.setattr("pathlib.Path.glob", interrupted(Path.glob))
    seen = read_trajectory(tmp_path / "out.h5")
    assert len(seen) >= 3  # what was committed before reading began
    assert_prefix(seen, frames(3 + late))


def test_file_has_the_datasets_and_attributes_of_the_design(tmp_path):
    scene = scene_of(PAIR, vesicles={"seed": 11})
    simulate(scene, tmp_path / "out.h5")
    with h5py.File(tmp_path / "out.h5") as file:
        F, M, N = 7, 2, 16
        assert set(file) >= {"t", "X", "sigma", "diagnostics"}
        assert {name: file[name].shape for name in ("t", "X", "sigma")} == {"t": (F,), "X": (F, M, 2, N), "sigma": (F, M, N)}
        assert all(file[name].dtype == np.float64 for name in ("t", "X", "sigma"))
        assert set(file["diagnostics"]) == set(NAMES)
        assert all(file["diagnostics"][name].shape == (F,) for name in NAMES)
        assert set(file.attrs) >= {"schema", "scene", "solver", "commit", "seed"}
        assert json.loads(file.attrs["scene"])["vesicles"]["points"] == N
        assert (file.attrs["solver"], file.attrs["seed"]) == ("implicit", 11)
        assert len(file.attrs["commit"]) >= 7
        assert np.isfinite(file["diagnostics/bending_energy"][:]).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.h5", "out.h5.checkpoint", "out.h5.checkpoint.previous"]


def test_one_vesicle_has_no_tension_unless_asked(tmp_path):
    simulate(scene_of(), tmp_path / "without.h5")
    simulate(scene_of(output={"tension": True}), tmp_path / "with.h5")
    with h5py.File(tmp_path / "without.h5") as without, h5py.File(tmp_path / "with.h5") as with_it:
        assert "sigma" not in without
        assert with_it["sigma"].shape == (7, 1, 16)
        assert np.abs(with_it["sigma"][1:]).max(axis=(1, 2)).min() > 0


def test_until_keeps_the_frames_to_a_step():
    assert_same_frames(frames(6).until(3), frames(4))


def test_a_file_without_the_later_diagnostics_reads_them_as_zeros(tmp_path, writer):
    writer.append(frame(1))
    writer.close()
    with h5py.File(tmp_path / "out.h5", "a") as file:
        for name in set(NAMES) - set(OLD_NAMES):
            del file["diagnostics"][name]
    old = read_trajectory(tmp_path / "out.h5")
    assert_same_frames(old, frames(2))
    for name in OLD_NAMES:
        assert np.array_equal(old.diagnostics[name], frames(2).diagnostics[name])
    assert all(old.diagnostics[name].tolist() == [0.0, 0.0] for name in set(NAMES) - set(OLD_NAMES))


def spoiled(whole, name, path):
    """A file that is no trajectory, made of a good one."""
    if name == "folder.h5":
        return path.mkdir()
    path.write_bytes({"text.h5": b"t = 0", "empty.h5": b"", "short.h5": whole[: len(whole) // 2]}.get(name, whole))
    if len(path.read_bytes()) == len(whole):
        with h5py.File(path, "a") as file:
            if name == "schema.h5":
                file.attrs["schema"] = 99
            else:
                del file[{"no_x.h5": "X", "no_diagnostics.h5": "diagnostics", "no_energy.h5": "diagnostics/bending_energy"}[name]]
    return None


NO_TRAJECTORIES = ["text.h5", "empty.h5", "short.h5", "folder.h5", "schema.h5", "no_x.h5", "no_diagnostics.h5", "no_energy.h5"]


@pytest.mark.parametrize("name", NO_TRAJECTORIES)
def test_what_is_no_trajectory_is_refused_in_one_line(tmp_path, writer, name):
    writer.close()
    spoiled((tmp_path / "out.h5").read_bytes(), name, tmp_path / name)
    with pytest.raises(ValueError, match=name) as caught:
        read_trajectory(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_what_is_not_there_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.h5 does not exist"):
        read_trajectory(tmp_path / "none.h5")
    assert not exists(tmp_path / "none.h5")
