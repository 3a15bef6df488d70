"""Values on layers about a curve against other quadratures, their interpolation, and the correction made from it."""

import helpers
import numpy as np
import pytest
import torch
from helpers import nodes, rotate

from biem.backend import counting
from biem.curves.curve import arclength_weights, length
from biem.curves.fourier import coefficients, evaluate, resample
from biem.curves.shapes import perturbed
from biem.stokes import near_layers
from biem.stokes.near import layer_values
from biem.stokes.near_layers import NearLayers, curve_sum, exact_layers, layer_points, one_sided, rbf
from biem.stokes.near_search import NearPairs

OFFSETS = (-1.0, -0.5, 0.0, 0.5, 1.0)


def shapes(N, seeds=range(8), **options):
    """Random shapes (M, 2, N) of reduced area 0.65, one for each seed."""
    return np.stack([perturbed(N, 0.65, seed=seed, **options) for seed in seeds])


def random_density(M, N, modes, seed=0):
    """Densities (M, 2, N) with normal coefficients for the modes 0..modes, the same for every N."""
    a = np.random.default_rng(seed).normal(size=(2, M, 2, modes + 1))
    phase = np.arange(modes + 1)[:, None] * nodes(N)
    return a[0] @ np.cos(phase) + a[1] @ np.sin(phase)


def pairs_at(X, alpha, distance):
    """Points (M * P, 2) at parameters and signed distances (M, P) of each curve, and their pairs."""
    c = coefficients(X)
    x_t = evaluate(c, alpha, 1)
    normal = np.stack([x_t[:, 1], -x_t[:, 0]], axis=1) / np.hypot(x_t[:, 0], x_t[:, 1])[:, None]
    points = (evaluate(c, alpha) + distance[:, None] * normal).transpose(0, 2, 1).reshape(-1, 2)
    vesicle = np.repeat(np.arange(len(X)), alpha.shape[1])
    unused = np.full(alpha.size, np.nan)
    return points, NearPairs(np.arange(alpha.size), vesicle, alpha.ravel(), distance.ravel(), unused)


def random_pairs(X, count, seed=0):
    """`pairs_at` random parameters and distances up to h."""
    rng = np.random.default_rng(seed)
    h = (length(X) / X.shape[-1])[:, None]
    return pairs_at(X, rng.uniform(0, 2 * np.pi, (len(X), count)), h * rng.uniform(-1, 1, (len(X), count)))


def two_blobs(N, mu=1.0):
    """X, f (2, 2, N), targets (27, 2) 0.3 h outside the first, 0.4 h inside the second and far away, pairs, and exact and plain u."""
    X, f, _ = helpers.two_blobs(N)
    points, pairs = pairs_at(X, np.stack([helpers.FEET] * 2), np.array([[0.3], [-0.4]]) / N + np.zeros(13))
    targets = np.concatenate([points, [[3.0, 1.0]]])
    exact = layer_values(X, f, np.stack([targets] * 2), mu).sum(axis=0)
    g = f * arclength_weights(X)[:, None, :]
    return X, f, targets, pairs, exact, sum(curve_sum(targets, np.full(27, m), X, g, mu) for m in (0, 1))


def reference(X, f, points, tolerance=1e-9):
    """`near.layer_values` at the layer points, from four times the nodes: the speed of these curves is not resolved on their own."""
    flat = points.transpose(0, 1, 3, 2).reshape(len(X), -1, 2)
    u = layer_values(resample(X, 4 * X.shape[-1]), resample(f, 4 * X.shape[-1]), flat, 1.0, tolerance)
    return u.reshape(len(X), -1, X.shape[-1], 2).transpose(0, 1, 3, 2)


def relative(u, exact):
    """Largest error of each vesicle over its max |S|."""
    return np.abs(u - exact).max(axis=(1, 2, 3)) / np.abs(exact).max(axis=(1, 2, 3))


