"""The periodic pair sum against rows of images summed in closed form, free arrays, cylinders; its invariances, precision, odd input."""

import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from biem.backend import counting
from biem.curves.lattice import Lattice
from biem.stokes import farfield, farfield_periodic
from biem.stokes.farfield import far_field_bytes, far_scheme, pair_sum
from biem.stokes.farfield_direct import direct_sum
from biem.stokes.farfield_periodic import PeriodicSum, periodic_schemes
from biem.stokes.kress import single_layer_kernel

LATTICES = {"square": Lattice(1.0, 1.0), "oblong": Lattice(1.3, 0.9), "sheared": Lattice(1.1, 1.0, 0.41), "flat": Lattice(2.0, 0.6, -0.8)}
BY_LATTICE = pytest.mark.parametrize("name", LATTICES)
BY_SCHEME = pytest.mark.parametrize("scheme", ["direct", "ewald"])
MU = 0.7


@pytest.fixture(autouse=True)
def library():
    pytest.importorskip("finufft")


def by_rows(r, lattice, modes=300, rows=20):
    """mu G (P, 2, 2) at separations r (P, 2) not in one row: the flow of each row of images is a Fourier series in x alone,

    G_row = 1/L sum_{k != 0} e^{ikx} (phi - k^2 psi, -ik psi'; ., k^2 psi),  phi = e^{-|ky|}/2|k|,  psi = (1 + |ky|) e^{-|ky|}/4|k|^3,

    and k = 0 adds H/(2L) B_2(y/H) to G_xx, with Bernoulli's polynomial, of mean zero.
    """
    width, height, offset = lattice.width, lattice.height, lattice.offset
    row = np.floor(r[:, 1] / height)
    x0, y0 = r[:, 0] - row * offset, r[:, 1] - row * height
    k = 2 * np.pi * np.arange(1, modes + 1) / width
    G = np.zeros((len(r), 2, 2))
    for j in range(-rows, rows + 1):
        x, y = (x0 - j * offset)[:, None], (y0 - j * height)[:, None]
        decay = np.exp(-k * np.abs(y))
        psi = (1 + k * np.abs(y)) * decay / (4 * k**3)
        G[:, 0, 0] += 2 / width * (np.cos(k * x) * (decay / (2 * k) - k**2 * psi)).sum(-1)
        G[:, 1, 1] += 2 / width * (np.cos(k * x) * k**2 * psi).sum(-1)
        G[:, 0, 1] += 2 / width * (np.sin(k * x) * k * y * decay / (4 * k)).sum(-1)
    G[:, 1, 0] = G[:, 0, 1]
    G[:, 0, 0] += height / width * ((y0 / height) ** 2 - y0 / height + 1 / 6) / 2
    return G


