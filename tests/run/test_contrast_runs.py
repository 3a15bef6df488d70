"""Scenes with a viscosity contrast: one of 1 is no contrast at all, runs resume bit for bit, what cannot be is refused in a line."""

import re

import numpy as np
import pytest
from scene_helpers import DT, PAIR, assert_same_frames, cli, scene_of, the_error, write_scene

from biem.curves.curve import area, inclination, length
from biem.membrane.operators import surface_divergence
from biem.observe.instant import instant
from biem.run.simulate import simulate
from biem.run.solver import make_stepper
from biem.scene.build import build
from biem.scene.config import load_scene
from biem.scene.plan import memory_estimate
from biem.steppers.stepper import State

SPLIT = {"solver": {"kind": "split"}}
MIXED = {"vesicles": {"contrast": [5.0, 0.2]}}
KINDS = pytest.mark.parametrize("kind", ["implicit", "split"])


def built_of_contrast(counts):
    return {name for name in counts if "double" in name or "contrast" in name}


@KINDS
@pytest.mark.parametrize("contrast", [1.0, 1, [1.0, 1]])
def test_contrast_1_changes_no_bit_and_builds_nothing(kind, contrast):
    solver = {"solver": {"kind": kind}, "time": {"horizon": 3 * DT, "order": 2}}
    plain = simulate(scene_of(PAIR, solver))
    given = simulate(scene_of(PAIR, solver, vesicles={"contrast": contrast}))
    assert_same_frames(given.trajectory, plain.trajectory)
    assert given.counts == plain.counts
    assert not built_of_contrast(given.counts)
    other = simulate(scene_of(PAIR, solver, vesicles={"contrast": 1.5}))
    assert {"contrast_matrix", "double_layer_matrix", "double_layer_sum"} <= built_of_contrast(other.counts)
    assert np.abs(other.trajectory.X[-1] - plain.trajectory.X[-1]).max() > 1e-6


@KINDS
def test_a_single_vesicle_sums_no_double_layers(kind):
    counts = simulate(scene_of({"solver": {"kind": kind}}, vesicles={"contrast": 3.0}, time={"horizon": 2 * DT})).counts
    assert built_of_contrast(counts) == {"contrast_matrix", "double_layer_matrix"}


@pytest.mark.parametrize("options", [SPLIT, {"solver": {"kind": "implicit"}}, {**SPLIT, "time": {"adaptive": True, "order": 2}}])
def test_resumed_run_is_bitwise_the_run_that_was_not_stopped(tmp_path, options):
    of = lambda steps: scene_of(PAIR, MIXED, options, time={"horizon": steps * DT})
    whole = simulate(of(6), tmp_path / "whole.h5").trajectory
    stops = [0]
    simulate(of(6), tmp_path / "parts.h5", enough=lambda t, X: stops.append(0) or len(stops) > 3)
    parts = simulate(of(6), tmp_path / "parts.h5", resume=True)
    assert len(whole) > 5
    assert_same_frames(parts.trajectory, whole)


def test_what_cannot_be_is_refused_in_one_line(tmp_path):
    path = write_scene(tmp_path, PAIR)
    refusal = lambda *settings: the_error(cli("run", path, "-o", tmp_path / "x.h5", *(w for s in settings for w in ("--set", s))), 2)
    assert "vesicles.contrast = 0: expected a positive" in refusal("vesicles.contrast=0")
    assert "vesicles.contrast = [1.0, -2.0]: expected a positive" in refusal("vesicles.contrast=[1.0, -2.0]")
    assert "vesicles.contrast has 3 entries for 2 vesicle(s)" in refusal("vesicles.contrast=[1.0, 2.0, 3.0]")
    assert "vesicles.contrast = [1.0, 2.0]: networks are for a contrast of 1" in refusal(
        "vesicles.contrast=[1.0, 2.0]", 'solver.kind="vesnet"', 'solver.maps={relax = "mlp"}'
    )
    assert not (tmp_path / "x.h5").exists()
    assert build(load_scene(path, ["vesicles.contrast=[1.0, 2.0]", 'solver.kind="vesnet"', 'solver.maps="exact"'])).contrast is not None
    assert build(load_scene(path, ["vesicles.contrast=1", 'solver.kind="vesnet"'])).contrast is None


def test_shapes_from_a_file_take_a_contrast(tmp_path):
    simulate(scene_of(PAIR, time={"horizon": DT}), tmp_path / "first.h5")
    vesicles = {"reduced_area": None, "points": None, "file": "first.h5", "contrast": [2.0, 1.0]}
    assert np.array_equal(build(scene_of(vesicles=vesicles, folder=tmp_path)).contrast, [2.0, 1.0])


