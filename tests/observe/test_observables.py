"""Observables by their definitions: known shapes and motions, periodic boxes, names and what scenes do not have."""

from pathlib import Path

import numpy as np
import pytest
from helpers import ellipse, nodes, rotate
from scene_helpers import PAIR, scene_of

from biem.curves.curve import centroid, normal
from biem.curves.lattice import Lattice
from biem.observe import motion
from biem.observe.observables import Observer
from biem.observe.quantities import QUANTITIES, select
from biem.scene.build import build

ROOT = Path(__file__).parents[2]
CHANNEL = {"flow": {"kind": "poiseuille", "rate": 100.0, "width": 0.8}}
FOUR = {"vesicles": {"placement": "grid", "count": 4, "area_fraction": 0.2}}
BOX = {"vesicles": {"placement": "grid", "count": 4, "area_fraction": None, "box": [3.0, 2.0]}}
WALLS = {"walls": {"kind": "circle", "radius": 1.2, "omega": 5.0, "spacing": 0.1}}


def of(X, name, *changes, **more):
    """The value of a quantity for membranes X in place of the scene's."""
    problem = build(scene_of(*changes, more))
    return Observer.of(problem, [name]).row(X, 0.0, 0).values[name][0]


def curves(*parts):
    """(M, 2, N) of ellipses given by half axes, angle, centre."""
    return np.stack([rotate(ellipse(64, a, b), angle) + np.asarray(c)[:, None] for a, b, angle, c in parts])


def arcs(*axes):
    """ds (M, 64) of ellipses given by half axes."""
    a, b = np.array(axes).T[..., None]
    return np.hypot(a * np.sin(nodes(64)), b * np.cos(nodes(64))) * 2 * np.pi / 64


def test_shape_of_an_ellipse():
    X = curves((0.3, 0.1, 0.4, (3.0, -2.0)))
    assert of(X, "area") == pytest.approx([np.pi * 0.03], rel=1e-12)
    assert of(X, "deformation") == pytest.approx([0.5], rel=1e-12)
    assert of(X, "inclination") == pytest.approx([0.4], rel=1e-12)
    assert of(X, "centroid")[0] == pytest.approx([3.0, -2.0], abs=1e-13)
    perimeter = of(X, "length")[0]
    assert perimeter == pytest.approx(1.336489, abs=1e-6)  # 4 a E(e)
    assert of(X, "reduced_area") == pytest.approx([4 * np.pi * np.pi * 0.03 / perimeter**2], rel=1e-12)


def test_bending_energy_of_a_circle():
    X = curves((0.2, 0.2, 0.0, (0.0, 0.0)))
    assert of(X, "bending_energy", physics={"kappa_b": 3.0}) == pytest.approx([3.0 * np.pi / 0.2], rel=1e-12)


def test_rigid_motion():
    X = curves((0.3, 0.1, 0.4, (3.0, -2.0)), (0.2, 0.15, 1.0, (0.0, 1.0)))
    c, omega, v = centroid(X), np.array([2.0, -3.0]), np.array([[1.0, 5.0], [-2.0, 0.5]])
    r = X - c[..., None]
    u = v[..., None] + omega[:, None, None] * np.stack([-r[:, 1], r[:, 0]], axis=1)
    assert motion.centroid_velocity(X, u) == pytest.approx(v, abs=1e-12)
    nu = of(X, "reduced_area", PAIR)
    assert motion.tank_treading_frequency(X, u) == pytest.approx(omega * nu, abs=1e-12)
    f = np.stack([np.cos(nodes(64)), np.sin(nodes(64))])[None] * normal(X)
    assert motion.power(X, f, 0 * u + v[..., None]) == pytest.approx(
        ((f * v[..., None]).sum(1) * arcs((0.3, 0.1), (0.2, 0.15))).sum(1), rel=1e-12
    )


def test_going_round_a_circle():
    X = curves((0.2, 0.2, 0.0, (1.0, 0.0)))
    around = np.stack([-np.sin(nodes(64)), np.cos(nodes(64))])[None]
    assert motion.tank_treading_frequency(X, 0.2 * 7.0 * around) == pytest.approx([7.0], rel=1e-12)
    assert motion.tank_treading_frequency(X, 0.0 * around + 5.0) == pytest.approx([0.0], abs=1e-12)


