"""Runs between walls: what their files hold, restarts, pictures, checks, devices."""

import json

import numpy as np
import pytest
from PIL import Image
from scene_helpers import DT, assert_same_frames, cli, the_error

from biem.run.trajectory import TrajectoryWriter, read_trajectory
from biem.run.verify import verify

SCENE = """
[vesicles]
centers = [[-0.45, 0.0], [0.45, 0.1]]
angles = [1.4, 1.7]
reduced_area = 0.8
points = 16

[walls]
kind = "circle"
radius = 0.8
omega = 50.0
spacing = 0.08

[[walls.obstacles]]
shape = "polygon"
sides = 3
center = [0.05, -0.45]
size = 0.12
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "walled.toml"
    path.write_text(SCENE + f'\n[time]\ndt = {DT}\nhorizon = {4 * DT}\n\n[solver]\nkind = "split"\n')
    return path


def finished(scene, name, *options):
    out = scene.parent / name
    result = cli("run", scene, "-o", out, "--quiet", *options)
    assert result.exit_code == 0, result.output
    return read_trajectory(out)


def test_walls_are_in_the_trajectory_and_in_its_pictures(scene):
    frames = finished(scene, "out.h5")
    outer, body = frames.attributes["walls"]
    assert np.abs(np.hypot(*outer) - 0.8).max() < 1e-12
    assert abs(float(np.mean(body[1])) + 0.45) < 0.02
    assert 0 < frames.diagnostics["min_gap"].min() < 0.3
    assert cli("plot", scene.parent / "out.h5", "-o", scene.parent, "--no-movie").exit_code == 0
    with Image.open(scene.parent / "frames.png") as image:
        shown = np.asarray(image.convert("RGB")).astype(int)
    wall = np.abs(shown - [0x4A, 0x55, 0x60]).max(axis=-1) < 4
    assert wall.mean() > 0.005


def test_a_restart_between_walls_is_bitwise(scene):
    whole = finished(scene, "whole.h5")
    finished(scene, "part.h5", "--set", f"time.horizon={2 * DT}")
    assert_same_frames(finished(scene, "part.h5", "--resume"), whole)


@pytest.mark.parametrize("solver", ["implicit", "split"])
def test_devices_and_solvers_agree(scene, solver):
    short = ("--set", f"time.horizon={DT}")
    plain = finished(scene, "split.h5", *short).X[-1]
    if solver == "split":
        assert np.abs(finished(scene, "torch.h5", *short, "--set", "solver.device=torch").X[-1] - plain).max() < 1e-13
    else:
        frames = finished(scene, "implicit.h5", *short, "--solver", "implicit")
        assert 1 <= frames.diagnostics["gmres_iterations"][-1] < 25
        assert 0 < np.abs(frames.X[-1] - plain).max() < 2e-4


def test_verify_finds_a_vesicle_beyond_the_walls(scene):
    frames = finished(scene, "out.h5")
    assert all(check.passed for check in verify(frames))
    frames.X[2, 1, 0] += 0.3
    TrajectoryWriter(scene.parent / "out.h5", frames.attributes, [frames]).close()
    failed = [check for check in verify(read_trajectory(scene.parent / "out.h5")) if not check.passed]
    assert "between the walls" in [check.name for check in failed]
    assert "[2]" in next(check.detail for check in failed if check.name == "between the walls")


def test_plan_names_the_walls(scene):
    lines = cli("plan", scene, "--no-measure").output
    assert "yes  walls" in lines
    assert "an outer wall and 1 body," in lines
    assert "factorised once" in lines


def test_other_walls_are_not_gone_on_with(scene):
    finished(scene, "out.h5")
    message = the_error(cli("run", scene, "-o", scene.parent / "out.h5", "--resume", "--set", "walls.omega=51.0"), 2)
    assert "walls.omega was 50.0, is 51.0" in message


def test_attributes_stay_readable_as_json(scene):
    assert json.loads(finished(scene, "out.h5").attributes["scene"])["walls"]["obstacles"][0]["sides"] == 3


def test_a_wall_file_that_has_changed_is_not_gone_on_with(scene):
    t = 2 * np.pi * np.arange(64) / 64
    write = lambda radius: np.savetxt(scene.parent / "walls.txt", radius * np.stack([np.cos(t), np.sin(t)], axis=1))
    table = '[walls]\nkind = "file"\nfile = "walls.txt"\nomega = 50.0\nspacing = 0.08\n'
    scene.write_text(scene.read_text().replace(SCENE[SCENE.index("[walls]") :], table))
    write(0.8)
    whole = finished(scene, "whole.h5")
    finished(scene, "out.h5", "--set", f"time.horizon={2 * DT}")
    write(0.9)
    message = the_error(cli("run", scene, "-o", scene.parent / "out.h5", "--resume"), 2)
    assert "restore walls.file" in message
    write(0.8)
    assert_same_frames(finished(scene, "out.h5", "--resume"), whole)


def test_the_end_of_a_channel_is_named_where_a_vesicle_reaches_it(tmp_path):
    path = tmp_path / "channel.toml"
    path.write_text(
        '[vesicles]\npoints = 16\ncenters = [[1.2, 0.0]]\n[walls]\nkind = "channel"\nlength = 3.0\nwidth = 0.4\nu_max = 100.0\n'
        '[time]\ndt = 2e-4\nhorizon = 1.0\n[solver]\nkind = "split"\n'
    )
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5", "--quiet"), 3)
    assert "crosses a wall" in message
    assert "a longer channel or a shorter time.horizon" in message


def test_plan_does_not_factorise_large_walls(tmp_path):
    path = tmp_path / "large.toml"
    path.write_text('[vesicles]\npoints = 16\n[walls]\nkind = "circle"\nradius = 50.0\nomega = 1.0\n[time]\ndt = 1.0\nhorizon = 1.0\n')
    printed = cli("plan", path).output
    assert "10054 nodes" in printed
    assert "to factorise, once; steps are not measured" in printed
