"""The maps by resultants: against dense operators with the same kernel, identities, precision, chunks, threads, accelerator code."""

from functools import cached_property

import numpy as np
import pytest
import torch

from biem.backend import counting
from biem.curves.curve import arclength_weights, area, center_of_nodes, length, speed
from biem.curves.fourier import derivative, resample
from biem.curves.reparam import redistribute
from biem.curves.shapes import perturbed
from biem.membrane import resultants
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import VesicleOperators, bending_force, relaxation_system, surface_divergence, tension_force
from biem.membrane.resultants import Resultants, dot_product_matrix, in_frame, inverse_factor
from biem.stokes import kress
from biem.stokes.kress import single_layer_kernel

KAPPA_B, MU = 1.3, 0.7
SIZES = (32, 64, 100)


class DenseOperators(VesicleOperators):
    """The dense operators with the single layer of the resultants."""

    @cached_property
    def S_blocks(self):
        local = self.X - center_of_nodes(self.X)
        return single_layer_kernel(local, derivative(local), self.mu) * arclength_weights(self.X)[:, None, None, :]


def shapes(n, count=3, seed=0, **options):
    return np.stack([perturbed(n, 0.65, seed=seed + k, **options) for k in range(count)]) + 0.3


def uneven(n, count=3):
    """Curves whose nodes are not equally spaced: |X_alpha| varies by a factor of about 3."""
    fine = shapes(512, count, modes=4)
    alpha = 2 * np.pi * np.arange(n) / n
    c = np.fft.rfft(fine) / 512
    phase = np.exp(1j * np.arange(257)[:, None] * (alpha + 0.5 * np.sin(alpha)))
    X = 2 * np.real(c[..., 1:] @ phase[1:]) + c[..., :1].real
    assert 2.5 < (speed(X).max(axis=1) / speed(X).min(axis=1)).min() < 4
    return X


def column(u):
    return u.reshape(len(u), -1, 1)


def wave(X, k=5):
    return np.cos(k * X)


def relative(a, b):
    a, b = np.asarray(a), np.asarray(b)
    return np.abs(a - b).max() / np.abs(b).max()


def all_maps(R, u, dt=1e-5):
    return {"flow": R.flow_tension(u), "self": R.self_tension(), "project": R.project(u), "relax": R.relaxation(dt)}


def compare(got, want, tolerance):
    for name, value in want.items():
        assert relative(got[name], value) < tolerance, name


@pytest.mark.parametrize("make", [shapes, uneven])
@pytest.mark.parametrize("n", SIZES)
def test_tensions_and_projection_equal_the_dense_operators(n, make):
    X = make(n)
    R, ops = Resultants(X, KAPPA_B, MU), DenseOperators(X, KAPPA_B, MU)
    u = wave(X)
    sigma = np.linalg.solve(ops.L, ops.P @ column(u))
    assert relative(R.flow_tension(u), sigma[..., 0]) < 1e-11
    assert relative(R.self_tension(), np.linalg.solve(ops.L, ops.P @ column(ops.bending_velocity()))[..., 0]) < 1e-11
    assert relative(R.project(u), (column(u) - ops.T @ sigma).reshape(u.shape)) < 1e-11


@pytest.mark.parametrize("make", [shapes, uneven])
@pytest.mark.parametrize("n", SIZES)
def test_relaxation_equals_the_dense_operators(n, make):
    """To 1e-11 of the length, or to what rounding leaves of the 2n x 2n system: its condition number grows as dt n^3."""
    X = make(n)
    R, ops = Resultants(X, KAPPA_B, MU), DenseOperators(X, KAPPA_B, MU)
    for dt in (1e-7, 1e-5, 1e-3, 1e-1, 1.0):
        Z, _ = relaxation_system(ops, column(ops.bending_velocity()), dt, False)
        condition = np.linalg.cond(np.eye(2 * n) - dt * (np.eye(2 * n) - ops.M) @ ops.B).max()
        assert np.abs(Z).max() > 10 * dt / (1 + 1e3 * dt)  # something moves
        assert np.abs(R.relaxation(dt).reshape(Z.shape) - Z).max() < max(1e-11, 1e-16 * condition), dt


