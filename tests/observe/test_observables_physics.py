"""Stresses, powers and rates against exact results: symmetry, invariance, dissipation, rigid discs, other resolutions."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import circle, ellipse, nodes, rotate
from scene_helpers import PAIR, scene_of

from biem.curves.curve import arclength_weights, area, bending_energy, centroid, length, normal, tangent
from biem.curves.fourier import resample
from biem.curves.lattice import Lattice
from biem.curves.shapes import perturbed
from biem.membrane.operators import bending_force, tension_force
from biem.membrane.repulsion import Repulsion
from biem.observe import motion
from biem.observe.instant import instant
from biem.observe.observables import Observer
from biem.observe.stress import contrast_stresslets, reference_area, repulsive_stress, stresslets
from biem.run.simulate import simulate
from biem.run.solver import make_stepper
from biem.scene.build import build
from biem.steppers.stepper import State

ROUGH = {"vesicles": {"shape": "perturbed", "reduced_area": 0.65, "points": 96, "seed": 3}}
STILL = {"flow": {"kind": "quiescent", "rate": None}}
BOX = {"vesicles": {"placement": "grid", "count": 2, "box": [2.0, 1.5], "points": 32}}


def row(problem, names, X=None, **options):
    """Values of the quantities at t = 0, by name."""
    return {k: v[0] for k, v in Observer.of(problem, names, **options).row(problem.X if X is None else X, 0.0, 0).values.items()}


def moments(X, f):
    """int x_i f_j ds (M, 2, 2), about the mean node."""
    r = X - X.mean(axis=-1, keepdims=True)
    return np.einsum("mik,mjk,mk->mij", r, f, arclength_weights(X))


def test_stresslet_of_a_circle_under_tension():
    X, a = circle(64, 0.2)[None], nodes(64)
    found = stresslets(X, 3.0 + np.cos(2 * a)[None] + 0.5 * np.sin(2 * a)[None], 2.0)[0]
    expected = np.pi * 0.2 * (3.0 + 2.0 / 0.2**2) * np.eye(2) + 0.5 * np.pi * 0.2 * np.array([[-1.0, -0.5], [-0.5, 1.0]])
    assert found == pytest.approx(expected, rel=1e-12)


def test_stresslet_is_the_moment_of_the_force_and_no_torque_acts():
    problem = build(scene_of(PAIR, ROUGH))
    at = instant(problem, problem.X)
    S, M = stresslets(at.X, at.sigma, 1.0), -moments(at.X, at.force)
    assert np.abs(S - M).max() < 1e-11 * np.abs(S).max()  # at the nodes too
    for f in (bending_force(at.X), tension_force(at.X, at.sigma)):
        torque = moments(at.X, f)
        assert np.abs(torque[:, 0, 1] - torque[:, 1, 0]).max() < 1e-11 * np.abs(torque).max()


def test_turned_and_shifted_suspension():
    problem = build(scene_of(PAIR, ROUGH, STILL))
    names = ["stress", "stresslet", "velocity", "tank_treading_frequency", "power", "deformation", "pair_distance", "bending_energy"]
    angle, c, s = 0.7, np.cos(0.7), np.sin(0.7)
    turned = rotate(problem.X, angle) + np.array([[300.0], [-500.0]])
    Q = np.array([[c, -s], [s, c]])
    tensor = lambda v: np.stack([v[..., [0, 1]], v[..., [1, 2]]], axis=-2)
    a, b = row(problem, names), row(problem, names, turned)
    for name in ("stress", "stresslet"):
        assert tensor(b[name]) == pytest.approx(Q @ tensor(a[name]) @ Q.T, rel=1e-7, abs=1e-7 * np.abs(a[name]).max()), name
    assert b["velocity"] == pytest.approx(a["velocity"] @ Q.T, abs=1e-7 * np.abs(a["velocity"]).max())
    for name in ("tank_treading_frequency", "power", "deformation", "pair_distance", "bending_energy"):
        assert b[name] == pytest.approx(a[name], rel=1e-7, abs=1e-7 * np.abs(a[name]).max()), name


def test_given_tension_is_taken():
    problem = build(scene_of(PAIR, ROUGH))
    X = problem.X
    sigma = 1e4 * np.cos(2 * nodes(96)) + np.array([[1.0], [-2.0]])
    names = ["stresslet", "velocity", "power"]
    given = {k: v[0] for k, v in Observer.of(problem, names, solve=False).row(X, 0.0, 1, sigma).values.items()}
    at = instant(problem, X, 0.0, sigma)
    assert given["velocity"] == pytest.approx(motion.centroid_velocity(X, at.velocity), rel=1e-9)
    assert given["power"] == pytest.approx(motion.power(X, at.force, at.velocity), rel=1e-9)
    assert given["stresslet"][:, 0] == pytest.approx(-moments(X, at.force)[:, 0, 0], rel=1e-9)
    found = row(problem, names)
    for name in names:
        assert np.abs(given[name] - found[name]).max() > 0.1 * np.abs(found[name]).max(), name


def test_shifted_in_shear():
    problem = build(scene_of(PAIR, ROUGH))
    names = ["stress", "velocity", "tank_treading_frequency", "power", "intrinsic_viscosity", "normal_stress_difference", "smallest_gap"]
    a, b = row(problem, names), row(problem, names, problem.X + np.array([[7.0], [0.5]]))
    assert b["velocity"] - a["velocity"] == pytest.approx(np.array([[50.0, 0.0]] * 2), abs=1e-6)
    for name in set(names) - {"velocity"}:
        assert b[name] == pytest.approx(a[name], rel=1e-6, abs=1e-6 * np.abs(a[name]).max()), name
    assert a["normal_stress_difference"] == a["stress"][0] - a["stress"][2]


FLOWS = (STILL, {}, {"flow": {"kind": "extensional", "rate": 300.0}})


@pytest.mark.parametrize("flow", FLOWS, ids=["still", "shear", "extension"])
@pytest.mark.parametrize("pair", [{}, PAIR], ids=["M=1", "M=2"])
def test_power_is_minus_the_rate_of_the_bending_energy(flow, pair):
    problem = build(scene_of(ROUGH, pair, flow))
    X, at = problem.X, instant(problem, problem.X)
    e = 1e-5 * problem.length / np.abs(at.velocity).max()
    rate = (bending_energy(X + e * at.velocity) - bending_energy(X - e * at.velocity)) / (2 * e)
    power = row(problem, ["power"])["power"]
    assert np.abs(power + rate).max() < 1e-3 * np.abs(rate).max()
    by_tension = (tension_force(X, at.sigma) * at.velocity).sum(1) * arclength_weights(X)
    assert np.abs(by_tension.sum(-1)).max() < 1e-3 * np.abs(rate).max()  # inextensible: it does none


@pytest.mark.parametrize("flow", FLOWS[:2], ids=["still", "shear"])
def test_power_is_what_small_steps_lose(flow):
    problem = build(scene_of(ROUGH, flow, solver={"corrections": []}))
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    before = bending_energy(problem.X)[0]
    rates = []
    for dt in (2e-9, 1e-9):
        rates.append((bending_energy(stepper.step(State(0.0, problem.X), dt).state.X)[0] - before) / dt)
    assert row(problem, ["power"])["power"][0] == pytest.approx(rates[0] - 2 * rates[1], rel=1e-3)  # dt -> 0


def steady(points, reduced_area=0.65, turns=4, **more):
    """Problem and last frame of one vesicle that tank-treads in shear, Ca = 5."""
    vesicles = {"shape": "ellipse", "reduced_area": reduced_area, "points": points, "angles": [0.35]}
    flow, time = {"rate": None, "capillary": 5.0}, {"dt": "0.05 t_gamma", "horizon": f"{turns} t_gamma", "save_every": 1000, "order": 2}
    scene = scene_of(vesicles=vesicles, flow=flow, time=time, **more)
    return build(scene), simulate(scene).trajectory.X[-1]


def test_viscosity_of_one_vesicle_at_twice_the_resolution():
    names = ["intrinsic_viscosity", "normal_stress_difference", "tank_treading_frequency", "inclination"]
    coarse, fine = (row(problem, names, X) for problem, X in (steady(32), steady(64)))
    assert coarse["intrinsic_viscosity"] == pytest.approx(fine["intrinsic_viscosity"], rel=2e-3)
    assert coarse["normal_stress_difference"] == pytest.approx(fine["normal_stress_difference"], rel=2e-3)
    assert coarse["tank_treading_frequency"] == pytest.approx(fine["tank_treading_frequency"], rel=1e-3)
    assert 1.2 < fine["intrinsic_viscosity"] < 1.5


def test_same_shape_on_fewer_nodes():
    problem, X = steady(64, turns=2)
    fewer = build(scene_of(vesicles={"shape": "ellipse", "reduced_area": 0.65, "points": 32}, flow={"rate": problem.flow.rate}))
    a, b = row(problem, ["stress"], X)["stress"], row(fewer, ["stress"], resample(X, 32))["stress"]
    assert np.abs(a - b).max() < 2e-3 * np.abs(a).max()


def test_a_nearly_circular_vesicle_is_a_rigid_disc():
    """In shear a disc turns at half the rate and has the intrinsic viscosity 2 (Einstein's 5/2 in the plane)."""
    problem, X = steady(32, 0.99)
    values = row(problem, ["intrinsic_viscosity", "tank_treading_frequency"], X)
    assert values["tank_treading_frequency"][0] / problem.flow.rate == pytest.approx(-0.5, abs=0.01)
    assert 1.97 < values["intrinsic_viscosity"] < 1.98  # 2 - 2.54 (1 - reduced area) + ...
    rounder = build(scene_of(vesicles={"reduced_area": 0.99999, "shape": "ellipse", "points": 32, "angles": [np.pi / 4]}))
    assert row(rounder, ["tank_treading_frequency"])["tank_treading_frequency"][0] == pytest.approx(-50.0, rel=1e-4)


def test_viscosity_of_a_suspension_by_its_area_fraction():
    problem = build(scene_of(BOX))
    values = row(problem, ["effective_viscosity", "intrinsic_viscosity", "vesicle_intrinsic_viscosity", "stress", "stresslet"])
    fraction = area(problem.X).sum() / 3.0
    assert reference_area(problem)[0] == 3.0
    assert values["effective_viscosity"] == pytest.approx(1 + fraction * values["intrinsic_viscosity"], rel=1e-12)
    assert values["intrinsic_viscosity"] == pytest.approx(values["vesicle_intrinsic_viscosity"].mean(), rel=1e-9)  # of equal areas
    assert values["stress"] == pytest.approx(values["stresslet"].sum(axis=0) / 3.0, rel=1e-12)
    stiffer = build(scene_of(BOX, physics={"mu": 2.0, "kappa_b": 2.0}))  # the same motion, twice the stress
    again = row(stiffer, ["effective_viscosity", "stress"])
    assert again["effective_viscosity"] == pytest.approx(values["effective_viscosity"], rel=1e-6)
    assert again["stress"] == pytest.approx(2 * values["stress"], rel=1e-6)


def test_area_of_reference():
    grid = {"vesicles": {"placement": "grid", "count": 2, "area_fraction": 0.1}}
    problem = build(scene_of(grid))
    assert reference_area(problem)[0] == pytest.approx(area(problem.X).sum() / 0.1)
    assert reference_area(build(scene_of(grid, domain={"periodic": [2.0, 1.4]}, vesicles={"area_fraction": None})))[0] == 2.8
    walled = build(scene_of(STILL, walls={"kind": "circle", "radius": 1.2, "omega": 5.0, "spacing": 0.1}))
    assert reference_area(walled)[0] == pytest.approx(np.pi * 1.2**2, rel=1e-3)
    pair = build(scene_of(PAIR))
    assert reference_area(pair)[0] == pytest.approx(area(pair.X).sum())
    assert not reference_area(pair)[2]


def test_another_viscosity_inside():
    X = np.stack([rotate(ellipse(64, 0.3, 0.1), 0.4), circle(64, 0.2)])
    E, spin = np.array([[0.7, 2.0], [2.0, -0.7]]), np.array([[0.0, -3.0], [3.0, 0.0]])
    u = (E + spin) @ X + np.array([[4.0], [5.0]])
    S = contrast_stresslets(X, u, np.array([3.0, 0.5]), 2.0)
    assert S[0] == pytest.approx(2 * 2.0 * 2.0 * np.pi * 0.03 * E, abs=1e-12)  # 2 (lambda - 1) mu A E
    assert S[1] == pytest.approx(2 * -0.5 * 2.0 * np.pi * 0.04 * E, abs=1e-12)
    problem = build(scene_of(vesicles={"contrast": 4.0, "points": 64}))
    at = instant(problem, problem.X)
    flux = np.einsum("mik,mjk,mk->mij", at.velocity, normal(at.X), arclength_weights(at.X))
    expected = -moments(at.X, at.force) + 3.0 * (flux + np.swapaxes(flux, 1, 2))
    assert row(problem, ["stresslet"])["stresslet"][0] == pytest.approx(expected[0].ravel()[[0, 1, 3]], rel=1e-9)


def test_stress_of_repulsion():
    X = np.stack([perturbed(64, 0.8, seed=1), perturbed(64, 0.8, seed=2) + np.array([[0.43], [0.03]])])
    repulsion = Repulsion(0.12, 1e3)
    each, whole = repulsive_stress(repulsion, X, None)
    f = repulsion.force(X)
    r = X - X.mean(axis=(0, 2))[:, None]
    moment = np.einsum("mik,mjk,mk->ij", r, f, arclength_weights(X))
    assert np.abs(moment).max() > 1.0
    assert whole == pytest.approx(-moment, rel=1e-9, abs=1e-9 * np.abs(moment).max())  # symmetric: pairs of forces have no torque
    assert np.linalg.eigvalsh(whole).max() < 1e-9  # what is pushed apart carries pressure
    own = -np.einsum("mik,mjk,mk->mij", X - centroid(X)[..., None], f, arclength_weights(X))
    assert each == pytest.approx(0.5 * (own + np.swapaxes(own, 1, 2)), rel=1e-12)
    image = X.copy()
    image[1] += np.array([[5.0], [0.0]])
    box = Lattice(5.0, 4.0)
    assert repulsive_stress(repulsion, image, box)[1] == pytest.approx(whole, rel=1e-9, abs=1e-9 * np.abs(whole).max())
    none = repulsive_stress(replace(repulsion, reach=1e-4), X, None)
    assert not none[0].any()
    assert not none[1].any()


def test_repulsion_is_part_of_the_stress():
    close = {"vesicles": {"centers": [[-0.13, 0.0], [0.13, 0.0]], "angles": [1.57, 1.57], "points": 32}}
    problem = build(scene_of(close, solver={"repulsion": {"reach": 0.1, "strength": 1e4}}))
    values, at = row(problem, ["stress", "stresslet"]), instant(problem, problem.X)
    r = at.X - at.X.mean(axis=(0, 2))[:, None]
    whole = -np.einsum("mik,mjk,mk->ij", r, at.force, arclength_weights(at.X)) / area(at.X).sum()
    assert values["stress"] == pytest.approx(whole.ravel()[[0, 1, 3]], rel=1e-9)
    assert values["stress"] * area(at.X).sum() != pytest.approx(values["stresslet"].sum(axis=0), rel=1e-2)


def test_images_of_a_periodic_box_stand_for_each_other():
    pair = {"vesicles": {"centers": [[-0.2, 0.1], [0.3, -0.2]], "angles": [0.3, 1.2], "points": 32}}
    problem = build(scene_of(pair, domain={"periodic": [0.9, 0.8]}, solver={"repulsion": {"reach": 0.15, "strength": 1e4}}))
    names = ["stress", "stresslet", "effective_viscosity", "smallest_gap", "nearest_distance", "pair_distance", "tank_treading_frequency"]
    moved = problem.X + np.array([[[0.0], [0.8]], [[1.8], [0.0]]])
    a, b = row(problem, names), row(problem, names, moved)
    for name in names:
        assert b[name] == pytest.approx(a[name], rel=1e-8), name
    assert a["effective_viscosity"] == pytest.approx(1 + a["stress"][1] / 100.0, rel=1e-12)


def test_tangents_of_tension_are_those_of_the_membrane():
    """A tension of 1 alone has the trace length, whatever the shape."""
    X = perturbed(64, 0.65, seed=5)[None]
    S = stresslets(X, np.ones((1, 64)), 0.0)
    assert np.trace(S[0]) == pytest.approx(length(X)[0], rel=1e-12)
    t = tangent(X)
    assert S[0, 0, 0] == pytest.approx((t[0, 0] ** 2 * arclength_weights(X)[0]).sum(), rel=1e-12)
