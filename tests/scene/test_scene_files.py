"""The scenes in configs/scenes: all load and plan; the suspension in Poiseuille flow is what its header says, and is packed quickly."""

import time
from pathlib import Path

import numpy as np
import pytest
import shapely
from scene_helpers import cli

from biem.curves.crossing import pair_crossings, polygons, self_crossings
from biem.curves.curve import area, reduced_area
from biem.scene.build import build
from biem.scene.config import load_scene
from biem.scene.plan import memory_estimate, required_parts

SCENES = sorted((Path(__file__).parents[2] / "configs" / "scenes").glob("*.toml"))
POISEUILLE = next(path for path in SCENES if path.stem == "poiseuille_2000")


@pytest.mark.parametrize("path", [p for p in SCENES if p != POISEUILLE], ids=lambda path: path.stem)
def test_every_scene_plans(path):
    out = cli("plan", path, "--no-measure")
    assert out.exit_code == 0, out.output
    assert out.output.startswith(f"{path.stem}: ")
    assert load_scene(path).name == path.stem


@pytest.mark.parametrize("count", [500])
def test_the_suspension_in_poiseuille_flow_is_what_its_header_says(count):
    scene = load_scene(POISEUILLE)
    assert scene.vesicles.count == 2000
    width, height = scene.vesicles.box
    if count < 2000:  # a shorter stretch of the same channel
        scene = load_scene(POISEUILLE, [f"vesicles.count={count}", f"vesicles.box=[{width * count / 2000}, {height}]"])
    begin = time.process_time()
    problem = build(scene)
    assert time.process_time() - begin < 30 * count / 2000 + 5
    X, W = problem.X, problem.flow.width
    assert X.shape == (count, 2, 32)
    assert area(X).sum() / (scene.vesicles.box[0] * height) == pytest.approx(0.30, abs=0.005)
    assert problem.radius / W == pytest.approx(0.025, rel=1e-3)
    assert pytest.approx(5.13, abs=0.005) == W
    assert problem.flow.rate * W == pytest.approx(2430, rel=2e-3)
    assert np.allclose(reduced_area(X), 0.65, atol=1e-3)
    assert np.abs(X[:, 1]).max() <= W
    assert np.abs(X[:, 1]).max() > 0.97 * W  # and up to there
    shapes = polygons(X)
    assert not self_crossings(X, shapes)
    assert not pair_crossings(X, shapes)
    tree = shapely.STRtree(shapes)
    i, j = tree.query(shapes, predicate="dwithin", distance=0.99 * scene.vesicles.gap)
    assert (i == j).all()  # none closer than the gap
    needed = {part.name for part in required_parts(problem) if part.needed}
    assert {"advection", "far field", "near field", "vesicle-vesicle coupling"} <= needed
    assert memory_estimate(problem) < 2e9
