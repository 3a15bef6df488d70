"""Short-range repulsion: where it acts, Newton's third law, its size, what it does to a pair pressed together, and its work."""

import numpy as np
import pytest
import torch

from biem.backend import counting
from biem.curves.curve import arclength_weights, area, curvature, effective_radius, length
from biem.curves.shapes import ellipse, place
from biem.membrane.maps import ExactMaps
from biem.membrane.repulsion import Repulsion, work_of
from biem.scene.flows import make_flow
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Fields
from biem.stokes.near_search import minimum_gap

REACH, STRENGTH = 0.03, 1e4
FIELDS = Fields(near_tolerance=1e-8, far_field="direct")


def stacked(gap, N=64, shift=0.0, turn=0.0):
    """Two ellipses of length 1, long axes along x, the upper one `gap` above the other, moved along it and turned."""
    one = ellipse(N, 0.9)
    half = 0.5 * (np.ptp(one[1]) + gap)
    return np.stack([place(one, np.array([0.0, -half]), 0.0), place(one, np.array([shift, half]), turn)])


def crowd(N=32):
    """Five vesicles with gaps below the reach, one of them far away."""
    one = ellipse(N, 0.7)
    width, height = np.ptp(one, axis=1)
    spots = ((0.0, 0.0, 0.0), (0.05, height + 0.012, 0.02), (width + 0.015, 0.01, 0.1), (0.3, 2 * height + 0.02, -0.05), (5.0, 5.0, 1.0))
    return np.stack([place(one, np.array([x, y]), angle) for x, y, angle in spots])


def net(f, X):
    """Total force (M, 2) and torque about the origin (M,) of each membrane."""
    g = f * arclength_weights(X)[:, None, :]
    return g.sum(axis=-1), (X[:, 0] * g[:, 1] - X[:, 1] * g[:, 0]).sum(axis=-1)


def test_nothing_for_one_vesicle_or_where_all_gaps_are_wide():
    assert Repulsion(10.0, STRENGTH).force(stacked(0.01)[:1]) is None
    with counting() as counts:
        assert Repulsion(REACH, STRENGTH).force(stacked(1.01 * REACH)) is None
    assert counts["repulsed_nodes"] == 0
    with counting() as counts:
        assert Repulsion(REACH, STRENGTH).force(stacked(0.9 * REACH)) is not None
    assert counts["repulsed_nodes"] >= 2


def test_total_force_and_torque_vanish():
    X = crowd()
    f = Repulsion(REACH, STRENGTH).force(X)
    force, torque = net(f, X)
    assert np.abs(force).max() > 1.0
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * np.abs(f * arclength_weights(X)[:, None, :]).sum()
    assert abs(torque.sum()) < 1e-12 * np.abs(torque).max()
    assert np.abs(f[4]).max() == 0.0
    two = np.ascontiguousarray(X[:2])
    (a, b), (s, t) = net(Repulsion(REACH, STRENGTH).force(two), two)
    assert np.abs(a + b).max() < 1e-13 * np.abs(a).max() * 100
    assert abs(s + t) < 1e-11 * abs(s)


def test_it_drives_membranes_apart_and_grows_as_the_gap_closes():
    upward = []
    for gap in (0.025, 0.015, 0.005):
        X = stacked(gap)
        f = Repulsion(REACH, STRENGTH).force(X)
        (lower, upper), _ = net(f, X)
        assert lower[1] < 0.0 < upper[1]
        assert abs(upper[0]) < 1e-10 * upper[1]  # by symmetry
        upward.append(upper[1])
    assert 0 < 2 * upward[0] < upward[1] < upward[2]


def test_size_between_nearly_flat_membranes():
    """Where the membranes face each other across the gap d: strength (1 - d/reach) of its own, and the reaction, denser by 1 + c d."""
    N, gap = 512, 0.01
    X = stacked(gap, N)
    f = Repulsion(REACH, STRENGTH).force(X)
    lowest = int(np.argmin(X[1, 1]))
    bend = curvature(X)[1, lowest]
    assert f[1, 1, lowest] == pytest.approx(STRENGTH * (1 - gap / REACH) * (2 + bend * gap), rel=1e-3)
    assert abs(f[1, 0, lowest]) < 1e-3 * f[1, 1, lowest]
    total = net(f, X)[0][1, 1]
    # twice the integral of strength (1 - d/reach) n_y over the part of one membrane that is within reach
    one = X[1]
    d = np.array([np.hypot(*(X[0] - p[:, None])).min() for p in one.T])
    fine = 2 * STRENGTH * (np.maximum(0.0, 1 - d / REACH) * arclength_weights(X)[1]).sum()
    assert total == pytest.approx(fine, rel=0.02)


