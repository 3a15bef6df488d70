"""Vesicles between walls: exact rigid rotation, the two solvers in one limit, area kept, repulsion and guard at walls."""

import numpy as np
import pytest
from helpers import rotate

from biem.curves.curve import area, length
from biem.errors import NumericalFailure
from biem.run.simulate import simulate
from biem.scene.config import make_scene

COUETTE = {"kind": "couette", "radius": 1.6, "inner_radius": 0.7, "capillary": 5.0}
BESIDE = {"centers": [[1.1, 0.0]], "points": 32}


def run(walls, vesicles, dt="0.02 t_gamma", horizon="0.4 t_gamma", kind="split", order=1, output=None, **solver):
    table = {
        "name": "confined",
        "vesicles": vesicles,
        "walls": walls,
        "time": {"dt": dt, "horizon": horizon, "order": order},
        "solver": {"kind": kind, **solver},
    }
    return simulate(make_scene(table), output)


@pytest.mark.parametrize("kind", ["implicit", "split"])
def test_vesicles_turn_rigidly_with_a_cylinder(kind):
    """At equilibrium in a fluid that turns as a solid body nothing deforms: X(t) is X(0) turned by omega t."""
    cylinder, inside = {"kind": "circle", "radius": 1.0, "omega": 40.0}, {"centers": [[0.3, 0.2]], "points": 48}
    errors = []
    for dt in (0.02, 0.01):
        X = run(cylinder, inside, f"{dt} t_gamma", kind=kind, order=2).trajectory.X
        errors.append(np.abs(X[-1] - rotate(X[0], 0.4)).max())
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < 1e-3


@pytest.fixture(scope="module")
def limits():
    """Shapes after 0.4 t_gamma in a Couette device, by either solver, dt and half of it, order 2."""
    way = lambda kind, dt: run(COUETTE, BESIDE, dt, kind=kind, order=2).trajectory.X[-1]
    return {(kind, dt): way(kind, f"{dt} t_gamma") for kind in ("implicit", "split") for dt in (0.04, 0.02)}


def test_both_solvers_have_one_limit(limits):
    apart = [np.abs(limits["implicit", dt] - limits["split", dt]).max() for dt in (0.04, 0.02)]
    assert apart[1] < 0.4 * apart[0]
    assert apart[1] < 2e-4


def test_a_vesicle_in_a_couette_device_keeps_area_and_length_by_itself():
    drift = []
    for dt in ("0.02 t_gamma", "0.01 t_gamma"):
        X = run(COUETTE, BESIDE, dt, kind="split", order=2, corrections=["redistribute"]).trajectory.X
        drift.append(max(abs(float(measure(X[-1])[0] / measure(X[0])[0]) - 1) for measure in (area, length)))
    assert drift[1] < 2e-4
    assert drift[1] < 0.4 * drift[0]


def test_corrected_area_is_kept_exactly():
    X = run(COUETTE, BESIDE).trajectory.X
    assert abs(float(area(X[-1])[0] / area(X[0])[0]) - 1) < 1e-9


def test_more_wall_nodes_change_nothing():
    two = [run({**COUETTE, "spacing": s}, BESIDE, horizon="0.2 t_gamma").trajectory.X[-1] for s in (1 / 16, 1 / 32)]
    assert np.abs(two[0] - two[1]).max() < 1e-9


def test_walls_are_factorised_once_and_only_where_there_are_some():
    counts = run(COUETTE, BESIDE, horizon="0.1 t_gamma").counts
    assert counts["wall_factorization"] == 1
    assert counts["wall_velocity"] > 10
    scene = {"name": "open", "vesicles": {"points": 16}, "flow": {"kind": "shear", "rate": 1.0}, "time": {"dt": 1e-3, "horizon": 2e-3}}
    assert not [name for name in simulate(make_scene(scene)).counts if "wall" in name]


def test_a_step_through_a_wall_is_rejected():
    """The velocity is along the cylinders: a long step along it leaves the circle."""
    with pytest.raises(NumericalFailure, match="vesicle 0 crosses a wall"):
        run(COUETTE, BESIDE, "1 t_gamma", "5 t_gamma", max_error=1e3, corrections=[])


def test_repulsion_keeps_off_walls():
    """Of two vesicles at rest beside a wall, the one that it repels moves away."""
    walls = {"kind": "channel", "length": 4.0, "width": 0.3}
    start = {"centers": [[0.0, 0.3 - 0.092 - 0.01]], "points": 64}
    free = run(walls, start, 1e-6, 5e-6).trajectory
    kept = run(walls, start, 1e-6, 5e-6, repulsion={"reach": 0.05, "strength": 2e5}).trajectory
    gap = lambda trajectory: trajectory.diagnostics["min_gap"]
    assert gap(free)[0] == gap(kept)[0] < 0.05
    assert gap(kept)[-1] > gap(free)[-1] + 1e-5
    assert kept.diagnostics["repulsion_work"][-1] > 0
