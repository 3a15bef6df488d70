"""What the measurements of docs/contrast.md rest on: when a vesicle rests or turns over, bisection, and the theory of an ellipse."""

from dataclasses import replace

import measure_contrast
import numpy as np
import pytest
from scene_helpers import scene_of
from studies.turning import WINDOW, Turned, angles, in_shear, twice_in_shear

from biem.curves.shapes import ellipse, place
from biem.run.simulate import simulate
from biem.scene.build import build
from biem.stokes.quadrature import full_matrix, single_layer_blocks


def at(angle):
    return place(ellipse(32, 0.8), np.zeros(2), angle)[None]


def told(ending, path, step=0.5):
    """The time at which the ending says True to a vesicle of these angles."""
    for k, angle in enumerate(path):
        if ending(k * step, at(angle)):
            return k * step
    return None


def test_a_vesicle_at_rest_and_one_that_turns_over():
    times = np.arange(0, 60, 0.5)
    assert told(Turned(1.0), 0.3 * np.exp(-times)) == pytest.approx(WINDOW + 6, abs=2)
    turning = 0.3 - 0.4 * times
    assert told(Turned(1.0), turning) == pytest.approx(np.pi / 0.4, abs=0.5)
    assert told(Turned(1.0, 2), turning) == pytest.approx(2 * np.pi / 0.4, abs=0.5)
    assert told(Turned(2.0), 0.3 + 1e-5 * times) == pytest.approx(2 * WINDOW, abs=0.5)  # times count in t_gamma
    assert told(Turned(1.0), 0.3 - 2e-4 * times) is None  # slow, but not at rest


def test_a_run_that_goes_on_knows_its_frames():
    done = simulate(scene_of(vesicles={"shape": "ellipse"})).trajectory
    scene = scene_of(vesicles={"shape": "ellipse"})
    unit = build(scene).flow.time_scale
    assert angles(done).shape == (len(done),)
    X = np.stack([at(-0.4 * k) for k in range(12)])
    earlier = replace(done, X=X, t=0.1 * unit * np.arange(12))
    assert angles(earlier)[-1] == pytest.approx(-4.4, abs=1e-6)
    assert in_shear(scene, earlier)(1.2 * unit, at(-4.6))
    assert not twice_in_shear(scene, earlier)(1.2 * unit, at(-4.6))


def test_bisection():
    assert float(measure_contrast._bisected(lambda contrast: contrast < 4.07, 3.0, 5.0)) == pytest.approx(4.07, abs=0.02)
    assert "not between" in measure_contrast._bisected(lambda contrast: contrast < 2.0, 3.0, 5.0)


def test_theory_of_an_ellipse():
    """3 is the critical contrast of semi-axes 3 and 1, as B says in closed form; K is the moment of the tractions on a rigid ellipse."""
    assert measure_contrast.keller_skalak(measure_contrast.ASPECT_3) == pytest.approx(3.0, abs=1e-5)
    n, a, b = 256, 1.0, 0.4
    t = 2 * np.pi * np.arange(n) / n
    x, y = a * np.cos(t), b * np.sin(t)
    ds = np.hypot(a * np.sin(t), b * np.cos(t)) * 2 * np.pi / n
    r = (a * a - b * b) / (a * a + b * b)  # angular velocity in the strain (y, x), without torque
    f = np.linalg.lstsq(
        full_matrix(single_layer_blocks(np.stack([x, y])[None]))[0], np.concatenate([-(1 + r) * y, (r - 1) * x]), rcond=1e-12
    )
    fx, fy = f[0].reshape(2, n)
    assert abs((ds * (x * fy - y * fx)).sum()) < 1e-10
    assert -0.5 * (ds * (fx * y + fy * x)).sum() / (np.pi * a * b) == pytest.approx(2 * (a + b) ** 2 / (a * a + b * b), rel=1e-9)
