"""A comparison made by hand: two vesicles that move as told, by a reference, by rungs that are off by known distances, and others."""

import json

import numpy as np
from scene_helpers import PAIR, table
from studies.compared import Ran, compare
from studies.fitting import Entry
from studies.rungs import Rung
from studies.runs import Kept, Record, read_record, run

from biem.curves.shapes import equilibrium, place
from biem.run.trajectory import TrajectoryWriter, join, one_frame
from biem.scene.config import make_scene

UNIT = 0.01  # t_gamma
FRAMES = 31
SPEED = (2.0, 0.5)  # R a t_gamma: the vesicles part
TURN = 0.4  # rad a t_gamma


def kept_here(scene, path, timeout=None):
    """`studies.runs.kept` without a process of its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return Kept(scene, path, read_record(scene, path) or run(scene, path))


def kept_all_here(tasks, *_, **__):
    """`studies.runs.kept_all` in this process."""
    return {name: kept_here(*task) for name, task in tasks.items()}


def scene(**solver):
    """Of two vesicles."""
    return make_scene(table(PAIR, solver=solver))


def moving(path, off=0.0, until=3.0, points=32, scene=None):
    """A trajectory file: two vesicles part and turn; `off`: how far from it the second one is, in R a t_gamma, along x. until: t_gamma."""
    shape = equilibrium(points, 0.65)
    R = float(np.sqrt(0.65 / (4 * np.pi**2)))
    times = np.linspace(0.0, 3.0, FRAMES)
    frames = []
    for k, t in enumerate(times[times <= until + 1e-9]):
        step = np.array(SPEED) * R * t
        centers = [np.array([-1.5 * R, 0.0]) - step, np.array([1.5 * R, 0.0]) + step + np.array([off * R * t, 0.0])]
        X = np.stack([place(shape, c, TURN * t + n) for n, c in enumerate(centers)])
        frames.append(one_frame(UNIT * t, 10 * k, X, None, {"bending_energy": 1.0, "wall_seconds": 0.02, "rejected": 0.0}))
    TrajectoryWriter(
        path, {"schema": 1, "run": "x", "t_gamma": UNIT, "scene": json.dumps({}), "flow_width": 0.0}, [join(frames, {})]
    ).close()
    return R


def ran(folder, name, cpu_a_step, failure="", until=3.0, **motion):
    """A rung that took some CPU seconds a step, 10 steps a frame."""
    path = folder / f"{len(list(folder.glob('*.h5')))}.h5"
    found = scene(kind="implicit" if name == "implicit" or name.startswith("truth") else "split")
    moving(path, until=until, **motion)
    steps = round(until / 3.0 * (FRAMES - 1)) * 10
    record = Record("", failure, UNIT * until, steps, 0.02, cpu_a_step, 1e8, {"near": 0.01}, {"pair_sum": 7}, commit="abc", machine="one")
    return Ran(Entry(Rung(name, found), notes=("N = 32, as it likes",) if name == "good" else ()), Kept(found, path, record))


def refused(name, why):
    """A rung that was not run."""
    return Ran(Entry(Rung(name, scene(kind="split")), refused=why), None)


def comparison(folder, rungs=None, coarse=0.003):
    """A reference of 0.4 s a step, and of rungs a good one, a cheap one that is far off, a dear one, one that failed and one refused.

    coarse: how far the second run of the reference is off, R a t_gamma.
    """
    truth = ran(folder, "truth", 0.4)
    rungs = rungs or [
        ran(folder, "good", 0.02, off=0.002),
        ran(folder, "cheap", 0.01, off=-0.1),
        ran(folder, "implicit", 0.1, off=0.003),
        ran(folder, "broken", 0.001, failure="step 100: vesicles cross", until=1.0, off=0.0005),
        refused("unfit", "they are for 32 nodes, <b>not</b> these"),
    ]
    return compare(truth, rungs, ran(folder, "truth, coarser", 0.4, off=coarse), 3.0, "its difference from a run at twice the step")
