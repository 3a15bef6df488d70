"""The implicit step: its equations by an independent dense assembly, order, invariance, what fails and how."""

from itertools import pairwise

import numpy as np
import pytest

from biem.backend import counting
from biem.curves.curve import arclength_weights, area, effective_radius, inclination, length, speed
from biem.curves.fourier import resample
from biem.curves.shapes import ellipse, equilibrium, place
from biem.errors import NumericalFailure
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import VesicleOperators, membrane_force
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Fields
from biem.stokes.kernels import stokeslet


def pair(points, distance=2.3):
    one = equilibrium(points, 0.65)
    R = float(effective_radius(one[None])[0])
    return np.stack([place(one, np.array([-distance * R, 0.3 * R]), 0.0), place(one, np.zeros(2), np.pi / 2)])


def linear_flow(gradient):
    return lambda X, t: np.einsum("ij,mjn->min", np.asarray(gradient, dtype=float), X)


def shear_of(X, capillary=5.0):
    return capillary / float(effective_radius(X)[0]) ** 3


def run(X, flow, dt, steps, corrected=True, **options):
    stepper = ImplicitStepper(1.0, 1.0, flow, **options)
    if corrected:
        stepper = Corrected(stepper, CORRECTIONS, area(X), length(X))
    state = State(0.0, X)
    for _ in range(steps):
        state = stepper.step(state, dt).state
    return state


def test_the_step_solves_the_coupled_equations():
    """All unknowns X, sigma of three separated vesicles in one dense system, assembled here with explicit kernels; N = 96 native."""
    N, dt, kappa_b, mu = 96, 2e-5, 1.3, 0.7
    one = ellipse(N, 0.8)
    X = np.stack([place(one, np.array(c), a) for c, a in (((0, 0), 0.3), ((0.75, 0.1), 1.0), ((0.2, 0.8), -0.5))])
    flow = linear_flow([[10.0, 900.0], [50.0, -10.0]])
    ops = VesicleOperators(X, kappa_b, mu)
    n, M = 2 * N, 3
    A = np.zeros((M * (n + N), M * (n + N)))
    rhs = np.zeros(M * (n + N))
    S, B, T, P, L = ops.S, ops.B, ops.T, ops.P, ops.L
    D, D4, weights = ops.D, ops.D4, arclength_weights(X)
    zero = np.zeros((N, N))
    for i in range(M):
        row = slice(i * (n + N), i * (n + N) + n)
        tension_row = slice(row.stop, row.stop + N)
        A[row, row] = np.eye(n) / dt - B[i]
        A[row, tension_row] = -T[i]
        A[tension_row, row] = P[i] @ B[i]
        A[tension_row, tension_row] = L[i]
        u_inf = flow(X, 0.0)[i].reshape(-1)
        rhs[row] = X[i].reshape(-1) / dt + u_inf
        rhs[tension_row] = -P[i] @ u_inf
        for j in range(M):
            if j == i:
                continue
            gxx, gxy, gyy = stokeslet(X[i, 0][:, None] - X[j, 0], X[i, 1][:, None] - X[j, 1], mu)
            G = np.block([[gxx * weights[j], gxy * weights[j]], [gxy * weights[j], gyy * weights[j]]])
            bend = -kappa_b * G @ np.block([[D4[j], zero], [zero, D4[j]]])
            tense = G @ np.concatenate([D[j] * ops.tangent[j, 0], D[j] * ops.tangent[j, 1]])
            other = slice(j * (n + N), j * (n + N) + n)
            other_tension = slice(other.stop, other.stop + N)
            A[row, other] -= bend
            A[row, other_tension] -= tense
            A[tension_row, other] += P[i] @ bend
            A[tension_row, other_tension] += P[i] @ tense
    solution = np.linalg.solve(A, rhs).reshape(M, n + N)
    new = ImplicitStepper(kappa_b, mu, flow).step(State(0.0, X), dt).state
    want = solution[:, :n].reshape(M, 2, N)
    assert np.abs(want - X).max() > 1e-3
    assert np.abs(new.X - want).max() < 1e-8
    assert np.abs(new.sigma - solution[:, n:]).max() < 1e-5 * np.abs(new.sigma).max()
    assert S.shape == (M, n, n)


