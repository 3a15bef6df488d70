"""The search for near pairs against a minimisation for every pair, on packings, strong shapes, unlike sizes and broken input."""

from functools import cache

import helpers
import numba
import numpy as np
import pytest
import torch
from helpers import circle, nodes
from scipy.optimize import minimize_scalar

from biem.backend import counting
from biem.curves.curve import length
from biem.curves.fourier import coefficients, evaluate
from biem.curves.packing import random_packing
from biem.curves.shapes import equilibrium, perturbed, place
from biem.stokes import near_search
from biem.stokes.near_search import NearPairs, _lengths, _within, find_near, locate, minimum_gap


@cache
def packing(M=12, N=32, sizes=(1.0,), seed=1):
    """M vesicles (M, 2, N) packed at random at an area fraction of about 30 %."""
    rng = np.random.default_rng(seed)
    shapes = np.stack([perturbed(N, 0.7, seed=k) if k % 2 else equilibrium(N, 0.65) for k in range(4)])[np.arange(M) % 4]
    side = np.sqrt(0.055 * M / 0.3)
    X = np.stack([place(*a) for a in zip(shapes, *random_packing(shapes, (side, side), 0.01, rng), strict=True)])
    center = X.mean(axis=-1, keepdims=True)
    return center + (X - center) * np.resize(sizes, M)[:, None, None]


def own_nodes(X):
    return X.transpose(0, 2, 1).reshape(-1, 2), np.repeat(np.arange(X.shape[0]), X.shape[-1])


def all_pairs(X, targets):
    """Distance and parameter (P, M) of every target to every curve: the best of 2048 samples, then a bounded minimisation."""
    n = 2048
    distance, alpha = np.empty((len(targets), len(X))), np.empty((len(targets), len(X)))
    for m, curve in enumerate(X):
        c = coefficients(curve)[None]
        samples = evaluate(c, nodes(n)[None])[0].T
        k = np.argmin(((targets[:, None] - samples) ** 2).sum(-1), axis=1)
        for p, x in enumerate(targets):
            at = minimize_scalar(
                lambda a, c=c, x=x: ((evaluate(c, np.array([[a]]))[0, :, 0] - x) ** 2).sum(),
                bounds=(2 * np.pi * (k[p] - 1) / n, 2 * np.pi * (k[p] + 1) / n),
                options={"xatol": 1e-10},
            )
            distance[p, m], alpha[p, m] = np.sqrt(at.fun), at.x
    return distance, alpha


def array_path(X, targets, width, exclude=None):
    """What an accelerator runs, on tensors of the CPU."""
    X, targets = torch.from_numpy(X), torch.from_numpy(targets)
    exclude = None if exclude is None else torch.from_numpy(exclude)
    return _within(X, targets, width / X.shape[-1] * _lengths(X), exclude, False)


def assert_same(a: NearPairs, b: NearPairs, tolerance: float):
    assert (a.target == b.target).all()
    assert (a.vesicle == b.vesicle).all()
    assert np.abs((a.alpha - b.alpha + np.pi) % (2 * np.pi) - np.pi).max(initial=0.0) < 10 * tolerance
    assert np.abs(a.distance - b.distance).max(initial=0.0) < tolerance
    assert np.abs(a.rho - b.rho).max(initial=0.0) < 10 * tolerance


@pytest.mark.parametrize("search", [find_near, array_path])
@pytest.mark.parametrize("width", [0.4, 2.5])
def test_packing_against_a_minimisation_for_every_pair(search, width):
    X = packing(M=5)
    rng = np.random.default_rng(2)
    nodes, owner = own_nodes(X)
    targets = np.concatenate([nodes[::2], nodes[rng.integers(160, size=100)] + rng.normal(0, 0.02, (100, 2))])
    exclude = np.concatenate([owner[::2], rng.integers(-1, 5, size=100)])
    distance, alpha = all_pairs(X, targets)
    reach = width * length(X) / 32
    wanted = (distance <= reach) & (exclude[:, None] != np.arange(5))
    p, m = np.nonzero(wanted)  # sorted by target, then curve
    pairs = search(X, targets, width, exclude).to_numpy()
    assert len(p) > 20
    assert (pairs.target == p).all()
    assert (pairs.vesicle == m).all()
    assert np.abs(np.abs(pairs.distance) - distance[p, m]).max() < 1e-10
    inside = np.stack([helpers.dense_distance(x, targets)[1] for x in X], axis=1)
    assert ((pairs.distance < 0) == inside[p, m]).all()
    assert (pairs.distance < 0).any()
    turn = np.abs((pairs.alpha - alpha[p, m] + np.pi) % (2 * np.pi) - np.pi)
    assert turn[pairs.distance > 0].max() < 1e-6


