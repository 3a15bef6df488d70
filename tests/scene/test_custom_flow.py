"""Custom flows: a callable by its dotted name, in a module beside the scene; what it returns is checked."""

import sys

import numpy as np
import pytest
from scene_helpers import DT, scene_of, write_flow

from biem.errors import NumericalFailure
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory
from biem.scene.build import build
from biem.scene.config import make_scene

X = np.random.default_rng(0).uniform(-1.0, 1.0, size=(2, 2, 5))
x, y = X[:, 0], X[:, 1]


@pytest.fixture(autouse=True)
def _same_path(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))


def custom(folder, body, name="f", **flow):
    module = write_flow(folder, f"import numpy as np\ndef f(x, y, t):\n    {body}\n")
    return build(scene_of({"flow": {"kind": "custom", "rate": None, "function": f"{module}.{name}", **flow}}, folder=folder))


def test_a_custom_flow_lies_beside_the_scene(tmp_path):
    problem = custom(tmp_path, "return 2.0 * y + t, 0.5")  # a number stands for a constant
    assert np.array_equal(problem.flow.velocity(X, 4.0), np.stack([2 * y + 4.0, 0 * y + 0.5], axis=1))
    assert problem.flow.time_scale is None
    built_in = simulate(scene_of()).trajectory
    (tmp_path / "shear").mkdir()
    same = simulate(custom(tmp_path / "shear", "return 100.0 * y, 0.0 * x").scene).trajectory
    assert np.array_equal(same.X, built_in.X)


def test_custom_flows_of_one_name_in_two_folders_are_two_flows(tmp_path):
    velocities = []
    for k in (1, 2):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "flow_of_one_name.py").write_text(f"def f(x, y, t):\n    return {k}.0 * y, 0.0 * x\n")
        scene = scene_of({"flow": {"kind": "custom", "rate": None, "function": "flow_of_one_name.f"}}, folder=folder)
        velocities.append(build(scene).flow.velocity(X, 0.0))
    assert np.array_equal(velocities[1], 2 * velocities[0])


@pytest.mark.parametrize("out", ["y", "(y[:, :3], x[:, :3])", "(x[None], y[None])", "(x, y, x)", "None", "('a', 'b')"])
def test_a_custom_flow_of_wrong_shape_is_refused(tmp_path, out):
    with pytest.raises(ValueError, match=r"flow_.*\.f.* must return \(u, v\)"):
        simulate(custom(tmp_path, f"return {out}").scene)


def test_a_custom_flow_of_wrong_shape_is_refused_before_anything_is_touched(tmp_path):
    (tmp_path / "out.h5").write_text("an older result")
    with pytest.raises(ValueError):
        simulate(custom(tmp_path, "return y").scene, tmp_path / "out.h5", force=True)
    assert (tmp_path / "out.h5").read_text() == "an older result"


def test_a_custom_flow_that_is_not_finite_says_where_and_when(tmp_path):
    with pytest.raises(ValueError, match=r"not finite at x = .*, y = .*, t = 0"):
        simulate(custom(tmp_path, "return np.where(y > 0, np.nan, y), x").scene)


@pytest.mark.parametrize(
    ("function", "body"),
    [("g", "return x, y"), ("__name__", "return x, y"), ("f", "return x, y)"), ("f", "return x, y\nimport no_such_module")],
)
def test_a_custom_flow_that_cannot_be_imported_is_refused(tmp_path, function, body):
    with pytest.raises(ValueError, match=rf"flow\.function = .*{function}"):
        custom(tmp_path, body, function)


def test_a_custom_flow_that_fails_on_the_way_leaves_the_last_good_state(tmp_path):
    scene = custom(tmp_path, f"return np.where(t > {2.5 * DT}, np.nan, y), 0 * x").scene  # met by the fourth step
    scene = make_scene({**scene.model_dump(mode="json"), "time": {"dt": DT, "horizon": 6 * DT, "save_every": 5}}, tmp_path)
    with pytest.raises(NumericalFailure, match=r"step 4 rejected.*flow_.*\.f is not finite at x = .*, t = "):
        simulate(scene, tmp_path / "out.h5")
    assert read_trajectory(tmp_path / "out.h5").step.tolist() == [0, 3]
    assert read_checkpoint(checkpoint_path(tmp_path / "out.h5")).step == 3
