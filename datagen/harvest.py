"""Harvest: runs of fundamental flows, and the shapes that vesicles take along the way. mu = kappa_b = length = 1.

A task is a batch of runs of one family, each a single vesicle; of a suspension it is one run. The shapes of a task are taken at common
times, evenly spaced over the family's horizon in units of t_gamma = 1/(mean rate of the batch), of relaxation of t_kappa = R^3. A step is
at most family.dt of the smallest t_gamma among the runs, and of t_kappa where the flow is weaker than bending.

Steps are first-order split steps: shapes are wanted, not trajectories. What their errors change most is when a shape is reached.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi

import numpy as np

from biem.backend import Array, count, to_numpy
from biem.curves.fourier import remove_nyquist, resample
from biem.curves.pose import standardize
from datagen.batch import Batch
from datagen.config import Dataset
from datagen.flows import Flows, radius_of, start_of
from datagen.jobs import one_thread
from datagen.suspension import draw_scene, suspension

LADDER = (32, 64, 128, 256)  # nodes of adaptive runs


@dataclass(frozen=True)
class HarvestTask:
    """Runs first .. first + runs - 1, counted over all families, of one family (its index in the file)."""

    id: int
    family: int
    first: int
    runs: int


def harvest_tasks(config: Dataset) -> list[HarvestTask]:
    """All tasks of a data set, in order."""
    tasks: list[HarvestTask] = []
    first = 0
    for index, family in enumerate(config.harvest):
        batch = 1 if family.flow == "suspension" else family.batch
        for start in range(0, family.runs, batch):
            tasks.append(HarvestTask(len(tasks), index, first + start, min(batch, family.runs - start)))
        first += family.runs
    return tasks


def harvest(config: Dataset, task: HarvestTask) -> dict[str, np.ndarray]:
    """The shapes of a task, by run, then by time: X (n, 2, points) standardized, run, family (n,) int64, time, capillary (n,).

    time is in t_gamma of the run, of relaxation in t_kappa; capillary is 0 of relaxation. A run that fails ends there, its later shapes
    are missing; it is counted as runs_ended.
    """
    shapes = _of_suspension if config.harvest[task.family].flow == "suspension" else _of_batch
    with one_thread():  # the bytes of a shard do not depend on the number of threads
        X, run, time, capillary = shapes(config, task)
        X_std, _ = standardize(X)
    return {
        "X": X_std,
        "run": task.first + run,
        "family": np.full(len(X), task.family),
        "time": time,
        "capillary": capillary,
    }


Shapes = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # X (n, 2, points), run in the task, time and capillary number (n,)


def _of_batch(config: Dataset, task: HarvestTask) -> Shapes:
    family, reduced_area = config.harvest[task.family], config.shapes.reduced_area
    starts = [start_of(config, task.family, _number(config, task) + b) for b in range(task.runs)]
    flows = Flows.of(family.flow, starts, reduced_area)
    batch = Batch(flows.velocity, reduced_area / (4.0 * pi), _ladder(config), config.simulation.tolerance)

    t_kappa = radius_of(reduced_area) ** 3
    rate = np.full(task.runs, 1.0 / t_kappa) if family.flow == "relaxation" else flows.rate
    spacing = family.horizon / family.shapes / rate.mean()
    steps = ceil(spacing / (family.dt * min(1.0 / rate.max(), t_kappa)) - 1e-9)

    groups = batch.start(_on_device(np.stack([s.X for s in starts]), config.simulation.device))
    X = np.zeros((task.runs, family.shapes, 2, config.shapes.points))
    taken = np.zeros((task.runs, family.shapes), dtype=bool)
    for k in range(family.shapes):
        groups = batch.advance(groups, spacing / steps, steps)
        for group in groups:
            X[group.runs, k] = _stored(to_numpy(group.state.X), config)
            taken[group.runs, k] = True
    count("runs_ended", int((~taken[:, -1]).sum()))
    run, time = np.nonzero(taken)
    return X[run, time], run, (time + 1) * spacing * rate[run], np.array([s.capillary for s in starts])[run]


def _of_suspension(config: Dataset, task: HarvestTask) -> Shapes:
    family = config.harvest[task.family]
    scene, capillary = draw_scene(config, task.family, _number(config, task))
    frames = list(suspension(scene, family.shapes))
    count("runs_ended", int(len(frames) < family.shapes))
    n = len(frames) * family.vesicles
    X = _stored(np.concatenate([np.empty((0, 2, scene.vesicles.points)), *frames]), config)
    time = np.repeat(np.arange(1, len(frames) + 1) * family.horizon / family.shapes, family.vesicles)
    return X, np.zeros(n, dtype=np.int64), time, np.full(n, capillary)


def _number(config: Dataset, task: HarvestTask) -> int:
    """The task's first run as it counts in its family."""
    return task.first - sum(family.runs for family in config.harvest[: task.family])


def _stored(X: np.ndarray, config: Dataset) -> np.ndarray:
    """Membranes low-passed to the modes that are kept of shapes, before they are standardized, on the nodes that shapes are stored with."""
    return resample(remove_nyquist(resample(X, 2 * config.shapes.modes)), config.shapes.points)


def _ladder(config: Dataset) -> tuple[int, ...]:
    points = config.simulation.points
    return LADDER if points == "adaptive" else (points,)


def _on_device(X: np.ndarray, device: str) -> Array:
    """On "cpu" (NumPy), "torch" (PyTorch on the CPU) or "cuda[:N]"."""
    if device == "cpu":
        return X
    import torch

    return torch.as_tensor(X, device="cpu" if device == "torch" else device)
