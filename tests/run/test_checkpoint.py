"""Checkpoints: bitwise, whole or not there, the previous one kept, never a state that is not finite."""

import os
from contextlib import suppress
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from biem.run.checkpoint import Checkpoint, checkpoint_path, read_checkpoint, remove_checkpoints, write_checkpoint
from biem.steppers.stepper import State


def make(step, tension=True):
    rng = np.random.default_rng(step)
    sigma, *vectors = rng.normal(size=(2, 16)), *rng.normal(size=(3, 2, 2, 16))
    state = State(step / 3.0, vectors[0], sigma if tension else None, (step / 4.0, *vectors[1:]) if tension else None)
    area_0, length_0 = rng.uniform(size=(2, 2))
    return Checkpoint(step, state, area_0, length_0, '{"name": "x"}', {"seconds": 0.1 * step}, {"pair_sum": step}, "", {"dt": 0.1 / step})


def assert_same(a, b):
    names = ("step", "scene", "running", "counts", "run", "control")
    assert [a.state.t, *(getattr(a, n) for n in names)] == [b.state.t, *(getattr(b, n) for n in names)]
    assert (a.state.coupling is None) == (b.state.coupling is None)
    assert a.state.coupling is None or all(np.array_equal(p, q) for p, q in zip(a.state.coupling, b.state.coupling, strict=True))
    pairs = [(a.state.X, b.state.X), (a.area_0, b.area_0), (a.length_0, b.length_0), (a.state.sigma, b.state.sigma)]
    assert all((p is None and q is None) or np.array_equal(p, q) for p, q in pairs)


@pytest.fixture
def path(tmp_path):
    return checkpoint_path(tmp_path / "out.h5")


@pytest.mark.parametrize("tension", [True, False])
def test_what_is_written_is_read_bit_for_bit(path, tension):
    write_checkpoint(path, make(5, tension))
    assert_same(read_checkpoint(path), make(5, tension))


def test_newest_is_read_and_the_previous_one_kept(path):
    for step in (1, 2, 3):
        write_checkpoint(path, make(step))
    assert_same(read_checkpoint(path), make(3))
    path.unlink()
    assert_same(read_checkpoint(path), make(2))
    assert len(list(path.parent.iterdir())) == 1


@pytest.mark.parametrize("size", [0, 1, 100, 2048, 0.5, 0.99])
def test_truncated_file_falls_back_on_the_previous_one(path, size):
    for step in (1, 2):
        write_checkpoint(path, make(step))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(size * len(whole)) if size < 1 and size > 0 else size])
    assert_same(read_checkpoint(path), make(1))


def test_file_that_lacks_something_falls_back_too(path):
    for missing in ("X", "area_0", "counts"):
        for step in (1, 2):
            write_checkpoint(path, make(step))
        with h5py.File(path, "a") as file:
            del file[missing]
        assert_same(read_checkpoint(path), make(1))


def test_a_checkpoint_of_before_adaptive_steps_is_read(path):
    write_checkpoint(path, make(5))
    with h5py.File(path, "a") as file:
        del file["control"]
    assert_same(read_checkpoint(path), replace(make(5), control={}))


def test_tensors_are_written_as_the_arrays_that_they_are(path):
    whole = make(5)
    state = replace(whole.state, X=torch.from_numpy(whole.state.X), sigma=torch.from_numpy(whole.state.sigma))
    write_checkpoint(path, replace(whole, state=state))
    assert_same(read_checkpoint(path), whole)


@pytest.mark.parametrize("where", ["X", "sigma", "coupling", "t"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_that_is_not_finite_is_refused_and_the_old_one_left(path, where, value):
    for step in (1, 2):
        write_checkpoint(path, make(step))
    before = {p.name: p.read_bytes() for p in path.parent.iterdir()}
    bad = make(3)
    if where == "t":
        bad = replace(bad, state=replace(bad.state, t=value))
    else:
        {"X": bad.state.X, "sigma": bad.state.sigma, "coupling": bad.state.coupling[2]}[where][1, ..., 3] = value
    with pytest.raises(ValueError, match="step 3 is not finite"):
        write_checkpoint(path, bad)
    assert {p.name: p.read_bytes() for p in path.parent.iterdir()} == before


@pytest.mark.parametrize("survived", range(6))
def test_a_crash_at_any_rename_or_sync_leaves_one_of_the_two_newest(path, monkeypatch, survived):
    for step in (1, 2):
        write_checkpoint(path, make(step))
    left = survived

    def crashing(call):
        def run(*arguments):
            nonlocal left
            if left == 0:
                raise KeyboardInterrupt
            left -= 1
            return call(*arguments)

        return run

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", crashing(os.replace))
        patch.setattr(os, "fsync", crashing(os.fsync))
        with suppress(KeyboardInterrupt):
            write_checkpoint(path, make(3))
    newest = 2
    for whole in path.parent.glob("out*"):
        with h5py.File(whole) as file:
            newest = max(newest, file.attrs["step"])
    assert newest == (2 if survived < 2 else 3)
    assert_same(read_checkpoint(path), make(newest))
    write_checkpoint(path, make(4))  # and writing goes on
    assert_same(read_checkpoint(path), make(4))


def test_nothing_to_read_says_so(path):
    with pytest.raises(ValueError, match=r"no readable checkpoint at .*out\.h5"):
        read_checkpoint(path)
    path.write_text("not HDF5")
    with pytest.raises(ValueError, match="no readable checkpoint"):
        read_checkpoint(path)


def test_removing_leaves_nothing(path):
    for step in (1, 2):
        write_checkpoint(path, make(step))
    remove_checkpoints(path)
    remove_checkpoints(path)
    assert not list(path.parent.iterdir())
