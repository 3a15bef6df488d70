"""Harvest: its tasks and draws, shapes and times, runs that end, devices, bytes, the files of data sets."""

import hashlib
import os
import subprocess
import sys
from math import pi
from pathlib import Path

import numpy as np
import pytest
from harvest_cases import EXTENSIONAL, POISEUILLE, RELAXATION, SHEAR, SUSPENSION, R, dataset, first_task

from biem.backend import counting
from biem.curves.curve import bending_energy, centroid, curvature, inclination, length, reduced_area
from biem.curves.shapes import ellipse, place
from biem.scene.flows import make_flow
from datagen.batch import Batch
from datagen.config import load_dataset
from datagen.flows import Flows, Start, initial_shape, random_of, start_of
from datagen.harvest import HarvestTask, harvest, harvest_tasks

ROOT = Path(__file__).parents[2]


def digest(shard):
    return hashlib.sha256(b"".join(np.ascontiguousarray(shard[name]).tobytes() for name in sorted(shard))).hexdigest()


def test_tasks_hold_every_run_once_in_order():
    config = dataset(RELAXATION | {"runs": 7, "batch": 3}, SUSPENSION, SHEAR | {"runs": 4, "batch": 4})
    tasks = harvest_tasks(config)
    assert tasks == harvest_tasks(config)
    assert [task.id for task in tasks] == list(range(6))
    assert [(task.family, task.first, task.runs) for task in tasks] == [(0, 0, 3), (0, 3, 3), (0, 6, 1), (1, 7, 1), (1, 8, 1), (2, 9, 4)]


def test_run_r_has_the_stratum_r_of_the_capillary_numbers():
    config = dataset(SHEAR | {"runs": 40, "capillary": (0.5, 50.0)})
    drawn = np.array([start_of(config, 0, r).capillary for r in range(40)])
    place_in = np.log(drawn / 0.5) / np.log(100.0) * 40 - np.arange(40)
    assert place_in.min() >= 0.0
    assert place_in.max() < 1.0
    assert 0.2 < place_in.std() < 0.4  # 0.29 where it is uniform


def test_a_run_is_drawn_by_seed_family_and_number_alone():
    shear = SHEAR | {"runs": 6}
    config = dataset(RELAXATION, shear | {"batch": 4})
    other = dataset(RELAXATION | {"runs": 9, "horizon": 5.0}, shear | {"batch": 2, "dt": 0.01, "shapes": 7})
    drawn, again = start_of(config, 1, 4), start_of(other, 1, 4)
    assert np.array_equal(drawn.X, again.X)
    assert drawn.capillary == again.capillary
    for unlike in (start_of(config, 1, 5), start_of(dataset(RELAXATION, shear, seed=1), 1, 4), start_of(dataset(shear), 0, 4)):
        assert np.abs(unlike.X - drawn.X).max() > 1e-3


@pytest.mark.parametrize(("initial", "modes"), [("perturbed", 6), ("equilibrium", 6), ("ellipse", 6), ("perturbed", 12)])
def test_initial_shapes(initial, modes):
    config = dataset(SHEAR | {"initial": initial, "roughness": modes})
    X = np.stack([initial_shape(config, config.harvest[0], random_of(config, 0, r)) for r in range(3)])
    assert reduced_area(X) == pytest.approx(0.65, abs=1e-9)
    assert length(X) == pytest.approx(1.0, abs=1e-12)
    theta = curvature(X) / (2 * pi) - 1.0  # of the tangent angle's own modes, on nodes equally spaced
    beyond = np.abs(np.fft.rfft(theta))[:, modes + 1 :].max() / np.abs(np.fft.rfft(theta)).max()
    assert (beyond < 1e-6) == (initial == "perturbed")


def test_places_in_poiseuille_flow_are_on_both_sides_within_the_range():
    config = dataset(POISEUILLE | {"runs": 30, "offset": (0.1, 0.5), "confinement": (0.2, 0.6)})
    starts = [start_of(config, 0, r) for r in range(30)]
    y = np.array([centroid(s.X[None])[0, 1] * s.confinement / R for s in starts])  # in W
    assert 0.1 <= np.abs(y).min() < 0.2
    assert 0.4 < np.abs(y).max() <= 0.5
    assert 5 < (y > 0).sum() < 25
    Cn = np.array([s.confinement for s in starts])
    assert 0.2 <= Cn.min() < 0.3
    assert 0.5 < Cn.max() <= 0.6
    angles = np.array([inclination(s.X[None])[0] for s in starts])
    assert angles.min() < -0.8
    assert angles.max() > 0.8


