"""`python -m biem field`: numbers, tables, pictures and movies of a trajectory's frames; interruptions; what is refused in one line."""

import h5py
import numpy as np
import pytest
from PIL import Image
from scene_helpers import PAIR, cli, scene_of, the_error, write_flow

from biem.observe.fields import QUANTITIES, FlowField
from biem.observe.grid import Grid, box_around, frames_named, grid_shape
from biem.observe.instant import instant
from biem.run import fields as sampling
from biem.run.field_pictures import SHOWN, Painter
from biem.run.fields import FrameFields
from biem.run.simulate import simulate
from biem.run.trajectory import read_trajectory
from biem.scene.build import build


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "out.h5"
    simulate(scene_of(PAIR, tracers={"count": 4, "box": [0.6, 0.4]}, time={"horizon": 2 * 2.0**-13}), path)
    return path


def of_frame(path, frame, x, quantities=QUANTITIES, **more):
    problem = build(scene_of(PAIR))
    with h5py.File(path) as file:
        at = instant(problem, file["X"][frame], float(file["t"][frame]))
    return FlowField(problem, at, **more).values(x, quantities)


def test_numbers_on_a_grid_are_those_of_the_field(tmp_path, out):
    assert cli("field", out, "-o", tmp_path / "f.h5", "--frames", "all", "--grid", "9x7", "--box=-0.5,-0.4,0.5,0.4").exit_code == 0
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 7))
    with h5py.File(tmp_path / "f.h5") as file:
        assert file["frame"][:].tolist() == [0, 1, 2]
        assert np.array_equal(file["x"][1], x[0])
        assert np.array_equal(file["y"][1], y[:, 0])
        for k in (0, 2):
            exact = of_frame(out, k, np.stack([x.ravel(), y.ravel()], axis=-1))
            for name in ("inside", *QUANTITIES):
                stored = file[name][k]
                assert stored.shape[:2] == (7, 9)
                assert np.array_equal(stored.reshape(63, *stored.shape[2:]), getattr(exact, name))
        assert "of the fluid outside" in file.attrs["about"]
        assert file["vorticity"].attrs["unit"] == "1/time"
        assert all(values.attrs["definition"] for values in file.values())
        assert file.attrs["trajectory"] == "out.h5"
    assert not (tmp_path / "f.h5.parts").exists()


def test_a_table_at_points_and_the_disturbance(tmp_path, out):
    np.savetxt(tmp_path / "p.txt", [[0.0, 0.3], [0.35, 0.0]])
    arguments = ["--points", tmp_path / "p.txt", "--quantities", "velocity,stress"]
    assert cli("field", out, "-o", tmp_path / "f.csv", *arguments, "--frames", "0:2", "--disturbance").exit_code == 0
    lines = (tmp_path / "f.csv").read_text().splitlines()
    assert lines[4].startswith("# s_xx, s_xy, s_yx, s_yy [kappa_b/length^3]: s = -p I + mu")
    assert [line[0] for line in lines[:7]] == ["#"] * 6 + ["t"]
    assert lines[6] == "t,x,y,inside,u,v,s_xx,s_xy,s_yx,s_yy"
    rows = np.array([[float(value) for value in line.split(",")] for line in lines[7:]])
    assert rows[:, 3].tolist() == [-1, 1, -1, 1]
    exact = of_frame(out, 1, np.array([[0.0, 0.3], [0.35, 0.0]]), disturbance=True)
    assert np.array_equal(rows[2:, 4:6], exact.velocity)
    assert np.array_equal(rows[2:, 6:], exact.stress.reshape(2, 4))
    assert cli("field", out, "-o", tmp_path / "p.h5", "--points", tmp_path / "p.txt").exit_code == 0
    with h5py.File(tmp_path / "p.h5") as file:
        assert file["pressure"].shape == (1, 2)
        assert np.array_equal(file["points"][:], [[0.0, 0.3], [0.35, 0.0]])


@pytest.mark.parametrize("show", SHOWN)
def test_a_picture_of_each_quantity(tmp_path, out, show):
    result = cli("field", out, "-o", tmp_path / "a.png", "--show", show, "--grid", 30, *(["--streamlines"] if show == "speed" else []))
    assert result.exit_code == 0
    assert str(tmp_path / "a.png") in result.stdout
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).reshape(-1, 3)
    assert len(np.unique(picture, axis=0)) > 300
    assert (np.abs(picture.astype(int) - [255, 127, 14]).sum(-1) < 30).any()  # tracers


