"""One split step of a dense random suspension: NumPy, PyTorch, single precision, Ewald's sum and numbers of threads agree."""

import os
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from biem.backend import counting
from biem.curves.crossing import pair_crossings
from biem.curves.curve import area, effective_radius
from biem.curves.packing import assemble, random_packing
from biem.curves.shapes import perturbed
from biem.membrane.maps import LAYERS, ExactMaps
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import State
from biem.stokes.interaction import Fields
from biem.stokes.near_search import minimum_gap

M, N, FRACTION, GAP = 40, 32, 0.3, 0.02


@cache
def packed():
    """40 shapes (40, 2, 32) of length 1 and reduced area 0.7 on 30 % of a square, gaps of 0.02 at least."""
    rng = np.random.default_rng(0)
    shapes = np.stack([perturbed(N, 0.7, seed=rng, modes=4) for _ in range(M)])
    side = float(np.sqrt(area(shapes).sum() / FRACTION))
    X = assemble(shapes, *random_packing(shapes, (side, side), GAP, rng))
    assert pair_crossings(X) == []
    assert 0.5 * GAP < minimum_gap(X) < 1.0 / N  # near fields matter
    return X


def stepper(precision="float64", near_tolerance=1e-8, **options):
    rate = 5.0 / float(effective_radius(packed())[0]) ** 3

    def shear(X, t):
        return torch.stack([rate * X[:, 1], 0 * X[:, 1]], 1) if isinstance(X, torch.Tensor) else np.stack([rate * X[:, 1], 0 * X[:, 1]], 1)

    maps = ExactMaps(precision=precision)
    options = {"far_field": "direct", **options}
    fields = Fields(near_tolerance=near_tolerance, precision=precision, layers=maps.near_layers, offsets=LAYERS, **options)
    return SplitStepper(maps, 1.0, 1.0, shear, fields), 0.02 / rate


@cache
def warm():
    """A state that has made a step, so that the next one predicts."""
    split, dt = stepper()
    return split.step(State(0.0, packed()), dt).state


def one_step(state=None, **options):
    split, dt = stepper(**options)
    return split.step(warm() if state is None else state, dt).state


def on_torch(state):
    move = torch.from_numpy
    coupling = (state.coupling[0], move(state.coupling[1]), move(state.coupling[2]))
    return State(state.t, move(state.X), None, coupling)


def difference(a, b):
    """Of two positions, over the length of a membrane, which is 1."""
    return np.abs(np.asarray(a.X) - np.asarray(b.X)).max()


def test_torch_equals_numpy():
    warm()
    with counting() as counts:
        exact = one_step()
    assert counts["pair_sum"] == 2
    assert counts["near_sums"] > 500
    assert difference(exact, warm()) > 1e-2
    other = one_step(on_torch(warm()))
    assert other.X.dtype == torch.float64
    assert difference(other, exact) < 1e-11
    assert np.abs(np.asarray(other.sigma) - exact.sigma).max() < 1e-8 * np.abs(exact.sigma).max()


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_single_precision(library):
    other = one_step(on_torch(warm()) if library == "torch" else None, precision="float32", near_tolerance=1e-5)
    assert 1e-10 < difference(other, one_step()) < 1e-5


def test_ewald_equals_direct():
    """To the tolerance 1e-6 of the induced velocity, which a step moves by a few percent of the length."""
    pytest.importorskip("finufft")
    exact, other = one_step(), one_step(far_field="ewald", far_tolerance=1e-6)
    assert 0 < difference(other, exact) < 1e-6
    assert np.abs(other.coupling[1] - exact.coupling[1]).max() < 1e-5 * np.abs(exact.coupling[1]).max()


def test_layers_are_close_to_upsampling():
    """Layers err by about 1e-2 of max |S| at N = 32, where a neighbour is within h alone."""
    exact, other = one_step(), one_step(near_field="layers")
    assert 1e-9 < difference(other, exact) < 1e-3
    assert difference(one_step(near_field="none"), exact) > 1.5 * difference(other, exact)


CASES = {
    "direct": {},
    "ewald": {"far_field": "ewald", "far_tolerance": 1e-6},
    "single": {"precision": "float32", "near_tolerance": 1e-5},
}
SCRIPT = """
import sys
import numpy as np
from parity.test_dense_suspension import CASES, State, stepper
X, out = np.load(sys.argv[1]), {}
for name in sys.argv[3:]:
    split, dt = stepper(**CASES[name])
    state = split.step(State(0.0, X), dt).state
    out |= {f"{name}_X": split.step(state, dt).state.X, f"{name}_sigma": state.sigma}
np.savez(sys.argv[2], **out)
"""


def test_the_number_of_threads_changes_nothing(tmp_path):
    """In processes of their own, with OMP_NUM_THREADS 1 and 2, from the same file: two steps."""
    cases = [name for name in CASES if name != "ewald" or find_spec("finufft")]
    np.save(tmp_path / "X.npy", packed())
    running = {}
    for threads in ("1", "2"):
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "PYTHONPATH": str(Path(__file__).parents[1])}
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / "X.npy"), str(tmp_path / f"{threads}.npz"), *cases]
        running[threads] = subprocess.Popen(command, env=environment, cwd=Path(__file__).parents[2])
    assert [process.wait() for process in running.values()] == [0, 0]
    one, two = (np.load(tmp_path / f"{threads}.npz") for threads in running)
    assert len(one.files) == 2 * len(cases)
    for name in one.files:
        assert np.abs(one[name] - two[name]).max() <= 1e-12 * np.abs(one[name]).max(), name
    assert np.abs(one["direct_X"] - packed()).max() > 1e-2
