"""Direct sums of the near correction against its rows, in every precision and path; what they hold in memory and count."""

import numba
import numpy as np
import pytest
import torch
from helpers import circle, two_blobs
from test_near_search import own_nodes, packing

from biem.backend import counting
from biem.curves.curve import arclength_weights
from biem.curves.fourier import coefficients, evaluate, resample
from biem.stokes import farfield_direct
from biem.stokes.farfield_direct import direct_sum
from biem.stokes.near import LEVELS, apply_rows, near_correction, near_width, upsampling
from biem.stokes.near_search import NearPairs, find_near
from biem.stokes.near_sums import NearSums

MU = 1.3


def suspension(M=12, tolerance=1e-6, shift=0.0):
    """X, targets, f and the near pairs: own nodes, and targets at 1e-6 to 1 h from membranes, inside and out, so that all levels occur."""
    X = packing(M) + shift
    c, t = coefficients(X - shift), np.linspace(0.1, 6.1, M * 5).reshape(M, 5)
    x, along = evaluate(c, t), evaluate(c, t, 1)
    offset = np.resize([-0.03, 1e-3, 0.02, 3e-8, 0.006, -0.004, 0.012], (M, 5))[:, None]
    close = x + shift + offset * np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    nodes, owner = own_nodes(X)
    targets = np.concatenate([nodes, close.transpose(0, 2, 1).reshape(-1, 2)])
    exclude = np.concatenate([owner, np.full(5 * M, -1)])
    f = np.random.default_rng(0).normal(size=(2, *X.shape))
    return X, targets, f, find_near(X, targets, near_width("upsample", tolerance), exclude)


def by_rows(X, targets, pairs, tolerance, u, f):
    return apply_rows(u, near_correction(X, targets, pairs, MU, "upsample", tolerance), pairs, f)


def as_tensors(pairs):
    return NearPairs(*(torch.from_numpy(getattr(pairs, name)) for name in ("target", "vesicle", "alpha", "distance", "rho")))


def sums_by_arrays(X, targets, pairs, tolerance):
    """What an accelerator runs, on tensors of the CPU."""
    return NearSums._build(X, targets, as_tensors(pairs), MU, tolerance, False)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8])
def test_sums_equal_rows_for_every_force(tolerance):
    X, targets, forces, pairs = suspension(tolerance=tolerance)
    assert set(upsampling(pairs.rho, 32, tolerance)) == {0, *LEVELS}
    sums = NearSums.build(X, targets, pairs, MU, tolerance)
    tensors = sums_by_arrays(torch.from_numpy(X), torch.from_numpy(targets), pairs, tolerance)
    u = np.random.default_rng(1).normal(size=targets.shape)
    for f in forces:
        correction = by_rows(X, targets, pairs, tolerance, 0 * u, f)
        scale = np.abs(correction).max()
        assert np.abs(sums.add(0 * u, f) - correction).max() < 1e-11 * scale
        assert np.abs(tensors.add(torch.from_numpy(0 * u), torch.from_numpy(f)).numpy() - correction).max() < 1e-11 * scale
        assert np.abs(sums.add(u, f) - u - correction).max() < 1e-13 * np.abs(u).max()


def test_array_sums_whatever_the_chunks(monkeypatch):
    X, targets, (f, _), pairs = suspension()
    u = np.zeros_like(targets)
    exact = NearSums.build(X, targets, pairs, MU, 1e-6).add(u, f)
    monkeypatch.setattr(farfield_direct, "CHUNK", 2000)
    chunked = sums_by_arrays(*map(torch.from_numpy, (X, targets)), pairs, 1e-6).add(*map(torch.from_numpy, (u, f))).numpy()
    assert np.abs(chunked - exact).max() < 1e-12 * np.abs(exact).max()


def test_tensors_of_the_cpu_go_through_the_loops():
    X, targets, (f, _), pairs = suspension()
    u = np.zeros_like(targets)
    sums = NearSums.build(*map(torch.from_numpy, (X, targets)), pairs, MU, 1e-6)
    result = sums.add(*map(torch.from_numpy, (u, f)))
    assert result.dtype == torch.float64
    assert (result.numpy() == NearSums.build(X, targets, pairs, MU, 1e-6).add(u, f)).all()