def test_pictures_show_values_where_their_points_are(out):
    grid = Grid.of((-1.0, -0.5, 1.0, 0.5), (5, 3))
    trajectory = read_trajectory(out)
    painter = Painter(trajectory, "vorticity", (-1.0, 1.0), False)
    figure, axes = painter._figure(grid)
    painter._draw(figure, axes, FrameFields(0, 0.0, {"vorticity": np.arange(15.0)}), grid, False)
    x0, x1, y0, y1 = axes.images[0].get_extent()
    assert np.allclose(x0 + (np.arange(5) + 0.5) * (x1 - x0) / 5, grid.x)
    assert np.allclose(y0 + (np.arange(3) + 0.5) * (y1 - y0) / 3, grid.y)
    assert axes.get_xlim() == (-1.0, 1.0)


def test_a_movie_has_all_frames_and_may_follow(tmp_path, out):
    assert cli("field", out, "-o", tmp_path / "a.gif", "--grid", "20x16", "--follow").exit_code == 0
    with Image.open(tmp_path / "a.gif") as movie:
        assert movie.n_frames == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gif"]
    assert cli("field", out, "-o", tmp_path / "a.h5", "--grid", "20x16", "--follow", "--frames", "all").exit_code == 0
    with h5py.File(tmp_path / "a.h5") as file, h5py.File(out) as frames:
        center = frames["X"][:].mean(axis=(1, 3))
        assert np.abs(file["x"][:].mean(axis=1) - file["x"][0].mean() - center[:, 0] + center[0, 0]).max() < 1e-12


