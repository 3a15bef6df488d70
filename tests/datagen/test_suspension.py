"""Suspensions of the harvest: the obstacles drawn, the scenes, their shapes, a run that fails."""

import numpy as np
import pytest
import shapely
from harvest_cases import RELAXATION, SUSPENSION, R, dataset, first_task

import datagen.suspension
from biem.backend import counting
from biem.curves.crossing import polygons
from biem.curves.curve import reduced_area
from biem.errors import NumericalFailure
from biem.scene.build import build
from datagen.harvest import harvest, harvest_tasks
from datagen.suspension import GAP, draw_obstacles, draw_scene


def test_obstacles_leave_room_between_them():
    """Gaps of the bodies as the solver makes them, of all kinds; another seed, other obstacles."""
    family = dataset(SUSPENSION | {"radius": 2.0, "obstacles": 5, "vesicles": 4}).harvest[0]
    kinds = set()
    for number in range(3):
        config = dataset(family.model_dump(), seed=number)
        scene, _ = draw_scene(config, 0, 1)
        kinds |= {o.shape for o in scene.walls.obstacles}
        outer, *bodies = [polygons(X[None])[0] for X in build(scene).walls.curves]
        gaps = [shapely.distance(a, b) for i, a in enumerate(bodies) for b in [outer.exterior, *bodies[:i]]]
        assert len(gaps) == 15
        assert GAP - 1e-6 <= min(gaps) < 1.0
    assert kinds == {"circle", "ellipse", "polygon", "star"}


def test_no_room_for_obstacles():
    family = dataset(SUSPENSION | {"radius": 1.0, "obstacles": 9}).harvest[0]
    with pytest.raises(ValueError, match=r"^harvest: 9 obstacles 0.35 apart were not placed in a cylinder of radius 1 .*: take fewer"):
        draw_obstacles(family, np.random.default_rng(0))


def test_scenes_of_suspensions():
    config = dataset(SUSPENSION | {"runs": 8, "capillary": (1.0, 16.0)}, points="adaptive")
    drawn = [draw_scene(config, 0, r) for r in range(8)]
    capillary = np.array([c for _, c in drawn])
    assert np.abs(np.log2(capillary) - 0.5 * (np.arange(8) + 0.5)).max() <= 0.25
    omega = np.array([scene.walls.omega for scene, _ in drawn])
    assert np.abs(omega) * R**3 == pytest.approx(capillary)
    assert 0 < (omega > 0).sum() < 8
    problem = build(drawn[3][0])
    assert problem.X.shape == (3, 2, 64)
    assert problem.flow.time_scale == pytest.approx(1 / abs(omega[3]))
    assert problem.dt == pytest.approx(0.1 / abs(omega[3]))


def test_shard_of_a_suspension():
    config = dataset(RELAXATION, SUSPENSION)
    shard = harvest(config, harvest_tasks(config)[2])
    assert shard["X"].shape == (6, 2, 128)
    assert shard["run"].tolist() == [4] * 6
    assert shard["family"].tolist() == [1] * 6
    assert shard["time"] == pytest.approx([0.2] * 3 + [0.4] * 3)
    assert (shard["capillary"] == draw_scene(config, 1, 1)[1]).all()
    assert np.abs(reduced_area(shard["X"]) - 0.65).max() < 1e-5
    moved = np.abs(shard["X"][:3] - shard["X"][3:]).max(axis=(1, 2))
    assert moved.min() > 1e-5


def test_a_suspension_that_fails_keeps_what_came_before(monkeypatch):
    calls = iter(range(1000))

    def check(*state):
        if next(calls) >= 9:
            raise NumericalFailure("off")

    config = dataset(SUSPENSION | {"shapes": 4, "horizon": 1.6})
    whole = first_task(config)
    monkeypatch.setattr(datagen.suspension, "check_state", check)
    with counting() as counts:
        shard = first_task(config)
    assert counts["runs_ended"] == 1
    assert len(shard["X"]) == 6
    assert all(np.array_equal(shard[name], whole[name][:6]) for name in shard)
    monkeypatch.setattr(datagen.suspension, "check_state", lambda *state: check())
    assert first_task(config)["X"].shape == (0, 2, 128)