@KINDS
def test_plan_says_what_a_contrast_takes(tmp_path, kind):
    plan = lambda *settings: cli("plan", write_scene(tmp_path, PAIR, {"solver": {"kind": kind}}), "--no-measure", *settings).output
    assert re.search(r" -   viscosity contrast +vesicles\.contrast = 1", plan())
    text = plan("--set", "vesicles.contrast=[0.5, 4]")
    assert re.search(r"yes  viscosity contrast +0\.5 to 4: dense operators .*direct sums of 32 double layers", text)
    many = scene_of({"solver": {"kind": "split"}}, vesicles={"placement": "grid", "count": 30, "area_fraction": 0.1})
    stiff = scene_of({"solver": {"kind": "split"}}, vesicles={"placement": "grid", "count": 30, "area_fraction": 0.1, "contrast": 4.0})
    assert memory_estimate(build(stiff)) > memory_estimate(build(many))


CLOSE = {"vesicles": {"centers": [[-0.14, 0.02], [0.14, 0.0]], "angles": [1.57, 1.57], "points": 48, "reduced_area": 0.9}}


RELAXING = {"flow": {"kind": "quiescent", "rate": None}, "vesicles": {"shape": "ellipse", "reduced_area": 0.97}}


@pytest.mark.parametrize("case", [{}, {"solver": {"repulsion": {"reach": 0.3}}}, RELAXING])
def test_instants_are_what_small_steps_tend_to(case):
    problem = build(scene_of(CLOSE, MIXED, case, {"output": {"tension": True}}, solver={"kind": "implicit", "corrections": []}))
    at = instant(problem, problem.X)
    if problem.scene.solver.repulsion is None:
        assert np.abs(surface_divergence(problem.X, at.velocity)).max() < 1e-2 * np.abs(at.velocity).max() / problem.length
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    velocity, sigma = [], []
    for dt in (2e-8, 1e-8):
        state = stepper.step(State(0.0, problem.X), dt).state
        velocity.append((state.X - problem.X) / dt)
        sigma.append(state.sigma)
    tolerance = 2e-3 if problem.scene.solver.repulsion is None else 5e-3  # kinks of the repulsion leave modes that nodes do not hold
    assert np.abs(2 * velocity[1] - velocity[0] - at.velocity).max() < tolerance * np.abs(at.velocity).max()
    assert np.abs(2 * sigma[1] - sigma[0] - at.sigma).max() < 2e-3 * np.abs(at.sigma).max()
    again = instant(problem, problem.X, sigma=at.sigma)
    assert np.abs(again.velocity - at.velocity).max() < 1e-6 * np.abs(at.velocity).max()


def test_an_instant_of_one_vesicle_and_of_equal_fluids():
    single = build(scene_of(CLOSE, vesicles={"centers": None, "angles": None, "contrast": 4.0}))
    alone = instant(single, single.X)
    assert np.abs(surface_divergence(single.X, alone.velocity)).max() < 2e-3 * np.abs(alone.velocity).max() / single.length
    plain = build(scene_of(CLOSE))
    nearly = build(scene_of(CLOSE, vesicles={"contrast": 1.0 + 1e-9}))
    a, b = instant(plain, plain.X), instant(nearly, nearly.X)
    assert np.abs(a.velocity - b.velocity).max() < 1e-5 * np.abs(a.velocity).max()
    assert np.abs(a.sigma - b.sigma).max() < 1e-4 * np.abs(a.sigma).max()


# Steady inclination of one vesicle in shear by another two-dimensional boundary-integral code: reduced area 0.663 (semi-axes 1 and 3),
# N = 64, contrast: angle. B. Quaife & G. Biros, github.com/bioflume/ves2d, docs/papers/lowResolution/figs/inclineAngles.tikz
PUBLISHED = {0.5: 0.4354, 3.0: 0.1681}


@pytest.mark.parametrize("contrast", PUBLISHED)
def test_steady_inclination_is_the_published_one(contrast):
    scene = scene_of(
        {"solver": {"kind": "split"}, "flow": {"rate": None, "capillary": 52.0}},
        vesicles={"shape": "ellipse", "reduced_area": 0.6630557, "points": 32, "contrast": contrast, "angles": [PUBLISHED[contrast]]},
        time={"dt": "0.05 t_gamma", "horizon": "8 t_gamma", "order": 2, "adaptive": True, "tolerance": 1e-3, "save_every": 1000},
    )
    X = simulate(scene).trajectory.X[-1]
    assert float(inclination(X)[0]) == pytest.approx(PUBLISHED[contrast], abs=0.004)