def test_velocity_is_the_rate_of_the_centroid():
    X, t = curves((0.3, 0.1, 0.4, (3.0, -2.0))), nodes(64)
    u = np.stack([np.cos(2 * t) + 0.3, np.sin(3 * t) * np.cos(t)])[None]
    flux = (u * normal(X)).sum(1) * arcs((0.3, 0.1))
    u -= flux.sum() / arcs((0.3, 0.1)).sum() * normal(X)  # keeps the area, as a fluid does
    moved = (centroid(X + 1e-6 * u) - centroid(X - 1e-6 * u)) / 2e-6
    assert motion.centroid_velocity(X, u) == pytest.approx(moved, rel=1e-8)


def test_displacements_are_from_the_first_frame():
    problem = build(scene_of(PAIR))
    observer = Observer.of(problem, ["mean_square_displacement"])
    assert observer.row(problem.X, 0.0, 0).values["mean_square_displacement"].tolist() == [[0.0, 0.0]]
    moved = problem.X + np.array([[0.3, -0.4], [-0.1, 0.2]])[..., None]
    assert observer.row(moved, 1.0, 1).values["mean_square_displacement"][0] == pytest.approx([0.05, 0.1], rel=1e-12)


def test_distances():
    X = curves((0.2, 0.2, 0.0, (0.0, 0.0)), (0.2, 0.2, 0.0, (0.7, 0.0)), (0.2, 0.2, 0.0, (0.0, 1.0)))
    three = {"vesicles": {"centers": [[0, 0], [1, 0], [2, 0]], "angles": [1.5, 1.5, 1.5]}}
    assert of(X, "pair_distance", three) == pytest.approx([0.7, 1.0, np.hypot(0.7, 1.0)])
    assert of(X, "nearest_distance", three) == pytest.approx([0.7, 0.7, 1.0])
    assert of(X, "smallest_gap", three) == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize("lattice", [(2.4, 1.1), (2.4, 1.1, 0.7), (2.4, 1.1, -1.1), (5.0, 0.7, 1.25), (6.0, 0.6, -2.4), (0.7, 5.0, 0.3)])
def test_nearest_images(lattice):
    lattice = Lattice(*lattice)
    c = np.random.default_rng(0).uniform(-4.0, 4.0, (6, 2))
    shifts = np.array([m * lattice.vectors[0] + n * lattice.vectors[1] for m in range(-15, 16) for n in range(-15, 16)])
    i, j = motion.pairs(6).T
    every = np.hypot(*np.moveaxis((c[i] - c[j])[:, None] + shifts, -1, 0))
    assert motion.pair_distances(c, lattice) == pytest.approx(every.min(axis=1), rel=1e-12)
    to_others = np.where(np.eye(6, dtype=bool), np.inf, 0.0)
    to_others[i, j] = to_others[j, i] = every.min(axis=1)
    own = np.hypot(*shifts[np.abs(shifts).sum(1) > 0].T).min()
    assert motion.nearest_distances(c, lattice) == pytest.approx(np.minimum(to_others.min(axis=1), own), rel=1e-12)


def test_distances_in_a_sheared_box_are_those_of_its_time():
    pair = {"vesicles": {"centers": [[0.0, 0.6], [0.1, -0.55]], "angles": [0.0, 0.0]}, "domain": {"periodic": [2.0, 1.6]}}
    problem = build(scene_of(pair))
    observer = Observer.of(problem, ["pair_distance", "nearest_distance"])
    for t in (0.0, 0.003, 0.011):  # the row above has moved on by 160 t, by multiples of 2 less
        across = np.hypot((0.1 + 160.0 * t + 1.0) % 2.0 - 1.0, 0.45)
        values = observer.row(problem.X, t, 0).values
        assert values["pair_distance"][0] == pytest.approx([min(across, np.hypot(0.1, 1.15))], rel=1e-9)
        assert values["nearest_distance"][0] == pytest.approx([min(across, np.hypot(0.1, 1.15))] * 2, rel=1e-9)


