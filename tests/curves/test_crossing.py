"""Crossing membranes are found, close ones are not taken for crossing."""

import numpy as np
import pytest
import torch
from helpers import blob, circle, dumbbell, nodes

from biem.curves.crossing import fluid_region, outside_region, pair_crossings, polygons, self_crossings
from biem.curves.shapes import equilibrium, place


def figure_eight(N=64):
    t = nodes(N)
    return np.stack([np.cos(t), 0.5 * np.sin(2 * t)])


def tangent_circles(gap, angle):
    """Two unit circles of 32 nodes at a distance, the contact at the angle: at a node for 0, midway between two for pi/32."""
    away = (2 + gap) * np.array([np.cos(angle), np.sin(angle)])
    return circle(32), circle(32, center=away)


@pytest.mark.parametrize("angle", [0.0, np.pi / 32, np.pi / 100])
@pytest.mark.parametrize("depth", [0.5, 1e-2, 1e-3, 1e-4, 2e-5])
def test_overlapping_curves_are_found(depth, angle):
    first, last = tangent_circles(-depth, angle)
    X = np.stack([first, circle(32, center=(9.0, 0.0)), last])
    assert pair_crossings(X) == [(0, 2)]
    assert self_crossings(X) == []


@pytest.mark.parametrize("angle", [0.0, np.pi / 32])
@pytest.mark.parametrize("gap", [0.5, 1e-2, 1e-3, 1e-5])
def test_close_curves_are_not(gap, angle):
    assert pair_crossings(np.stack(tangent_circles(gap, angle))) == []


@pytest.mark.parametrize(("gap", "crossings"), [(1e-3, []), (-1e-3, [(0, 1)])])
def test_a_small_circle_in_the_waist_of_a_coarse_dumbbell(gap, crossings):
    """The contact is where the polygon of the concave waist strays outside the curve by more than the gap."""
    N, t = 12, np.pi / 2 + np.pi / 48  # midway between two corners of the coarse polygon
    foot = np.array([np.cos(t), np.sin(t) * (0.1 + 0.4 * np.cos(t) ** 2)])
    tangent = np.array([-np.sin(t), np.cos(t) * (0.1 + 0.4 * np.cos(t) ** 2) - 0.8 * np.sin(t) ** 2 * np.cos(t)])
    normal = np.array([tangent[1], -tangent[0]]) / np.hypot(*tangent)
    X = np.stack([dumbbell(N, 0.2), circle(N, 0.1, foot + (0.1 + gap) * normal)])
    assert pair_crossings(X) == crossings


def test_contained_curves_are_found():
    assert pair_crossings(np.stack([circle(32, 0.1, (0.3, 0.2)), circle(32)])) == [(0, 1)]


def test_every_pair_of_a_crowd_is_found_once():
    X = np.stack([circle(32, 0.6, (float(i), 0.0)) for i in range(5)])
    assert sorted(pair_crossings(X)) == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_a_gap_of_1e_3_of_the_length_along_a_curved_contact_is_no_crossing():
    """A blob and its mirror image in the line that supports it in direction n, moved apart by the gap."""
    n, X = np.array([0.8, 0.6]), blob(nodes(64))
    support = (n @ blob(nodes(100_000))).max()
    image = (X - 2 * np.outer(n, n @ X - support))[:, ::-1]
    for gap, crossings in ((1e-3, []), (-1e-3, [(0, 1)])):
        assert pair_crossings(np.stack([X, image + gap * n[:, None]])) == crossings


def test_figure_eight_crosses_itself():
    assert self_crossings(np.stack([circle(64), figure_eight(), circle(64)])) == [1]


def test_a_figure_eight_among_others_does_not_disturb_the_pairs():
    X = np.stack([circle(64, 0.3, (0.6, 0.0)), figure_eight(), circle(64, center=(5.0, 5.0))])
    assert pair_crossings(X) == [(0, 1)]


@pytest.mark.parametrize(("neck", "found"), [(1e-3, []), (-1e-3, [0])])
def test_a_closing_neck(neck, found):
    assert self_crossings(dumbbell(128, neck)[None]) == found


@pytest.mark.parametrize("shift", [0.0, np.pi / 128, np.pi / 300])
@pytest.mark.parametrize(("neck", "found"), [(1e-4, []), (-1e-4, [0])])
def test_a_neck_that_closes_between_corners(neck, found, shift):
    """The sides bulge towards each other: their polygons are up to 1e-3 farther apart than they."""
    t = nodes(32) + shift
    X = np.stack([np.cos(t), np.sin(t) * (0.5 * neck + 0.4 * np.cos(t) ** 2)])
    assert self_crossings(X[None]) == found


def test_slender_vesicles_do_not_cross_themselves_and_stack_closely():
    X = equilibrium(64, 0.4)
    above = place(X, (0.0, np.ptp(X[1]) + 1e-3), 0.0)
    assert self_crossings(np.stack([X, above])) == []
    assert pair_crossings(np.stack([X, above])) == []


def test_one_curve_has_no_pairs_and_tensors_are_accepted():
    assert pair_crossings(circle(32)[None]) == []
    X = torch.from_numpy(np.stack([circle(32), circle(32, center=(1.0, 0.0))]))
    assert pair_crossings(X) == [(0, 1)]
    assert self_crossings(X) == []


def test_one_crossing_pair_and_one_self_crossing_among_2000():
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(50.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    one = equilibrium(32, 0.65)  # 0.42 long
    X = np.stack([place(one, 0.45 * c, a) for c, a in zip(grid, rng.uniform(0, 2 * np.pi, len(grid)), strict=True)])
    assert (self_crossings(X), pair_crossings(X)) == ([], [])
    X[700] = figure_eight(32) * 0.15 + X[700].mean(axis=-1, keepdims=True)
    X[1234] += 0.7 * (X[1235] - X[1234]).mean(axis=-1, keepdims=True)
    assert self_crossings(X) == [700]
    assert pair_crossings(X) == [(1234, 1235)]
    assert (self_crossings(X, polygons(X)), pair_crossings(X, polygons(X))) == ([700], [(1234, 1235)])


def test_polygons_run_through_the_refined_curve():
    P = polygons(circle(32)[None], 8)[0]
    n = 8 * 32
    assert pytest.approx(0.5 * n * np.sin(2 * np.pi / n), rel=1e-12) == P.area


@pytest.mark.parametrize("angle", [0.0, np.pi / 32, np.pi / 100])
@pytest.mark.parametrize("depth", [1e-2, 1e-3, 1e-4, 2e-5, -2e-5, -1e-3])
def test_a_circle_over_a_wall_is_found_however_shallow(depth, angle):
    """A circle of 32 nodes in a round one of 512, touching it at a node or between nodes, and one about a round body in it."""
    region = fluid_region([circle(512, 3.0), circle(512, 0.5)])
    out = np.array([np.cos(angle), np.sin(angle)])
    X = np.stack([circle(32, 1.0, (2 + depth) * out), circle(32, 1.0, (1.5 - depth) * -out), circle(32, 0.1, (0.0, 2.0))])
    assert outside_region(X, region) == ([0, 1] if depth > 0 else [])
