"""Velocity close to a curve against independent quadratures, and the search for what is close against dense sampling."""

import helpers
import numpy as np
import pytest
import torch
from helpers import blob, blob_layer_by_sinh, circle, crowd, nodes, rotate, standing_off

from biem.backend import counting
from biem.curves.curve import length
from biem.curves.fourier import interpolation_matrix
from biem.stokes.near import layer_values, near_width
from biem.stokes.near_search import find_near, minimum_gap
from biem.stokes.quadrature import full_matrix, single_layer_blocks
from biem.stokes.single_layer import single_layer


def case(N):
    """The blob (length 1) and its density on N nodes, (1, 2, N)."""
    return tuple(a[None] for a in helpers.blob_case(N))


def on_curve(N):
    """S at the N nodes (N, 2) by the on-surface matrix."""
    X, f = case(N)
    return (full_matrix(single_layer_blocks(X)) @ f.reshape(1, -1, 1)).reshape(2, N).T


LARGEST = np.abs(on_curve(256)).max()


def error(N, offset, **options):
    """Largest error over max |S| at the signed distance from the blob."""
    return np.abs(single_layer(*case(N), standing_off(offset), **options) - blob_layer_by_sinh(offset)).max() / LARGEST


@pytest.mark.parametrize("offset", [s * d / 32 for d in (0.1, 0.5, 1.0) for s in (1, -1)])
def test_near_field_against_the_trapezoid_rule_on_many_nodes(offset):
    exact = helpers.blob_layer_by_trapezoid(standing_off(offset))
    assert np.abs(single_layer(*case(128), standing_off(offset)) - exact).max() <= 1e-8 * LARGEST


@pytest.mark.parametrize(("mode", "bound"), [(16, 1e-6), (32, 1e-4)])
def test_rough_densities_up_to_the_nyquist_mode_of_64_nodes(mode, bound):
    X, x = case(64)[0], np.concatenate([standing_off(d / 64) for d in (0.1, -0.1, 1.0, -1.0)])
    exact = helpers.blob_layer_by_trapezoid(x, lambda t: np.stack([np.cos(mode * t), 0.5 * np.cos(mode * t)]))
    u = single_layer(X, np.cos(mode * nodes(64)) * np.array([[[1.0], [0.5]]]), x)
    assert np.abs(u - exact).max() < bound * np.abs(exact).max()


@pytest.mark.parametrize("offset", [1e-3, 1e-4, -1e-4, 1e-6, -1e-6, 1e-9, 0.0])
def test_near_field_very_close_and_on_the_curve(offset):
    assert error(128, offset) <= 1e-8


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8, 1e-10])
def test_error_stays_below_the_tolerance_at_any_distance(tolerance):
    distances = np.geomspace(0.01, 6, 12) / 128
    assert max(error(128, sign * d, tolerance=tolerance) for sign in (1, -1) for d in distances) < tolerance


@pytest.mark.parametrize("which", [slice(1, None, 2), slice(0, None, 2)], ids=["between_nodes", "at_nodes"])
def test_on_the_curve_the_near_field_is_the_on_surface_matrix(which):
    u = single_layer(*case(128), blob(nodes(256)).T[which])
    assert np.isfinite(u).all()
    assert np.abs(u - on_curve(256)[which]).max() < 1e-9 * LARGEST


@pytest.mark.parametrize("edge", [1.0, near_width("upsample", 1e-6)])
@pytest.mark.parametrize("sign", [1, -1])
def test_velocity_is_continuous_across_the_edges_of_the_near_zone(edge, sign):
    below, above = (single_layer(*case(128), standing_off(sign * edge * x / 128)) for x in (1 - 1e-9, 1 + 1e-9))
    assert np.abs(above - below).max() < 1e-6 * LARGEST


def test_ying_zorin_is_better_than_no_correction_and_converges():
    for offset in (0.1 / 32, -0.1 / 32, 1e-4):
        assert error(128, offset, near_field="ying_zorin") < 0.02 * error(128, offset, near_field="none")
    errors = np.array([max(error(N, s * 0.5 / N, near_field="ying_zorin") for s in (1, -1)) for N in (32, 64, 128, 256)])
    assert (np.log2(errors[:-1] / errors[1:]) > 2).all()


def test_layer_values_about_every_curve():
    X, f = (np.concatenate([a, 2 * a]) for a in case(128))
    offsets = (0.0, 1e-6, -1e-3, 0.5 / 128, 3 / 128, -0.05)
    points, exact = (np.concatenate([g(d) for d in offsets]) for g in (standing_off, blob_layer_by_sinh))
    u = layer_values(X, f, np.stack([points, 2 * points]), 1.0)
    total = (helpers.blob_density(nodes(512)) * np.hypot(*helpers.blob_derivative(nodes(512)))).mean(axis=1) * 2 * np.pi
    assert np.abs(u[0] - exact).max() < 1e-9 * LARGEST
    assert np.abs(u[1] - 4 * (exact - np.log(2) / (4 * np.pi) * total)).max() < 1e-8 * LARGEST


