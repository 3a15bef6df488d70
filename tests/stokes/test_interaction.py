"""Velocity of vesicles due to all others: against brute force, shares of the vesicles, near schemes, precision, and what is not built."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import blob_case, rotate, stokeslet_sum

from biem.backend import counting
from biem.curves.curve import arclength_weights
from biem.curves.fourier import resample
from biem.membrane.maps import LAYERS, ExactMaps
from biem.stokes.interaction import Fields, Interaction
from biem.stokes.single_layer import single_layer

MU = 1.3
FIELDS = Fields(near_tolerance=1e-10, far_field="direct")
SPOTS = ((0.0, 0.0, 0.0), (0.3889, 0.0, 0.5), (0.0843, 0.3036, 2.0), (1.2, 0.2, 1.0), (-0.4135, 0.0589, 3.0))  # gaps 0.006, 0.012, 0.020


def blobs(N, spots=SPOTS):
    """X, f (M, 2, N) of blobs of length 1 at centres and angles, some closer than h, with unlike densities."""
    X, f = blob_case(N)
    curves = np.stack([rotate(X, angle) + np.array([[x], [y]]) for x, y, angle in spots])
    return curves, np.stack([rotate(f, 1.0 + 2.0 * angle) * (1.0 + 0.3 * k) for k, (_, _, angle) in enumerate(spots)])


def by_trapezoid(X, f, n=1 << 14):
    """The same by the trapezoid rule on n nodes of every other curve."""
    fine, g = resample(X, n), resample(f, n)
    g = g * arclength_weights(fine)[:, None, :]
    u = np.zeros_like(X)
    for i in range(len(X)):
        for j in range(len(X)):
            if j != i:
                u[i] += stokeslet_sum(X[i].T, fine[j], g[j]).T / MU
    return u


def relative(u, exact):
    u, exact = np.asarray(u), np.asarray(exact)
    return np.abs(u - exact).max() / np.abs(exact).max()


def velocity(X, f, fields=FIELDS, **options):
    return Interaction.build(X, MU, fields, **options).velocity(f)


@pytest.mark.parametrize("stored", [False, True])
def test_equals_the_trapezoid_rule_on_many_nodes(stored):
    X, f = blobs(64)
    exact = by_trapezoid(X, f)
    assert relative(velocity(X, f, stored=stored), exact) < 1e-7
    assert relative(velocity(X, f, replace(FIELDS, near_field="none")), exact) > 1e-3


@pytest.mark.parametrize("near_field", ["auto", "upsample", "ying_zorin", "none"])
def test_equals_the_single_layer_of_the_others(near_field):
    X, f = blobs(48)
    u = velocity(X, f, replace(FIELDS, near_field=near_field))
    for m in range(len(X)):
        others = np.arange(len(X)) != m
        want = single_layer(X[others], f[others], X[m].T, MU, near_field, "direct", FIELDS.near_tolerance).T
        assert np.abs(u[m] - want).max() < 1e-12 * np.abs(u).max()


def test_linear_and_inverse_to_the_viscosity():
    X, f = blobs(32)
    interaction = Interaction.build(X, MU, FIELDS)
    u, v = interaction.velocity(f), interaction.velocity(f[:, ::-1])
    assert relative(interaction.velocity(2.0 * f - f[:, ::-1]), 2.0 * u - v) < 1e-13
    assert relative(Interaction.build(X, 2 * MU, FIELDS).velocity(f), u / 2) < 1e-13
    alone = np.zeros_like(f)
    alone[2] = f[2]
    assert np.abs(interaction.velocity(alone)[2]).max() == 0.0  # nothing acts on itself


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("near_field", ["upsample", "layers", "ying_zorin"])
def test_shares_of_the_vesicles_give_the_rows_of_the_whole(near_field, stored):
    X, f = blobs(32)
    fields = replace(FIELDS, near_field=near_field, layers=ExactMaps(mu=MU).near_layers, offsets=LAYERS)
    whole = velocity(X, f, fields, stored=stored)
    for mine in (slice(0, 2), slice(2, 3), slice(3, 5)):
        part = velocity(X, f, fields, mine=mine, stored=stored)
        assert part.shape == whole[mine].shape
        assert np.abs(part - whole[mine]).max() < 1e-13 * np.abs(whole).max()


def test_stored_rows_and_sums_are_the_same_correction():
    X, f = blobs(32)
    with counting() as sums:
        direct = velocity(X, f)
    with counting() as rows:
        kept = velocity(X, f, stored=True)
    assert relative(direct, kept) < 1e-12
    assert sums["near_sums"] == rows["near_rows"] > 50
    assert rows["near_sums"] == 0


def test_layers_have_the_accuracy_of_one_sided_interpolation_and_the_fit_across_is_worse():
    """Largest error over max |u|, N = 32, 64, 128: one-sided of third order, one Gaussian fit about 0.5 % at any N."""
    layered = Fields("layers", 1e-8, "direct", layers=ExactMaps(mu=MU).near_layers, offsets=LAYERS)
    one, fit = [], []
    for N in (32, 64, 128):
        X, f = blobs(N)
        exact = velocity(X, f)
        one.append(relative(velocity(X, f, layered), exact))
        fit.append(relative(velocity(X, f, replace(layered, near_field="layers_rbf")), exact))
    assert one[0] < 1e-2
    assert one[2] < 1e-4
    assert one[0] > 4 * one[1] > 16 * one[2], one
    assert all(b > 1.5 * a for a, b in zip(one, fit, strict=True)), (one, fit)
    assert fit[2] > 10 * one[2], (one, fit)


def test_layers_take_over_only_where_they_reach():
    X, _ = blobs(32)
    layered = replace(FIELDS, near_field="layers", layers=ExactMaps(mu=MU).near_layers, offsets=LAYERS)
    interaction = Interaction.build(X, MU, layered)
    with counting() as counts:
        Interaction.build(X, MU, FIELDS)
    inner, outer = interaction.near
    assert len(inner.pairs) > 10
    assert len(inner.pairs) + sum(len(level.target) for level in outer.levels) == counts["near_sums"]
    assert np.abs(inner.pairs.distance).max() <= 1.0 / 32
    tight = replace(layered, near_tolerance=1e-2)  # a near zone that the layers cover
    assert len(Interaction.build(X, MU, tight).near) == 1


def test_single_precision_of_the_pair_sum():
    X, f = blobs(32)
    exact = velocity(X, f)
    u = velocity(X, f, replace(FIELDS, precision="float32"))
    assert u.dtype == np.float64
    assert 1e-9 < relative(u, exact) < 2e-6
    far = velocity(X + 1e3, f, replace(FIELDS, precision="float32"))  # coordinates are lowered about the middle
    assert relative(far, u) < 1e-6


@pytest.mark.parametrize("fields", [FIELDS, replace(FIELDS, near_field="ying_zorin"), replace(FIELDS, near_field="layers")])
@pytest.mark.parametrize("stored", [False, True])
def test_nothing_near_is_made_for_vesicles_far_apart(fields, stored):
    X, f = blobs(64, ((0.0, 0.0, 0.0), (2.0, 0.0, 1.0), (0.0, 3.0, 2.0)))
    with counting() as counts:
        interaction = Interaction.build(X, MU, fields, stored=stored)
        u = interaction.velocity(f)
    assert interaction.near == ()
    assert counts == {"near_search": 1, "pair_sum": 1}
    assert relative(u, by_trapezoid(X, f, 256)) < 1e-12


def test_no_near_field_searches_nothing():
    X, f = blobs(32)
    with counting() as counts:
        velocity(X, f, replace(FIELDS, near_field="none"))
    assert counts == {"pair_sum": 1}
    with pytest.raises(ValueError, match='near_field = "close"'):
        Interaction.build(X, MU, replace(FIELDS, near_field="close"))


@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
def test_ewald_equals_direct(tolerance):
    pytest.importorskip("finufft")
    rng = np.random.default_rng(0)
    spots = [(0.45 * (k % 6), 0.45 * (k // 6), angle) for k, angle in enumerate(rng.uniform(0, 6, 36))]
    X, f = blobs(32, spots)
    exact, u = velocity(X, f), velocity(X, f, replace(FIELDS, far_field="ewald", far_tolerance=tolerance))
    assert np.linalg.norm(u - exact) < tolerance * np.linalg.norm(exact)
    assert np.linalg.norm(u - exact) > 0


@pytest.mark.parametrize("near_field", ["upsample", "layers", "layers_rbf", "none"])
def test_torch_equals_numpy(near_field):
    X, f = blobs(32)
    fields = replace(FIELDS, near_field=near_field, layers=ExactMaps(mu=MU).near_layers, offsets=LAYERS)
    u = velocity(torch.from_numpy(X), torch.from_numpy(f), fields)
    assert u.dtype == torch.float64
    assert relative(u, velocity(X, f, fields)) < 1e-11


def test_motions_and_reindexing():
    X, f = blobs(32)
    u = velocity(X, f)
    assert relative(velocity(rotate(X, 0.7) + 100.0, rotate(f, 0.7)), rotate(u, 0.7)) < 1e-9
    assert relative(velocity(X[::-1], f[::-1]), u[::-1]) < 1e-12
    assert relative(velocity(np.roll(X, 5, -1), np.roll(f, 5, -1)), np.roll(u, 5, -1)) < 1e-9


def test_vesicles_act_on_each_other_alike():
    """int f_i . u_ij ds = int f_j . u_ji ds."""
    X, f = blobs(96, ((0.0, 0.0, 0.0), (0.5, 0.01, 0.5)))
    only = lambda k: f * (np.arange(2) == k)[:, None, None]
    ds = arclength_weights(X)[:, None, :]
    a, b = (velocity(X, only(k)) for k in (0, 1))
    assert (f[1] * a[1] * ds[1]).sum() == pytest.approx((f[0] * b[0] * ds[0]).sum(), rel=1e-8)
