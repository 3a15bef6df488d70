"""The compiled pair sum against the kernel in plain NumPy, at any scale, origin and memory layout, and against PyTorch."""

import numpy as np
import pytest
import torch
from helpers import rotate

from biem.backend import counting
from biem.stokes import farfield_direct
from biem.stokes.farfield_direct import DirectSum, chunked_sum, direct_sum, own_sum, own_sum_of_arrays
from biem.stokes.kernels import stokeslet


def case(M=4, N=32, P=50, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(P, 2)), rng.normal(size=(M, 2, N)), rng.normal(size=(M, 2, N))


def plain_sum(targets, X, g, mu, exclude=None):
    """One target after the other with the kernel of `kernels`."""
    u = np.zeros((len(targets), 2))
    for p, x in enumerate(targets):
        for j in range(len(X)):
            if exclude is None or exclude[p] != j:
                gxx, gxy, gyy = stokeslet(x[0] - X[j, 0], x[1] - X[j, 1], mu)
                u[p] += (gxx * g[j, 0] + gxy * g[j, 1]).sum(), (gxy * g[j, 0] + gyy * g[j, 1]).sum()
    return u


@pytest.mark.parametrize("mu", [1.0, 0.3])
def test_compiled_loop_equals_the_kernel(mu):
    targets, X, g = case()
    u = plain_sum(targets, X, g, mu)
    assert np.abs(direct_sum(targets, X, g, mu) - u).max() < 1e-13 * np.abs(u).max()


def test_one_force_at_one_point_by_the_formula():
    u = direct_sum(np.array([[3.0, 4.0]]), np.zeros((1, 2, 1)), np.array([[[1.0], [2.0]]]), 2.0)
    exact = (-np.log(5) * np.array([1.0, 2.0]) + 11 * np.array([3.0, 4.0]) / 25) / (8 * np.pi)
    assert u[0] == pytest.approx(exact, rel=1e-15)


@pytest.mark.parametrize("distance", [1e-150, 1e-30, 1e-8, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 2.0**0.5, 0.5**0.5, 7.0, 1e8, 1e30, 1e150])
def test_the_loops_own_logarithm_at_all_scales(distance):
    """A force across the separation meets -log|r| alone."""
    X, g = np.zeros((1, 2, 1)), np.array([[[0.0], [1.0]]])
    u = direct_sum(np.array([[distance, 0.0]]), X, g, 1.0)[0]
    assert 4 * np.pi * u == pytest.approx([0.0, -np.log(distance)], rel=1e-14, abs=1e-16)


def test_excluded_curves_are_skipped():
    targets, X, g = case()
    exclude = np.arange(len(targets)) % 5 - 1
    u = plain_sum(targets, X, g, 1.0, exclude)
    assert np.abs(direct_sum(targets, X, g, 1.0, exclude) - u).max() < 1e-13 * np.abs(u).max()
    assert np.abs(direct_sum(targets, X, g, 1.0) - u)[exclude >= 0].min() > 1e-6
    none = direct_sum(targets, X, g, 1.0, np.full(len(targets), -1))
    assert (none == direct_sum(targets, X, g, 1.0)).all()


@pytest.mark.parametrize("convert", [lambda a: a, torch.from_numpy])
def test_nodes_that_skip_their_own_curve_do_not_meet_themselves(convert):
    _, X, g = case()
    targets, owner = X.transpose(0, 2, 1).reshape(-1, 2), np.repeat(np.arange(4), 32)
    u = np.asarray(direct_sum(*map(convert, (targets, X, g)), 1.0, convert(owner)))
    assert np.isfinite(u).all()
    with np.errstate(all="ignore"):
        exact = plain_sum(targets, X, g, 1.0, owner)
    assert np.abs(u - exact).max() < 1e-12 * np.abs(exact).max()


def test_a_far_away_origin_changes_nothing():
    targets, X, g = case()
    u = direct_sum(targets, X, g, 1.0)
    assert np.abs(direct_sum(targets + 1000.0, X + 1000.0, g, 1.0) - u).max() < 1e-9 * np.abs(u).max()


