"""Background flows: their formulas, incompressibility, NumPy against PyTorch, strengths given in several ways."""

import numpy as np
import pytest
import torch
from scene_helpers import scene_of

from biem.curves.curve import area
from biem.scene.build import build
from biem.scene.flows import make_flow

RATE, W = 3.0, 0.7
X = np.random.default_rng(0).uniform(-1.0, 1.0, size=(2, 2, 5))
x, y = X[:, 0], X[:, 1]
U = RATE * W  # u_max in Poiseuille flow, U of Taylor-Green: rate = U/W
R2 = x**2 + y**2
FORMULAS = {
    "quiescent": (0 * x, 0 * x),
    "shear": (RATE * y, 0 * x),
    "extensional": (RATE * x, -RATE * y),
    "poiseuille": (U * (1 - (y / W) ** 2), 0 * x),
    "taylor_green": (U * np.sin(np.pi * x / W) * np.cos(np.pi * y / W), -U * np.cos(np.pi * x / W) * np.sin(np.pi * y / W)),
    "rotation": (-RATE * W**2 * y / R2, RATE * W**2 * x / R2),
}


@pytest.mark.parametrize("kind", FORMULAS)
def test_velocity_is_the_formula(kind):
    u = make_flow(kind, RATE, W).velocity(X, 0.0)
    assert u.shape == X.shape
    assert np.abs(u - np.stack(FORMULAS[kind], axis=1)).max() < 1e-14
    assert make_flow(kind, -RATE, W).time_scale == (None if kind == "quiescent" else 1 / RATE)


@pytest.mark.parametrize("kind", FORMULAS)
def test_divergence_is_zero(kind):
    velocity, h = make_flow(kind, RATE, W).velocity, 1e-5
    along_x, along_y = np.array([h, 0.0])[:, None], np.array([0.0, h])[:, None]
    u_x, u_y = [(velocity(X + d, 0.0) - velocity(X - d, 0.0)) / (2 * h) for d in (along_x, along_y)]
    assert np.abs(u_x[:, 0] + u_y[:, 1]).max() < 1e-7 * max(1.0, np.abs(u_x).max())
    if kind == "rotation":
        assert np.abs(u_x[:, 1] - u_y[:, 0]).max() < 1e-7 * np.abs(u_x).max()  # irrotational but at the origin


@pytest.mark.parametrize("kind", FORMULAS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_numpy_and_torch_agree(kind, dtype):
    velocity = make_flow(kind, RATE, W).velocity
    u = velocity(torch.from_numpy(X).to(dtype), 0.0)
    assert u.dtype == dtype
    assert np.abs(u.numpy() - velocity(X, 0.0)).max() < (1e-14 if dtype == torch.float64 else 1e-4)


def test_rotation_is_refused_where_it_is_singular():
    with pytest.raises(ValueError, match="origin"):
        make_flow("rotation", RATE, W).velocity(np.zeros((1, 2, 16)), 0.0)
    turning = {"flow": {"kind": "rotation", "width": 1.0}}
    with pytest.raises(ValueError, match="vesicle 1 covers the origin"):
        build(scene_of(turning, vesicles={"centers": [[1.0, 0.0], [0.05, 0.0]]}))
    assert build(scene_of(turning, vesicles={"centers": [[1.0, 0.0], [-1.0, 0.0]]})).X.shape[0] == 2


def in_units(flow):
    """A problem with mu, kappa_b and length away from 1, and the radius R of its vesicle."""
    units = {"physics": {"mu": 3.0, "kappa_b": 2.0}, "vesicles": {"length": 1.5}}
    problem = build(scene_of(units, flow={"rate": None, **flow}))
    return problem, np.sqrt(area(problem.X)[0] / np.pi)


@pytest.mark.parametrize("kind", ["shear", "extensional"])
def test_capillary_number_and_rate_give_the_same_flow(kind):
    problem, R = in_units({"kind": kind, "capillary": -0.3})
    by_rate, _ = in_units({"kind": kind, "rate": -0.3 * 2.0 / (3.0 * R**3)})  # Ca = mu R^3 rate / kappa_b
    assert np.allclose(problem.flow.velocity(X, 0.0), by_rate.flow.velocity(X, 0.0), rtol=1e-13, atol=0)


def test_capillary_number_and_confinement_in_poiseuille_flow():
    Ca, Cn = 8.0, 0.4
    _, R = in_units({"kind": "shear", "rate": 1.0})
    width = R / Cn
    u_max = Ca * 2.0 * width / (2 * 3.0 * R**3)  # Ca = 2 mu u_max R^3 / (kappa_b W)
    expected = u_max * (1 - (y / width) ** 2)
    for strength in ({"capillary": Ca}, {"u_max": u_max}, {"rate": u_max / width}):
        for size in ({"width": width}, {"confinement": Cn}):
            problem, _ = in_units({"kind": "poiseuille", **strength, **size})
            assert np.allclose(problem.flow.velocity(X, 0.0)[:, 0], expected, rtol=1e-12, atol=0)
            assert problem.flow.time_scale == pytest.approx(2 * 3.0 * R**3 / (2.0 * Ca), rel=1e-12)  # W/u_max, whatever Cn is


@pytest.mark.parametrize(
    ("flow", "fragment"),
    [
        ({"rate": 1.0, "capillary": 2.0}, "flow.rate and flow.capillary"),
        ({"kind": "poiseuille", "rate": None, "u_max": 1.0, "capillary": 2.0, "width": 1.0}, "flow.u_max and flow.capillary"),
        ({"kind": "poiseuille", "width": 1.0, "confinement": 0.4}, "flow.width and flow.confinement"),
        ({"kind": "poiseuille"}, "needs a width"),
        ({"kind": "taylor_green", "rate": None, "u_max": 1.0}, "needs a width"),
        ({"kind": "rotation"}, "needs a width"),
        ({"rate": None}, "needs a rate"),
        ({"rate": None, "u_max": 1.0}, "flow.u_max"),
        ({"width": 1.0}, "no width"),
        ({"confinement": 0.2}, "no width"),
        ({"kind": "quiescent"}, "quiescent"),
        ({"function": "m.f"}, "flow.function"),
        ({"kind": "custom", "rate": None}, "function"),
    ],
)
def test_strengths_and_widths_that_contradict_are_refused(flow, fragment):
    with pytest.raises(ValueError, match=fragment.replace(".", r"\.")):
        build(scene_of(flow=flow))
