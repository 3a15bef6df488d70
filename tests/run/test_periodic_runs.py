"""Runs in a periodic box: copies, images, sides change nothing; shear, restarts, solvers, processes, devices, guard, files, bad input."""

import os
import re
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import shapely
from limits import LIMIT
from scene_helpers import DT, assert_same_frames, cli, scene_of, stop_after, the_error, write_flow, write_scene

from biem.curves.curve import area, length
from biem.curves.lattice import Box, Lattice
from biem.curves.shapes import ellipse, equilibrium, place
from biem.errors import NumericalFailure
from biem.observe.instant import instant
from biem.run import plot
from biem.run import simulate as loop
from biem.run.guard import check_state
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import read_trajectory
from biem.run.verify import verify
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.scene.plan import memory_estimate, required_parts
from biem.stokes.near_search import minimum_gap

SIDES, RATE, STEPS = np.array([0.9, 0.7]), 1000.0, 4
T = STEPS * DT / 4  # strained by 0.12
SPLIT = {"kind": "split", "near_tolerance": 1e-9, "far_tolerance": 1e-9}
IMPLICIT = {"kind": "implicit"}
SOLVERS = pytest.mark.parametrize("solver", [SPLIT, IMPLICIT], ids=["split", "implicit"])
FLOWS = pytest.mark.parametrize("rate", [0.0, RATE], ids=["at rest", "sheared"])


def membranes(N=16):
    """Three vesicles that are not at equilibrium, gaps below h between two of them."""
    one = ellipse(N, 0.8)
    return np.stack([place(one, np.array(c), a) for c, a in (((-0.2, 0.0), 1.3), ((0.04, 0.02), 1.6), ((0.35, -0.1), 0.3))])


def scene_with(folder, X, sides=SIDES, rate=RATE, steps=STEPS, dt=DT / 4, name="X", **tables):
    """The scene of membranes X in a box, or in the plane (None), sheared or at rest."""
    with h5py.File(folder / f"{name}.h5", "w") as file:
        file["X"] = X
    flow = {"kind": "shear", "rate": rate} if rate else {"kind": "quiescent"}
    table = {"name": "box", "vesicles": {"file": f"{name}.h5"}, "flow": flow, "time": {"dt": dt, "horizon": steps * dt}}
    table |= {} if sides is None else {"domain": {"periodic": [float(side) for side in sides]}}
    time = tables.pop("time", {})
    return make_scene({**table, "time": {**table["time"], **time}, **tables}, folder)


def last(folder, *arguments, **tables):
    return simulate(scene_with(folder, *arguments, **tables)).trajectory.X[-1]


def carried(n, rate, t, sides=SIDES):
    """Displacement (M, 2, 1) at t of curves that began at lattice vectors n (M, 2) in a box at t = 0."""
    n = np.asarray(n, dtype=float)
    return np.stack([n[:, 0] * sides[0] + n[:, 1] * rate * t * sides[1], n[:, 1] * sides[1]], axis=1)[..., None]


@SOLVERS
@FLOWS
def test_the_images_move_as_curves_of_their_own_do(tmp_path, solver, rate):
    """A box with two copies of everything, beside or above each other: in shear the upper ones are carried along."""
    X = membranes()
    one = last(tmp_path, X, rate=rate, solver=solver)
    assert np.abs(one - X).max() > (1e-2 if rate else 1e-3)
    for times in ((2, 1), (1, 2)):
        n = np.array([times[0] - 1, times[1] - 1])
        copies = np.concatenate([X, X + (n * SIDES)[:, None]])
        both = last(tmp_path, copies, SIDES * times, rate=rate, solver=solver)
        want = np.concatenate([one, one + carried(n[None], rate, T)])
        assert np.abs(both - want).max() < (1e-7 if rate else 1e-10)


