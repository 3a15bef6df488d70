"""`verify`: passes on files that runs leave, fails with exit code 3 on files that were changed."""

import re

import h5py
import numpy as np
import pytest
from scene_helpers import DT, PAIR, cli, scene_of, the_error

from biem.run.simulate import simulate

GOOD = {
    "pair": {"vesicles": {**PAIR["vesicles"], "points": 32}},
    "coarse": {},
    "coarse ellipse": {"vesicles": {"shape": "ellipse", "reduced_area": 0.65}, "flow": {"kind": "quiescent", "rate": None}},
    "uncorrected": {"solver": {"corrections": []}},
    "few frames": {"time": {"save_every": 1000}},
}


@pytest.mark.parametrize("case", GOOD)
def test_verify_passes_on_good_runs(tmp_path, case):
    simulate(scene_of(GOOD[case], time={"horizon": 8 * DT}), tmp_path / "out.h5")
    result = cli("verify", tmp_path / "out.h5")
    assert result.exit_code == 0, result.output
    assert "FAILED" not in result.output
    assert "2 frames" in result.output if case == "few frames" else "9 frames" in result.output


def tamper(name, file):
    X = file["X"][:]
    if name == "area":
        X[3] *= 1.001
    elif name == "finite":
        X[2, 0, 1, 5] = np.nan
    elif name == "crossing":
        X[4, 1] = X[4, 0] + 0.01
    elif name == "energies":
        X[5, 1] = X[5, 0] + 2.0
    elif name == "times":
        file["t"][3] = file["t"][1]
    file["X"][...] = X


@pytest.mark.parametrize("name", ["area", "finite", "crossing", "energies", "times"])
def test_verify_fails_on_a_tampered_file(tmp_path, name):
    scene = scene_of(PAIR, vesicles={"points": 32, "angles": [1.2, 1.6]}, flow={"kind": "poiseuille", "width": 0.5})
    simulate(scene, tmp_path / "out.h5")
    assert cli("verify", tmp_path / "out.h5").exit_code == 0
    with h5py.File(tmp_path / "out.h5", "a") as file:
        tamper(name, file)
    result = cli("verify", tmp_path / "out.h5")
    assert "checks failed" in the_error(result, 3)
    assert re.search(rf"^FAILED.*{name}", result.output, re.MULTILINE)