@pytest.mark.parametrize("shift", [0.0, 64.0])
@pytest.mark.parametrize("build", [lambda X, x, p: NearSums.build(X, x, p, MU, 1e-6), lambda X, x, p: sums_by_arrays(X, x, p, 1e-6)])
def test_single_precision_also_far_from_the_origin(shift, build):
    X, targets, (f, _), _ = suspension()
    single = [torch.from_numpy(a).float() for a in (X + shift, targets + shift, 0 * targets, f)]
    X, targets, u, f = (a.double().numpy() for a in single)
    exclude = np.concatenate([own_nodes(X)[1], np.full(60, -1)])
    pairs = find_near(X, targets, near_width("upsample", 1e-6), exclude)
    exact = by_rows(X, targets, pairs, 1e-6, u, f)
    result = build(*single[:2], pairs).add(*single[2:])
    assert result.dtype == torch.float32
    assert np.abs(result.numpy() - exact).max() < 1e-5 * np.abs(exact).max()


def test_the_sums_do_not_depend_on_threads_or_on_the_order_of_the_curves():
    X, targets, (f, _), pairs = suspension()
    u, before = np.zeros_like(targets), numba.get_num_threads()
    results = []
    for n in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(n)
        results.append(NearSums.build(X, targets, pairs, MU, 1e-6).add(u, f))
    numba.set_num_threads(before)
    assert (results[0] == results[1]).all()
    order = np.random.default_rng(0).permutation(12)
    moved = NearPairs(pairs.target, np.argsort(order)[pairs.vesicle], pairs.alpha, pairs.distance, pairs.rho)
    again = NearSums.build(X[order], targets, moved, MU, 1e-6).add(u, f[order])
    assert np.abs(again - results[0]).max() < 1e-13 * np.abs(again).max()


def test_corrected_velocity_is_that_of_the_trapezoid_rule_on_many_nodes():
    """Trapezoid on 64 nodes plus correction, against 4096 nodes of the same curve and density."""
    X, f, targets = two_blobs(64)
    pairs = find_near(X, targets, near_width("upsample", 1e-9))
    fine, f_fine = resample(X, 4096), resample(f, 4096)
    exact = direct_sum(targets, fine, f_fine * arclength_weights(fine)[:, None], MU)
    coarse = direct_sum(targets, X, f * arclength_weights(X)[:, None], MU)
    u = NearSums.build(X, targets, pairs, MU, 1e-9).add(coarse, f)
    assert np.abs(coarse - exact).max() > 1e-3 * np.abs(exact).max()
    assert np.abs(u - exact).max() < 1e-8 * np.abs(exact).max()


def test_only_what_is_near_is_counted_upsampled_and_stored():
    X = np.stack([circle(32, 1.0, (4.0 * k, 0.0)) for k in range(30)])
    targets = np.array([[4.0 * 7 + 1.1, 0.0], [4.0 * 9, 1.25], [2.0, 0.0]])
    with counting() as counts:
        pairs = find_near(X, targets, 2.0)
        sums = NearSums.build(X, targets, pairs, MU, 1e-6)
    assert counts == {"near_search": 1, "near_sums": 2}
    assert sorted(v for level in sums.levels for v in level.vesicle) == [7, 9]
    assert sums.rows is None
    with counting() as counts:
        far = NearSums.build(X, targets, find_near(X, targets[2:], 2.0), MU, 1e-6)
    assert counts["near_sums"] == counts["near_rows"] == 0
    u = np.ones((3, 2))
    assert far.levels == ()
    assert (far.add(u, X) == u).all()


def test_a_force_that_is_not_finite_reaches_its_neighbours_alone():
    X, targets, (f, _), pairs = suspension()
    f[3, 0, 3] = np.nan
    u = NearSums.build(X, targets, pairs, MU, 1e-6).add(np.zeros_like(targets), f)
    hit = np.isin(np.arange(len(targets)), pairs.target[pairs.vesicle == 3])
    assert np.isnan(u[hit]).all()
    assert np.isfinite(u[~hit]).all()