@pytest.mark.parametrize("search", [find_near, array_path])
def test_strong_shapes_inside_outside_and_on_the_curve(search):
    X = np.stack([perturbed(64, 0.45, seed=3), helpers.rotate(perturbed(64, 0.5, seed=8), 1.0) + 0.05])
    c, t = coefficients(X), np.linspace(0.05, 6.2, 40)
    foot, along = (evaluate(c, np.stack([t, t]), order) for order in (0, 1))
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(along[:, 0], along[:, 1])[:, None]
    for offset in (0.0, 1e-8, -1e-4, 2e-3, -2e-3):
        for m in range(2):
            targets = (foot[m] + offset * normal[m]).T
            pairs = search(X[[m]], targets, 0.5).to_numpy()
            assert (pairs.target == np.arange(40)).all()
            assert np.abs(pairs.distance - offset).max() < 1e-13
            assert np.abs(pairs.alpha - t).max() < 1e-11


@pytest.mark.parametrize("search", [find_near, array_path])
def test_unlike_sizes_far_from_the_origin(search):
    X = np.concatenate([packing(sizes=(1.0, 0.3, 0.03, 1e-4)), circle(32, 3.0)[None]])
    near = X[:, :, ::4] + 0.5 * length(X)[:, None, None] / 32
    targets = near.transpose(0, 2, 1).reshape(-1, 2)
    distance = np.stack([helpers.dense_distance(x, targets)[0] for x in X], axis=1)
    reach = 1.5 * length(X) / 32
    clear = np.abs(distance / reach - 1) > 1e-3
    for shift in (0.0, 1000.0):
        pairs = search(X + shift, targets + shift, 1.5).to_numpy()
        found = np.zeros_like(clear)
        found[pairs.target, pairs.vesicle] = True
        assert (found == (distance <= reach))[clear].all()
        assert (found.sum(axis=0) > 0).all()
        error = np.abs(np.abs(pairs.distance) - distance[pairs.target, pairs.vesicle])
        assert (error < 1e-3 * reach[pairs.vesicle]).all()


def test_array_path_equals_the_loops_whatever_the_chunks(monkeypatch):
    X = packing(M=30, sizes=(1.0, 0.4), seed=2)
    targets, owner = own_nodes(X)
    loops = find_near(X, targets, 3.0, owner)
    assert len(loops) > 80
    assert_same(array_path(X, targets, 3.0, owner).to_numpy(), loops, 1e-12)
    assert_same(_within(X, targets, 3.0 / 32 * _lengths(X), owner, False), loops, 1e-12)
    monkeypatch.setattr(near_search, "CHUNK", 1000)
    assert_same(array_path(X, targets, 3.0, owner).to_numpy(), loops, 1e-12)


def test_many_curves_at_one_place():
    """More curves about a target than the loops keep from their first pass, in the order of the curves."""
    X = np.stack([circle(32, 1 + 0.01 * k) for k in range(20)][::-1])
    targets, owner = own_nodes(X)
    pairs = find_near(X, targets, 2.5, owner)
    assert (np.diff(pairs.target * 20 + pairs.vesicle) > 0).all()
    assert len(pairs) == 19 * 640
    assert pairs.distance == pytest.approx(0.01 * (pairs.vesicle - owner[pairs.target]), abs=1e-13)
    same = find_near(np.repeat(X[:1], 20, axis=0), targets, 2.5, owner)
    assert len(same) == 19 * 640
    assert_same(array_path(X, targets, 2.5, owner).to_numpy(), pairs, 1e-12)


def test_closest_parameter_inside_where_newton_is_slow():
    """Targets next to the centre of curvature, on the long axis of an ellipse: the closest point is the end of the axis."""
    X = helpers.ellipse(64, 1.0, 0.5)[None]
    x = np.array([[0.76, 0.0], [0.77, 1e-3], [-0.8, 0.0]])  # centre of curvature at 0.75
    pairs = locate(X, x, np.arange(3), np.zeros(3, dtype=int), np.array([0.1, -0.1, 3.0]))
    assert pairs.distance[[0, 2]] == pytest.approx([-0.24, -0.2], rel=1e-12)
    foot = evaluate(coefficients(X)[[0, 0, 0]], pairs.alpha[:, None])[..., 0]
    tangent = evaluate(coefficients(X)[[0, 0, 0]], pairs.alpha[:, None], 1)[..., 0]
    assert np.abs(((foot - x) * tangent).sum(-1)).max() < 1e-13