@pytest.mark.parametrize("kind", ["shear", "extensional", "poiseuille"])
def test_flows_of_a_batch_are_those_of_its_runs(kind):
    flows = Flows.of(kind, [Start(np.empty(0), c, Cn) for c, Cn in ((1.0, 0.3), (4.0, 0.5), (9.0, 0.8))], 0.65)
    X = np.stack([place(ellipse(32, 0.65), np.zeros(2), a) for a in (0.1, 0.2)])
    u = flows.velocity(np.array([0, 2]), X)(X, 0.0)
    for i, (capillary, Cn) in enumerate(((1.0, 0.3), (9.0, 0.8))):
        rate = capillary / ((2.0 if kind == "poiseuille" else 1.0) * R**3)
        single = make_flow(kind, rate, R / Cn).velocity(X[[i]], 0.0)[0]
        assert np.abs(u[i] - single).max() < 1e-7 * np.abs(single).max()


def test_relaxation_ends_in_the_equilibrium_shape():
    shard = first_task(dataset(RELAXATION | {"dt": 0.1, "horizon": 12.0, "shapes": 4}, points="adaptive"))
    energy = bending_energy(shard["X"]).reshape(3, 4)
    assert energy[:, -1] == pytest.approx(42.8572, abs=1e-3)
    assert (np.diff(energy) < 1e-6).all()
    assert (shard["capillary"] == 0).all()


@pytest.mark.parametrize("family", [RELAXATION, SHEAR, EXTENSIONAL, POISEUILLE])
def test_shards(family):
    """Columns, standard shapes, times in the unit of each run; lengths and areas as they began."""
    config = dataset(family, family | {"runs": 5, "batch": 2}, points="adaptive")
    task = harvest_tasks(config)[2]
    assert task == HarvestTask(2, 1, 5, 2)
    shard = harvest(config, task)
    assert shard["X"].shape == (4, 2, 128)
    assert shard["run"].tolist() == [5, 5, 6, 6]
    assert shard["family"].tolist() == [1] * 4
    assert {shard[name].dtype.name for name in ("run", "family")} == {"int64"}
    assert {shard[name].dtype.name for name in ("X", "time", "capillary")} == {"float64"}
    assert np.abs(length(shard["X"]) - 1).max() < 1e-12
    assert np.abs(reduced_area(shard["X"]) - 0.65).max() < 1e-5
    assert np.abs(centroid(shard["X"])).max() < 1e-12
    horizon = family["horizon"]
    spacing = shard["time"].reshape(2, 2)
    assert spacing[:, 1] == pytest.approx(2 * spacing[:, 0])
    assert spacing[:, 1].mean() == pytest.approx(horizon)
    if family is not RELAXATION:  # in t_gamma of the run, at common times
        assert spacing[1, 1] / spacing[0, 1] == pytest.approx(shard["capillary"][2] / shard["capillary"][0])
        assert shard["capillary"][0] == start_of(config, 1, 2).capillary


def test_steps_are_bounded_by_both_time_scales(monkeypatch):
    taken = []
    monkeypatch.setattr(Batch, "advance", lambda self, groups, dt, steps: taken.append((dt, steps)) or groups)
    for capillary in ((5.0, 5.1), (0.1, 0.1001)):
        first_task(dataset(SHEAR | {"capillary": capillary, "dt": 0.05, "horizon": 0.6, "shapes": 3}))
    (strong, few), _, _, (weak, many), *_ = taken
    assert (few, many) == (5, 40)  # 0.2 of the mean t_gamma by 0.05 of the smallest; 0.2 t_gamma are a little less than 2 t_kappa
    assert strong == pytest.approx(0.2 / 5 * R**3 / 5.05, rel=0.01)
    assert 0.045 < weak / R**3 < 0.05


