"""Vesicles in a periodic box: their velocities do not know where the box's sides are, how large a part of the images it holds, or shear."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import blob_case, rotate

from biem.curves.curve import arclength_weights
from biem.curves.fourier import resample
from biem.curves.lattice import Lattice
from biem.membrane.maps import LAYERS, ExactMaps
from biem.membrane.repulsion import Repulsion
from biem.stokes.farfield_periodic import PeriodicSum
from biem.stokes.interaction import Fields, Interaction
from biem.stokes.kress import on_own_curve

MU = 1.3
FIELDS = Fields(near_tolerance=1e-10, far_tolerance=1e-11)
BOX = Lattice(1.05, 0.9, 0.23)
SPOTS = ((0.0, 0.0, 0.0), (0.3889, 0.0, 0.5), (0.0843, 0.3036, 2.0))  # gaps 0.006 and 0.012; images about 0.1 apart
BY_FIELD = pytest.mark.parametrize("near_field", ["upsample", "layers", "ying_zorin", "stored"])


def blobs(N, spots=SPOTS):
    """X, f (M, 2, N) of blobs of length 1, some closer than h, with unlike densities of sum zero."""
    X, f = blob_case(N)
    curves = np.stack([rotate(X, angle) + np.array([[x], [y]]) for x, y, angle in spots])
    f = np.stack([rotate(f, 1.0 + 2.0 * angle) * (1.0 + 0.3 * k) for k, (_, _, angle) in enumerate(spots)])
    ds = arclength_weights(curves)[:, None, :]
    return curves, f - (f * ds).sum(-1, keepdims=True) / ds.sum(-1, keepdims=True)


def velocity(X, f, lattice=BOX, near_field="upsample", fields=FIELDS, **options):
    stored = near_field == "stored"
    fields = replace(fields, near_field="upsample" if stored else near_field, layers=ExactMaps(mu=MU).near_layers, offsets=LAYERS)
    return Interaction.build(X, MU, fields, stored=stored, lattice=lattice, **options).velocity(f)


def relative(u, exact):
    return np.abs(np.asarray(u) - exact).max() / np.abs(exact).max()


def across(X, n=(0, 0), d=(0.0, 0.0), lattice=BOX):
    """All curves moved by d, each by its own lattice vector (n_1, n_2), of many."""
    many = np.random.default_rng(0).integers(-3, 4, size=(len(X), 2)) if n == "many" else np.broadcast_to(n, (len(X), 2))
    return X + (many @ lattice.vectors + np.asarray(d))[:, :, None]


@BY_FIELD
@pytest.mark.parametrize("d", [(0.5, 0.0), (0.33, 0.47), (0.0, -0.39)])
def test_a_pair_across_the_side_of_the_box_moves_as_in_its_middle(near_field, d):
    X, f = blobs(48)
    u = velocity(X, f, near_field=near_field)
    assert relative(velocity(across(X, "many", d), f, near_field=near_field), u) < 1e-11
    assert relative(velocity(across(X, "many", d), f, near_field="none"), u) > 1e-2  # there is a near field there


def test_equals_the_periodic_sum_over_many_nodes():
    """On them the plain rule is exact; of its own curve a target skips the nodes, not their images."""
    X, f = blobs(64)
    fine, g = resample(X, 4096), resample(f, 4096)
    g = g * arclength_weights(fine)[:, None, :]
    moved = across(X, "many", (0.4, 0.3))
    u = velocity(moved, f)
    for m in range(len(X)):
        others = PeriodicSum(fine[m, :, ::64].T, fine, MU, BOX, np.full(64, m), 1e-11).velocity(g).T
        assert np.abs(u[m] - others).max() < 3e-8 * np.abs(u).max()
    assert relative(velocity(moved, f, near_field="none"), u) > 3e-3


@BY_FIELD
@pytest.mark.parametrize("times", [(2, 1), (1, 2), (3, 2)])
def test_a_box_of_several_copies_gives_the_same_velocities(near_field, times):
    """Copies that are curves of their own, and images."""
    X, f = blobs(32)
    u = velocity(X, f, near_field=near_field)
    a_1, a_2 = BOX.vectors
    copies = np.concatenate([X + (m * a_1 + n * a_2)[:, None] for m in range(times[0]) for n in range(times[1])])
    large = Lattice(times[0] * BOX.width, times[1] * BOX.height, times[1] * BOX.offset)
    v = velocity(copies, np.tile(f, (times[0] * times[1], 1, 1)), large, near_field)
    assert relative(v, np.tile(u, (times[0] * times[1], 1, 1))) < 1e-9


@BY_FIELD
def test_one_vesicle_beside_its_own_image(near_field):
    X, f = blobs(32, SPOTS[:1])
    narrow = Lattice(float(np.ptp(X[0, 0])) + 0.01, 1.0)  # a gap of a third of an arclength spacing
    u = velocity(X, f, narrow, near_field)
    both, g = np.concatenate([X, X + np.array([narrow.width, 0.0])[:, None]]), np.concatenate([f, f])
    assert relative(velocity(both, g, Lattice(2 * narrow.width, 1.0), near_field)[:1], u) < 1e-9
    assert relative(velocity(X, f, narrow, "none"), u) > 1e-2


def test_reciprocity():
    """Of two sets of forces either one does the same work on the other's flow; also where one of them has a sum."""
    X, f = blobs(96)
    h = blob_case(96)[1][None] * np.array([1.0, -0.4, 2.0])[:, None, None]
    ds = arclength_weights(X)[:, None, :]
    work = [((velocity(X, a) + on_own_curve(X, a, MU)) * b * ds).sum() for a, b in ((f, h), (h, f))]
    assert abs(work[0] - work[1]) < 1e-8 * abs(work[0])
    assert abs(work[0]) > 1e-3