def test_reindexing_curves_and_targets():
    X = packing()
    targets, owner = own_nodes(X)
    pairs = find_near(X, targets, 2.5, owner)
    rng = np.random.default_rng(0)
    curves, points = rng.permutation(12), rng.permutation(len(targets))
    again = find_near(X[curves], targets[points], 2.5, np.argsort(curves)[owner[points]])
    order = np.lexsort((curves[again.vesicle], points[again.target]))
    back = NearPairs(points[again.target], curves[again.vesicle], again.alpha, again.distance, again.rho).subset(order)
    assert_same(back, pairs, 1e-13)


@pytest.mark.parametrize("search", [find_near, array_path])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_values_that_are_not_finite_or_absurd_take_no_one_else_with_them(search, bad):
    X = packing()
    targets, owner = own_nodes(X)
    good = search(X, targets, 2.5, owner).to_numpy()
    broken, moved = X.copy(), targets.copy()
    broken[3, 1, 5] = bad
    moved[40:45, 0] = bad
    with np.errstate(all="ignore"):
        pairs = search(broken, moved, 2.5, owner).to_numpy()
    left = good.subset((good.vesicle != 3) & ~((good.target >= 40) & (good.target < 45)))
    assert 0 < len(left) < len(good)
    assert_same(pairs, left, 1e-12)
    with np.errstate(all="ignore"):
        assert len(search(np.full_like(X, bad), targets, 2.5, owner)) == 0
        assert minimum_gap(broken) == minimum_gap(np.delete(X, 3, axis=0))


@pytest.mark.parametrize("search", [find_near, array_path])
def test_nothing_near_no_targets_and_one_curve(search):
    X = packing(M=2)
    far = np.array([[1e9, 0.0], [-1e12, 3.0]])
    assert len(search(X, far, 2.5)) == 0
    assert len(search(X, far[:0], 2.5)) == 0
    assert len(search(X[:1], own_nodes(X[:1])[0], 2.5, np.zeros(32, dtype=int))) == 0
    assert len(search(X[:1], own_nodes(X[:1])[0], 0.01)) == 32
    assert len(search(np.zeros((1, 2, 32)), far, 2.5)) == 0


def test_tensors_in_any_precision_and_the_count():
    X = packing()
    targets, owner = own_nodes(X)
    with counting() as counts:
        pairs = find_near(X, targets, 2.5, owner)
    assert counts == {"near_search": 1}
    assert_same(find_near(*map(torch.from_numpy, (X, targets)), 2.5, torch.from_numpy(owner)), pairs, 1e-15)
    single = find_near(torch.from_numpy(X).float(), torch.from_numpy(targets).float(), 2.5, torch.from_numpy(owner))
    exact = find_near(X.astype(np.float32).astype(float), targets.astype(np.float32).astype(float), 2.5, owner)
    assert_same(single, exact, 1e-15)


def test_results_do_not_depend_on_the_number_of_threads():
    X = packing(M=20)
    targets, owner = own_nodes(X)
    before, results = numba.get_num_threads(), []
    for n in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(n)
        results.append(find_near(X, targets, 2.5, owner))
    numba.set_num_threads(before)
    assert len(results[0]) > 50
    for name in ("target", "vesicle", "alpha", "distance", "rho"):
        assert (getattr(results[0], name) == getattr(results[1], name)).all()


@pytest.mark.parametrize("spread", [1.0, 3.0, 300.0])
@pytest.mark.parametrize("sizes", [(1.0,), (1.0, 0.1, 0.02)])
def test_minimum_gap_of_packings_however_dilute(spread, sizes):
    X = packing(sizes=sizes)
    X = X + (spread - 1) * X.mean(axis=-1, keepdims=True)
    targets, owner = own_nodes(X)
    distance = np.stack([helpers.dense_distance(x, targets, 1 << 12)[0] for x in X], axis=1)
    distance[owner[:, None] == np.arange(len(X))] = np.inf
    assert minimum_gap(X) == pytest.approx(distance.min(), rel=1e-3)
    assert minimum_gap(X) <= distance.min() * (1 + 1e-12)


def test_minimum_gap_of_nested_touching_and_equal_curves():
    rings = np.stack([circle(32, r) for r in (1.0, 1.5, 1.9, 2.5)])
    assert minimum_gap(rings) == pytest.approx(0.4, rel=1e-12)
    assert minimum_gap(np.stack([circle(32), circle(32, 1.0, (2.0, 0.0))])) < 1e-14
    assert minimum_gap(np.stack([circle(32)] * 3)) == 0.0
