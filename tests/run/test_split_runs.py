"""The split solver through `simulate` and the command line: restarts, counts, diagnostics, options, rejected steps."""

import h5py
import numpy as np
import pytest
from scene_helpers import DT, PAIR, assert_same_frames, cli, scene_of, stop_after, write_scene

from biem.curves.curve import area, length
from biem.errors import NumericalFailure
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory

SPLIT = {"solver": {"kind": "split"}}
TORCH = {"solver": {"kind": "split", "device": "torch"}}
REST = {"flow": {"kind": "quiescent", "rate": None}}
CLOSE = {"vesicles": {"points": 32, "centers": [[-0.095, 0.0], [0.095, 0.0]], "angles": [1.57, 1.57]}}
REPELLED = {"solver": {"kind": "split", "repulsion": {"reach": 0.05, "strength": 1e3}}}
WAYS = {
    "order 1": SPLIT,
    "order 2": {**SPLIT, "time": {"order": 2}},
    "adaptive": {**SPLIT, "time": {"adaptive": True, "tolerance": 1e-4, "dt": DT / 2}},
    "order 2, adaptive": {**SPLIT, "time": {"adaptive": True, "order": 2, "tolerance": 1e-4, "dt": DT / 2}},
    "order 1, torch": TORCH,
    "order 2, torch": {**TORCH, "time": {"order": 2}},
    "adaptive, torch": {**TORCH, "time": {"adaptive": True, "tolerance": 1e-4, "dt": DT / 2}},
    "float32": {"solver": {"kind": "split", "dtype": "float32"}},
    "repulsion": REPELLED,
}


@pytest.mark.parametrize("way", WAYS)
def test_a_run_stopped_at_any_step_goes_on_bitwise(tmp_path, monkeypatch, way):
    scene = scene_of(CLOSE if way == "repulsion" else PAIR, WAYS[way], time={"horizon": 4 * DT, "save_every": 2})
    whole = simulate(scene)
    steps = int(whole.trajectory.step[-1])
    assert steps >= 4
    for stop in range(1, steps) if "torch" not in way else (1, steps - 1):  # there a step takes long
        out = tmp_path / f"{stop}.h5"
        with monkeypatch.context() as patch:
            stop_after(patch, stop)
            with pytest.raises(Stopped, match=f"step {stop} "):
                simulate(scene, out)
        kept = read_checkpoint(checkpoint_path(out))
        assert kept.step == stop
        t, u, rate = kept.state.coupling  # of the step before
        assert t < kept.state.t
        assert u.shape == rate.shape == whole.trajectory.X.shape[1:]
        assert np.abs(u).max() > 0
        assert np.isfinite(rate).all()
        done = simulate(scene, out, resume=True)
        assert_same_frames(done.trajectory, whole.trajectory)
        assert done.counts == whole.counts
        for name, values in whole.trajectory.diagnostics.items():
            assert name == "wall_seconds" or np.array_equal(done.trajectory.diagnostics[name], values), name


def test_the_coupling_in_the_checkpoint_matters(tmp_path):
    """Without it, the tension is iterated anew: a run that lost it would differ, so the test above sees its loss."""
    whole = simulate(scene_of(PAIR, SPLIT, time={"horizon": 4 * DT})).trajectory
    simulate(scene_of(PAIR, SPLIT, time={"horizon": 2 * DT}), tmp_path / "out.h5")
    with h5py.File(checkpoint_path(tmp_path / "out.h5"), "r+") as file:
        del file["coupling"], file["coupling_rate"]
    parts = simulate(scene_of(PAIR, SPLIT, time={"horizon": 4 * DT}), tmp_path / "out.h5", resume=True).trajectory
    assert 0 < np.abs(parts.X[-1] - whole.X[-1]).max() < 1e-6


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_torch_on_the_cpu_is_numpy_to_rounding(dtype):
    a, b = (simulate(scene_of(PAIR, s, solver={"dtype": dtype})).trajectory for s in (SPLIT, TORCH))
    assert np.abs(a.X - b.X).max() < (1e-12 if dtype == "float64" else 1e-6)


def test_split_follows_implicit_at_first_order_in_dt():
    """Both are of first order: their difference halves with dt."""
    off = []
    for dt in (DT, DT / 2):
        split, implicit = (simulate(scene_of(PAIR, s, time={"dt": dt, "horizon": 8 * DT})).trajectory for s in (SPLIT, {}))
        off.append(np.abs(split.X[-1] - implicit.X[-1]).max())
    assert 0 < off[0] < 2e-3
    assert off[1] < 0.7 * off[0]