def test_an_interrupted_call_is_gone_on_from(tmp_path, out, monkeypatch):
    compute, done = sampling._compute, []

    def failing(trajectory, problem, request, k):
        if len(done) == 2:
            raise OSError("no space")
        done.append(k)
        return compute(trajectory, problem, request, k)

    arguments = ["field", out, "-o", tmp_path / "f.h5", "--frames", "all", "--grid", "8x8", "--quiet"]
    monkeypatch.setattr(sampling, "_compute", failing)
    assert "no space" in the_error(cli(*arguments), 5)
    assert not (tmp_path / "f.h5").exists()
    done.clear()
    monkeypatch.setattr(sampling, "_compute", lambda *a: done.append(a[-1]) or compute(*a))
    assert cli(*arguments).exit_code == 0
    assert done == [2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.h5"]


def test_parts_of_another_request_are_not_taken(tmp_path, out):
    request = sampling.Request([0], ("velocity",), points=np.array([[0.0, 0.3]]))
    problem, trajectory = build(scene_of(PAIR)), read_trajectory(out)
    first = next(sampling.sampled(trajectory, problem, request, tmp_path / "parts"))
    again = next(sampling.sampled(trajectory, problem, request, tmp_path / "parts"))
    assert np.array_equal(first.values["velocity"], again.values["velocity"])
    other = sampling.Request([0], ("velocity",), points=np.array([[0.0, 0.4]]))
    moved = next(sampling.sampled(trajectory, problem, other, tmp_path / "parts"))
    assert np.abs(moved.values["velocity"] - first.values["velocity"]).max() > 1.0
    (tmp_path / "parts" / "00000000.h5").write_bytes(b"torn")
    assert np.array_equal(
        next(sampling.sampled(trajectory, problem, other, tmp_path / "parts")).values["velocity"], moved.values["velocity"]
    )


BAD = {
    "no trajectory": (["none.h5"], "none.h5"),
    "ending": (["-o", "a.pdf"], "expected a name that ends in"),
    "unknown quantity": (["-o", "a.h5", "--quantities", "speed"], "--quantities speed: expected some of"),
    "unknown picture": (["-o", "a.png", "--show", "heat"], "--show heat: expected one of speed"),
    "quantities of a picture": (["-o", "a.png", "--quantities", "stress"], "a picture has --show"),
    "streamlines of numbers": (["-o", "a.h5", "--streamlines"], "go with pictures"),
    "two frames": (["-o", "a.png", "--frames", "all"], "names 3 frames"),
    "no such frame": (["-o", "a.png", "--frames", "7"], "frames 0 to 2"),
    "no slice": (["-o", "a.gif", "--frames", "a:b"], "frames 0 to 2"),
    "grid": (["-o", "a.h5", "--grid", "10x"], "--grid 10x: expected NXxNY"),
    "one point": (["-o", "a.h5", "--grid", "1x5"], "--grid 1x5"),
    "box": (["-o", "a.h5", "--box", "1,2,3"], "--box 1,2,3: expected x0,y0,x1,y1"),
    "empty box": (["-o", "a.h5", "--box", "1,0,1,2"], "--box"),
    "box and follow": (["-o", "a.h5", "--box", "0,0,1,2", "--follow"], "leave out --follow"),
    "memory": (["-o", "a.h5", "--grid", "1000000x1000000"], "MB of memory"),
    "no points": (["-o", "a.csv", "--points", "none.txt"], "none.txt does not exist"),
    "points and grid": (["-o", "a.h5", "--points", "none.txt", "--grid", "5"], "leave out --grid"),
    "points of a picture": (["-o", "a.png", "--points", "none.txt"], "a picture needs a grid"),
    "table of a grid": (["-o", "a.csv"], "a .csv is for --points"),
    "tolerance": (["-o", "a.h5", "--tolerance", "2"], "--tolerance 2"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_done_ends_in_one_line(tmp_path, out, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    arguments, fragment = BAD[case]
    source = arguments if case == "no trajectory" else [out, *arguments]
    assert fragment in the_error(cli("field", *source), 2)
    assert list(tmp_path.iterdir()) == []


def test_memory_is_refused_before_anything_is_computed(tmp_path, out, monkeypatch):
    monkeypatch.setattr(sampling, "free_memory", lambda: 6e7)
    monkeypatch.setattr(sampling, "_compute", lambda *a: pytest.fail("computed"))
    message = the_error(cli("field", out, "-o", tmp_path / "a.h5", "--grid", "400x400", "--frames", "all"), 2)
    assert "3 frames of 1.6e+05 points" in message
    assert "60 MB are free" in message
    assert "take a coarser grid" in message


def test_a_custom_flow_is_found_in_its_folder_and_has_no_pressure(tmp_path):
    module = write_flow(tmp_path, "def shear(x, y, t):\n    return 100.0 * y, 0.0 * x\n")
    scene = scene_of(flow={"kind": "custom", "rate": None, "function": f"{module}.shear"}, folder=tmp_path, time={"horizon": 2.0**-13})
    simulate(scene, tmp_path / "out.h5")
    arguments = ["field", tmp_path / "out.h5", "-o", tmp_path / "f.h5", "--grid", "6x6", "--folder", tmp_path]
    assert "only the velocity of this flow is known" in the_error(cli(*arguments, "--quantities", "pressure"), 2)
    assert cli(*arguments).exit_code == 0
    with h5py.File(tmp_path / "f.h5") as file:
        assert "velocity" in file
        assert "pressure" not in file


def test_names_of_frames_grids_and_boxes():
    assert frames_named("-1", 5) == [4]
    assert frames_named("1:4:2", 5) == [1, 3]
    assert frames_named("all", 2) == [0, 1]
    assert frames_named("3, 0", 4) == [3, 0]
    assert grid_shape("40", (0.0, 0.0, 4.0, 1.0)) == (40, 10)
    assert grid_shape(None, (0.0, 0.0, 1.0, 2.0)) == (150, 300)
    assert grid_shape("7x9", (0.0, 0.0, 1.0, 2.0)) == (7, 9)
    assert Grid.of((0.0, 1.0, 2.0, 3.0), (3, 2)).points.tolist() == [[0, 1], [1, 1], [2, 1], [0, 3], [1, 3], [2, 3]]
    X = np.array([[[0.0, 1.0], [0.0, 2.0]]])
    assert box_around(X) == pytest.approx((-0.3, -0.3, 1.3, 2.3))
    assert box_around(np.stack([X, X + 1.0])) == pytest.approx((-0.45, -0.45, 2.45, 3.45))