def test_layers_lie_along_the_normal():
    X = np.stack([helpers.circle(16, 0.5, (3.0, 1.0)), helpers.circle(16)])
    h = 2 * np.pi * np.array([0.5, 1.0]) / 16
    got = layer_points(X, (-1.0, 0.0, 2.0))
    want = [[helpers.circle(16, R + o * d, c) for o in (-1, 0, 2)] for R, d, c in ((0.5, h[0], (3.0, 1.0)), (1.0, h[1], (0.0, 0.0)))]
    assert np.abs(got - want).max() < 1e-14


@pytest.mark.parametrize("tolerance", [1e-4, 1e-5, 1e-6, 1e-8])
def test_exact_layers_meet_the_tolerance_whatever_the_density(tolerance):
    X, f = shapes(32, range(4)), np.random.default_rng(0).normal(size=(4, 2, 32))
    assert relative(exact_layers(X, f, 1.0, OFFSETS, tolerance), reference(X, f, layer_points(X, OFFSETS))).max() < tolerance


def test_exact_layers_of_an_analytic_curve():
    X, f = (a[None] for a in helpers.blob_case(128))
    u = exact_layers(X, f, 2.0, OFFSETS, 1e-10)[0]
    largest = np.abs(u).max()
    assert np.abs(2 * u[2] - helpers.blob_layer_by_kress(512)[:, ::4]).max() < 1e-8 * largest
    for k in (0, 1, 3, 4):
        want = helpers.blob_layer_by_trapezoid(layer_points(X, OFFSETS)[0, k].T).T
        assert np.abs(2 * u[k] - want).max() < 1e-8 * largest


def test_exact_layers_of_rough_shapes_and_where_a_layer_meets_the_curve():
    """Curvature up to 1/h: layers at -h fold, and few of their points are so close to the curve that graded panels take over."""
    X, f = shapes(32, modes=12, power=0.7), random_density(8, 32, 8)
    with counting() as counts:
        u = exact_layers(X, f, 1.0, OFFSETS, 1e-6)[:, (0, 1, 3, 4)]
    assert 1 <= counts["layer_points_too_close"] < 5
    fine, g = (resample(a, 4096 * 32) for a in (X, f))
    g = g * arclength_weights(fine)[:, None, :]
    points = layer_points(X, OFFSETS)[:, (0, 1, 3, 4)].transpose(0, 1, 3, 2).reshape(-1, 2)
    exact = curve_sum(points, np.repeat(np.arange(8), 128), fine, g, 1.0).reshape(8, 4, 32, 2).transpose(0, 1, 3, 2)
    errors = np.sort((np.abs(u - exact).max(axis=2) / np.abs(exact).max(axis=(1, 2, 3))[:, None, None]).ravel())
    assert errors[-5] < 1e-6
    assert errors[-1] < 1e-5  # the trapezoid rule that is compared with is no better there


def test_curve_sum_is_the_sum_of_stokeslets_of_one_curve():
    rng = np.random.default_rng(0)
    X, g, x, own = rng.normal(size=(3, 2, 16)), rng.normal(size=(3, 2, 16)), rng.normal(size=(20, 2)), rng.integers(0, 3, 20)
    want = np.concatenate([helpers.stokeslet_sum(x[[q]], X[own[q]], g[own[q]]) for q in range(20)])
    assert np.abs(curve_sum(x, own, X, g, 3.0) - want / 3).max() < 1e-14
    without = helpers.stokeslet_sum(X[1, :, :1].T, X[1, :, 1:], g[1, :, 1:])
    assert np.abs(curve_sum(X[1, :, :1].T, np.array([1]), X, g, 1.0) - without).max() < 1e-14