# Counts and what is kept, of one vesicle and of two

ONE_CASES = {
    "at rest": (REST, False, 0),
    "in flow": ({}, False, 1),
    "tension at rest": ({**REST, "output": {"tension": True}}, True, 1),
    "tension in flow": ({"output": {"tension": True}}, True, 1),
}


@pytest.mark.parametrize("case", ONE_CASES)
def test_one_vesicle_takes_what_it_needs(case):
    changes, tension, factors = ONE_CASES[case]
    changes = {**changes, "vesicles": {"shape": "ellipse", "points": 32}}
    done = simulate(scene_of(SPLIT, changes, time={"horizon": 3 * DT}))
    assert (done.trajectory.sigma is not None) == tension
    assert not {"pair_sum", "near_search", "near_rows", "coupled_response"} & set(done.counts)
    longer = simulate(scene_of(SPLIT, changes, time={"horizon": 5 * DT})).counts  # the first step may need more
    assert longer["relaxation_matrix"] - done.counts["relaxation_matrix"] == 2
    assert longer["tension_matrix"] - done.counts["tension_matrix"] == 2 * factors
    if "rest" in case:
        assert done.counts["relaxation_matrix"] == 3
    alone = simulate(scene_of(changes, time={"horizon": 3 * DT})).trajectory  # implicit
    assert np.abs(done.trajectory.X - alone.X).max() < 1e-3
    if "rest" in case:
        energy = done.trajectory.diagnostics["bending_energy"]
        assert (np.diff(energy) <= 1e-9 * energy[0]).all()


@pytest.mark.parametrize(("order", "states", "solves"), [(1, 1, 1), (2, 2, 3)])
def test_two_pair_sums_and_one_factorisation_a_state(order, states, solves):
    M = 2
    few, more = (simulate(scene_of(PAIR, SPLIT, time={"horizon": steps * DT, "order": order})).counts for steps in (3, 5))
    assert more["pair_sum"] - few["pair_sum"] == 2 * 2 * states
    assert more["tension_matrix"] - few["tension_matrix"] == 2 * states * M
    assert more["relaxation_matrix"] - few["relaxation_matrix"] == 2 * solves * M
    assert 0 < few["pair_sum"] - 2 * 3 * states <= 60  # what the first step has nothing to predict from takes sweeps
    assert "coupled_response" not in more


@pytest.mark.parametrize("near_field", ["auto", "upsample", "ying_zorin", "layers", "layers_rbf", "none"])
def test_every_near_field_runs_and_all_but_none_agree(near_field):
    runs = [simulate(scene_of(CLOSE, SPLIT, solver={"near_field": n}, time={"horizon": 2 * DT})) for n in (near_field, "upsample")]
    assert (runs[0].counts["near_search"] > 0) == (near_field != "none")
    off = np.abs(runs[0].trajectory.X - runs[1].trajectory.X).max()
    assert off < {"auto": 1e-15, "upsample": 1e-15, "none": 1e-1}.get(near_field, 1e-4)
    assert near_field in ("auto", "upsample") or off > 1e-12


def test_repulsion_works_and_its_work_is_kept(tmp_path):
    time = {"dt": DT / 16, "horizon": DT / 4}
    free, repelled = (simulate(scene_of(CLOSE, s, REST, time={**time, "save_every": 2})) for s in (SPLIT, REPELLED))
    assert "repulsed_nodes" not in free.counts
    assert repelled.counts["repulsed_nodes"] > 0
    assert (free.trajectory.diagnostics["repulsion_work"] == 0).all()
    work = repelled.trajectory.diagnostics["repulsion_work"]
    assert work[0] == 0
    assert (work[1:] > 0).all()  # in a fluid at rest, it moves them
    apart = [done.trajectory.X[-1, 1, 0].mean() - done.trajectory.X[-1, 0, 0].mean() for done in (free, repelled)]
    assert apart[1] > apart[0] + 1e-6
    every = simulate(scene_of(CLOSE, REPELLED, REST, time=time)).trajectory.diagnostics["repulsion_work"]
    assert work[1:] == pytest.approx([every[1:3].sum(), every[3:].sum()], rel=1e-12)  # since the last frame
    kept = simulate(scene_of(CLOSE, REPELLED, REST, time={**time, "save_every": 2}), tmp_path / "out.h5").trajectory
    assert np.array_equal(read_trajectory(tmp_path / "out.h5").diagnostics["repulsion_work"], kept.diagnostics["repulsion_work"])


