"""Forces and velocities at an instant: inextensible, without net force, and what small implicit steps tend to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from biem.curves.curve import area, length
from biem.membrane.operators import surface_divergence
from biem.observe.instant import instant
from biem.run.solver import make_stepper
from biem.scene.build import build
from biem.scene.config import load_scene
from biem.steppers.stepper import State

CASES = (
    ("shear_pair", ["vesicles.centers=[[-0.13, 0.02], [0.13, 0.0]]", "vesicles.angles=[1.57, 1.57]", 'vesicles.unit="length"']),
    ("shear_pair", ["solver.repulsion={reach=0.3}"]),
    ("poiseuille_single", []),
    ("relaxation", []),
    ("couette_obstacles", ["walls.spacing=0.08"]),
)


@pytest.mark.parametrize(("scene", "settings"), CASES)
def test_small_steps_tend_to_it(scene, settings):
    problem = build(load_scene(f"configs/scenes/{scene}.toml", ["vesicles.points=64", *settings, "solver.kind=implicit"]))
    at = instant(problem, problem.X)
    if problem.scene.solver.repulsion is None:  # whose kinks leave Nyquist modes
        assert np.abs(surface_divergence(problem.X, at.velocity)).max() < 3e-3 * np.abs(at.velocity).max() / problem.length
    stepper = make_stepper(replace(problem, scene=_uncorrected(problem.scene)), area(problem.X), length(problem.X))
    velocity, sigma = [], []
    for dt in (1e-4 * problem.dt, 0.5e-4 * problem.dt):
        state = stepper.step(State(0.0, problem.X), dt).state
        velocity.append((state.X - problem.X) / dt)
        sigma.append(state.sigma)
    assert np.abs(2 * velocity[1] - velocity[0] - at.velocity).max() < 2e-3 * np.abs(at.velocity).max()
    assert np.abs(2 * sigma[1] - sigma[0] - at.sigma).max() < 2e-3 * np.abs(at.sigma).max()


def _uncorrected(scene):
    return scene.model_copy(
        update={
            "solver": scene.solver.model_copy(update={"corrections": []}),
            "output": scene.output.model_copy(update={"tension": True}),
            "time": scene.time.model_copy(update={"order": 1, "adaptive": False}),
        }
    )
