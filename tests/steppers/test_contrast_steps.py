"""Steps of vesicles whose fluid is another one: the coupled equations by dense assembly, orders, resolution, gaps, the rigid limit."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from thread_ranks import on_threads

from biem.backend import counting
from biem.curves.curve import arclength_weights, area, effective_radius, inclination, length, normal
from biem.curves.fourier import resample
from biem.curves.shapes import ellipse, equilibrium, place
from biem.membrane.contrast import ContrastMaps, ContrastOperators
from biem.membrane.maps import ExactMaps
from biem.membrane.repulsion import Repulsion
from biem.steppers.corrections import CORRECTIONS, Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Fields
from biem.stokes.kernels import double_layer, stokeslet
from biem.stokes.near_search import minimum_gap
from biem.stokes.walls import Walls

FIELDS = Fields(near_tolerance=1e-9, far_field="direct")
SOLVERS = ("implicit", "split")


def pair(points, distance=2.3, reduced_area=0.65, shape=equilibrium):
    one = shape(points, reduced_area)
    R = float(effective_radius(one[None])[0])
    return np.stack([place(one, np.array([-distance * R, 0.3 * R]), 0.0), place(one, np.zeros(2), np.pi / 2)])


def shear_of(X, capillary=5.0):
    return capillary / float(effective_radius(X)[0]) ** 3


def shear(rate):
    def flow(X, t):
        return (torch if isinstance(X, torch.Tensor) else np).stack([rate * X[:, 1], 0.0 * X[:, 0]], 1)

    return flow


def make(solver, contrast, flow, order=1, mine=slice(None), **options):
    """The stepper; contrast: of every vesicle, or None."""
    contrast = None if contrast is None else np.asarray(contrast, dtype=float)
    if solver == "implicit":
        stepper = ImplicitStepper(1.0, 1.0, flow, fields=FIELDS, contrast=contrast, **options)
    else:
        maps = ExactMaps() if contrast is None else ContrastMaps(contrast=contrast[mine])
        stepper = SplitStepper(maps, 1.0, 1.0, flow, FIELDS, contrast=contrast, **options)
    return stepper if order == 1 else Extrapolated(stepper)


def march(stepper, X, dt, steps, corrected=False):
    if corrected:
        stepper = Corrected(stepper, CORRECTIONS, area(X), length(X))
    state = State(0.0, X)
    for _ in range(steps):
        state = stepper.step(state, dt).state
    return state


def test_the_implicit_step_solves_the_coupled_equations():
    """All unknowns X, sigma and u of two separated vesicles in one dense system, assembled here with explicit kernels; N = 96 native."""
    N, dt, kappa_b, mu, contrast = 96, 2e-5, 1.3, 0.7, (5.0, 0.3)
    one = ellipse(N, 0.8)
    X = np.stack([place(one, np.array(c), a) for c, a in (((0, 0), 0.3), ((0.6, 0.1), 1.0))])
    rate, n, M = 900.0, 2 * N, 2
    ops = ContrastOperators(X, kappa_b, mu, None, np.asarray(contrast))
    weights, normals = arclength_weights(X), normal(X)
    block = 2 * n + N  # increment, velocity and tension of each
    A, rhs = np.zeros((M * block, M * block)), np.zeros(M * block)
    zero = np.zeros((N, N))
    for i in range(M):
        Z, U, T = (slice(i * block + a, i * block + b) for a, b in ((0, n), (n, 2 * n), (2 * n, block)))
        P = ops.P[i]
        A[Z, Z], A[Z, U] = np.eye(n), -dt * np.eye(n)
        A[T, U] = P
        A[U, U] = np.linalg.inv(ops.A_inverse[i])
        rhs[U] = np.concatenate([rate * X[i, 1], 0 * X[i, 1]])
        for j in range(M):
            bend_on = -kappa_b * np.block([[ops.D4[j], zero], [zero, ops.D4[j]]])
            tense = np.concatenate([ops.D[j] * ops.tangent[j, 0], ops.D[j] * ops.tangent[j, 1]])
            if j == i:
                S = np.linalg.inv(ops.A_inverse[i]) @ ops.S[i]
            else:
                rx, ry = (X[i, c][:, None] - X[j, c] for c in (0, 1))
                gxx, gxy, gyy = (g * weights[j] for g in stokeslet(rx, ry, mu))
                S = np.block([[gxx, gxy], [gxy, gyy]])
                dxx, dxy, dyy = (d * weights[j] for d in double_layer(rx, ry, *normals[j]))
                A[U, slice(j * block + n, j * block + 2 * n)] = -(1.0 - contrast[j]) * np.block([[dxx, dxy], [dxy, dyy]])
            A[U, slice(j * block, j * block + n)] -= S @ bend_on
            A[U, slice(j * block + 2 * n, (j + 1) * block)] -= S @ tense
            rhs[U] += S @ bend_on @ X[j].ravel()
    solution = np.linalg.solve(A, rhs).reshape(M, block)
    new = ImplicitStepper(kappa_b, mu, shear(rate), fields=FIELDS, contrast=np.asarray(contrast)).step(State(0.0, X), dt).state
    want = solution[:, :n].reshape(M, 2, N)
    assert np.abs(want).max() > 1e-3
    assert np.abs(new.X - X - want).max() < 1e-8
    assert np.abs(new.sigma - solution[:, 2 * n :]).max() < 1e-5 * np.abs(new.sigma).max()


@cache
def smooth_run(solver, contrast, order, steps):
    """X after 0.12 t_gamma of a close pair of smooth shapes, uncorrected."""
    X = smooth_pair()
    contrasts = None if contrast is None else [contrast] * 2
    rate = shear_of(X)
    return march(make(solver, contrasts, shear(rate), order), X, 0.12 / rate / steps, steps).X


def smooth_pair():
    return pair(24, 2.2, 0.95, ellipse)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("contrast", [5.0, 0.2])
def test_orders_in_dt_and_one_limit(solver, contrast):
    """Order 1 and, extrapolated, 2; both solvers tend to the same, which is not that of equal fluids."""
    for order in (1, 2):
        ends = [smooth_run(solver, contrast, order, steps) for steps in (4, 8, 16)]
        observed = np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max())
        assert observed > order - 0.4, (order, observed)
    limits = [smooth_run(solver, contrast, 2, 16) for solver in SOLVERS]
    assert np.abs(limits[0] - limits[1]).max() < 2e-5
    assert np.abs(limits[0] - smooth_run("implicit", None, 2, 16)).max() > 5e-4


def test_repulsion_moves_them_the_same_by_both_solvers():
    """The neighbour's double layer is of velocities with the repulsion in them, once."""
    X = smooth_pair()
    rate = shear_of(X)
    marched = lambda solver, **options: march(make(solver, [5.0, 0.2], shear(rate), 2, **options), X, 0.02 / rate, 2).X
    implicit, split = (marched(solver, repulsion=Repulsion(0.5, 2e3)) for solver in SOLVERS)
    assert np.abs(implicit - split).max() < 0.03 * np.abs(implicit - marched("implicit")).max()