def test_alone_is_relaxation_and_far_apart_is_alone():
    X = pair(32)
    assert np.abs(run(X[:1], None, 1e-5, 1, corrected=False).X - ExactMaps().relax(X[:1], 1e-5)).max() < 1e-7  # of two quadratures
    far = X + np.array([0.0, 1e4])[:, None, None] * np.array([1.0, 0.0])[:, None]
    apart = run(far, None, 1e-5, 2, corrected=False).X - (far - X)
    for m in range(2):
        assert np.abs(apart[m] - run(X[m : m + 1], None, 1e-5, 2, corrected=False).X).max() < 1e-10


def test_warm_start_depends_on_the_state_alone_and_saves_iterations():
    X = pair(32)
    flow, dt = linear_flow([[0, shear_of(X)], [0, 0]]), 0.02 / shear_of(X)
    stepper = ImplicitStepper(1.0, 1.0, flow)
    first = stepper.step(State(0.0, X), dt)
    warm = stepper.step(first.state, dt)
    cold = stepper.step(State(dt, first.state.X), dt)
    assert np.abs(warm.state.X - cold.state.X).max() < 1e-10
    assert warm.diagnostics["gmres_iterations"] < cold.diagnostics["gmres_iterations"]
    again = stepper.step(State(dt, first.state.X.copy(), first.state.sigma.copy()), dt)
    assert np.array_equal(again.state.X, warm.state.X)


def test_first_order_in_dt():
    X = pair(32)
    rate = shear_of(X)
    ends = [run(X, linear_flow([[0, rate], [0, 0]]), h / rate, round(0.24 / h)).X for h in (0.04, 0.02, 0.01)]
    order = np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max())
    assert order == pytest.approx(1.0, abs=0.05)


def test_spectral_decay_in_the_nodes():
    """Shape after three steps of a close pair, against N = 96: each 16 nodes gain a factor of 3 at least."""
    rate = shear_of(pair(96))
    flow = linear_flow([[0, rate], [0, 0]])
    exact = resample(run(pair(96), flow, 0.04 / rate, 3).X, 192)
    errors = [np.abs(resample(run(pair(N), flow, 0.04 / rate, 3).X, 192) - exact).max() for N in (16, 32, 48, 64)]
    assert errors[3] < 1e-6
    assert all(b < a / 3 for a, b in pairwise(errors))


def test_invariance_to_rigid_motion_reindexing_and_reflection():
    X = pair(32)
    rate = shear_of(X)
    shear = np.array([[0, rate], [0, 0.0]])
    dt = 0.02 / rate
    plain = run(X, linear_flow(shear), dt, 5)
    c, s = np.cos(0.7), np.sin(0.7)
    Q, F = np.array([[c, -s], [s, c]]), np.diag([1.0, -1.0])

    def flip(Y):
        return np.roll(Y[..., ::-1], 1, axis=-1)

    turned = run(Q @ X, linear_flow(Q @ shear @ Q.T), dt, 5)
    assert np.abs(turned.X - Q @ plain.X).max() < 1e-10
    far = np.array([1000.0, -1000.0])[:, None]
    moved = run(X + far, lambda Y, t: linear_flow(shear)(Y - far, t), dt, 5)
    assert np.abs(moved.X - far - plain.X).max() < 1e-10
    rolled = run(np.roll(X, 5, axis=-1), linear_flow(shear), dt, 5)
    assert np.abs(rolled.X - np.roll(plain.X, 5, axis=-1)).max() < 1e-10
    assert np.abs(rolled.sigma - np.roll(plain.sigma, 5, axis=-1)).max() < 1e-7 * np.abs(plain.sigma).max()
    mirrored = run(flip(F @ X), linear_flow(F @ shear @ F), dt, 5)
    assert np.abs(mirrored.X - flip(F @ plain.X)).max() < 1e-10
    swapped = run(X[::-1], linear_flow(shear), dt, 5)
    assert np.abs(swapped.X - plain.X[::-1]).max() < 1e-10


