"""The loop: frames and diagnostics are those of the steps, memory or file makes no difference, units scale out exactly."""

import json

import numpy as np
from scene_helpers import DT, PAIR, assert_prefix, assert_same_frames, scene_of, table

from biem.curves.curve import area, bending_energy, length
from biem.run.simulate import simulate
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.stokes.near_search import minimum_gap


def test_frames_are_saved_every_so_often_and_at_the_horizon():
    every = simulate(scene_of(PAIR, time={"horizon": 7.5 * DT})).trajectory
    some = simulate(scene_of(PAIR, time={"horizon": 7.5 * DT, "save_every": 3})).trajectory
    assert np.array_equal(np.diff(every.t), DT * np.array([1, 1, 1, 1, 1, 1, 1, 0.5]))
    assert some.step.tolist() == [0, 3, 6, 8]
    assert np.array_equal(some.X, every.X[some.step])
    for name in ("area_error", "length_error", "gmres_iterations"):  # the worst since the last frame
        worst = [every.diagnostics[name][a + 1 : b + 1].max() for a, b in ((0, 3), (3, 6), (6, 8))]
        assert some.diagnostics[name][1:].tolist() == worst
    assert every.diagnostics["gmres_iterations"][1:].min() > 0
    assert every.diagnostics["wall_seconds"][1:].min() > 0
    assert np.array_equal(every.diagnostics["min_gap"], [minimum_gap(X) for X in every.X])
    energy = [bending_energy(X, 1.0).sum() for X in every.X]
    assert np.allclose(every.diagnostics["bending_energy"], energy, rtol=1e-13)


def test_a_run_in_memory_is_the_run_in_a_file(tmp_path):
    in_memory, in_file = simulate(scene_of(PAIR)), simulate(scene_of(PAIR), tmp_path / "deep" / "er" / "out.h5")
    assert in_memory.path is None
    assert_same_frames(in_memory.trajectory, in_file.trajectory)
    assert_prefix(simulate(scene_of(PAIR, time={"horizon": 2 * DT})).trajectory, in_file.trajectory)


def test_corrections_keep_area_and_length_and_their_lack_is_seen():
    for corrections, limit in ((["area_length"], 1e-9), ([], 1e-2)):
        done = simulate(scene_of(solver={"corrections": corrections})).trajectory
        drift = max(np.abs(f(done.X[-1]) / f(done.X[0]) - 1).max() for f in (area, length))
        assert drift < limit
        assert done.diagnostics["length_error"].max() > 1e-9  # before correction


def test_units_scale_out_exactly():
    L, mu, kappa_b = 2.0, 3.0, 5.0
    flow, time = {"rate": None, "capillary": 2.0}, {"dt": "0.01 t_kappa", "horizon": "0.05 t_kappa"}
    natural = simulate(scene_of(PAIR, flow=flow, time=time, output={"tension": True})).trajectory
    centers = [[L * c for c in center] for center in PAIR["vesicles"]["centers"]]
    units = {"physics": {"mu": mu, "kappa_b": kappa_b}, "vesicles": {"length": L, "centers": centers}}
    scaled = simulate(scene_of(PAIR, units, flow=flow, time=time)).trajectory
    assert np.abs(scaled.X / L - natural.X).max() < 1e-8
    assert np.allclose(scaled.t * kappa_b / (mu * L**3), natural.t, rtol=1e-12)
    scale = np.abs(natural.sigma).max()
    assert np.abs(scaled.sigma * L**2 / kappa_b - natural.sigma).max() < 1e-6 * scale
    energy = scaled.diagnostics["bending_energy"] * L / kappa_b
    assert np.allclose(energy, natural.diagnostics["bending_energy"], rtol=1e-8)


def test_scene_in_the_attributes_makes_the_run_again(tmp_path):
    done = simulate(scene_of(PAIR), tmp_path / "out.h5").trajectory
    again = make_scene(json.loads(done.attributes["scene"]), tmp_path)
    assert np.array_equal(build(again).X, done.X[0])


def test_scene_in_the_attributes_may_have_a_file(tmp_path):
    done = simulate(scene_of(PAIR), tmp_path / "out.h5").trajectory
    from_file = make_scene({**table(), "vesicles": {"file": "out.h5"}}, tmp_path)
    resolved = simulate(from_file).trajectory.attributes["scene"]
    assert make_scene(json.loads(resolved), tmp_path) == from_file
    assert np.abs(build(make_scene(json.loads(resolved), tmp_path)).X - done.X[-1]).max() < 1e-15