@SOLVERS
@FLOWS
def test_where_the_sides_are_and_which_image_stands_for_all_changes_nothing(tmp_path, solver, rate):
    X = membranes()
    one = last(tmp_path, X, rate=rate, solver=solver)
    n = np.array([[2, 0], [0, -1], [-1, 3]])
    bound = 1e-7 if rate else 1e-12  # the first iterations end at a share of the largest velocity, that of the flow included
    assert np.abs(last(tmp_path, X + carried(n, rate, 0.0), rate=rate, solver=solver) - one - carried(n, rate, T)).max() < bound
    for d in ((0.51, 0.0), (0.2, 0.33)):  # the two that are close come to lie across a side
        moved = last(tmp_path, X + np.array(d)[:, None], rate=rate, solver=solver)
        assert np.abs(moved - one - np.array([d[0] + rate * T * d[1], d[1]])[:, None]).max() < bound


def test_a_wide_box_is_as_good_as_the_plane(tmp_path):
    """What the images add falls with the square of the side: they are of no net force, and only gradients move a vesicle."""
    X = membranes()[:2]
    free = last(tmp_path, X, None, solver=SPLIT)
    off = [np.abs(last(tmp_path, X, (side, side), solver=SPLIT) - free).max() for side in (2.0, 4.0, 8.0)]
    assert 3.2 < off[0] / off[1] < 4.8
    assert 3.2 < off[1] / off[2] < 4.8
    assert off[2] < 2e-3 * np.abs(free - X).max()


def test_split_and_implicit_come_together_with_the_step(tmp_path):
    X, differences = membranes(32), []
    for steps in (2, 4, 8):
        ends = [last(tmp_path, X, rate=100.0, steps=steps, dt=T / steps, solver=solver) for solver in (SPLIT, IMPLICIT)]
        differences.append(np.abs(ends[0] - ends[1]).max())
    assert 1.5 < differences[1] / differences[2] < 2.5
    assert differences[0] < 1e-3


@pytest.mark.parametrize("time", [{}, {"order": 2}, {"adaptive": True, "tolerance": 1e-3}], ids=["order 1", "order 2", "adaptive"])
def test_a_stopped_run_goes_on_bit_for_bit(tmp_path, monkeypatch, time):
    X = membranes()
    scene = scene_with(tmp_path, X, solver={"kind": "split"}, steps=6, time=time)
    whole = simulate(scene, tmp_path / "whole.h5").trajectory
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        with pytest.raises(Stopped):
            simulate(scene, tmp_path / "parts.h5")
    assert len(read_trajectory(tmp_path / "parts.h5")) == 4
    parts = simulate(scene, tmp_path / "parts.h5", resume=True).trajectory
    assert_same_frames(parts, whole)
    assert list(parts.attributes["periodic"]) == [*SIDES, RATE]


def test_a_long_run_keeps_areas_and_gaps_and_paths_have_no_jumps(tmp_path):
    one = ellipse(16, 0.8)
    X = np.stack([place(one, np.array(c), a) for c, a in (((-0.2, -0.05), 1.3), ((0.1, 0.3), 0.2))])
    done = simulate(scene_with(tmp_path, X, steps=50, dt=DT, solver={"kind": "split"})).trajectory
    c = done.X.mean(axis=-1)
    assert np.ptp(c[:, :, 0], axis=0).max() > 2 * SIDES[0]  # through the box more than once
    assert np.abs(np.diff(c, axis=0)).max() < 0.1
    for measure in (area, length):
        assert max(np.abs(measure(frame) / measure(X) - 1).max() for frame in done.X) < 1e-10
    for k in (0, 25, 50):
        lattice = done.lattice(k)
        assert lattice == Box(*SIDES, RATE).at(done.t[k])
        assert done.diagnostics["min_gap"][k] == minimum_gap(done.X[k], lattice) < minimum_gap(done.X[k]) + 1e-15
    assert all(check.passed for check in verify(done))


def test_one_vesicle_feels_its_images(tmp_path):
    X = membranes()[:1]
    scene = scene_with(tmp_path, X, (0.6, 0.45), solver={"kind": "split"})
    done = simulate(scene)
    assert done.counts["periodic_sum"] > 0
    assert done.trajectory.sigma is not None
    assert np.abs(done.trajectory.X[-1] - last(tmp_path, X, None, solver={"kind": "split"})).max() > 2e-3
    needed = {part.name: part.why for part in required_parts(build(scene)) if part.needed}
    assert needed["tension"] == "its force moves its own images"
    assert needed["far field"].startswith("periodic Ewald sum of 16 points")
    coupling = "1 vesicle and its images in a box of 0.6 x 0.45, filled to 0.236, sheared at 1000: explicit, two sums a step"
    assert needed["vesicle-vesicle coupling"] == coupling
    assert memory_estimate(build(scene)) > memory_estimate(build(scene_with(tmp_path, X, None, solver={"kind": "split"})))


