"""Batches of runs: the motion in shear and in extension, the nodes that runs are on, independence of one another, runs that fail."""

from functools import cache
from itertools import pairwise
from math import pi

import numpy as np
import pytest
from harvest_cases import AREA, SHEAR, R, dataset, first_task, shear_batch

import datagen.harvest
from biem.backend import counting
from biem.curves.curve import centroid, inclination
from biem.curves.shapes import ellipse, equilibrium, perturbed, place
from datagen.batch import MARGIN, Batch, tail
from datagen.flows import Flows, Start


def test_extensional_flow_moves_with_the_vesicle():
    """Far off the stagnation point the shape is the same, and it stays where it is."""
    flows = Flows.of("extensional", [Start(np.empty(0), 5.0, 1.0)] * 2, 0.65)
    X = perturbed(64, 0.65, seed=1)[None] + np.array([[[0.0], [0.0]], [[0.3], [-7.0]]])
    batch = Batch(flows.velocity, AREA, (64,), 1e-3)
    groups = batch.advance(batch.start(X), 0.05 / flows.rate[0], 20)
    Y = groups[0].state.X
    assert np.abs(Y[1] - Y[0] - (X[1] - X[0])).max() < 1e-9
    assert np.abs(centroid(Y)[0]).max() < 0.01
    assert np.abs(Y[0] - X[0]).max() > 0.05


def test_steady_inclination_in_shear():
    """0.35526 at Ca 5; the error of a step is of first order, 2.5e-3 at dt = 0.05 t_gamma."""
    angles = []
    for dt, steps in ((0.1, 100), (0.05, 200)):
        batch, rate = shear_batch([5.0])
        groups = batch.advance(batch.start(ellipse(64, 0.65)[None]), dt / rate[0], steps)
        angles.append(float(inclination(groups[0].state.X)[0]))
    assert angles[1] == pytest.approx(0.35526, abs=3e-3)
    assert 2 * angles[1] - angles[0] == pytest.approx(0.35526, abs=1e-3)


def test_tail_of_known_modes():
    t = 2 * pi * np.arange(64) / 64
    z = np.exp(1j * t) + 0.3 * np.exp(-2j * t) + 0.02 * np.exp(11j * t) + 0.01 * np.exp(-15j * t) + 5.0
    X = np.stack([z.real, z.imag])[None]
    whole = np.sqrt(1 + 0.09 + 0.0005)
    assert tail(X, 32)[0] == pytest.approx(np.hypot(0.02, 0.01) / whole)  # |k| > 32/3
    assert tail(X, 34)[0] == pytest.approx(0.01 / whole)  # |k| > 34/3
    assert tail(X, 64)[0] < 1e-15


@cache
def on_nodes(points, tolerance=1e-3):
    """The shard in shear from rough shapes, and the nodes that runs were on at the end of each interval."""
    used = []
    rough = SHEAR | {"runs": 5, "capillary": (30.0, 33.0), "roughness": 12, "dt": 0.05, "horizon": 0.6, "shapes": 3}

    class Watched(Batch):
        def advance(self, groups, dt, steps):
            after = super().advance(groups, dt, steps)
            used.extend((self, g) for g in after)
            return after

    with pytest.MonkeyPatch.context() as patch, counting() as counts:
        patch.setattr(datagen.harvest, "Batch", Watched)
        shard = first_task(dataset(rough, points=points, tolerance=tolerance))
    return shard, used, counts


def test_adaptive_nodes_give_the_shapes_of_many_nodes():
    """The coarser the tolerance, the fewer nodes and the larger the error; at 1e-3 it is below a tenth of the usual selection distance."""
    fine = on_nodes(128)[0]["X"]
    errors, nodes = [], []
    for tolerance in (1e-2, 1e-3, 1e-4):
        shard, used, _ = on_nodes("adaptive", tolerance)
        errors.append(np.hypot(*np.moveaxis(shard["X"] - fine, 1, 0)).max())
        nodes.append(np.mean([g.points for _, g in used for _ in g.runs]))
    assert errors[1] < 2e-4
    assert errors[0] > 4 * errors[1] > 16 * errors[2], errors
    assert 32 <= nodes[0] < nodes[1] < nodes[2] < 128, nodes