@pytest.mark.parametrize("contrast", [5.0, 0.2])
def test_spectral_decay_in_the_nodes(contrast):
    """Shape after a step of a close pair, against N = 80."""
    rate = shear_of(pair(96))
    move = lambda N: resample(march(make("implicit", [contrast] * 2, shear(rate)), pair(N), 0.04 / rate, 1).X, 192)
    exact = move(80)
    errors = [np.abs(move(N) - exact).max() for N in (16, 32, 48)]
    assert errors[2] < 1e-5
    assert all(b < a / 3 for a, b in pairwise(errors))


@pytest.mark.parametrize("solver", SOLVERS)
def test_two_membranes_closer_than_a_node_spacing(solver):
    """A gap of 0.4 h at N = 32: the step is that of N = 64."""
    coarse, fine = close_pair(32), close_pair(64)
    assert 0.3 < minimum_gap(coarse) * 32 < 0.5
    rate = shear_of(fine)
    contrast = [5.0, 0.2]
    ends = [march(make(solver, contrast, shear(rate)), X, 0.004 / rate, 1).X - X for X in (coarse, fine)]
    moved = np.abs(ends[1]).max()
    assert np.abs(resample(ends[0], 64) - ends[1]).max() < 0.01 * moved


def close_pair(N, gap=0.0125):
    """Two upright ellipses side by side."""
    one = place(ellipse(N, 0.9), np.zeros(2), np.pi / 2)
    width = np.ptp(place(ellipse(768, 0.9), np.zeros(2), np.pi / 2)[0])
    return np.stack([one, one + np.array([[width + gap], [0.01]])])