@pytest.mark.parametrize("mine", [slice(0, 1), slice(1, 3)])
@BY_FIELD
def test_shares_of_the_vesicles_give_the_rows_of_the_whole(near_field, mine):
    X, f = blobs(32)
    X = across(X, "many", (0.5, 0.2))
    whole = velocity(X, f, near_field=near_field)
    assert np.abs(velocity(X, f, near_field=near_field, mine=mine) - whole[mine]).max() < 1e-13 * np.abs(whole).max()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@BY_FIELD
def test_tensors_and_single_precision(near_field, precision):
    X, f = blobs(32)
    X = across(X, "many", (0.5, 0.2))
    u = velocity(X, f, near_field=near_field)
    fields = replace(FIELDS, precision=precision)
    v = velocity(torch.from_numpy(X), torch.from_numpy(f), near_field=near_field, fields=fields)
    assert v.dtype == torch.float64
    assert relative(v, u) < (1e-11 if precision == "float64" else 1e-5)


def test_repulsion_acts_across_the_sides():
    X, _ = blobs(48)
    repulsion = Repulsion(0.03, 1e3)
    f = repulsion.force(X)
    assert np.abs(f).max() > 100
    assert relative(repulsion.force(X, BOX), f) < 1e-11  # images are farther apart
    for d in ((0.5, 0.0), (0.33, 0.47), (0.0, -0.39)):
        assert relative(repulsion.force(across(X, "many", d), BOX), f) < 1e-9
    moved = torch.from_numpy(across(X, "many", (0.5, 0.0)))
    assert relative(repulsion.force(moved, BOX), f) < 1e-9
    assert Repulsion(1e-3, 1e3).force(X, BOX) is None


def test_repulsion_from_its_own_image_is_of_sum_zero():
    X, _ = blobs(48, SPOTS[:1])
    narrow = Lattice(float(np.ptp(X[0, 0])) + 0.01, 1.0)
    f = Repulsion(0.03, 1e3).force(X, narrow)
    assert np.abs(f).max() > 100
    total = (f * arclength_weights(X)[:, None, :]).sum(axis=-1)
    assert np.abs(total).max() < 1e-12 * np.abs(f).max()
    assert f[0, 0, X[0, 0].argmax()] < 0 < f[0, 0, X[0, 0].argmin()]  # both ends are pushed back
    assert Repulsion(0.03, 1e3).force(X) is None
