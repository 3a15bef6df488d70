"""The table [walls]: what each kind takes and drives, what is refused, and where vesicles may be."""

import numpy as np
import pytest
import shapely
from scene_helpers import DT, cli, the_error

from biem.curves.crossing import polygons
from biem.scene.build import build
from biem.scene.config import make_scene


def scene(walls, vesicles=None, folder=".", **more):
    table = {
        "name": "walled",
        "vesicles": {"reduced_area": 0.8, "points": 16, **(vesicles or {})},
        "walls": walls,
        "time": {"dt": DT, "horizon": 4 * DT},
        "solver": {"kind": "split"},
        **more,
    }
    return make_scene(table, folder)


def problem(*args, **more):
    return build(scene(*args, **more))


def refused(*args, **more):
    with pytest.raises(ValueError) as caught:
        problem(*args, **more)
    message = str(caught.value)
    assert "\n" not in message
    return message


CIRCLE = {"kind": "circle", "radius": 1.5, "omega": 3.0}
COUETTE = {"kind": "couette", "radius": 2.0, "inner_radius": 1.0, "omega": -2.0, "inner_omega": 1.0}
CHANNEL = {"kind": "channel", "length": 6.0, "width": 0.8, "u_max": 5.0}
BESIDE = {"centers": [[1.5, 0.0]]}
ROCK = {"shape": "circle", "center": [0.8, 0.0], "size": 0.2}


def at(p, *points):
    return p.flow.velocity(np.array([points], dtype=float).transpose(0, 2, 1), 0.0)[0].T


def test_a_turning_cylinder_turns_its_fluid():
    p = problem(CIRCLE)
    assert p.flow.time_scale == pytest.approx(1 / 3)
    assert np.abs(at(p, (0.4, -0.2), (0.0, 1.49)) - 3.0 * np.array([[0.2, 0.4], [-1.49, 0.0]])).max() < 1e-9


def test_couette_rate_is_the_shear_rate_half_way():
    p = problem(COUETTE, BESIDE)
    r, h = 1.5, 1e-4
    u = at(p, (r - h, 0.0), (r + h, 0.0))[:, 1] / np.array([r - h, r + h])
    assert abs(r * (u[1] - u[0]) / (2 * h)) == pytest.approx(1 / p.flow.time_scale, rel=1e-6)


def test_channel_drives_poiseuille_flow():
    p = problem(CHANNEL)
    y = np.array([0.0, 0.3, -0.7])
    u = at(p, *[(0.5, v) for v in y])
    assert np.abs(u - np.stack([5.0 * (1 - (y / 0.8) ** 2), 0 * y], axis=1)).max() < 1e-7
    assert p.flow.time_scale == pytest.approx(0.8 / 5.0)


@pytest.mark.parametrize("walls", [CIRCLE, {**COUETTE, "inner_omega": None}, CHANNEL])
def test_capillary_number_sets_the_rate(walls):
    table = {k: v for k, v in walls.items() if k not in ("omega", "inner_omega", "u_max")}
    p = problem({**table, "capillary": 4.0}, BESIDE if walls["kind"] == "couette" else None)
    factor = 2.0 if walls["kind"] == "channel" else 1.0
    assert factor * p.radius**3 / p.flow.time_scale == pytest.approx(4.0, rel=1e-4)


def test_obstacles_turn_about_their_centers():
    p = problem({**CIRCLE, "omega": 0.0, "obstacles": [{**ROCK, "omega": 7.0}]})
    assert p.flow.time_scale == pytest.approx(1 / 7)
    beside = at(p, (0.8 + 0.2 + 1e-9, 0.0))[0]
    assert np.abs(beside - [0.0, 1.4]).max() < 1e-6


def test_walls_at_rest_drive_nothing():
    p = problem({"kind": "circle", "radius": 1.0})
    assert p.flow.kind == "quiescent"
    assert p.walls is not None


def test_a_file_of_points_is_the_curve_through_them(tmp_path):
    t = 2 * np.pi * np.arange(40) / 40
    outer = np.stack([1.5 * np.cos(t), np.sin(t)], axis=1)
    body = np.stack([0.9 + 0.2 * np.cos(-t), 0.1 + 0.1 * np.sin(-t)], axis=1)  # clockwise
    text = "\n\n".join("\n".join(f"{x:.17g} {y:.17g}" for x, y in curve) for curve in (outer, body))
    (tmp_path / "walls.txt").write_text(text + "\n")
    p = problem({"kind": "file", "file": "walls.txt", "omega": 0.5}, {"length": 0.5}, tmp_path)
    assert len(p.walls.curves) == 2
    assert p.region.area == pytest.approx(np.pi * (1.5 - 0.02), rel=1e-5)
    for X, (a, b, x0, y0) in zip(p.walls.curves, ((1.5, 1.0, 0.0, 0.0), (0.2, 0.1, 0.9, 0.1)), strict=True):
        assert np.abs(((X[0] - x0) / a) ** 2 + ((X[1] - y0) / b) ** 2 - 1).max() < 1e-6


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2\n3 4\n", "2 points"),
        ("1 2 3\n" * 16, "3 columns"),
        ("a b\n" * 16, "two columns"),
        ("", "no points"),
        ("\n".join(f"{np.cos(t)} {np.sin(t) if k else np.nan}" for k, t in enumerate(np.arange(16) * np.pi / 8)), "point 0 is [1.0, nan]"),
        ("\n".join(f"{x} {y}" for x, y in np.random.default_rng(0).normal(size=(32, 2))), "do not resolve"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, words):
    (tmp_path / "walls.txt").write_text(text)
    message = refused({"kind": "file", "file": "walls.txt"}, folder=tmp_path)
    assert words in message
    assert "walls.txt" in message