def test_forces_at_an_instant_are_those_of_the_box(tmp_path):
    """Inextensible, and the same from any image; the velocity of a step of the implicit solver as it becomes short."""
    X, t = membranes(64), 0.003
    problem = build(scene_with(tmp_path, X))
    now = instant(problem, X, t)
    n = np.array([[1, 0], [0, -2], [3, 1]])
    other = instant(problem, X + carried(n, RATE, t), t)
    assert np.abs(other.force - now.force).max() < 1e-6 * np.abs(now.force).max()
    assert np.abs(other.velocity - now.velocity - carried(n, RATE, 1.0) + carried(n, RATE, 0.0)).max() < 1e-6 * np.abs(now.velocity).max()
    plane = instant(build(scene_with(tmp_path, X, None)), X, t)
    assert np.abs(plane.velocity - now.velocity).max() > 0.05 * np.abs(now.velocity).max()
    start, dt = instant(problem, X), 1e-9
    moved = last(tmp_path, X, steps=1, dt=dt, solver={"kind": "implicit", "corrections": []})
    assert np.abs((moved - X) / dt - start.velocity).max() < 2e-3 * np.abs(start.velocity).max()


@pytest.mark.parametrize("solver", [{"device": "torch"}, {"dtype": "float32"}, {"far_field": "ewald"}, {"near_field": "layers"}], ids=str)
def test_other_ways_to_the_same_result(tmp_path, solver):
    pytest.importorskip("finufft")
    X = membranes(32)
    bound = {"dtype": 2e-5, "near_field": 2e-3}.get(next(iter(solver)), 1e-7)
    u = last(tmp_path, X, solver={"kind": "split"})
    assert np.abs(last(tmp_path, X, solver={"kind": "split", **solver}) - u).max() < bound


def test_learned_maps_run_in_the_box(tmp_path):
    one = equilibrium(32, 0.65)
    X = np.stack([place(one, np.array(c), a) for c, a in (((-0.4, 0.0), 1.3), ((0.45, 0.1), 1.6))])
    runs = [last(tmp_path, X, (1.1, 0.8), steps=4, dt=1e-5, solver=solver) for solver in ({"kind": "split"}, {"kind": "vesnet"})]
    assert np.abs(runs[1] - runs[0]).max() < 0.05 * np.abs(runs[0] - X).max()
    assert np.abs(runs[1] - last(tmp_path, X, None, steps=4, dt=1e-5, solver={"kind": "vesnet"})).max() > 1e-4