def test_units_scale_exactly():
    """Lengths times 3, kappa_b times 2, mu times 5: the same motion in the scaled time."""
    X = pair(32)
    rate, a, kappa_b, mu = shear_of(X), 3.0, 2.0, 5.0
    time = mu * a**3 / kappa_b
    plain = ImplicitStepper(1.0, 1.0, linear_flow([[0, rate], [0, 0]])).step(State(0.0, X), 0.02 / rate).state.X
    scaled = ImplicitStepper(kappa_b, mu, linear_flow([[0, rate / time], [0, 0]])).step(State(0.0, a * X), 0.02 / rate * time).state.X
    assert np.abs(scaled / a - plain).max() < 1e-8


def test_corrections_keep_area_and_length():
    X = pair(32)
    rate = shear_of(X)
    state = run(X, linear_flow([[0, rate], [0, 0]]), 0.05 / rate, 10)
    assert np.abs(area(state.X) / area(X) - 1).max() < 1e-10
    assert np.abs(length(state.X) / length(X) - 1).max() < 1e-10
    raw = run(X, linear_flow([[0, rate], [0, 0]]), 0.05 / rate, 10, corrected=False)
    assert np.abs(area(raw.X) / area(X) - 1).max() > 1e-4


def test_failure_names_residual_iterations_and_gap():
    X = pair(32)
    with pytest.raises(NumericalFailure, match=r"residual of .* after 2 iterations.*gap"):
        ImplicitStepper(1.0, 1.0, linear_flow([[0, 1e4], [0, 0]]), max_iterations=2).step(State(0.0, X), 1e-5)


def test_near_field_matters_and_is_on_demand():
    X, apart = pair(32), pair(32, distance=12.0)
    with counting() as close:
        exact = run(X, None, 1e-5, 1, corrected=False).X
    with counting() as distant:
        run(apart, None, 1e-5, 1, corrected=False)
    assert close["near_rows"] > 0
    assert distant["near_rows"] == 0
    rough = run(X, None, 1e-5, 1, corrected=False, fields=Fields(near_field="none")).X
    better = run(X, None, 1e-5, 1, corrected=False, fields=Fields(near_field="ying_zorin")).X
    assert np.abs(better - exact).max() < np.abs(rough - exact).max()


def test_inclination_turns_the_right_way():
    """Shear u = rate y e_x carries the top to the right: a vesicle along y leans to positive angles below pi/2."""
    X = place(ellipse(32, 0.65), np.zeros(2), np.pi / 2)[None]
    rate = shear_of(X)
    angle = float(inclination(run(X, linear_flow([[0, rate], [0, 0]]), 0.05 / rate, 10).X)[0])
    assert 0.5 < angle < 1.5


def test_membrane_force_at_the_new_state_moves_the_neighbour():
    """Two vesicles at rest with relaxed shapes feel nothing; with one deformed, the other moves."""
    still = pair(48, distance=6.0)
    assert np.abs(run(still, None, 1e-5, 1, corrected=False).X - still).max() < 1e-7
    bent = still.copy()
    bent[0] = place(ellipse(48, 0.65), np.array([-0.7, 0.0]), 0.4)
    assert np.abs(run(bent, None, 1e-5, 1, corrected=False).X[1] - bent[1]).max() > 1e-6
    assert np.isfinite(membrane_force(bent, np.zeros((2, 48)))).all()


def test_forces_at_few_nodes_sum_to_zero():
    """Those that answer a velocity too: a net force would move all other vesicles, however far away."""
    X = pair(32)
    response = ImplicitStepper(1.0, 1.0)._response(X, 1e-5)
    each = speed(X)
    size = np.abs(response.force_0).max()
    assert np.abs((response.force_0 * each[:, None]).sum(-1)).max() < 1e-9 * size
    columns = response.force_1.reshape(2, 2, 32, 64)
    assert np.abs((columns * each[:, None, :, None]).sum(2)).max() < 1e-9 * np.abs(columns).max()