@pytest.mark.parametrize("near_field", ["upsample", "ying_zorin", "none"])
def test_curves_add_up_motions_commute_viscosity_divides_and_torch_agrees(near_field):
    X, f, targets = helpers.two_blobs(64)
    u = single_layer(X, f, targets, near_field=near_field)
    one, two = (single_layer(X[[i]], f[[i]], targets, near_field=near_field) for i in (0, 1))
    scale = np.abs(u).max()
    assert np.abs(one + two - u).max() < 1e-13 * scale
    excluded = single_layer(X, f, targets, near_field=near_field, exclude=np.zeros(len(targets), dtype=int))
    assert np.abs(excluded - two).max() < 1e-13 * scale
    turned = single_layer(rotate(X, 0.5), rotate(f, 0.5), rotate(targets.T, 0.5).T, near_field=near_field)
    assert np.abs(turned - rotate(u.T, 0.5).T).max() < 1e-10 * scale
    assert np.abs(single_layer(X + 1000.0, f, targets + 1000.0, near_field=near_field) - u).max() < 1e-8 * scale
    assert np.abs(single_layer(X, f, targets, mu=5.0, near_field=near_field) - u / 5).max() < 1e-14 * scale
    tensors = (torch.from_numpy(a) for a in (X, f, targets))
    assert np.abs(single_layer(*tensors, near_field=near_field).numpy() - u).max() < 1e-12 * scale


def test_rows_are_made_for_near_pairs_alone():
    with counting() as counts:
        single_layer(*case(64), np.array([[3.0, 1.0], [0.0, 0.0]]))
        assert counts["near_rows"] == 0
        single_layer(*case(64), standing_off(1e-3))
    assert counts["near_rows"] == 13


@pytest.mark.parametrize("bad", [{"near_field": "quick"}, {"far_field": "fmm"}, {"targets": np.zeros((2, 5))}, {"f": np.zeros(9)}])
def test_bad_arguments_raise(bad):
    (name,) = bad
    with pytest.raises(ValueError, match=f"{name} .*(quick|fmm|2, 5|9,)"):
        single_layer(**{"X": case(64)[0], "f": case(64)[1], "targets": np.zeros((5, 2))} | bad)


@pytest.mark.parametrize("width", [0.5, 1.0, 3.0])
def test_search_finds_every_near_pair_with_distance_and_side(width):
    X, rng = crowd(64), np.random.default_rng(0)
    targets = np.concatenate([rng.uniform(-0.45, 0.45, size=(2000, 2)), rng.normal((0.3, -0.1), 0.02, size=(500, 2))])
    exclude = rng.integers(-1, 4, size=2500)
    sampled = [helpers.dense_distance(x, targets) for x in crowd(512)]
    distance, inside = (np.stack(a, axis=1) for a in zip(*sampled, strict=True))
    reach = width * length(X) / 64
    pairs = find_near(X, targets, width, exclude)
    p, m = pairs.target, pairs.vesicle
    found = np.zeros_like(inside)
    found[p, m] = True
    wanted = (distance < reach) & (np.arange(4) != exclude[:, None])
    assert wanted.sum(axis=0).min() > 20  # of each curve
    assert (found == wanted)[np.abs(distance - reach) > 5e-5].all()  # the samples are up to 5e-5 apart
    assert len(p) == found.sum()
    assert np.abs(np.abs(pairs.distance) - distance[p, m]).max() < 3e-5
    assert ((pairs.distance < 0) == inside[p, m])[distance[p, m] > 5e-5].all()
    foot = np.stack([interpolation_matrix(pairs.alpha[[q]], 64)[0] @ X[m[q]].T for q in range(len(p))])
    assert np.abs(np.hypot(*(foot - targets[p]).T) - np.abs(pairs.distance)).max() < 1e-12


def test_near_zone_is_measured_from_the_curve_not_from_its_nodes():
    h = 2 * np.pi / 16
    targets = (1 + 0.1 * h) * np.array([[np.cos(h / 8), np.sin(h / 8)]])
    assert len(find_near(circle(16)[None], targets, 0.0999)) == 0
    pairs = find_near(circle(16)[None], targets, 0.1001)
    assert [pairs.distance[0], pairs.alpha[0], pairs.rho[0]] == pytest.approx([0.1 * h, h / 8, np.log(1 + 0.1 * h)], rel=1e-12)


@pytest.mark.parametrize("gap", [1e-3, 0.3, 40.0])
def test_minimum_gap_of_two_circles(gap):
    assert minimum_gap(np.stack([circle(32), circle(32, 0.5, (1.5 + gap, 0.0))])) == pytest.approx(gap, rel=1e-9)
    assert minimum_gap(circle(32)[None]) == np.inf
