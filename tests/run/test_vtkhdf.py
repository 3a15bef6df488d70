"""VTKHDF exports read back by VTK's own reader, the one of ParaView: geometry, data, times; what is exported of an unfinished run."""

import importlib.util
import subprocess
import sys

import h5py
import numpy as np
import pytest
from limits import LIMIT
from PIL import Image
from scene_helpers import DT, PAIR, cli, scene_of, the_error

from biem.curves.curve import area, curvature, length
from biem.curves.fourier import resample
from biem.observe.fields import FlowField
from biem.observe.instant import instant
from biem.run.simulate import simulate
from biem.run.trajectory import TrajectoryWriter, one_frame, read_trajectory
from biem.run.vtkhdf import write_image, write_polydata
from biem.scene.build import build

RING = {
    "walls": {"kind": "couette", "radius": 1.0, "inner_radius": 0.4, "omega": 20.0, "spacing": 0.1},
    "flow": {"kind": None, "rate": None},
    "vesicles": {"centers": [[0.7, 0.0]], "angles": [1.2]},
}


def steps_of(path):
    """Data of every step and its time, by vtkHDFReader."""
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    assert reader.CanReadFile(str(path))
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or (None,)
    steps = []
    for t in times:
        if t is None:
            reader.Update()
        else:
            reader.UpdateTimeStep(t)
        data = reader.GetOutputDataObject(0)
        copy = data.NewInstance()
        copy.DeepCopy(data)
        steps.append((t, copy))
    return steps


def points_of(data):
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(data.GetPoints().GetData())


def array_of(data, name, where="Point"):
    from vtkmodules.util.numpy_support import vtk_to_numpy

    array = getattr(data, f"Get{where}Data")().GetArray(name)
    assert array is not None, name
    return vtk_to_numpy(array)