def test_runs_are_resolved_and_not_more_than_they_need():
    _, used, counts = on_nodes("adaptive", 1e-4)
    assert {g.points for _, g in used} == {64, 128}
    for batch, group in used:
        assert (tail(group.state.X, group.points) <= batch.tolerance).all()
        assert (tail(group.state.X, group.points // 2) > MARGIN * batch.tolerance).all()
        assert (np.diff(group.runs) > 0).all()
    assert counts["runs_ended"] == 0


def test_an_interval_that_ends_unresolved_is_repeated_with_twice_the_nodes():
    """The equilibrium shape, compressed along its axis into one that 32 nodes do not hold; a loose tolerance lets it stay there."""
    X = place(equilibrium(256, 0.65), np.zeros(2), pi / 2)[None]
    rate = 40.0 / R**3
    flow = lambda runs, like: lambda Y, t: rate * np.stack([Y[:, 0], -Y[:, 1]], axis=1)

    def end(ladder, tolerance):
        batch = Batch(flow, AREA, ladder, tolerance)
        start = batch.start(X)
        assert start[0].points == ladder[0]
        with counting() as counts:
            (group,) = batch.advance(start, 0.02 / rate, 15)
        return group.state.X, counts["intervals_repeated"]

    (coarse, none), (repeated, once), (exact, _) = end((32, 64), 0.1), end((32, 64), 1e-3), end((128,), 1e-3)
    assert (none, once) == (0, 1)
    assert (coarse.shape[-1], repeated.shape[-1]) == (32, 64)
    assert np.abs(repeated - exact[..., ::2]).max() < 0.1 * np.abs(coarse - exact[..., ::4]).max()


def test_runs_that_relax_go_on_with_half_the_nodes():
    """Each as soon as they resolve it with a margin; the shapes are those on many nodes."""
    X = np.stack([perturbed(256, 0.65, seed=s, modes=12) for s in range(4)])
    still = lambda runs, like: None
    batch, fine = Batch(still, AREA, (32, 64, 128), 2e-4), Batch(still, AREA, (128,), 2e-4)
    groups, exact = batch.start(X), fine.start(X)
    history = []
    for _ in range(8):
        history.append({int(r): g.points for g in groups for r in g.runs})
        groups, exact = batch.advance(groups, 0.05 * R**3, 5), fine.advance(exact, 0.05 * R**3, 5)
    assert set(history[0].values()) == {64, 128}
    assert set(history[-1].values()) == {64}
    assert all(later[r] <= earlier[r] for earlier, later in pairwise(history) for r in range(4))
    for g in groups:
        assert np.abs(g.state.X - exact[0].state.X[g.runs][..., :: 128 // g.points]).max() < 2e-5


def test_a_run_does_not_depend_on_its_batch():
    X = np.stack([perturbed(64, 0.65, seed=s) for s in range(4)])
    batch, rate = shear_batch([2.0, 3.0, 4.0, 5.0], ladder=(32, 64))
    dt = 0.05 / rate.max()
    together = {int(r): g.state.X[i] for g in march(batch, X, dt) for i, r in enumerate(g.runs)}
    for r, capillary in enumerate((2.0, 3.0, 4.0, 5.0)):
        alone, _ = shear_batch([capillary], ladder=(32, 64))
        (group,) = march(alone, X[[r]], dt)
        assert np.abs(group.state.X[0] - together[r]).max() < 1e-10


def march(batch, X, dt, intervals=3):
    groups = batch.start(X)
    for _ in range(intervals):
        groups = batch.advance(groups, dt, 4)
    return groups


@pytest.mark.parametrize("failing", [(1,), (0, 2, 3), (0, 1, 2, 3)])
def test_runs_that_fail_end_and_the_others_go_on(failing):
    """Runs that get a velocity that is not a number on any nodes."""
    X = np.stack([perturbed(64, 0.65, seed=s) for s in range(4)])
    sound, rate = shear_batch([2.0, 3.0, 4.0, 5.0])

    def flow(runs, like):
        inner = sound.flow(runs, like)
        return lambda Y, t: inner(Y, t) + np.where(np.isin(runs, failing) & (t > 0), np.nan, 0.0)[:, None, None]

    dt = 0.05 / rate.max()
    groups = march(Batch(flow, AREA, (32, 64), 0.5), X, dt)
    left = [r for r in range(4) if r not in failing]
    assert [r for g in groups for r in g.runs] == left
    expected = march(Batch(sound.flow, AREA, (32, 64), 0.5), X, dt)[0].state.X
    for g in groups:
        assert np.abs(g.state.X - expected[left]).max() < 1e-10