def test_linear_in_the_strength_and_of_units():
    X = crowd()
    f = Repulsion(REACH, STRENGTH).force(X)
    assert np.abs(Repulsion(REACH, 3 * STRENGTH).force(X) - 3 * f).max() < 1e-13 * np.abs(f).max()
    assert np.abs(Repulsion(2 * REACH, STRENGTH).force(2 * X) - f).max() < 1e-10 * np.abs(f).max()


def test_motions_and_reindexing():
    X = crowd()
    repulsion = Repulsion(REACH, STRENGTH)
    f = repulsion.force(X)
    c, s = np.cos(0.7), np.sin(0.7)
    Q = np.array([[c, -s], [s, c]])
    scale = np.abs(f).max()
    assert np.abs(repulsion.force(Q @ X + 100.0) - Q @ f).max() < 1e-8 * scale
    assert np.abs(repulsion.force(X[::-1]) - f[::-1]).max() < 1e-11 * scale
    assert np.abs(repulsion.force(np.roll(X, 5, -1)) - np.roll(f, 5, -1)).max() < 1e-10 * scale


def test_torch_equals_numpy():
    X = crowd()
    f, g = (Repulsion(REACH, STRENGTH).force(a) for a in (X, torch.from_numpy(X)))
    assert g.dtype == torch.float64
    assert np.abs(g.numpy() - f).max() < 1e-12 * np.abs(f).max()


def test_work_is_the_integral_of_force_and_displacement():
    X = stacked(0.01)
    f = np.zeros_like(X)
    f[1, 1] = 3.0
    assert work_of(f, X, 0.0 * X + np.array([[7.0], [2.0]])) == {"repulsion_work": pytest.approx(3.0 * 2.0 * float(length(X[1:])[0]))}
    assert work_of(None, X, X) == {}


def solver(kind, flow, repulsion):
    if kind == "split":
        return SplitStepper(ExactMaps(), 1.0, 1.0, flow, FIELDS, repulsion)
    return ImplicitStepper(1.0, 1.0, flow, tolerance=1e-8, fields=FIELDS, repulsion=repulsion)


@pytest.mark.parametrize("kind", ["split", "implicit"])
def test_a_pair_pressed_together_keeps_a_wider_gap_and_the_work_has_its_sign(kind):
    """Extensional flow (-rate x, rate y) presses two vesicles tip to tip: they approach against the repulsion, until it prevails."""
    one = ellipse(48, 0.9)
    half = 0.5 * (np.ptp(one[0]) + 0.032)
    X = np.stack([place(one, np.array([x, 0.0]), 0.0) for x in (-half, half)])
    rate = 5.0 / float(effective_radius(X)[0]) ** 3
    flow = make_flow("extensional", -rate).velocity

    def press(repulsion):
        stepper = Corrected(solver(kind, flow, repulsion), CORRECTIONS, area(X), length(X))
        state, gaps, work = State(0.0, X), [], []
        for _ in range(16):
            result = stepper.step(state, 0.02 / rate)
            state = result.state
            gaps.append(minimum_gap(state.X))
            work.append(result.diagnostics.get("repulsion_work"))
        return np.array(gaps), work

    free, none = press(None)
    kept, work = press(Repulsion(0.04, STRENGTH))
    assert none == [None] * 16
    assert (kept > free).all()
    assert kept.min() > free.min() + 1e-4
    change = np.diff(kept, prepend=minimum_gap(X))
    assert (np.array(work)[change < -2e-4] < 0).all()
    assert (change < -2e-4).sum() >= 3
    assert np.array(work)[change > 2e-4].min(initial=1.0) > 0


@pytest.mark.parametrize("kind", ["split", "implicit"])
def test_at_rest_it_drives_vesicles_apart_and_its_work_is_positive(kind):
    X = stacked(0.01, 48)
    dt = 1e-6
    stepper = solver(kind, None, Repulsion(REACH, STRENGTH))
    with counting() as counts:
        result = stepper.step(State(0.0, X), dt)
    assert counts["repulsed_nodes"] > 2
    still = solver(kind, None, None).step(State(0.0, X), dt).state.X
    moved = (result.state.X - still).mean(axis=-1)
    assert moved[1, 1] > 0 > moved[0, 1]
    f = Repulsion(REACH, STRENGTH).force(X)
    work = (f * (result.state.X - X) * arclength_weights(X)[:, None, :]).sum()
    assert result.diagnostics["repulsion_work"] == pytest.approx(work, rel=1e-12)
    assert (f * (result.state.X - still) * arclength_weights(X)[:, None, :]).sum() > 0
    assert minimum_gap(result.state.X) > minimum_gap(still)


@pytest.mark.parametrize("kind", ["split", "implicit"])
def test_off_by_default(kind):
    X = stacked(0.01, 32)
    with counting() as counts:
        result = solver(kind, None, None).step(State(0.0, X), 1e-6)
    assert "repulsed_nodes" not in counts
    assert "repulsion_work" not in result.diagnostics