@pytest.mark.parametrize("solver", SOLVERS)
def test_area_and_length_are_kept_to_the_order_of_the_step(solver):
    """What contrast 5 and 0.2 lose in area, uncorrected, halves with dt, and is not much more than what equal fluids lose."""
    lost = lambda contrast, steps: np.abs(area(smooth_run(solver, contrast, 1, steps)) / area(smooth_pair()) - 1.0).max()
    for contrast in (5.0, 0.2):
        assert lost(contrast, 8) < 0.6 * lost(contrast, 4)
        assert lost(contrast, 4) < 5.0 * lost(None, 4)


def test_a_stiff_vesicle_turns_as_jeffery_says():
    """Contrast 1e4: an ellipse in shear keeps its shape and turns by dtheta/dt = -rate (a^2 sin^2 + b^2 cos^2)/(a^2 + b^2)."""
    X = ellipse(64, 0.8)[None]
    a, b = np.ptp(X[0], axis=1).max() / 2, np.ptp(X[0], axis=1).min() / 2
    rate = 1000.0
    for angle in (0.0, 0.7, np.pi / 2):
        Y = place(X[0], np.zeros(2), angle)[None]
        want = -rate * (a**2 * np.sin(angle) ** 2 + b**2 * np.cos(angle) ** 2) / (a**2 + b**2)
        for solver in SOLVERS:
            end = march(make(solver, [1e4], shear(rate)), Y, 1e-3 / rate, 1).X
            assert float(np.sin(inclination(end) - inclination(Y))[0]) / 1e-3 * rate == pytest.approx(want, rel=2e-3)


def test_walls_answer_to_the_double_layers():
    """A pair in a turning cylinder: both solvers tend to one limit, which is not that of equal fluids."""
    X = 0.5 * smooth_pair()
    t = 2 * np.pi * np.arange(96) / 96
    circle = np.stack([np.cos(t), np.sin(t)])

    def inside(radius):
        walls = Walls((radius * circle,), np.zeros((1, 2)), 1.0, np.stack([-circle[1], circle[0]], axis=1) * radius * 300.0)
        return {"walls": walls, "flow": walls.flow}

    def end(solver, contrast, walls, flow, order=2):
        return march(make(solver, contrast, flow, order, walls=walls), X, 1e-5, 2).X

    ends = [end(solver, [5.0, 0.2], **inside(0.6)) for solver in SOLVERS]
    assert np.abs(ends[0] - ends[1]).max() < 2e-2 * np.abs(ends[0] - X).max()
    plain = end("implicit", None, **inside(0.6))
    assert np.abs(ends[0] - plain).max() > 5e-2 * np.abs(ends[0] - X).max()


def test_ranks_and_tensors_make_the_same_step():
    X = np.concatenate([pair(32), pair(32) + np.array([0.0, 0.6])[:, None]])
    contrast, rate = [5.0, 1.0, 0.2, 30.0], shear_of(X)
    dt = 0.01 / rate
    alone = march(make("split", contrast, shear(rate)), X, dt, 2)
    shared = on_threads(2, lambda ranks: march(make("split", contrast, shear(rate), mine=ranks.mine(4), ranks=ranks), X, dt, 2).X)
    assert all(np.array_equal(part, alone.X) for part in shared)
    state = State(0.0, torch.from_numpy(X))
    stepper = make("split", contrast, shear(rate))
    for _ in range(2):
        state = stepper.step(state, dt).state
    assert np.abs(state.X.numpy() - alone.X).max() < 1e-11


def test_only_vesicles_with_a_contrast_have_double_layers():
    X = pair(32)
    rate = shear_of(X)
    for solver in SOLVERS:
        with counting() as counts:
            make(solver, None, shear(rate)).step(State(0.0, X), 1e-6)
        assert not {name for name in counts if "double" in name or "contrast" in name}
        with counting() as counts:
            make(solver, [1.0, 4.0], shear(rate)).step(State(0.0, X), 1e-6)
        assert counts["double_layer_sum"] >= 2
        assert counts["contrast_matrix"] >= 2