def test_several_processes_give_the_same(tmp_path):
    pytest.importorskip("mpi4py")
    mpirun = Path(sys.executable).parent / "mpirun"
    if not mpirun.exists():
        pytest.skip("no mpirun beside the interpreter")
    tables = {"flow": {"kind": "shear", "rate": RATE}, "domain": {"periodic": [1.6, 1.5]}, "solver": {"kind": "split"}}
    vesicles = {"placement": "grid", "count": 7, "points": 16, "reduced_area": 0.8}
    path = write_scene(tmp_path, vesicles=vesicles, time={"dt": DT / 8, "horizon": 3 * DT / 8}, **tables)
    command = [mpirun, "-n", 2, sys.executable, "-m", "biem", "run", path, "-o", tmp_path / "two.h5", "--quiet"]
    done = subprocess.run(
        [str(c) for c in command], env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False, timeout=LIMIT
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert cli("run", path, "-o", tmp_path / "one.h5", "--quiet").exit_code == 0
    one, two = (read_trajectory(tmp_path / f"{name}.h5") for name in ("one", "two"))
    assert len(one) == 4
    assert np.abs(one.X - two.X).max() < 1e-12
    assert np.abs(one.sigma - two.sigma).max() < 1e-9 * np.abs(one.sigma).max()


def test_the_guard_sees_across_the_sides():
    X = membranes()
    clear, narrow = Lattice(*SIDES), Lattice(0.9, 0.3)
    check_state(X, None, {}, 1e-2, None, clear)
    with pytest.raises(NumericalFailure, match="vesicle 0 crosses its own image: the periodic box is too small for it"):
        check_state(X, None, {}, 1e-2, None, narrow)
    apart = X + np.array([[0, 0], [0, 0], [-0.29, 0]])[:, :, None]
    far = apart + np.array([[0, 0], [0, 0], [3 * 0.9, -2 * 0.7]])[:, :, None]
    check_state(far, None, {}, 1e-2)
    with pytest.raises(NumericalFailure, match=r"vesicles 1 and 2 cross \(1 pair"):
        check_state(far, None, {}, 1e-2, None, clear)


@pytest.mark.parametrize("solver", [{"kind": "split"}, {"kind": "implicit"}], ids=["split", "implicit"])
def test_every_step_is_guarded_with_the_images_where_they_are_then(tmp_path, monkeypatch, solver):
    seen = []
    monkeypatch.setattr(loop, "check_state", lambda *arguments: seen.append(arguments[5]))
    done = simulate(scene_with(tmp_path, membranes(), solver=solver)).trajectory
    assert [lattice.offset for lattice in seen] == pytest.approx([RATE * SIDES[1] * t for t in done.t[1:]])


def test_a_trajectory_whose_images_cross_is_found_out(tmp_path):
    done = simulate(scene_with(tmp_path, membranes(), rate=0.0, steps=1, solver={"kind": "split"})).trajectory
    assert all(check.passed for check in verify(done))
    done.attributes["periodic"] = [0.9, 0.3, 0.0]
    assert [check.name for check in verify(done) if not check.passed] == ["no crossing"]


def test_pictures_show_the_box_and_the_images_in_it(tmp_path):
    X = membranes() + np.array([0.1, 5.4 * SIDES[1]])[:, None]
    done = simulate(scene_with(tmp_path, X, steps=2, solver={"kind": "split"})).trajectory
    center, half = plot._view(done)
    assert np.array_equal(center, np.zeros((3, 2)))
    assert np.allclose(half, 0.51 * SIDES)
    for k in (0, 2):
        shown = plot._shown(done, k)
        assert len(shown) > 3
        x, y = np.meshgrid(*((np.arange(60) + 0.5) / 60 - 0.5,) * 2)
        times = sum(shapely.contains_xy(shapely.Polygon(p), x * SIDES[0], y * SIDES[1]).astype(int) for p in shown)
        assert times.max() == 1
        assert times.mean() == pytest.approx(area(X).sum() / SIDES.prod(), abs=0.02)
    files = plot.draw_all(done, tmp_path / "plots", movie=False)
    assert all(file.stat().st_size > 5000 for file in files)


PERIODIC_FLOW = """
import numpy as np
def wave(x, y, t):
    return 100.0 * np.sin(2 * np.pi * y / 0.7) + 0 * x, 30.0 + 0 * y
def no_wave(x, y, t):
    return 100.0 * np.sin(2 * np.pi * y / 0.8) + 0 * x, 30.0 + 0 * y
def later(x, y, t):
    return 100.0 + t * x, 0 * y
"""


def test_custom_flows_with_the_periods_of_the_box(tmp_path):
    module = write_flow(tmp_path, PERIODIC_FLOW)
    tables = {"vesicles": {"points": 16, "reduced_area": 0.8}, "domain": {"periodic": [0.9, 0.7]}, "solver": {"kind": "split"}}

    def scene(function):
        return write_scene(tmp_path, flow={"kind": "custom", "rate": None, "function": f"{module}.{function}"}, **tables)

    assert cli("run", scene("wave"), "-o", tmp_path / "out.h5", "--quiet").exit_code == 0
    X = read_trajectory(tmp_path / "out.h5").X
    assert np.abs((X[-1] - X[0]).mean(axis=-1)[0, 1] - 30.0 * 6 * DT) < 0.05 * 30.0 * 6 * DT
    assert "does not repeat itself in y with domain.periodic = [0.9, 0.7]" in the_error(cli("plan", scene("no_wave")), 2)
    assert "does not repeat itself in x" in the_error(cli("plan", scene("later")), 2)


def test_taylor_green_in_boxes_of_whole_periods():
    flow = {"kind": "taylor_green", "rate": 100.0, "width": 0.5}
    tables = {"flow": flow, "vesicles": {"placement": "grid", "count": 2, "points": 16}, "solver": {"kind": "split"}}
    one = simulate(scene_of(tables, domain={"periodic": [1.0, 1.0]})).trajectory
    assert np.abs(one.X[-1] - one.X[0]).max() > 1e-3
    with pytest.raises(ValueError, match=r"width 0\.5 repeats itself every 1: choose multiples of that"):
        build(scene_of(tables, domain={"periodic": [1.0, 1.5]}))


REFUSED = {
    "one side": ({"domain": {"periodic": [2.0]}}, r"expected two positive, finite sides \[Lx, Ly\].*one alone is not supported"),
    "negative": ({"domain": {"periodic": [2.0, -1.0]}}, r"domain.periodic = \[2.0, -1.0\]: expected two positive"),
    "not finite": ({"domain": {"periodic": [2.0, "inf"]}}, "expected two positive, finite sides"),
    "unknown key": ({"domain": {"periodc": [2.0, 1.0]}}, "unknown key domain.periodc: did you mean periodic"),
    "smaller than a vesicle": (
        {"domain": {"periodic": [0.3, 2.0]}},
        r"domain.periodic = \[0.3, 2\] is no larger than vesicle 0, which measures",
    ),
    "walls": ({"walls": {"kind": "circle", "radius": 2.0}, "flow": {"kind": "quiescent", "rate": None}}, r"\[walls\] enclose the fluid"),
    "contrast": ({"vesicles": {"contrast": 2.0}}, "vesicles.contrast other than 1 does not go with domain.periodic"),
    "extension": ({"flow": {"kind": "extensional"}}, 'flow.kind = "extensional" does not repeat itself'),
    "parabola": ({"flow": {"kind": "poiseuille", "width": 1.0}}, 'flow.kind = "poiseuille" does not repeat itself'),
    "vortex": ({"flow": {"kind": "rotation", "width": 1.0}, "vesicles": {"centers": [[0.6, 0.0]]}}, 'flow.kind = "rotation" does not'),
    "overlap of images": (
        {"vesicles": {"centers": [[-0.9, 0.0], [0.9, 0.0]]}},
        r"vesicles 0 and 1 overlap .*images of the periodic box counted",
    ),
    "no count": ({"vesicles": {"placement": "random"}}, "all over domain.periodic needs count or area_fraction, one of them"),
    "count and fraction": (
        {"vesicles": {"placement": "grid", "count": 3, "area_fraction": 0.2}},
        "needs count or area_fraction, one of them",
    ),
    "wide box": ({"vesicles": {"placement": "grid", "count": 3, "box": [3.0, 1.0]}}, "does not fit into domain.periodic"),
    "too many": ({"vesicles": {"placement": "random", "count": 90}}, "90 vesicles do not fit"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_box_does_not_go_with_is_refused_in_one_line(tmp_path, case):
    changes, expected = REFUSED[case]
    path = write_scene(tmp_path, {"domain": {"periodic": [2.0, 1.5]}, "solver": {"kind": "split"}}, changes)
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5"), 2)
    assert re.search(expected, message), message
    assert not list(tmp_path.glob("out*"))


def test_placement_fills_the_domain():
    for placement in ("random", "grid"):
        vesicles = {"placement": placement, "area_fraction": 0.3, "reduced_area": 0.65, "points": 32, "gap": 0.03}
        scene = scene_of(vesicles=vesicles, domain={"periodic": [1.2, 1.0]}, solver={"kind": "split"})
        X = build(scene).X
        assert area(X).sum() / 1.2 == pytest.approx(0.3, abs=0.02)
        assert minimum_gap(X, Lattice(1.2, 1.0)) >= 0.03 - 1e-9
        assert (np.abs(X).max(axis=(0, 2)) > [0.6, 0.5]).any() == (placement == "random")  # some reach over a side