def test_across_a_channel():
    X = curves((0.1, 0.1, np.pi / 64, (0.0, -0.75)), (0.1, 0.05, 0.0, (5.0, 0.1)), (0.1, 0.1, 0.0, (0.0, 0.3)), (0.1, 0.1, 0.0, (0.0, 0.3)))
    problem = build(scene_of(CHANNEL, FOUR))
    observer = Observer.of(problem, ["lateral_distribution", "cell_free_layer"], bins=4)
    assert observer.edges == pytest.approx([-0.8, -0.4, 0.0, 0.4, 0.8])
    values = observer.row(X, 0.0, 0).values
    assert values["lateral_distribution"][0] == pytest.approx(np.array([1, 0, 3, 0]) / (4 * 0.4))
    assert values["cell_free_layer"][0] == pytest.approx(-0.05)  # one is beyond y = -W


def test_share_of_vesicles_outside_all_bins_is_missing():
    assert motion.lateral_distribution(np.array([-2.0, 0.1, 0.2, 5.0]), np.array([-1.0, 0.0, 1.0])).tolist() == [0.0, 0.5]


def test_velocity_profile_is_a_mean_over_arcs():
    X, edges = curves((0.2, 0.2, 0.0, (0.0, 0.0)), (0.1, 0.1, 0.0, (3.0, 0.0))), np.array([-0.5, -0.25, 0.25, 0.5])
    u = np.stack([np.full((2, 64), 1.0), np.zeros((2, 64))], axis=1) * np.array([1.0, 4.0])[:, None, None]
    profile = motion.velocity_profile(X, u, edges)
    assert profile[1] == pytest.approx((0.2 * 1.0 + 0.1 * 4.0) / 0.3)
    assert np.isnan(profile[[0, 2]]).all()


def test_layer_between_walls():
    problem = build(scene_of(WALLS, flow={"kind": "quiescent", "rate": None}))
    outermost = np.hypot(*problem.X[0]).max()
    values = Observer.of(problem, ["cell_free_layer", "smallest_gap"]).row(problem.X, 0.0, 0).values
    assert values["cell_free_layer"][0] == pytest.approx(1.2 - outermost, rel=1e-9)
    assert values["smallest_gap"][0] == values["cell_free_layer"][0]


def test_unknown_names_are_refused_with_the_nearest():
    problem = build(scene_of())
    with pytest.raises(ValueError, match=r'^unknown quantity "inclinaton": did you mean inclination\?$'):
        select(problem, ["inclinaton"])
    with pytest.raises(ValueError, match=r'^unknown quantity "xyz": there are stress, effective_viscosity'):
        select(problem, ["xyz"])
    with pytest.raises(ValueError, match="no quantity is named"):
        select(problem, [])


MISSING = (
    ("normal_stress_difference", CHANNEL, 'is defined in flow.kind = "shear" alone, this scene has "poiseuille"'),
    ("effective_viscosity", CHANNEL, "is defined in flow.kind"),
    ("effective_viscosity", PAIR, "takes an area of the suspension"),
    ("pair_distance", {}, "takes more than one vesicle"),
    ("smallest_gap", {}, "takes more than one vesicle"),
    ("velocity_profile", PAIR, "takes a width: "),
    ("cell_free_layer", PAIR, "takes a width or walls: "),
    ("pair_distance", {"vesicles": {"placement": "grid", "count": 201, "area_fraction": 0.2}}, "would be 20100 numbers a frame"),
)


@pytest.mark.parametrize(("name", "changes", "why"), MISSING)
def test_what_a_scene_does_not_have_is_refused(name, changes, why):
    problem = build(scene_of(changes))
    with pytest.raises(ValueError, match=why) as refused:
        select(problem, ["area", name])
    assert str(refused.value).startswith(name)
    assert name not in {q.name for q in select(problem)}


def test_defaults_of_a_scene():
    shear, running = ({q.name for q in select(build(scene_of(BOX)), running=r)} for r in (False, True))
    assert shear == set(QUANTITIES) - {"cell_free_layer", "lateral_distribution", "velocity_profile"}
    assert shear - running == {"smallest_gap", "velocity", "tank_treading_frequency", "power"}
    contrast = {**BOX["vesicles"], "contrast": 5.0}
    assert "stress" not in {q.name for q in select(build(scene_of(vesicles=contrast)), running=True)}  # it takes the velocity then


@pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=list(QUANTITIES))
def test_definitions_stand_in_the_documentation(quantity):
    of = f" ({', '.join(quantity.components)})" if quantity.components else ""
    definition = quantity.definition.replace("|", "\\|")
    assert f"| `{quantity.name}`{of} | {quantity.unit} | {definition} |" in (ROOT / "docs" / "observables.md").read_text()