def test_velocity_of_a_resultant_is_that_of_its_force():
    """S[q_s] with q_b = -kappa_b X_sss and q = sigma X_s."""
    X = shapes(64)
    R, ops = Resultants(X, KAPPA_B, MU), DenseOperators(X, KAPPA_B, MU)
    sigma = np.sin(3 * X[:, 0])
    assert relative(R.velocity(R.bending), (ops.S @ column(bending_force(X, KAPPA_B))).reshape(X.shape)) < 1e-11
    assert relative(R.velocity(sigma[:, None] * R.t), (ops.S @ column(tension_force(X, sigma))).reshape(X.shape)) < 1e-12


@pytest.mark.parametrize("n", SIZES)
def test_projection_is_a_projection_and_keeps_length(n):
    X = shapes(n)
    R, u = Resultants(X), wave(X)
    once = R.project(u)
    assert relative(R.project(once), once) < 1e-12
    assert np.abs(surface_divergence(X, once)).max() < 1e-11
    assert np.abs(surface_divergence(X, u)).max() > 1
    assert np.abs(once - u).max() > 0.1


def test_rigid_motions_are_unchanged():
    X = shapes(64)
    spin = np.stack([-X[:, 1], X[:, 0]], axis=1) + np.array([2.0, -1.0])[:, None]
    assert np.abs(Resultants(X).project(spin) - spin).max() < 1e-13
    assert np.abs(Resultants(X).flow_tension(spin)).max() < 1e-11


def test_tension_of_a_circle_stretched_by_two_lobes():
    """u = cos(2t) n on radius a stretches by cos(2t)/a. Tension cos(2t) is the force -(3 e^{3it} - e^{-it})/(2a), which moves by
    -(e^{3it} - e^{-it})/(8 mu): the tangential velocity -sin(2t)/(4 mu), a stretching by -cos(2t)/(2 mu a). So L^-1 P u = -2 mu cos(2t),
    up to a constant, which is but a pressure.
    """
    a, n = 0.4, 48
    t = 2 * np.pi * np.arange(n) / n
    er = np.stack([np.cos(t), np.sin(t)])[None]
    R, u = Resultants(a * er, mu=MU), np.cos(2 * t) * er
    assert np.abs(surface_divergence(a * er, R.project(u))).max() < 1e-12
    sigma = R.flow_tension(u)[0]
    assert np.abs(sigma - sigma.mean() + 2 * MU * np.cos(2 * t)).max() < 1e-11


def test_relaxation_conserves_length_and_area_to_second_order():
    X = shapes(64)
    R = Resultants(X)
    changes = []
    for dt in (1e-7, 5e-8, 2.5e-8):
        Y = X + R.relaxation(dt)
        changes.append([np.abs(f(Y) / f(X) - 1.0).max() for f in (length, area)])
    order = np.log2(np.array(changes[:-1]) / changes[1:])
    assert np.abs(order - 2).max() < 0.05, order
    assert 1e-9 < np.max(changes[0]) < 1e-7


def test_relaxation_lowers_the_energy_and_has_no_tangential_strain():
    X = shapes(64)
    for dt in (1e-7, 1e-5, 1e-3, 1.0):
        Z = Resultants(X).relaxation(dt)
        assert np.abs(surface_divergence(X, Z)).max() < 1e-10
        assert ((bending_force(X) * Z).sum(axis=1) * speed(X)).sum(axis=-1).min() > 0


@pytest.mark.parametrize("entries", [1, 2 * 64**2, 5 * 64**2])
def test_the_size_of_chunks_changes_nothing(entries, monkeypatch):
    X = shapes(64, 7)
    u = wave(X)
    monkeypatch.setattr(resultants, "CPU_CHUNK", 1 << 30)
    want = all_maps(Resultants(X), u)
    monkeypatch.setattr(resultants, "CPU_CHUNK", entries)
    compare(all_maps(Resultants(X), u), want, 1e-14)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_threads_change_no_bit(precision, monkeypatch):
    X = shapes(64, 7)
    u = wave(X)
    monkeypatch.setattr(resultants, "CPU_CHUNK", 1)
    answers = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        answers.append(all_maps(Resultants(X, dtype=np.dtype(precision)), u))
    for other in answers[1:]:
        assert all(np.array_equal(other[name], answers[0][name]) for name in answers[0])