def test_turning_everything_turns_the_velocity():
    targets, X, g = case()
    u = direct_sum(targets, X, g, 1.0)
    turned = direct_sum(rotate(targets.T, 0.6).T, rotate(X, 0.6), rotate(g, 0.6), 1.0)
    assert np.abs(turned - rotate(u.T, 0.6).T).max() < 1e-12 * np.abs(u).max()


def test_any_memory_layout_and_order_of_targets():
    targets, X, g = case()
    u = direct_sum(targets, X, g, 1.0)
    assert (direct_sum(targets[::-1], X, g, 1.0)[::-1] == u).all()
    strided = direct_sum(np.asfortranarray(targets), np.asfortranarray(X), np.asfortranarray(g), 1.0)
    assert np.abs(strided - u).max() < 1e-14 * np.abs(u).max()
    assert (direct_sum(targets[7:8], X, g, 1.0) == u[7:8]).all()
    assert direct_sum(targets[:0], X, g, 1.0).shape == (0, 2)


@pytest.mark.parametrize("chunk", [1 << 20, 1000, 1])
@pytest.mark.parametrize("skip", [False, True])
def test_chunked_sum_of_tensors_equals_the_loop(monkeypatch, chunk, skip):
    monkeypatch.setattr(farfield_direct, "CHUNK", chunk)
    targets, X, g = case()
    targets[7] = X[2, :, 5]
    exclude = np.arange(len(targets)) % 5 - 1 if skip else np.full(len(targets), -1)
    tensors = [torch.from_numpy(a) for a in (targets, X, g, exclude)]
    u = direct_sum(targets, X, g, 0.7, exclude)
    for v in (direct_sum(*tensors[:3], 0.7, tensors[3]), chunked_sum(*tensors, 0.7)):
        assert np.abs(v.numpy() - u).max() < 1e-12 * np.abs(u).max()
    own = own_sum(targets, X, g, exclude, 0.7)
    assert np.abs(direct_sum(targets, X, g, 0.7) - u - own).max() < 1e-12 * np.abs(u).max()
    assert np.abs(own_sum_of_arrays(*tensors, 0.7).numpy() - own).max() < 1e-12 * np.abs(u).max()


def test_sum_for_fixed_points_equals_the_sum():
    targets, X, g = case()
    fixed = DirectSum(targets, X, 0.7)
    for f in (g, 2.0 * g):
        assert (fixed.velocity(f) == direct_sum(targets, X, f, 0.7)).all()


@pytest.mark.parametrize("convert", [lambda a: a, torch.from_numpy, lambda a: a.astype(np.float32)])
def test_what_is_not_a_number_stays_so_and_where_it_is(convert):
    targets, X, g = case()
    targets[3, 0] = np.nan
    u = np.asarray(direct_sum(*map(convert, (targets, X, g)), 1.0))
    assert np.isnan(u[3]).all()
    assert np.isfinite(np.delete(u, 3, axis=0)).all()
    g[2, 1, 4] = np.nan
    assert np.isnan(np.asarray(direct_sum(*map(convert, (targets, X, g)), 1.0))).all()


@pytest.mark.parametrize("convert", [lambda a: a.astype(np.float32), lambda a: torch.from_numpy(a).to(torch.float32)])
def test_single_precision_keeps_its_digits_far_from_the_origin(convert):
    """Separations are differences of positions, which lie on a lattice that float32 holds exactly, also when moved by 100."""
    targets, X, g = case()
    lattice = [np.round(a * 2**12) / 2**12 for a in (targets, X)]
    u = direct_sum(*lattice, g, 1.0)
    v = direct_sum(*(convert(a + 100.0) for a in lattice), convert(g), 1.0)
    assert str(v.dtype).endswith("float32")
    assert np.abs(np.asarray(v) - u).max() < 2e-4 * np.abs(u).max()


def test_each_sum_is_counted():
    with counting() as counts:
        direct_sum(*case(), 1.0)
    assert counts == {"pair_sum": 1}