def test_interpolation_is_exact_at_the_layer_points():
    X = shapes(32, range(2))
    values = np.random.default_rng(0).normal(size=(2, 5, 2, 32))
    h = np.repeat(length(X)[:, None] / 32, 32, axis=1)
    for k, offset in enumerate(OFFSETS):
        points, pairs = pairs_at(X, np.tile(nodes(32), (2, 1)), offset * h)
        assert np.abs(points.reshape(2, 32, 2).transpose(0, 2, 1) - layer_points(X, OFFSETS)[:, k]).max() < 1e-14
        want = values[:, k].transpose(0, 2, 1).reshape(-1, 2)
        assert np.abs(one_sided(values, X, pairs, OFFSETS) - want).max() < 1e-13
        assert np.abs(rbf(values, X, points, pairs, OFFSETS) - want).max() < 1e-7


def test_one_sided_is_a_polynomial_along_the_normal_on_either_side_and_continuous():
    X, offsets = helpers.circle(32)[None], (-1.5, -1.0, 0.0, 0.5, 1.0, 2.0)
    h = 2 * np.pi / 32
    outside, inside = np.polynomial.Polynomial([0.3, 1.0, -2.0, 0.5]), np.polynomial.Polynomial([0.3, -4.0, 1.0])
    profile = lambda d: np.where(d < 0, inside(d), outside(d))
    wave = lambda t: np.stack([np.cos(3 * t), np.sin(15 * t)])
    values = np.stack([profile(o) * wave(nodes(32)) for o in offsets])[None]
    alpha, d = np.linspace(0, 6, 41)[None], np.linspace(-1, 1, 41)[None]
    got = one_sided(values, X, pairs_at(X, alpha, h * d)[1], offsets)
    assert np.abs(got - (profile(d[0]) * wave(alpha[0])).T).max() < 1e-13
    values = np.random.default_rng(0).normal(size=values.shape)
    above, below = (one_sided(values, X, pairs_at(X, alpha, 0 * d + s * 1e-12)[1], offsets) for s in (1, -1))
    assert np.abs(above - below).max() < 1e-9
    with pytest.raises(ValueError, match=r"\(-1.0, 1.0\).* 0"):
        one_sided(values[:, :2], X, pairs_at(X, alpha, d)[1], (-1.0, 1.0))