def case(seed=0, M=3, N=6, P=150):
    """targets (P, 2), X and forces (M, 2, N) at random, well beyond any box."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, size=(P, 2)), rng.uniform(-3, 3, size=(M, 2, N)), rng.normal(size=(M, 2, N))


def apart(targets, X, lattice):
    """The targets that are in no row of a source."""
    y = (targets[:, None, 1] - X[:, 1].ravel()) / lattice.height
    return targets[(np.abs(y - np.round(y)) > 0.05).all(axis=1)]


def points_of(X):
    return X.transpose(0, 2, 1).reshape(-1, 2)


def difference(u, v):
    return np.linalg.norm(u - v) / np.linalg.norm(v)


@BY_LATTICE
@BY_SCHEME
def test_equals_the_sum_of_rows(name, scheme):
    lattice = LATTICES[name]
    targets, X, f = case(P=300)
    targets = apart(targets, X, lattice)
    assert len(targets) >= 10
    G = by_rows((targets[:, None, :] - points_of(X)).reshape(-1, 2), lattice).reshape(len(targets), -1, 2, 2)
    exact = np.einsum("pnij,nj->pi", G, points_of(f)) / MU
    for tolerance in (1e-4, 1e-7, 1e-10):
        for cutoff in (None, 0.4, 1.5):
            u = PeriodicSum(targets, X, MU, lattice, None, tolerance, (scheme,), cutoff=cutoff).velocity(f)
            assert difference(u, exact) < 3 * tolerance, (tolerance, cutoff)


@BY_LATTICE
def test_the_split_between_the_two_parts_changes_nothing(name):
    """Forces with and without a sum: the mean pressure gradient of the former belongs to the smooth part at any split."""
    targets, X, f = case(1)
    for g in (f, f - f.mean(axis=(0, 2), keepdims=True)):
        u = [PeriodicSum(targets, X, MU, LATTICES[name], None, 1e-12, cutoff=cutoff).velocity(g) for cutoff in (0.25, 0.5, 1.0, 2.0)]
        assert max(difference(v, u[0]) for v in u) < 1e-10
    split = [PeriodicSum(targets, X, MU, LATTICES[name], None, 1e-12, cutoff=cutoff) for cutoff in (0.25, 2.0)]
    near = [s.near(points_of(f)[s.image]) for s in split]
    assert difference(near[0], near[1]) > 0.5  # each of the parts does depend on it


@BY_LATTICE
def test_no_flux_through_any_period(name):
    """div u = 0 and the mean over the box is zero: as much passes any line from a point to its image one way as the other."""
    lattice = LATTICES[name]
    _, X, f = case(2, 1, 2)
    X = 0.05 * X  # the sources in the middle, the lines by the edges
    s = (np.arange(64) / 64)[:, None]
    for a in lattice.vectors:
        other = lattice.vectors[1 - int(a[1] != 0)]
        start = 0.5 * other - 0.5 * a
        across = np.array([a[1], -a[0]])
        u = PeriodicSum(start + s * a, X, MU, lattice, None, 1e-12).velocity(f) @ across
        assert abs(u.mean()) < 1e-10 * np.abs(u).max()
        assert np.abs(u).max() > 1e-3


def test_divergence_vanishes():
    targets, X, f = case(3)
    h = 1e-3
    for lattice in LATTICES.values():
        u = [PeriodicSum(targets + np.array(d), X, MU, lattice, None, 1e-12).velocity(f) for d in ((h, 0), (-h, 0), (0, h), (0, -h))]
        u2 = [
            PeriodicSum(targets + np.array(d), X, MU, lattice, None, 1e-12).velocity(f)
            for d in ((2 * h, 0), (-2 * h, 0), (0, 2 * h), (0, -2 * h))
        ]
        d1, d2 = ([(v[0] - v[1])[:, 0], (v[2] - v[3])[:, 1]] for v in (u, u2))
        slopes = [(8 * a - b) / (12 * h) for a, b in zip(d1, d2, strict=True)]  # of fourth order
        r = lattice.wrapped((targets[:, None, :] - points_of(X)).reshape(-1, 2)).reshape(len(targets), -1, 2)
        away = np.hypot(*np.moveaxis(r, -1, 0)).min(axis=1) > 0.1
        assert away.sum() > 50
        assert np.abs(slopes[0] + slopes[1])[away].max() < 1e-6 * np.abs(slopes[0])[away].max()


@BY_LATTICE
@BY_SCHEME
def test_nothing_changes_by_a_lattice_vector(name, scheme):
    lattice = LATTICES[name]
    targets, X, f = case(4)
    rng = np.random.default_rng(5)
    u = PeriodicSum(targets, X, MU, lattice, None, 1e-6, (scheme,), cutoff=0.5).velocity(f)
    far = targets + rng.integers(-3, 4, size=targets.shape) @ lattice.vectors
    moved = X + (rng.integers(-3, 4, size=(len(X), 2)) @ lattice.vectors)[:, :, None]
    assert difference(PeriodicSum(far, moved, MU, lattice, None, 1e-6, (scheme,), cutoff=0.5).velocity(f), u) < 1e-12
    again = replace(lattice, offset=lattice.offset + lattice.width)  # the same images
    assert difference(PeriodicSum(targets, X, MU, again, None, 1e-6, (scheme,), cutoff=0.5).velocity(f), u) < 1e-6


@BY_SCHEME
def test_a_target_skips_its_own_curve_and_not_its_images(scheme):
    lattice = Lattice(1.4, 1.2, 0.3)
    rng = np.random.default_rng(6)
    X = rng.normal(scale=0.1, size=(3, 2, 8)) + rng.uniform(-2, 2, size=(3, 2, 1))
    f = rng.normal(size=X.shape)
    targets, owner = points_of(X), np.repeat(np.arange(3), 8)
    owner[5] = -1
    u = PeriodicSum(targets, X, MU, lattice, owner, 1e-9, (scheme,)).velocity(f)
    whole = PeriodicSum(targets, X, MU, lattice, None, 1e-9, (scheme,)).velocity(f)
    own = direct_sum(targets, X, f, MU) - direct_sum(targets, X, f, MU, owner)
    assert np.abs(whole - own - u).max() < 1e-12 * np.abs(whole).max()
    # the whole is of all but the node itself, in the limit of points that come closer to it
    close = PeriodicSum(targets + np.array([1e-7, 0.0]), X, MU, lattice, None, 1e-9, (scheme,)).velocity(f)
    itself = direct_sum(np.array([[1e-7, 0.0]]), np.zeros((1, 2, 1)), np.eye(2)[:1, :, None], MU)[0, 0], -np.log(1e-7) / (4 * np.pi * MU)
    assert np.abs(close - points_of(f) * itself - whole).max() < 1e-5 * np.abs(whole).max()


def test_drag_of_a_square_array_of_cylinders():
    """F/(mu U) = 4 pi / (-log(c)/2 - 0.738 + c - 0.887 c^2 + 2.038 c^3 + O(c^4)), c: area fraction. Sangani & Acrivos (1982)."""
    N, lattice = 32, Lattice(1.0, 1.0)
    for fraction, bound in ((0.01, 3e-4), (0.05, 3e-4), (0.1, 3e-3)):
        radius, a = np.sqrt(fraction / np.pi), 2 * np.pi * np.arange(N) / N
        X = radius * np.stack([np.cos(a), np.sin(a)])[None]
        K = single_layer_kernel(X, radius * np.stack([-np.sin(a), np.cos(a)])[None])[0]  # of the cylinder itself
        images = PeriodicSum(points_of(X), X, 1.0, lattice, np.zeros(N, dtype=int), 1e-12)
        S = np.block([[K[0], K[1]], [K[1], K[2]]])
        for n in range(2 * N):
            unit = np.eye(2 * N)[n].reshape(1, 2, N)
            S[:, n] += images.velocity(unit).T.ravel()
        f = np.linalg.lstsq(S, np.repeat([1.0, 0.0], N), rcond=1e-12)[0].reshape(2, N).sum(axis=1)
        c = fraction
        drag = 4 * np.pi / (-0.5 * np.log(c) - 0.738 + c - 0.887 * c**2 + 2.038 * c**3)
        assert abs(f[0] / drag - 1) < bound
        assert abs(f[1]) < 1e-9 * drag


def test_a_large_free_array_of_copies():
    """A round array of copies that fade out at its edge, without a net force each, plus the flow that its edge makes.

    In the limit u_array - u = sum_n K(x - y_n) f_n / (mu V), K = -3/16 r^2 I + 1/8 r r^T: the uniform dipoles inside a disk.
    """
    lattice = Lattice(1.2, 0.9, 0.3)
    targets, X, f = case(7, 2, 5, 20)
    targets, X = 0.1 * targets, 0.1 * X
    f = f - f.mean(axis=(0, 2), keepdims=True)
    exact = PeriodicSum(targets, X, MU, lattice, None, 1e-12).velocity(f)
    r = targets[:, None, :] - points_of(X)
    K = -3 / 16 * (r**2).sum(-1)[..., None, None] * np.eye(2) + r[..., :, None] * r[..., None, :] / 8
    edge = np.einsum("pnij,nj->pi", K, points_of(f)) / (MU * lattice.area)
    assert np.abs(edge).max() > 0.1 * np.abs(exact).max()
    errors = []
    for radius in (4, 8, 16):
        n = np.arange(-2 * radius, 2 * radius + 1)
        images = np.stack(np.meshgrid(n, n), axis=-1).reshape(-1, 2) @ lattice.vectors
        distance = np.hypot(*images.T) / radius
        images, distance = images[distance < 1], distance[distance < 1]
        fade = np.exp(-36.0 * np.clip(2 * distance - 1, 0, 1) ** 8) if radius else 0
        copies = (X + images[:, None, :, None]).reshape(-1, 2, X.shape[2])
        array = direct_sum(targets, copies, (fade[:, None, None, None] * f).reshape(copies.shape), MU)
        errors.append(difference(array - edge, exact))
    assert errors[-1] < 2e-3
    assert errors[-1] < errors[0] / 10


def test_part_of_the_targets_gets_the_values_of_all():
    targets, X, f = case(8)
    for scheme in ("direct", "ewald"):
        u = PeriodicSum(targets, X, MU, LATTICES["sheared"], None, 1e-6, (scheme,)).velocity(f)
        for part in (slice(5, 6), slice(20, 90)):
            v = PeriodicSum(targets[part], X, MU, LATTICES["sheared"], None, 1e-6, (scheme,), of=len(targets)).velocity(f)
            assert np.abs(v - u[part]).max() < 1e-13 * np.abs(u).max()


@BY_SCHEME
def test_sum_over_arrays_equals_the_loop_also_in_single_precision(scheme):
    lattice = Lattice(1.4, 1.2, 0.3)
    rng = np.random.default_rng(9)
    X = rng.normal(scale=0.1, size=(5, 2, 8)) + rng.uniform(-0.6, 0.6, size=(5, 2, 1))
    f, targets, owner = rng.normal(size=X.shape), points_of(X), np.repeat(np.arange(5), 8)
    u = PeriodicSum(targets, X, MU, lattice, owner, 1e-6, (scheme,)).velocity(f)
    for compiled, dtype, bound in (
        (None, torch.float64, 1e-13),
        (False, torch.float64, 1e-10),
        (False, torch.float32, 3e-5),
        (None, torch.float32, 3e-5),
    ):
        x, Y, g = (torch.from_numpy(a).to(dtype) for a in (targets, X, f))
        v = PeriodicSum(x, Y, MU, lattice, torch.from_numpy(owner), 1e-6, (scheme,), compiled=compiled).velocity(g)
        assert v.dtype == dtype
        assert difference(v.numpy(), u) < bound


@pytest.mark.parametrize("compiled", [True, False])
def test_what_is_not_a_number_or_out_of_all_bounds_stays_so(compiled):
    targets, X, f = case(10)
    good = PeriodicSum(targets, X, MU, LATTICES["oblong"]).velocity(f)
    targets[3, 0], targets[8, 1], targets[9, 1] = np.nan, np.inf, 1e30

    def velocity(Y):
        x, Y, g = map(torch.from_numpy, (targets, Y, f))
        return PeriodicSum(x, Y, MU, LATTICES["oblong"], compiled=compiled).velocity(g).numpy()

    u = velocity(X)
    assert np.isnan(u[[3, 8, 9]]).all()
    assert difference(np.delete(u, [3, 8, 9], axis=0), np.delete(good, [3, 8, 9], axis=0)) < 1e-6
    for bad in (np.nan, np.inf, -1e200):
        assert np.isnan(velocity(np.where(np.arange(X.size).reshape(X.shape) == 7, bad, X))).all()


def test_names_choice_and_what_is_not_installed(monkeypatch):
    targets, X, f = case(11)
    lattice = LATTICES["square"]
    few, many = (far_scheme("auto", n, n, 1e-6, False, lattice) for n in (32, 64_000))
    assert (few, many) == ("direct", "ewald")
    with counting() as counts:
        u = [pair_sum(targets, X, MU, None, name, 1e-9, lattice=lattice).velocity(f) for name in ("auto", "direct", "ewald")]
    assert counts == {"pair_sum": 3, "periodic_sum": 3}
    assert max(difference(v, u[0]) for v in u) < 1e-8
    assert pair_sum(targets[:0], X, MU, lattice=lattice).velocity(f).shape == (0, 2)
    with pytest.raises(ValueError, match='far_field = "fmm"'):
        pair_sum(targets, X, MU, far_field="fmm", lattice=lattice)
    monkeypatch.setitem(sys.modules, "finufft", None)
    monkeypatch.setattr(farfield_periodic, "find_spec", lambda name: None)
    assert far_scheme("auto", 64_000, 64_000, 1e-6, False, lattice) == "direct"
    assert periodic_schemes() == ("direct",)
    assert np.array_equal(pair_sum(targets, X, MU, None, "auto", 1e-9, lattice=lattice).velocity(f), u[1])
    with pytest.raises(ValueError, match=r"pip install 'vesnet\[fast\]'"):
        pair_sum(targets, X, MU, far_field="ewald", lattice=lattice)


@BY_SCHEME
def test_memory_is_what_is_said(scheme):
    lattice, rng = Lattice(6.0, 6.0), np.random.default_rng(12)
    X = rng.uniform(-3, 3, size=(100, 2, 32))
    f, targets = rng.normal(size=X.shape), points_of(X)
    farfield.pair_sum(targets[:9], X[:2], MU, None, scheme, lattice=lattice).velocity(f[:2])  # what is imported and compiled once
    farfield_periodic.multiplier.cache_clear()
    tracemalloc.start()
    pair_sum(targets, X, MU, None, scheme, 1e-6, lattice=lattice).velocity(f)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 0.1 < peak / far_field_bytes(3200, 100, 32, scheme, 1e-6, (6.0, 6.0), lattice) < 1.2
