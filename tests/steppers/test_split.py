"""The split step: what it builds, its order in time alone and extrapolated, the implicit step, invariance, maps that are swapped."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from split_cases import FIELDS, close, counted, developed, in_shear, linear_flow, march, mild, relative, shear_of

from biem.backend import counting
from biem.curves.curve import center_of_nodes
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import membrane_force
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.split import FIRST_SWEEPS, SplitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Fields, Interaction


def test_one_vesicle_at_rest_is_relaxation_alone():
    X = mild(32)[:1]
    counts, new = counted(SplitStepper(ExactMaps(), 1.0, 1.0), State(0.0, X), 1e-5)
    assert counts == {"single_layer_matrix": 1, "relaxation_matrix": 1}
    assert np.array_equal(new.X, ExactMaps().relax(X, 1e-5))
    assert (new.t, new.sigma, new.coupling) == (1e-5, None, None)


def test_one_vesicle_in_a_flow_is_advected_and_relaxed_without_a_pair_sum():
    """The advection of second order, X + dt (1 - M)(u + dt/2 a), relaxed."""
    stepper, t_gamma = in_shear(mild(32))
    dt = 0.02 * t_gamma
    first, state = counted(stepper, State(0.0, mild(32)[:1]), dt)
    assert first["pair_sum"] == first["near_search"] == 0
    counts, new = counted(stepper, state, dt)
    assert counts == {"single_layer_matrix": 2, "relaxation_matrix": 1, "tension_matrix": 1}
    maps, X = ExactMaps(), state.X
    u = stepper.flow(X, 0.0)
    rate = (u - state.coupling[1]) / dt
    assert np.abs(new.X - maps.relax(X + dt * maps.advect(X, u + 0.5 * dt * rate), dt)).max() < 1e-13
    assert new.sigma is None
    kept = replace(stepper, tension=True).step(state, dt).state
    assert np.array_equal(kept.X, new.X)
    assert np.array_equal(kept.sigma, -(maps.self_tension(X) + maps.flow_tension(X, u)))


def test_vesicles_far_apart_make_nothing_near_and_two_pair_sums_a_step():
    X = mild(32) + 5.0 * np.arange(2)[:, None, None]
    stepper, _ = in_shear(X)
    first, state = counted(stepper, State(0.0, X))
    assert 2 <= first["pair_sum"] <= 2 * FIRST_SWEEPS
    for _ in range(3):
        counts, state = counted(stepper, state)
        assert counts == {"pair_sum": 2, "near_search": 1, "single_layer_matrix": 4, "tension_matrix": 2, "relaxation_matrix": 2}


def test_near_vesicles_take_one_search_and_two_pair_sums_a_step():
    stepper, _ = in_shear(close(32))
    _, state = counted(stepper, State(0.0, close(32)))
    counts, _ = counted(stepper, state)
    assert counts["near_sums"] > 20
    assert (counts["pair_sum"], counts["near_search"], counts["tension_matrix"], counts["relaxation_matrix"]) == (2, 1, 2, 2)


def test_far_apart_is_alone():
    X = mild(32) + np.array([0.0, 1e6])[:, None, None] * np.array([[1.0], [0.0]])
    shapes = X - center_of_nodes(X)
    gradient = [[0.0, shear_of(X)], [0.0, 0.0]]
    stepper = SplitStepper(ExactMaps(), 1.0, 1.0, linear_flow(gradient), FIELDS, tension=True)
    both = march(stepper, State(0.0, X), 1e-5, 2)
    for m in range(2):
        alone = march(stepper, State(0.0, X[m : m + 1]), 1e-5, 2)
        assert np.abs(both.X[m] - alone.X[0]).max() < 1e-9
        assert relative(both.sigma[m], alone.sigma[0]) < 1e-5
        assert np.abs(alone.X - center_of_nodes(alone.X) - shapes[m]).max() > 1e-4


def test_differs_from_the_implicit_step_by_first_order_and_extrapolated_by_second():
    """Motions over 0.4 t_gamma from one state; the two differ by 1e-6 in space at N = 32."""
    start = developed(mild, 32)
    split, t_gamma = in_shear(start.X)
    implicit = ImplicitStepper(1.0, 1.0, split.flow, fields=FIELDS)

    def differences(wrap):
        out = []
        for steps in (4, 8, 16):
            a, b = (march(wrap(s), start, 0.4 * t_gamma / steps, steps).X for s in (split, implicit))
            out.append(np.abs(a - b).max())
        return np.array(out)

    plain, extrapolated = differences(lambda s: s), differences(Extrapolated)
    assert np.abs(np.log2(plain[:-1] / plain[1:]) - 1).max() < 0.1, plain
    assert np.log2(extrapolated[:-1] / extrapolated[1:]).min() > 1.7, extrapolated
    assert extrapolated[-1] < 0.05 * plain[-1]
    assert plain[-1] < 1e-3


@pytest.mark.parametrize(("wrap", "order"), [(lambda s: s, 1.0), (Extrapolated, 2.0)])
def test_order_for_a_mild_pair(wrap, order):
    """Over 1 t_gamma, at dt = 0.1, 0.05, 0.025 t_gamma."""
    start = developed(mild, 32)
    stepper, t_gamma = in_shear(start.X)
    ends = [march(wrap(stepper), start, t_gamma / steps, steps).X for steps in (10, 20, 40)]
    assert np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max()) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize(("wrap", "least", "most"), [(lambda s: s, 0.9, 1.1), (Extrapolated, 1.75, 2.1)])
def test_order_for_a_close_pair_of_biconcave_vesicles(wrap, least, most):
    """The stiff modes, which follow the flow implicitly, lower the second order a little at these dt."""
    start = developed(close, 64)
    stepper, t_gamma = in_shear(start.X)
    ends = [march(wrap(stepper), start, t_gamma / steps, steps).X for steps in (10, 20, 40)]
    assert least < np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max()) < most


def test_order_from_a_state_that_knows_no_coupling():
    """The fixed point of the first step spoils no order."""
    X = mild(32)
    stepper, t_gamma = in_shear(X)
    start = State(0.0, march(stepper, State(0.0, X), 0.05 * t_gamma, 10).X)
    for wrap, order in ((lambda s: s, 1.0), (Extrapolated, 2.0)):
        ends = [march(wrap(stepper), start, 0.4 * t_gamma / steps, steps).X for steps in (4, 8, 16)]
        assert np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max()) == pytest.approx(order, abs=0.15)


@dataclass(frozen=True)
class Swapped:
    """Exact maps with one of them replaced by what it gives times a factor (relax: its increment), and what was called."""

    name: str
    factor: float
    exact: ExactMaps = field(default_factory=ExactMaps)
    calls: list = field(default_factory=list)

    def _map(self, name, X, *more):
        self.calls.append((name, X.shape[0]))
        value = getattr(self.exact, name)(X, *more)
        if name != self.name:
            return value
        return X + self.factor * (value - X) if name == "relax" else self.factor * value

    def advect(self, X, u):
        return self._map("advect", X, u)

    def relax(self, X, dt):
        return self._map("relax", X, dt)

    def self_tension(self, X):
        return self._map("self_tension", X)

    def flow_tension(self, X, u):
        return self._map("flow_tension", X, u)

    def near_layers(self, X, f):
        return self._map("near_layers", X, f)


@pytest.mark.parametrize("name", ["advect", "relax", "self_tension", "flow_tension", "near_layers"])
def test_each_map_can_be_replaced(name):
    """An exact stand-in changes no bit; one that is off by 1 % changes the step, and what it should."""
    X = close(32)
    stepper, t_gamma = in_shear(X)
    dt = 0.02 * t_gamma

    def step(maps):
        layered = replace(FIELDS, near_field="layers", layers=maps.near_layers, offsets=(-1.0, -0.5, 0.0, 0.5, 1.0))
        return replace(stepper, maps=maps, fields=layered).step(State(0.0, X), dt).state

    plain, same, off = step(ExactMaps()), Swapped(name, 1.0), Swapped(name, 1.01)
    exact, changed = step(same), step(off)
    assert np.abs(exact.X - plain.X).max() < 1e-14
    assert {called for called, _ in same.calls} == {"advect", "relax", "self_tension", "flow_tension", "near_layers"}
    assert all(m == 2 for _, m in same.calls)
    assert 1e-7 < np.abs(changed.X - plain.X).max() < 1e-3
    tension_changes = np.abs(changed.sigma - plain.sigma).max() / np.abs(plain.sigma).max()
    assert tension_changes < 1e-9 if name in ("advect", "relax") else 1e-5 < tension_changes < 0.1


def test_maps_that_do_nothing_leave_background_flow_alone():
    """advect u = u, relax X = X: the vesicles are carried by what the stepper hands to the maps."""

    class Carried(ExactMaps):
        def advect(self, X, u):
            return u

        def relax(self, X, dt):
            return X

    X = close(32)
    stepper, t_gamma = in_shear(X)
    dt = 0.02 * t_gamma
    new = replace(stepper, maps=Carried()).step(State(0.0, X), dt).state
    t, u, rate = new.coupling
    assert t == 0.0
    assert np.abs(new.X - X - dt * (u + 0.5 * dt * rate)).max() < 1e-14
    induced = Interaction.build(X, 1.0, FIELDS).velocity(membrane_force(X, new.sigma))
    assert np.abs(u - stepper.flow(X, 0.0) - induced).max() < 1e-12 * np.abs(u).max()


def test_advection_alone_is_of_second_order():
    """Nodes carried round by (1 + t)(-y, x), from a start without a rate and with unlike steps, against the exact turn."""

    class Carried(ExactMaps):
        def advect(self, X, u):
            return u

        def relax(self, X, dt):
            return X

    X = mild(16)[:1]
    flow = lambda Y, t: (1.0 + t) * linear_flow([[0.0, -1.0], [1.0, 0.0]])(Y, t)
    c, s = np.cos(1.5), np.sin(1.5)
    errors = []
    for steps in (10, 20, 40):
        state, stepper = State(0.0, X), SplitStepper(Carried(), 1.0, 1.0, flow, FIELDS)
        for k in range(steps):
            state = stepper.step(state, (1.0 + 0.5 * (-1) ** k) / steps).state
        assert state.t == pytest.approx(1.0)
        errors.append(np.abs(state.X - np.array([[c, -s], [s, c]]) @ X).max())
    assert np.abs(np.log2(np.array(errors[:-1]) / errors[1:]) - 2.0).max() < 0.15, errors


def test_invariance_to_rigid_motion_and_reindexing():
    X = close(32)
    rate = shear_of(X)
    shear = np.array([[0.0, rate], [0.0, 0.0]])
    dt = 0.02 / rate
    run = lambda X, flow: march(SplitStepper(ExactMaps(), 1.0, 1.0, flow, FIELDS), State(0.0, X), dt, 4)
    plain = run(X, linear_flow(shear))
    scale = np.abs(plain.sigma).max()
    c, s = np.cos(0.7), np.sin(0.7)
    Q, flip = np.array([[c, -s], [s, c]]), np.diag([1.0, -1.0])
    mirror = lambda Y: np.roll(Y[..., ::-1], 1, axis=-1)
    turned = run(Q @ X, linear_flow(Q @ shear @ Q.T))
    assert np.abs(turned.X - Q @ plain.X).max() < 1e-9
    assert np.abs(turned.sigma - plain.sigma).max() < 1e-6 * scale
    far = np.array([1000.0, -1000.0])[:, None]
    moved = run(X + far, lambda Y, t: linear_flow(shear)(Y - far, t))
    assert np.abs(moved.X - far - plain.X).max() < 1e-9
    rolled = run(np.roll(X, 5, axis=-1), linear_flow(shear))
    assert np.abs(rolled.X - np.roll(plain.X, 5, axis=-1)).max() < 1e-9
    assert np.abs(rolled.coupling[1] - np.roll(plain.coupling[1], 5, axis=-1)).max() < 1e-6 * np.abs(plain.coupling[1]).max()
    mirrored = run(mirror(flip @ X), linear_flow(flip @ shear @ flip))
    assert np.abs(mirrored.X - mirror(flip @ plain.X)).max() < 1e-9
    swapped = run(X[::-1], linear_flow(shear))
    assert np.abs(swapped.X - plain.X[::-1]).max() < 1e-9
    assert np.abs(swapped.sigma - plain.sigma[::-1]).max() < 1e-6 * scale


def test_units_scale_exactly():
    """Lengths times 3, kappa_b times 2, mu times 5: the same motion in the scaled time."""
    X = close(32)
    rate, a, kappa_b, mu = shear_of(X), 3.0, 2.0, 5.0
    time = mu * a**3 / kappa_b
    shear = lambda rate: linear_flow([[0.0, rate], [0.0, 0.0]])
    plain = march(SplitStepper(ExactMaps(), 1.0, 1.0, shear(rate), FIELDS), State(0.0, X), 0.02 / rate, 3)
    stepper = SplitStepper(ExactMaps(kappa_b, mu), kappa_b, mu, shear(rate / time), FIELDS)
    scaled = march(stepper, State(0.0, a * X), 0.02 / rate * time, 3)
    assert np.abs(scaled.X / a - plain.X).max() < 1e-8
    assert relative(scaled.sigma * a**2 / kappa_b, plain.sigma) < 1e-5


def test_steps_of_several_dt_from_one_state_share_the_advection():
    stepper, t_gamma = in_shear(close(32))
    state = stepper.step(State(0.0, close(32)), 0.02 * t_gamma).state
    counted(stepper, state)
    with counting() as shared:
        ends = [stepper.step(state, dt * t_gamma).state.X for dt in (0.02, 0.01, 0.005)]
    assert shared["tension_matrix"] == 0  # the state of the step before
    fresh = replace(stepper)
    with counting() as counts:
        again = [fresh.step(state, dt * t_gamma).state.X for dt in (0.02, 0.01, 0.005)]
    assert (counts["tension_matrix"], counts["pair_sum"], counts["near_search"], counts["relaxation_matrix"]) == (2, 2, 1, 6)
    assert all(np.array_equal(a, b) for a, b in zip(ends, again, strict=True))
    with counting() as counts:
        Extrapolated(replace(stepper)).step(state, 0.02 * t_gamma)
    assert (counts["tension_matrix"], counts["pair_sum"], counts["relaxation_matrix"]) == (4, 4, 6)


def test_a_step_depends_on_its_state_alone():
    X = close(32)
    stepper, t_gamma = in_shear(X)
    state = march(stepper, State(0.0, X), 0.02 * t_gamma, 3)
    copy = State(state.t, state.X.copy(), None, (state.coupling[0], state.coupling[1].copy(), state.coupling[2].copy()))
    other, _ = in_shear(X)
    assert np.array_equal(other.step(copy, 0.01 * t_gamma).state.X, stepper.step(state, 0.01 * t_gamma).state.X)


def test_what_is_shared_belongs_to_one_state_not_to_its_nodes_alone():
    """The same X at another time, or with another coupling velocity, is another state."""
    X = close(32)
    stepper, t_gamma = in_shear(X)
    faster = replace(stepper, flow=lambda Y, t: (1.0 + t) * stepper.flow(Y, t))
    faster.step(State(0.0, X), 1e-6)
    assert np.array_equal(faster.step(State(1.0, X), 1e-6).state.X, replace(faster).step(State(1.0, X), 1e-6).state.X)
    u = 1e3 * X
    stepper.step(State(0.0, X), 1e-6)
    coupled = State(0.0, X, None, (-0.01 * t_gamma, u, 0.0 * u))
    assert np.array_equal(stepper.step(coupled, 1e-6).state.X, replace(stepper).step(coupled, 1e-6).state.X)


def as_torch(state):
    move = torch.from_numpy
    coupling = None if state.coupling is None else (state.coupling[0], move(state.coupling[1]), move(state.coupling[2]))
    return State(state.t, move(state.X), None, coupling)


def test_torch_on_the_cpu_equals_numpy():
    state = State(0.0, close(32))
    stepper, t_gamma = in_shear(state.X)
    for _ in range(3):
        new = stepper.step(state, 0.02 * t_gamma).state
        other = stepper.step(as_torch(state), 0.02 * t_gamma).state
        assert other.X.dtype == torch.float64
        assert np.abs(other.X.numpy() - new.X).max() < 1e-11
        assert relative(other.sigma, new.sigma) < 1e-8
        assert relative(other.coupling[1], new.coupling[1]) < 1e-8
        state = new


@pytest.mark.parametrize("make", [mild, close])
def test_single_precision_is_within_five_digits_of_the_length_a_step(make):
    state = State(0.0, make(32))
    stepper, t_gamma = in_shear(state.X)
    fields = Fields(near_tolerance=1e-5, far_field="direct", precision="float32")
    single = replace(stepper, maps=ExactMaps(precision="float32"), fields=fields)
    for _ in range(3):
        new = stepper.step(state, 0.02 * t_gamma).state
        other = single.step(state, 0.02 * t_gamma).state
        assert other.X.dtype == np.float64
        assert 1e-12 < np.abs(other.X - new.X).max() < 1e-5
        tensors = single.step(as_torch(state), 0.02 * t_gamma).state
        assert np.abs(tensors.X.numpy() - other.X).max() < 1e-6
        state = new