def test_errors_at_random_targets_with_exact_layer_values():
    """Median over shapes of the largest error over max |S|, N = 32, 64, 128; within a factor 2."""
    fine, f_fine = shapes(128, modes=8, power=1.0), random_density(8, 128, 8, seed=7)
    errors = []
    for N in (32, 64, 128):
        X, f = fine[..., :: 128 // N], f_fine[..., :: 128 // N]
        points, pairs = random_pairs(X, 100, seed=1)
        exact = layer_values(fine, f_fine, points.reshape(8, 100, 2), 1.0, 1e-6)
        values = exact_layers(X, f, 1.0, OFFSETS)
        largest = np.abs(values).max(axis=(1, 2, 3))
        got = (one_sided(values, X, pairs, OFFSETS), rbf(values, X, points, pairs, OFFSETS))
        errors.append([np.median(np.abs(u.reshape(exact.shape) - exact).max(axis=(1, 2)) / largest) for u in got])
    expected = np.array([[1e-2, 9e-2], [2e-3, 2e-2], [3e-4, 9e-3]])
    assert np.abs(np.log2(errors / expected)).max() < 1, errors


def test_one_sided_is_of_third_order_and_the_fit_across_the_curve_stalls():
    errors = []
    N_all = np.array([128, 256, 384])
    for N in N_all:
        X, f = (a[None] for a in helpers.blob_case(N))
        values = exact_layers(X, f, 1.0, OFFSETS, 1e-9)
        worst = np.zeros(2)
        for d in (0.25 / N, -0.75 / N):
            points, pairs = pairs_at(X, helpers.FEET[None], np.full((1, 13), d))
            got = one_sided(values, X, pairs, OFFSETS), rbf(values, X, points, pairs, OFFSETS)
            worst = np.maximum(worst, [np.abs(u - helpers.blob_layer_by_sinh(d)).max() / np.abs(values).max() for u in got])
        errors.append(worst)
    one, fit = np.array(errors).T
    assert (np.diff(np.log(one)) / np.diff(np.log(N_all)) < -2.7).all(), one
    assert fit[0] < 0.01, fit
    assert 0.5 < fit[2] / fit[1] < 1, fit


@pytest.mark.parametrize("method", near_layers.METHODS)
def test_rotation_shift_and_reindexing_change_nothing(method):
    X, f = shapes(32, range(3)), random_density(3, 32, 6)
    points, pairs = random_pairs(X, 20)

    def velocity(X, f, points, pairs):
        maps = lambda X, f: exact_layers(X, f, 1.0, OFFSETS, 1e-10)
        return NearLayers.build(X, points, pairs, 1.0, method, maps, OFFSETS).add(np.zeros_like(points), f)

    u = velocity(X, f, points, pairs)
    bound = 1e-8 * np.abs(u).max()
    assert np.abs(velocity(rotate(X, 0.7), rotate(f, 0.7), rotate(points.T, 0.7).T, pairs) - rotate(u.T, 0.7).T).max() < bound
    assert np.abs(velocity(X + 50.0, f, points + 50.0, pairs) - u).max() < bound
    turned = NearPairs(pairs.target, pairs.vesicle, pairs.alpha - 2 * np.pi * 5 / 32, pairs.distance, pairs.rho)
    assert np.abs(velocity(np.roll(X, -5, -1), np.roll(f, -5, -1), points, turned) - u).max() < bound
    order = np.array([2, 0, 1])
    moved = NearPairs(pairs.target, np.argsort(order)[pairs.vesicle], pairs.alpha, pairs.distance, pairs.rho)
    assert np.abs(velocity(X[order], f[order], points, moved) - u).max() < bound


@pytest.mark.parametrize(("method", "gain"), [("layers", 50), ("layers_rbf", 1.2)])
def test_correction_replaces_the_trapezoid_rule(method, gain):
    mu = 5.0
    X, f, targets, pairs, exact, plain = two_blobs(64, mu)
    calls = []

    def maps(X, f):
        calls.append(X.shape)
        return exact_layers(X, f, mu, OFFSETS)

    with counting() as counts:
        u = NearLayers.build(X, targets, pairs, mu, method, maps, OFFSETS).add(plain, f)
        only_second = NearLayers.build(X, targets, pairs.subset(pairs.vesicle == 1), mu, method, maps, OFFSETS).add(plain, f)
    assert calls == [(2, 2, 64), (1, 2, 64)]
    assert counts["near_layers"] == 3
    assert counts["rbf_ridge"] == 0
    assert np.abs(u - exact).max() < np.abs(plain - exact).max() / gain
    assert np.abs(only_second - np.concatenate([plain[:13], u[13:]])).max() < 1e-12


@pytest.mark.parametrize("method", near_layers.METHODS)
def test_without_pairs_nothing_runs(method):
    X, f, targets, pairs, *_ = two_blobs(32)
    pairs = pairs.subset(slice(0))
    u = np.ones_like(targets)
    with counting() as counts:
        layers = NearLayers.build(X, targets, pairs, 1.0, method, lambda X, f: pytest.fail("called without pairs"), OFFSETS)
        assert (layers.add(u, f) == 1).all()
    assert counts["near_layers"] == 0
    values = np.ones((2, 5, 2, 32))
    assert one_sided(values, X, pairs, OFFSETS).shape == rbf(values, X, targets[:0], pairs, OFFSETS).shape == (0, 2)


def test_unknown_method_raises():
    X, _, targets, pairs, *_ = two_blobs(32)
    with pytest.raises(ValueError, match=r'"rbf".*"layers_rbf"'):
        NearLayers.build(X, targets, pairs, 1.0, "rbf", exact_layers, OFFSETS)


def test_layers_on_the_curve_alone_raise():
    with pytest.raises(ValueError, match=r"\(0.0,\).*not 0"):
        exact_layers(*(a[None] for a in helpers.blob_case(32)), 1.0, (0.0,))


def test_rbf_where_layer_points_coincide_takes_a_ridge():
    """The layer at the centre of a circle is one point, 32 times; only the curve with it gets the ridge."""
    offsets = (-32 / (2 * np.pi), 0.0, 1.0)
    X = np.stack([helpers.circle(32, 0.3), helpers.blob(nodes(32))])
    smooth = lambda x: np.stack([np.cos(x[..., 0, :]), 1 + x[..., 0, :] * x[..., 1, :]], axis=-2)
    h = length(X)[:, None] / 32
    with counting() as counts:
        for offset in (0.0, 1.0):
            points, pairs = pairs_at(X, np.tile(nodes(32), (2, 1)), offset * np.repeat(h, 32, axis=1))
            got = rbf(smooth(layer_points(X, offsets)), X, points, pairs, offsets)
            assert np.abs(got - smooth(points.T).T).max() < 1e-6
    assert counts["rbf_ridge"] == 2


@pytest.mark.parametrize("on_accelerator", [False, True], ids=["loops", "array_code"])
@pytest.mark.parametrize("method", near_layers.METHODS)
def test_torch_agrees(monkeypatch, method, on_accelerator):
    X, f, targets, pairs, *_ = two_blobs(32)
    maps = lambda X, f: exact_layers(X, f, 2.0, OFFSETS, 1e-6)
    u = NearLayers.build(X, targets, pairs, 2.0, method, maps, OFFSETS).add(np.zeros_like(targets), f)
    tensors = [torch.from_numpy(a) for a in (X, targets, f)]
    rough = torch.from_numpy(shapes(32, range(8), modes=12, power=0.7))
    rough_values = exact_layers(rough.numpy(), rough.numpy(), 1.0, OFFSETS)
    if on_accelerator:
        monkeypatch.setattr(near_layers, "on_cpu", lambda X: False)
        pairs = NearPairs(*(torch.from_numpy(a) for a in vars(pairs).values()))
    layers = NearLayers.build(*tensors[:2], pairs, 2.0, method, maps, OFFSETS)
    got = layers.add(torch.zeros_like(tensors[1]), tensors[2])
    assert isinstance(got, torch.Tensor)
    bound = 1e-11 if method == "layers" else 1e-9  # of the fit: rounding times the condition of its matrix
    assert np.abs(got.numpy() - u).max() < bound * np.abs(u).max()
    assert np.abs(exact_layers(rough, rough, 1.0, OFFSETS).numpy() - rough_values).max() < 1e-11 * np.abs(rough_values).max()


def test_array_code_of_the_fit_takes_a_ridge(monkeypatch):
    offsets = (-32 / (2 * np.pi), 0.0, 1.0)
    X = np.stack([helpers.circle(32, 0.3), helpers.blob(nodes(32))])
    values = layer_points(X, offsets)
    points, pairs = random_pairs(X, 5)
    u = rbf(values, X, points, pairs, offsets)
    monkeypatch.setattr(near_layers, "on_cpu", lambda X: False)
    with counting() as counts:
        got = rbf(torch.from_numpy(values), torch.from_numpy(X), torch.from_numpy(points), pairs, offsets)
    assert counts["rbf_ridge"] == 1
    assert np.abs(got.numpy() - u).max() < 1e-5


def test_single_precision_keeps_its_digits():
    X, f, targets, pairs, *_ = two_blobs(32)
    maps = lambda X, f: exact_layers(X, f, 1.0, OFFSETS)
    single = [torch.from_numpy(a.astype(np.float32)) for a in (X, targets, f)]
    for method in near_layers.METHODS:
        u = NearLayers.build(X, targets, pairs, 1.0, method, maps, OFFSETS).add(np.zeros_like(targets), f)
        got = NearLayers.build(*single[:2], pairs, 1.0, method, maps, OFFSETS).add(torch.zeros_like(single[1]), single[2])
        assert got.dtype == torch.float32
        assert np.abs(got.numpy() - u).max() < 1e-4 * np.abs(u).max()