def cells_of(data):
    return [[data.GetCell(c).GetPointId(i) for i in range(data.GetCell(c).GetNumberOfPoints())] for c in range(data.GetNumberOfCells())]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A run of two vesicles with tracers, exported with a grid."""
    folder = tmp_path_factory.mktemp("export")
    simulate(scene_of(PAIR, tracers={"count": 5, "box": [0.6, 0.4]}, time={"horizon": 3 * DT}), folder / "out.h5")
    result = cli("export", folder / "out.h5", "--vtkhdf", "--grid", "12x9")
    assert result.exit_code == 0, result.output
    assert result.stderr.count("notice") == 0
    assert [line.rsplit("/", 1)[1] for line in result.stdout.split()] == ["out.vtkhdf", "out.grid.vtkhdf", "out.tracers.vtkhdf"]
    assert not (folder / "out.vtkhdf.parts").exists()
    return folder


def test_membranes_are_closed_polylines_with_their_data_at_all_times(exported):
    trajectory, steps = read_trajectory(exported / "out.h5"), steps_of(exported / "out.vtkhdf")
    assert [t for t, _ in steps] == trajectory.t.tolist()
    problem = build(scene_of(PAIR))
    for k, (t, data) in enumerate(steps):
        n, X = 96, trajectory.X[k]
        assert data.GetClassName() == "vtkPolyData"
        assert data.GetNumberOfLines() == data.GetNumberOfCells() == 2
        assert cells_of(data) == [[*range(n), 0], [*range(n, 2 * n), n]]
        fine = resample(X, n)
        assert np.abs(points_of(data)[:, :2] - fine.transpose(0, 2, 1).reshape(-1, 2)).max() < 1e-14
        assert np.abs(points_of(data)[:, 2]).max() == 0
        at = instant(problem, X, t)
        assert np.abs(array_of(data, "tension") - resample(at.sigma, n).ravel()).max() < 1e-9 * np.abs(at.sigma).max()
        for name, exact in (("traction", at.force), ("velocity", at.velocity)):
            found = array_of(data, name)
            assert found.shape == (2 * n, 3)
            assert np.abs(found[:, :2] - resample(exact, n).transpose(0, 2, 1).reshape(-1, 2)).max() < 1e-9 * np.abs(exact).max()
        assert np.abs(array_of(data, "curvature") - curvature(fine).ravel()).max() < 1e-9 * np.abs(curvature(fine)).max()
        assert array_of(data, "vesicle").tolist() == [0] * n + [1] * n
        assert array_of(data, "vesicle", "Cell").tolist() == [0, 1]


def test_enclosed_areas_and_lengths_survive(exported):
    trajectory, (_, data) = read_trajectory(exported / "out.h5"), steps_of(exported / "out.vtkhdf")[-1]
    for m, cell in enumerate(cells_of(data)):
        x, y = points_of(data)[cell, :2].T
        assert 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) == pytest.approx(area(trajectory.X[-1])[m], rel=2e-3)
        assert np.hypot(np.diff(x), np.diff(y)).sum() == pytest.approx(length(trajectory.X[-1])[m], rel=1e-3)


def test_fields_are_an_image_series(exported):
    trajectory, steps = read_trajectory(exported / "out.h5"), steps_of(exported / "out.grid.vtkhdf")
    assert [t for t, _ in steps] == trajectory.t.tolist()
    problem = build(scene_of(PAIR))
    for k in (0, 3):
        t, data = steps[k]
        assert data.GetDimensions() == (12, 9, 1)
        x = np.array([data.GetPoint(i)[:2] for i in range(data.GetNumberOfPoints())])
        exact = FlowField(problem, instant(problem, trajectory.X[k], t)).values(x, ("velocity", "pressure", "vorticity", "stress"))
        flat = np.zeros((108, 1))
        stress = np.zeros((108, 3, 3))
        stress[:, :2, :2] = exact.stress
        expected = {"velocity": np.concatenate([exact.velocity, flat], axis=1), "stress": stress.reshape(108, 9)}
        for name, values in {**expected, "pressure": exact.pressure, "vorticity": exact.vorticity}.items():
            assert np.abs(array_of(data, name) - values).max() < 1e-8 * np.abs(values).max()  # x went by way of a spacing
        assert np.array_equal(array_of(data, "inside"), exact.inside)


def test_tracers_are_vertices(exported):
    trajectory, steps = read_trajectory(exported / "out.h5"), steps_of(exported / "out.tracers.vtkhdf")
    for k, (t, data) in enumerate(steps):
        assert t == trajectory.t[k]
        assert data.GetNumberOfVerts() == 5
        assert cells_of(data) == [[p] for p in range(5)]
        assert np.array_equal(points_of(data)[:, :2], trajectory.tracers[k])
        assert array_of(data, "vesicle").tolist() == trajectory.attributes["tracer_vesicle"].tolist()
        assert array_of(data, "left").tolist() == [0] * 5


def test_the_files_say_which_version_they_are(exported):
    with h5py.File(exported / "out.vtkhdf") as file:
        assert file["VTKHDF"].attrs["Version"].tolist() == [2, 0]
        assert file["VTKHDF"].attrs["Type"] == b"PolyData"
        assert file["VTKHDF/Steps"].attrs["NSteps"] == 4


def test_walls_and_one_frame_and_shapes_alone(tmp_path):
    simulate(scene_of(RING, time={"horizon": DT}), tmp_path / "out.h5")
    arguments = ["--shapes", "--frames", "-1", "--refine", 1, "--grid", "30", "--quantities", "velocity", "-o", tmp_path / "x.vtkhdf"]
    assert cli("export", tmp_path / "out.h5", "--vtkhdf", "--quiet", *arguments).exit_code == 0
    ((_, data),) = steps_of(tmp_path / "x.vtkhdf")
    assert data.GetNumberOfPoints() == 16
    assert [data.GetPointData().GetArrayName(i) for i in range(data.GetPointData().GetNumberOfArrays())] == ["curvature", "vesicle"]
    ((_, walls),) = steps_of(tmp_path / "x.walls.vtkhdf")
    assert np.hypot(*points_of(walls)[cells_of(walls)[0], :2].T) == pytest.approx(1.0)
    assert np.hypot(*points_of(walls)[cells_of(walls)[1], :2].T) == pytest.approx(0.4)
    assert array_of(walls, "wall", "Cell").tolist() == [0, 1]
    ((_, image),) = steps_of(tmp_path / "x.grid.vtkhdf")
    x = np.array([image.GetPoint(i)[:2] for i in range(image.GetNumberOfPoints())])
    fluid = np.isfinite(array_of(image, "velocity")[:, 0])
    assert np.array_equal(fluid, (np.hypot(*x.T) <= 1.0) & (np.hypot(*x.T) >= 0.4))
    assert set(array_of(image, "inside")[~fluid]) == {-2}


def test_a_periodic_run_is_exported_wrapped(tmp_path):
    moved = {"vesicles": {"centers": [[3.05, 1.0], [3.75, 0.95]]}, "domain": {"periodic": [1.4, 1.0]}}
    simulate(scene_of(PAIR, moved, tracers={"count": 6, "box": [9.0, 7.0]}, time={"horizon": DT}), tmp_path / "out.h5")
    assert cli("export", tmp_path / "out.h5", "--vtkhdf", "--shapes", "--quiet").exit_code == 0
    _, data = steps_of(tmp_path / "out.vtkhdf")[0]
    centers = points_of(data)[:, :2].reshape(2, -1, 2).mean(axis=1)
    assert (np.abs(centers) <= [0.7, 0.5]).all()
    shift = (np.array([[3.05, 1.0], [3.75, 0.95]]) - centers) / [1.4, 1.0]
    assert np.abs(shift - np.round(shift)).max() < 0.1
    assert np.abs(np.round(shift)).max() > 0
    x, (_, tracers) = read_trajectory(tmp_path / "out.h5").tracers[0], steps_of(tmp_path / "out.tracers.vtkhdf")[0]
    assert (np.abs(points_of(tracers)[:, :2]) <= [0.7, 0.5]).all()
    assert np.abs((x - points_of(tracers)[:, :2]) / [1.4, 1.0] % 1.0 - 0.5).min() > 0.5 - 1e-9
    assert np.abs(x).max() > 1.0


def test_an_unfinished_run_is_exported_as_far_as_it_is_committed_and_said_so(tmp_path):
    simulate(scene_of(PAIR), tmp_path / "out.h5", force=True, enough=lambda t, X: t >= 1.9 * DT)
    result = cli("export", tmp_path / "out.h5", "--vtkhdf", "--shapes")
    assert result.exit_code == 0
    assert f"it has committed 3 frame(s), to t = {2 * DT:.6g} of {6 * DT:.6g}" in result.stderr
    assert len(steps_of(tmp_path / "out.vtkhdf")) == 3


def test_loose_frames_of_a_run_that_is_being_written_are_exported_too(tmp_path):
    run = simulate(scene_of(PAIR, time={"horizon": 3 * DT}), tmp_path / "whole.h5").trajectory
    writer = TrajectoryWriter(tmp_path / "out.h5", run.attributes, [run.until(0)])
    for k in (1, 2):
        diagnostics = {name: float(values[k]) for name, values in run.diagnostics.items()}
        writer.append(one_frame(run.t[k], run.step[k], run.X[k], run.sigma[k], diagnostics))
    assert (tmp_path / "out.h5.frames").is_dir()
    result = cli("export", tmp_path / "out.h5", "--vtkhdf", "--shapes")
    assert "it has committed 3 frame(s)" in result.stderr
    assert [t for t, _ in steps_of(tmp_path / "out.vtkhdf")] == run.t[:3].tolist()


BAD = {
    "no format": ([], "name the format"),
    "ending": (["--vtkhdf", "-o", "a.vtk"], "ends in .vtkhdf"),
    "box without grid": (["--vtkhdf", "--box", "0,0,1,1"], "go with --grid"),
    "refine": (["--vtkhdf", "--refine", "0"], "--refine 0"),
    "frames": (["--vtkhdf", "--frames", "9"], "frames 0 to 3"),
    "memory": (["--vtkhdf", "--grid", "900000x900000"], "MB of memory"),
    "memory of membranes": (["--vtkhdf", "--refine", "100000000"], "a smaller --refine"),
    "tolerance": (["--vtkhdf", "--grid", "9", "--tolerance", "0"], "--tolerance 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_exported_ends_in_one_line(tmp_path, exported, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    arguments, fragment = BAD[case]
    assert fragment in the_error(cli("export", exported / "out.h5", *arguments), 2)
    assert list(tmp_path.iterdir()) == []


def test_writers_take_scalars_vectors_and_tensors(tmp_path):
    rng = np.random.default_rng(0)
    t, x = np.array([0.0, 0.5, 2.0]), rng.random((3, 4, 2))
    values = {"a": rng.random((3, 4)), "b": rng.random((3, 4, 2)), "c": rng.random((3, 4, 2, 2))}
    write_polydata(tmp_path / "p.vtkhdf", t, x, [np.array([0, 1, 2]), np.array([3, 0])], "Lines", values, {"d": np.array([5.0, 6.0])})
    for k, (time, data) in enumerate(steps_of(tmp_path / "p.vtkhdf")):
        assert time == t[k]
        assert cells_of(data) == [[0, 1, 2], [3, 0]]
        assert np.array_equal(array_of(data, "a"), values["a"][k])
        assert np.array_equal(array_of(data, "b")[:, :2], values["b"][k])
        assert np.array_equal(array_of(data, "c").reshape(4, 3, 3)[:, :2, :2], values["c"][k])
        assert array_of(data, "d", "Cell").tolist() == [5.0, 6.0]
    on_grid = rng.random((3, 2, 4))
    write_image(tmp_path / "i.vtkhdf", t, np.linspace(0, 3, 4), np.linspace(5, 6, 2), {"a": on_grid})
    for k, (_, data) in enumerate(steps_of(tmp_path / "i.vtkhdf")):
        assert data.GetBounds() == (0.0, 3.0, 5.0, 6.0, 0.0, 0.0)
        assert np.array_equal(array_of(data, "a").reshape(2, 4), on_grid[k])


def test_the_export_is_rendered_without_a_display(tmp_path, exported):
    script = importlib.util.find_spec("render_vtkhdf").origin
    command = [sys.executable, script, exported / "out.vtkhdf", "-o", tmp_path / "a.png", "--field", "pressure"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    assert "one of 4 steps" in done.stdout
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    middle = picture[: picture.shape[0] // 2].reshape(-1, 3)
    assert len(np.unique(middle, axis=0)) > 200
    bad = subprocess.run([*command[:-1], "heat"], capture_output=True, text=True, timeout=LIMIT, check=False)
    assert bad.returncode == 2
    assert 'there is no "heat"' in bad.stderr.splitlines()[-1]
