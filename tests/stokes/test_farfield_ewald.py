"""Ewald's sum against the direct sum: every layout of points, unit, force and tolerance; tensors; points and values out of the ordinary."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from biem.backend import counting
from biem.stokes import farfield_ewald
from biem.stokes.farfield_direct import direct_sum

pytest.importorskip("finufft")
EwaldSum = farfield_ewald.EwaldSum
M, N = 60, 32


def curves(M, width, height, rng):
    """Ellipses of random direction in a box."""
    center = rng.uniform(size=(M, 2)) * [width, height]
    a, turn = 2 * np.pi * np.arange(N) / N, rng.uniform(0, np.pi, size=(M, 1))
    z = np.exp(1j * turn) * (0.12 * np.cos(a) + 0.07j * np.sin(a))
    return center[:, :, None] + np.stack([z.real, z.imag], axis=1)


def smooth_forces(M, rng):
    """Of zero mean on each curve: beyond the curve nearly nothing is left of them."""
    a = 2 * np.pi * np.arange(N) / N
    return sum(rng.normal(size=(M, 2, 1)) * np.cos(k * a + rng.uniform(0, 6, size=(M, 2, 1))) / k for k in (1, 2, 3))


def layouts():
    rng = np.random.default_rng(0)
    box = curves(M, 3.2, 3.2, rng)
    pair = [curves(M // 2, 2.0, 2.0, rng), curves(M // 2, 2.0, 2.0, rng)]
    return {
        "box": box,
        "shifted": box + 1000.0,
        "small": 1e-3 * box,
        "large": 1e3 * box,
        "elongated": curves(M, 40.0, 0.2, rng),
        "sparse": curves(M, 200.0, 200.0, rng),
        "two clusters": np.concatenate([pair[0], pair[1] + np.array([400.0, 90.0])[:, None]]),
        "one far away": np.concatenate([box, curves(1, 0.1, 0.1, rng) + 1e4]),
    }


def own_nodes(X):
    return X.transpose(0, 2, 1).reshape(-1, 2), np.repeat(np.arange(len(X)), X.shape[2])


def error(u, exact):
    return np.linalg.norm(u - exact) / np.linalg.norm(exact)


def case(layout="box", seed=1):
    X = layouts()[layout]
    targets, owner = own_nodes(X)
    return targets, X, np.random.default_rng(seed).normal(size=X.shape), owner


@pytest.mark.parametrize("layout", layouts())
@pytest.mark.parametrize("kind", ["random", "smooth"])
def test_error_is_below_three_tolerances_and_falls_with_it(layout, kind):
    targets, X, f, owner = case(layout)
    f = f if kind == "random" else smooth_forces(len(X), np.random.default_rng(2))
    exact = direct_sum(targets, X, f, 0.7, owner)
    errors = [error(EwaldSum(targets, X, 0.7, owner, t).velocity(f), exact) for t in (1e-4, 1e-6, 1e-9)]
    assert errors[0] < 3e-4
    assert errors[1] < 3e-6
    assert errors[2] < 3e-9
    assert errors[2] < max(0.01 * errors[0], 1e-9)


def test_each_cut_off_gives_the_same(monkeypatch):
    """The error is below the tolerance whatever the balance of the two parts, so neither hides behind the other."""
    targets, X, f, owner = case()
    exact = direct_sum(targets, X, f, 1.0, owner)
    cutoffs = []
    for cost in (1e-11, 1e-9, 1e-7):
        monkeypatch.setattr(farfield_ewald, "PAIR_COST", cost)
        ewald = EwaldSum(targets, X, 1.0, owner, 1e-8)
        cutoffs.append(ewald.grid.cutoff)
        assert error(ewald.velocity(f), exact) < 1e-8
    assert cutoffs[0] > 4 * cutoffs[-1]


def test_targets_anywhere_with_and_without_excluded_curves():
    rng = np.random.default_rng(3)
    _, X, f, _ = case()
    targets = rng.uniform(-4, 8, size=(300, 2))
    targets[:20] = X[:20, :, 3]  # nodes of curves that may or may not be excluded; a point does not act on itself
    targets[20] += 500.0
    exclude = rng.integers(-1, M, size=300)
    exclude[:10] = np.arange(10)
    for skip in (None, exclude):
        exact = direct_sum(targets, X, f, 1.0, skip)
        assert error(EwaldSum(targets, X, 1.0, skip, 1e-8).velocity(f), exact) < 1e-8


def test_part_of_the_targets_gets_the_values_of_all():
    targets, X, f, owner = case()
    u = EwaldSum(targets, X, 1.0, owner, 1e-6).velocity(f)
    for part in (slice(5, 6), slice(100, 500)):
        v = EwaldSum(targets[part], X, 1.0, owner[part], 1e-6).velocity(f)
        assert np.abs(v - u[part]).max() < 1e-13 * np.abs(u).max()


def test_order_of_curves_and_of_targets():
    targets, X, f, owner = case()
    u = EwaldSum(targets, X, 1.0, owner, 1e-6).velocity(f)
    order, new = np.random.default_rng(4).permutation(M), np.random.default_rng(5).permutation(M * N)
    place = np.argsort(order)
    v = EwaldSum(targets[new], X[order], 1.0, place[owner][new], 1e-6).velocity(f[order])
    assert np.abs(v - u[new]).max() < 1e-12 * np.abs(u).max()


def test_linear_in_the_forces_and_the_inverse_viscosity():
    targets, X, f, owner = case()
    h = smooth_forces(M, np.random.default_rng(6))
    ewald = EwaldSum(targets, X, 1.0, owner, 1e-4)
    u = ewald.velocity(f)
    assert np.abs(ewald.velocity(2 * f - h) - 2 * u + ewald.velocity(h)).max() < 1e-12 * np.abs(u).max()
    assert np.abs(EwaldSum(targets, X, 4.0, owner, 1e-4).velocity(f) - u / 4).max() < 1e-13 * np.abs(u).max()


def test_moving_points_keep_the_table_and_the_table_keeps_its_values():
    targets, X, f, owner = case()
    farfield_ewald.fourier_table.cache_clear()
    u = EwaldSum(targets, X, 1.0, owner, 1e-6).velocity(f)
    moved = X + 1e-3 * np.sin(X[:, ::-1])
    EwaldSum(own_nodes(moved)[0], moved, 1.0, owner, 1e-6)
    assert farfield_ewald.fourier_table.cache_info().misses == 1
    assert np.abs(EwaldSum(targets, X, 1.0, owner, 1e-6).velocity(f) - u).max() < 1e-14 * np.abs(u).max()


THREADS = """
import numpy as np
from biem.stokes.farfield_ewald import EwaldSum
rng = np.random.default_rng(0)
X, f = rng.normal(size=(2, 60, 2, 32))
targets, owner = X.transpose(0, 2, 1).reshape(-1, 2), np.repeat(np.arange(60), 32)
print(EwaldSum(targets, X, 1.0, owner, 1e-6).velocity(f).tobytes().hex())
"""


def test_the_number_of_threads_changes_no_bit_of_a_sum_of_this_size():
    runs = [
        subprocess.run([sys.executable, "-c", THREADS], env=os.environ | {"OMP_NUM_THREADS": n}, capture_output=True, text=True, check=True)
        for n in "12"
    ]
    assert runs[0].stdout == runs[1].stdout


@pytest.mark.parametrize("layout", ["box", "two clusters"])
def test_sum_over_arrays_equals_the_loop(monkeypatch, layout):
    monkeypatch.setattr(farfield_ewald, "CHUNK", 300_000)
    targets, X, f, owner = case(layout)
    targets, owner = targets[::7].copy(), owner[::7]
    targets[3] = targets[40] + 1e-9  # closer than the table of the near kernel begins
    u = EwaldSum(targets, X, 0.7, owner, 1e-6).velocity(f)
    tensors = [torch.from_numpy(a) for a in (targets, X, f, owner)]
    for compiled, dtype, bound in ((None, torch.float64, 1e-13), (False, torch.float64, 1e-11)):
        x, Y, g = (a.to(dtype) for a in tensors[:3])
        v = EwaldSum(x, Y, 0.7, tensors[3], 1e-6, compiled).velocity(g)
        assert v.dtype == dtype
        assert np.abs(v.numpy() - u).max() < bound * np.abs(u).max()


@pytest.mark.parametrize("compiled", [None, False])
def test_single_precision_keeps_its_digits_far_from_the_origin(compiled):
    targets, X, f, owner = case()
    X = np.round(X * 2**12) / 2**12
    targets = own_nodes(X)[0]
    exact = direct_sum(targets, X, f, 1.0, owner)
    x, Y, g = (torch.from_numpy(a).to(torch.float32) for a in (targets + 100.0, X + 100.0, f))
    v = EwaldSum(x, Y, 1.0, torch.from_numpy(owner), 1e-6, compiled).velocity(g)
    assert v.dtype == torch.float32
    assert error(v.numpy(), exact) < 1e-5


@pytest.mark.parametrize("compiled", [True, False])
def test_what_is_not_a_number_stays_so(compiled):
    targets, X, f, owner = case()
    good = EwaldSum(targets, X, 1.0, owner, 1e-6).velocity(f)
    targets[3, 0], targets[8, 1] = np.nan, np.inf

    part = slice(0, 200)

    def velocity(X, f):
        x, Y, skip, g = map(torch.from_numpy, (targets[part], X, owner[part], f))
        return EwaldSum(x, Y, 1.0, skip, 1e-6, compiled).velocity(g).numpy()

    u = velocity(X, f)
    assert np.isnan(u[[3, 8]]).all()
    assert error(np.delete(u, [3, 8], axis=0), np.delete(good[part], [3, 8], axis=0)) < 1e-11
    bad = np.where(np.arange(X.size).reshape(X.shape) == 77, np.nan, 0.0)
    assert np.isnan(velocity(X + bad, f)).all()
    assert np.isnan(velocity(X, f + bad)).all()


@pytest.mark.parametrize("tensor", [False, True])
def test_few_points_and_points_all_in_one_place(tensor):
    convert = torch.from_numpy if tensor else lambda a: a
    rng = np.random.default_rng(7)
    one, line = np.full((1, 2, 1), 3.0), np.stack([np.linspace(0, 5, 40), np.full(40, 2.0)])[None]
    same = np.full((3, 2, 4), 7.0)
    for X in (one, line, same):
        f = rng.normal(size=X.shape)
        for targets in (np.array([[3.0, 4.0], [1e4, -7.0], [7.0, 7.0]]), own_nodes(X)[0]):
            exact = direct_sum(targets, X, f, 1.0)
            u = np.asarray(EwaldSum(*map(convert, (targets, X)), 1.0, None, 1e-9, not tensor).velocity(convert(f)))
            assert np.abs(u - exact).max() < 1e-8 * max(1.0, np.abs(f).sum())


def test_evaluations_are_counted():
    targets, X, f, owner = case()
    with counting() as counts:
        EwaldSum(targets, X, 1.0, owner).velocity(f)
    assert counts == {"pair_sum": 1, "ewald_sum": 1}