def test_two_close_vesicles_at_rest_stay_at_rest():
    """A gap of 0.4 arclength spacings: below the largest stable step of explicit interactions, errors must not grow from step to step."""
    steps = {"time": {"dt": 2**-16, "horizon": 20 * 2**-16}}
    done = simulate(scene_of(CLOSE, SPLIT, REST, **steps)).trajectory
    exact = simulate(scene_of(CLOSE, REST, **steps)).trajectory  # implicit
    assert np.abs(exact.X[-1] - exact.X[0]).max() < 1e-4
    assert np.abs(done.X[-1] - done.X[0]).max() < 1e-4
    assert done.diagnostics["length_error"].max() < 1e-6


@pytest.mark.parametrize("device", ["cpu", "torch"])
def test_diagnostics_are_those_of_a_split_step(device):
    done = simulate(scene_of(PAIR, SPLIT, solver={"device": device})).trajectory
    assert done.attributes["solver"] == "split"
    assert done.X.dtype == done.sigma.dtype == np.float64
    assert (done.diagnostics["gmres_iterations"] == 0).all()
    assert (done.diagnostics["area_error"][1:] > 0).all()
    for measure in (area, length):
        assert np.abs(measure(done.X[-1]) / measure(done.X[0]) - 1).max() < 1e-9


@pytest.mark.parametrize("device", ["cpu", "torch"])
@pytest.mark.parametrize("save_every", [1, 10])
def test_a_rejected_step_leaves_the_last_good_state(tmp_path, device, save_every):
    """A strain that switches on in the fourth step leaves more than max_error of length."""
    (tmp_path / "switched_strain.py").write_text("def f(x, y, t):\n    g = 1e5 if t > 2.5 * 2**-13 else 10.0\n    return g * x, -g * y\n")
    flow = {"flow": {"kind": "custom", "rate": None, "function": "switched_strain.f"}}
    changes = (PAIR, SPLIT, flow, {"solver": {"device": device}, "time": {"save_every": save_every, "horizon": 8 * DT}})
    good = simulate(scene_of(*changes, folder=tmp_path, time={"horizon": 3 * DT, "save_every": 1})).trajectory
    with pytest.raises(NumericalFailure, match=r"step 4 rejected at .*(off by|cross|finite).*state before it is kept"):
        simulate(scene_of(*changes, folder=tmp_path), tmp_path / "out.h5")
    left = read_trajectory(tmp_path / "out.h5")
    assert left.step[-1] == 3
    assert np.array_equal(left.X[-1], good.X[-1])
    kept = read_checkpoint(checkpoint_path(tmp_path / "out.h5"))
    assert kept.step == 3
    assert np.array_equal(kept.state.X, good.X[-1])


def test_the_bound_of_a_step_is_max_error():
    worst = simulate(scene_of(PAIR, SPLIT)).trajectory.diagnostics["length_error"].max()
    simulate(scene_of(PAIR, SPLIT, solver={"max_error": 1.01 * worst}))
    with pytest.raises(NumericalFailure, match=r"(length|area) of vesicle \d is off by .*solver\.max_error"):
        simulate(scene_of(PAIR, SPLIT, solver={"max_error": 0.5 * worst}))


@pytest.mark.parametrize("way", ["order 2", "adaptive", "order 1, torch", "repulsion"])
def test_verify_passes_on_a_split_run(tmp_path, way):
    out = tmp_path / "out.h5"
    path = write_scene(tmp_path, PAIR, {name: table for name, table in WAYS[way].items() if way != "repulsion"}, SPLIT)
    repulsion = ["--set", "solver.repulsion={reach = 0.2}"] if way == "repulsion" else []
    result = cli("run", path, "-o", out, *repulsion)
    assert result.exit_code == 0, result.output
    assert "GMRES" not in result.stdout
    assert "tension_matrix" in result.stdout
    checks = cli("verify", out)
    assert checks.exit_code == 0, checks.output
    assert "FAILED" not in checks.output


def test_a_run_is_not_resumed_by_another_solver_device_or_precision(tmp_path):
    simulate(scene_of(PAIR, SPLIT), tmp_path / "out.h5")
    for change, key in (({"kind": "implicit"}, "kind"), ({"device": "torch"}, "device"), ({"dtype": "float32"}, "dtype")):
        with pytest.raises(ValueError, match=rf"solver\.{key} was .*, is "):
            simulate(scene_of(PAIR, SPLIT, solver=change), tmp_path / "out.h5", resume=True)