def test_an_ended_run_is_counted_and_its_later_shapes_are_missing(monkeypatch):
    plain = Flows.velocity

    def velocity(self, which, like):
        inner = plain(self, which, like)
        return lambda X, t: inner(X, t) + np.where((which == 1) & (t > 0.7 / self.rate.mean()), np.nan, 0.0)[:, None, None]

    config = dataset(SHEAR | {"horizon": 1.6, "shapes": 4})
    whole = first_task(config)
    monkeypatch.setattr(Flows, "velocity", velocity)
    with counting() as counts:
        shard = first_task(config)
    assert counts["runs_ended"] == 1
    assert shard["run"].tolist() == [0, 0, 0, 0, 1, 2, 2, 2, 2]
    kept = np.isin(np.arange(12), [0, 1, 2, 3, 4, 8, 9, 10, 11])
    assert np.array_equal(shard["time"], whole["time"][kept])
    assert np.abs(shard["X"] - whole["X"][kept]).max() < 1e-10
    monkeypatch.setattr(Flows, "velocity", lambda self, which, like: lambda X, t: X + np.nan)
    with counting() as counts:
        shard = first_task(config)
    assert counts["runs_ended"] == 3
    assert shard["X"].shape == (0, 2, 128)
    assert len(shard["run"]) == len(shard["time"]) == len(shard["capillary"]) == 0


def test_steps_that_lose_area_or_length_end_a_run(monkeypatch):
    config = dataset(SHEAR | {"dt": 0.2, "horizon": 1.0})
    assert len(first_task(config)["X"]) == 6
    monkeypatch.setattr("datagen.batch.MAX_ERROR", 1e-6)
    assert len(first_task(config)["X"]) == 0


def test_runs_that_cross_themselves_end(monkeypatch):
    monkeypatch.setattr("datagen.batch.self_crossings", lambda X: [0] if len(X) > 1 else [])  # not found in any run alone
    assert len(first_task(dataset(SHEAR))["X"]) == 6
    monkeypatch.setattr("datagen.batch.self_crossings", lambda X: list(range(len(X))))
    assert len(first_task(dataset(SHEAR))["X"]) == 0


@pytest.mark.parametrize("family", [RELAXATION, SHEAR, EXTENSIONAL, POISEUILLE])
def test_numpy_and_torch_agree(family):
    rough = family | {"roughness": 8}
    numpy, on_torch = (first_task(dataset(rough, points="adaptive", device=device)) for device in ("cpu", "torch"))
    assert np.abs(numpy["X"] - on_torch["X"]).max() < 1e-9
    assert np.array_equal(numpy["time"], on_torch["time"])
    assert isinstance(on_torch["X"], np.ndarray)


HASHES = """
import sys
sys.path[:0] = {path!r}
from test_harvest import *
print(*hashes())
"""


def hashes():
    """Of the shards of one task of each family, on as many nodes as they need."""
    families = [family | {"roughness": 8} for family in (RELAXATION, SHEAR, EXTENSIONAL, POISEUILLE)] + [SUSPENSION]
    config = dataset(*families, points="adaptive")
    first = {task.family: task for task in reversed(harvest_tasks(config))}
    return [digest(harvest(config, first[k])) for k in range(len(families))]


def test_bytes_are_the_same_again_and_on_any_number_of_threads():
    assert hashes() == hashes()
    program = HASHES.format(path=[str(Path(__file__).parent), str(ROOT)])
    found = []
    for threads in ("1", "2"):
        environment = os.environ | {"OMP_NUM_THREADS": threads}
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
        found.append(done.stdout.split())
    assert found[0] == found[1]
    assert len(set(found[0])) == 5


@pytest.mark.parametrize(("name", "least", "most"), [("smoke", 90, 110), ("default", 90_000, 110_000)])
def test_the_files_of_data_sets(name, least, most):
    config = load_dataset(ROOT / "configs" / "datagen" / f"{name}.toml")
    assert {family.flow for family in config.harvest} == {"relaxation", "shear", "extensional", "poiseuille", "suspension"}
    shapes = sum(f.runs * f.shapes * (f.vesicles if f.flow == "suspension" else 1) for f in config.harvest)
    assert least <= shapes <= most
    assert sum(task.runs for task in harvest_tasks(config)) == sum(f.runs for f in config.harvest)
