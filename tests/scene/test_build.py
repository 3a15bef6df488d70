"""Initial membranes: what a file holds, checked and put right aloud."""

import h5py
import numpy as np
import pytest
from scene_helpers import PAIR, scene_of, table

from biem.curves.curve import area
from biem.run.simulate import simulate
from biem.run.trajectory import DIAGNOSTICS, TrajectoryWriter, one_frame, read_trajectory
from biem.scene.build import build
from biem.scene.config import make_scene

ALPHA = 2 * np.pi * np.arange(32) / 32
CENTERS = [(0.0, 0.0), (1.0, 0.2), (2.0, -0.1)]


def ellipses(alpha=ALPHA, centers=CENTERS):
    """Three ellipses (3, 2, N), counterclockwise."""
    one = np.stack([0.2 * np.cos(alpha), 0.1 * np.sin(alpha)])
    return np.stack([one + np.array(c)[:, None] for c in centers])


def from_file(folder, X, dataset="X", **more):
    """The problem of a file that holds X."""
    with h5py.File(folder / "shapes.h5", "w") as file:
        file[dataset] = X
    return build(make_scene({**table(more), "vesicles": {"file": "shapes.h5"}}, folder))


def test_a_file_is_taken_as_it_is(tmp_path):
    problem = from_file(tmp_path, ellipses())
    assert np.abs(problem.X - ellipses()).max() < 1e-15
    assert problem.notices == ()


def test_clockwise_membranes_are_reoriented_with_a_notice(tmp_path):
    X = ellipses()
    X[1] = X[1, :, ::-1]
    problem = from_file(tmp_path, X)
    assert (area(problem.X) > 0).all()
    assert len(problem.notices) == 1
    assert "1 clockwise" in problem.notices[0]
    assert "is 1" in problem.notices[0]
    nodes = [sorted(map(tuple, shape.T.round(12))) for shape in (problem.X[1], X[1])]
    assert nodes[0] == nodes[1]  # the same nodes, in the other direction


def spoil(m=None, c=None, k=None, value=None):
    X = ellipses()
    X[m, c, k] = value
    return X


REFUSED = [
    (spoil(2, 1, 5, np.nan), ("vesicle 2", "component y", "node 5")),
    (spoil(0, 0, 0, np.inf), ("vesicle 0", "component x", "node 0")),
    (ellipses(np.linspace(0, 2 * np.pi, 32) % (2 * np.pi)), ("same point", "vesicle 0")),  # the first node again at the end
    (ellipses(np.linspace(0, 2 * np.pi, 32)), ("same point", "vesicle 0", "node")),  # again but for rounding: 1e-16 apart
    (ellipses(ALPHA[:31]), ("31 nodes", "even")),
    (ellipses(ALPHA[::4]), ("8 nodes", "16")),
    (ellipses()[0], ("(2, 32)", "(M, 2, N)")),
    (ellipses().transpose(0, 2, 1), ("(3, 32, 2)", "(M, 2, N)")),
    (ellipses()[:0], ("(0, 2, 32)", "(M, 2, N)")),
    (ellipses()[None, :0], ("(0, 2, 32)",)),
    (np.float64(3.0), ("()", "(M, 2, N)")),
    (ellipses() + 1j, ("shapes.h5",)),
    (np.bytes_(b"text"), ("shapes.h5",)),
    (np.stack([0.2 * np.sin(ALPHA), 0.2 * np.sin(2 * ALPHA)])[None], ("vesicle 0 crosses itself",)),
    (ellipses(centers=[(0.0, 0.0), (1.0, 0.0), (1.2, 0.1)]), ("vesicles 1 and 2 overlap",)),
    (np.concatenate([ellipses()[:1], 0.3 * ellipses()[:1]]), ("vesicles 0 and 1 overlap",)),  # one inside the other
]


@pytest.mark.parametrize(("X", "fragments"), REFUSED, ids=range(len(REFUSED)))
def test_bad_shapes_in_a_file_are_refused_with_the_place(tmp_path, X, fragments):
    with pytest.raises(ValueError) as caught:
        from_file(tmp_path, X)
    for fragment in fragments:
        assert fragment in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["other", "X/inner"])
def test_a_file_without_a_dataset_x_says_what_it_has(tmp_path, name):
    with pytest.raises(ValueError, match=name.partition("/")[0]):
        from_file(tmp_path, ellipses(), dataset=name)


def test_what_is_no_hdf5_file_is_refused(tmp_path):
    (tmp_path / "text.h5").write_text("X = 1")
    (tmp_path / "folder.h5").mkdir()
    for name in ("text.h5", "folder.h5", "missing.h5"):
        with pytest.raises(ValueError, match=name) as caught:
            build(make_scene({**table(), "vesicles": {"file": name}}, tmp_path))
        assert "\n" not in str(caught.value)


def test_a_trajectory_gives_its_last_frame(tmp_path):
    done = simulate(scene_of(), tmp_path / "before.h5").trajectory
    problem = build(make_scene({**table(), "vesicles": {"file": "before.h5"}}, tmp_path))
    assert np.abs(problem.X - done.X[-1]).max() < 1e-15


def test_a_trajectory_of_a_killed_run_gives_its_last_frame_too(tmp_path):
    shapes = [ellipses() + 0.1 * k for k in range(3)]
    numbers = dict.fromkeys(DIAGNOSTICS, 0.0)
    writer = TrajectoryWriter(tmp_path / "killed.h5", {"schema": 1}, [one_frame(0.0, 0, shapes[0], None, numbers)])
    for k in (1, 2):
        writer.append(one_frame(0.1 * k, k, shapes[k], None, numbers))
    assert np.array_equal(read_trajectory(tmp_path / "killed.h5").X[-1], shapes[2])
    problem = build(make_scene({**table(), "vesicles": {"file": "killed.h5"}}, tmp_path))
    assert np.abs(problem.X - shapes[2]).max() < 1e-15


def test_a_file_excludes_keys_about_shapes():
    with pytest.raises(ValueError, match=r"vesicles\.file excludes vesicles\.points"):
        build(make_scene({**table(), "vesicles": {"file": "x.h5", "points": 32}}))


@pytest.mark.parametrize("changes", [{}, PAIR, {"flow": {"kind": "quiescent", "rate": None}, **PAIR}])
def test_circles_that_something_moves_are_refused(changes):
    with pytest.raises(ValueError, match=r"vesicle 0 is a circle .* take a reduced area of at most 0\.99999"):
        build(scene_of(changes, vesicles={**changes.get("vesicles", {}), "reduced_area": 1.0}))


def test_nearly_a_circle_is_none_and_a_circle_may_rest():
    assert len(build(scene_of(PAIR, vesicles={**PAIR["vesicles"], "reduced_area": 0.99999, "centers": [[-0.5, 0.0], [0.5, 0.0]]})).X) == 2
    still = {"flow": {"kind": "quiescent", "rate": None}}
    run = simulate(scene_of(still, vesicles={"reduced_area": 1.0}))
    assert np.abs(run.trajectory.X[-1] - run.trajectory.X[0]).max() < 1e-10