@pytest.mark.parametrize("n", SIZES)
def test_torch_on_the_cpu_equals_numpy(n):
    X = shapes(n)
    T, u = torch.from_numpy(X), torch.from_numpy(wave(X))
    got = all_maps(Resultants(T, KAPPA_B, MU), u)
    assert all(value.dtype == torch.float64 for value in got.values())
    compare(got, all_maps(Resultants(X, KAPPA_B, MU), wave(X)), 1e-11)


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("n", SIZES)
def test_single_precision_keeps_four_digits_of_maps_and_five_of_a_step(n, library):
    X = shapes(n)
    exact = {dt: all_maps(Resultants(X), wave(X), dt) for dt in (1e-6, 1e-4)}
    A, single = (X, np.float32) if library == "numpy" else (torch.from_numpy(X), torch.float32)
    u = wave(X) if library == "numpy" else torch.from_numpy(wave(X))
    for dt, want in exact.items():
        got = all_maps(Resultants(A, dtype=single), u, dt)
        assert all(value.dtype == A.dtype for value in got.values())
        for name in ("flow", "self", "project"):
            assert 1e-9 < relative(got[name], want[name]) < 1e-4, name
        assert np.abs(np.asarray(got["relax"]) - want["relax"]).max() < 1e-5


@pytest.mark.parametrize("make", [shapes, uneven])
@pytest.mark.parametrize("n", SIZES)
def test_the_code_of_accelerators_equals_the_compiled_loops(n, make, monkeypatch):
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    X = make(n)
    want = all_maps(Resultants(X, KAPPA_B, MU), wave(X))
    for module in (resultants, kress):
        monkeypatch.setattr(module, "on_cpu", lambda a: False)
    got = all_maps(Resultants(torch.from_numpy(X), KAPPA_B, MU), torch.from_numpy(wave(X)))
    torch.set_num_threads(before)
    compare(got, want, 1e-11)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_inner_loops_equal_their_array_code(dtype, monkeypatch):
    rng = np.random.default_rng(0)
    G, A = rng.normal(size=(2, 3, 18, 18)).astype(dtype), rng.normal(size=(2, 18, 18)).astype(dtype)
    a, b = rng.normal(size=(2, 2, 2, 18)).astype(dtype)
    compiled = in_frame(G, a, b), dot_product_matrix(A, a, b)
    assert all(m.dtype == dtype for m in compiled)
    full = np.block([[G[0, 0], G[0, 1]], [G[0, 1], G[0, 2]]])
    left, right = np.hstack([np.diag(c) for c in a[0]]), np.vstack([np.diag(c) for c in b[0]])
    tolerance = 1e-14 if dtype == "float64" else 1e-5
    assert relative(compiled[0][0], left @ full @ right) < tolerance
    monkeypatch.setattr(resultants, "on_cpu", lambda a: False)
    for one, other in zip(compiled, (in_frame(G, a, b), dot_product_matrix(A, a, b)), strict=True):
        assert relative(one, other) < tolerance


@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 15, 16, 34, 100])
def test_inverse_factor_for_any_size(n, monkeypatch):
    rng = np.random.default_rng(n)
    B = rng.normal(size=(3, n, n))
    A = B @ B.transpose(0, 2, 1) + n * np.eye(n)
    W = inverse_factor(A)
    assert np.abs(W.transpose(0, 2, 1) @ W @ A - np.eye(n)).max() < 1e-13
    assert np.array_equal(W, np.tril(W))
    assert relative(W, np.linalg.inv(np.linalg.cholesky(A))) < 1e-13
    single = inverse_factor(A.astype(np.float32))
    assert single.dtype == np.float32
    assert relative(single, W) < 1e-5
    monkeypatch.setattr(resultants, "on_cpu", lambda a: False)
    assert relative(inverse_factor(torch.from_numpy(A)), W) < 1e-13


def test_inverse_factor_of_an_indefinite_matrix_is_no_number_and_spoils_no_other():
    A = np.stack([np.eye(12)] * 3)
    A[1, 9, 9] = -1e-3
    A[2, 0, 3] = A[2, 3, 0] = np.nan
    W = inverse_factor(A)
    assert np.array_equal(W[0], np.eye(12))
    assert np.isnan(W[1, 9:]).any()
    assert np.isnan(W[2]).any()