def test_a_missing_file_is_refused(tmp_path):
    assert "does not exist" in refused({"kind": "file", "file": "none.txt"}, folder=tmp_path)


@pytest.mark.parametrize(
    ("walls", "words"),
    [
        ({"kind": "circle"}, "needs walls.radius"),
        ({"kind": "couette", "radius": 2.0}, "needs walls.inner_radius"),
        ({**CIRCLE, "u_max": 1.0}, "walls.u_max does not go with"),
        ({**CIRCLE, "capillary": 1.0}, "both set the strength"),
        ({**COUETTE, "inner_radius": 3.0}, "below walls.radius"),
        ({**CHANNEL, "length": 1.0}, "twice walls.width"),
        ({**CIRCLE, "obstacles": [ROCK, {**ROCK, "center": [0.7, 0.2]}]}, "walls.obstacles.0 and walls.obstacles.1 overlap"),
        ({**CIRCLE, "obstacles": [{**ROCK, "center": [1.4, 0.0]}]}, "walls.obstacles.0 is not inside"),
        ({**COUETTE, "obstacles": [{**ROCK, "center": [0.0, 0.9]}]}, "inner wall 1 and walls.obstacles.0 overlap"),
        ({**CIRCLE, "radus": 2.0}, "did you mean radius"),
        ({**CIRCLE, "obstacles": [{**ROCK, "sise": 2.0}]}, "did you mean size"),
        ({"kind": "sphere"}, "walls.kind"),
        ({**CIRCLE, "radius": 1e9}, "enlarge walls.spacing"),
    ],
)
def test_bad_tables_are_refused(walls, words):
    assert words in refused(walls)


def test_a_second_source_of_flow_is_refused():
    assert "remove [flow]" in refused(CIRCLE, flow={"kind": "shear", "rate": 1.0})


@pytest.mark.parametrize(("center", "where"), [([1.5, 0.0], "crosses"), ([5.0, 0.0], "beyond"), ([0.8, 0.0], "around a body")])
def test_vesicles_outside_the_fluid_are_refused(center, where):
    assert "vesicle 0 is not between the walls" in refused({**CIRCLE, "obstacles": [{**ROCK, "size": 0.05}]}, {"centers": [center]})


@pytest.mark.parametrize("amount", [{"count": 12}, {"area_fraction": 0.12}])
def test_random_placement_fills_the_fluid(amount):
    walls = {**CIRCLE, "obstacles": [ROCK, {**ROCK, "center": [-0.5, 0.3], "shape": "polygon", "size": 0.3}]}
    p = problem(walls, {"placement": "random", "gap": 0.03, **amount})
    shapes = polygons(p.X)
    assert shapely.contains_properly(p.region.buffer(-0.029), shapes).all()
    near = shapely.distance(shapes[:, None], shapes[None, :]) + np.eye(len(shapes))
    assert near.min() > 0.029
    if "area_fraction" in amount:
        assert shapely.area(shapes).sum() / p.region.area == pytest.approx(0.12, rel=0.08)
    spread = np.array([[s.centroid.x, s.centroid.y] for s in shapes])
    assert np.ptp(spread, axis=0).min() > 1.2


def test_random_placement_says_what_it_needs():
    assert "one of them" in refused(CIRCLE, {"placement": "random", "count": 3, "area_fraction": 0.1})
    assert "do not fit" in refused(CIRCLE, {"placement": "random", "count": 500})


def test_the_command_says_it_in_one_line(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('[time]\ndt = 1.0\nhorizon = 1.0\n[walls]\nkind = "circle"\n')
    assert "needs walls.radius" in the_error(cli("plan", path), 2)


def test_walls_that_the_memory_does_not_hold_are_refused_before_they_are_built(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('[time]\ndt = 1.0\nhorizon = 1.0\n[walls]\nkind = "circle"\nradius = 1.0\nspacing = 2e-4\n[vesicles]\npoints = 16\n')
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5"), 2)
    assert "a larger walls.spacing (the walls have 31416 nodes)" in message