def test_a_node_that_is_no_number_stays_in_its_vesicle():
    X = shapes(32)
    u = wave(X)
    want = all_maps(Resultants(X), u)
    for bad in (np.nan, np.inf):
        Y = X.copy()
        Y[1, 0, 3] = bad
        with np.errstate(invalid="ignore"):
            got = all_maps(Resultants(Y), u)
        for name, value in got.items():
            assert np.isnan(value[1]).all(), (name, bad)
            assert relative(value[[0, 2]], want[name][[0, 2]]) < 1e-13, (name, bad)


def test_where_the_nodes_lie_matters_to_no_resolved_map():
    """The same curves with even and uneven nodes: relaxed shapes agree as curves, to the accuracy of either."""
    even, odd = shapes(512, 2, modes=4), uneven(128, 2)
    for dt in (1e-6, 1e-4):
        a = resample(even[..., ::4] + Resultants(even[..., ::4]).relaxation(dt), 512)
        b = resample(odd + Resultants(odd).relaxation(dt), 512)
        assert np.abs(area(a) / area(b) - 1).max() < 1e-8
        assert np.abs(length(a) / length(b) - 1).max() < 1e-8
        a, b = (redistribute(Y)[0] for Y in (a, b))
        z_a, z_b = (np.fft.fft(Y[:, 0] + 1j * Y[:, 1]) / 512 for Y in (a, b))
        assert np.abs(np.abs(z_a) - np.abs(z_b)).max() < 1e-7  # but for the first node


def test_scaling_rotation_and_shift():
    X = shapes(64)
    u = wave(X)
    plain = all_maps(Resultants(X), u)
    c, s = np.cos(0.7), np.sin(0.7)
    Q = np.array([[c, -s], [s, c]])
    turned = all_maps(Resultants(Q @ X + 1e3), Q @ u)
    for name, value in plain.items():
        assert relative(turned[name], value if name in ("flow", "self") else Q @ value) < 1e-8, name
    a = 3.0
    scaled = Resultants(a * X, KAPPA_B, MU)
    dt = 1e-5 * MU * a**3 / KAPPA_B
    assert relative(scaled.relaxation(dt), a * plain["relax"]) < 1e-11
    assert relative(scaled.self_tension(), KAPPA_B / a**2 * plain["self"]) < 1e-10
    assert relative(scaled.flow_tension(u), MU * plain["flow"]) < 1e-10
    assert relative(scaled.project(u), plain["project"]) < 1e-11


def test_one_factor_serves_all_maps_of_a_curve():
    X = shapes(32, 5)
    R = Resultants(X)
    with counting() as counts:
        R.project(wave(X))
        R.self_tension()
        R.flow_tension(wave(X, 3))
    assert counts == {"single_layer_matrix": 5, "tension_matrix": 5}
    with counting() as counts:
        R.relaxation(1e-5)
    assert counts == {"single_layer_matrix": 5, "relaxation_matrix": 5}


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_the_batched_factorisation_of_torch_on_the_cpu_is_never_reached(precision, monkeypatch):
    """With batches, n >= 160 and two threads it is wrong."""

    def fail(*args, **options):
        raise AssertionError("LU of torch on the CPU")

    X = shapes(256, 3, modes=4)
    u = wave(X)
    maps = ExactMaps(points=256, precision=precision)
    want = maps.advect(X, u), maps.self_tension(X), maps.flow_tension(X, u), maps.relax(X, 1e-5) - X
    for name in ("lu_factor", "lu_factor_ex", "lu", "lu_solve", "solve", "solve_ex", "inv", "inv_ex", "tensorsolve"):
        monkeypatch.setattr(torch.linalg, name, fail)
    monkeypatch.setattr(torch.Tensor, "inverse", fail)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    T, v = torch.from_numpy(X), torch.from_numpy(u)
    got = maps.advect(T, v), maps.self_tension(T), maps.flow_tension(T, v), maps.relax(T, 1e-5) - T
    torch.set_num_threads(before)
    for a, b in zip(got, want, strict=True):
        assert relative(a, b) < (1e-9 if precision == "float64" else 1e-3)
