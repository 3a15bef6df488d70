"""`doctor`: what it finds on this machine, its runs of known results, and that what is wrong is told with exit code 3."""

import json
import os
import shutil
import sys
from importlib.metadata import version

import numpy as np
import pytest
from scene_helpers import cli

import biem
from biem.backend import threads
from biem.run import doctor
from biem.run.doctor import Absent, diagnose, examine, lines


def test_what_this_machine_has():
    found = examine()
    assert found["vesnet"] == biem.__version__
    assert found["packages"]["numpy"] == np.__version__
    assert found["packages"]["h5py"] == version("h5py")
    assert found["threads"] == threads()
    assert found["cores"] == len(os.sched_getaffinity(0))
    assert found["devices"][0] == "cpu: NumPy"
    assert 1e8 < found["memory_bytes"] < 1e14
    assert "pyFFTW" in found["fft"]
    text = "\n".join(lines({**found, "packages": {"numpy": "2.0", "cufinufft": None}}))
    assert "numpy 2.0; not installed: cufinufft" in text
    assert sys.executable in text


@pytest.fixture(scope="module")
def report():
    """All checks, as JSON."""
    result = cli("doctor", "--json")
    return result, json.loads(result.stdout)


def test_all_checks_hold_here(report):
    result, found = report
    checks = {check["name"]: check for check in found["checks"]}
    assert result.exit_code == 0
    assert found["passed"]
    expected = {
        "relaxation",
        "one vesicle in shear",
        "split against implicit",
        "files and restart",
        "far field",
        "networks",
        "two processes",
    }
    assert expected <= set(checks)
    for name in ("relaxation", "one vesicle in shear", "split against implicit", "files and restart", "networks"):
        assert checks[name]["state"] == "ok", checks[name]
    assert all(check["state"] in ("ok", "absent") for check in checks.values()), checks
    assert sum(check["seconds"] for check in checks.values()) < 60
    assert "42.857 known" in checks["relaxation"]["detail"]


CHEAP = {"relaxation": "relaxation", "steady_inclination": "one vesicle in shear", "far_field": "far field"}


@pytest.fixture
def only(monkeypatch):
    """The checks of these names alone."""
    return lambda *names: monkeypatch.setattr(doctor, "_checks", lambda: iter([(CHEAP[name], getattr(doctor, name)) for name in names]))


@pytest.mark.parametrize(
    ("name", "broken", "value"),
    [("relaxation", "LEAST_ENERGY", 43.0), ("steady_inclination", "INCLINATION", 0.357), ("relaxation", "simulate", None)],
)
def test_what_is_wrong_is_told_and_fails(monkeypatch, only, name, broken, value):
    only(name, "far_field")
    monkeypatch.setattr(doctor, broken, value)
    result = cli("doctor", "--quiet")
    assert result.exit_code == 3
    assert result.stdout.startswith(f"FAILED  {CHEAP[name]}: ")
    assert len(result.stdout.splitlines()) == 1  # the other one is in order
    assert result.stderr == "error: 1 of 2 checks failed\n"
    result = cli("doctor", "--json")
    assert (result.exit_code, json.loads(result.stdout)["passed"]) == (3, False)


def test_an_energy_that_rises_or_an_area_that_drifts_fails(monkeypatch, only):
    only("relaxation")
    run = doctor._run
    monkeypatch.setattr(doctor, "verify", lambda run: [doctor.Finding("area kept", "failed", "", 0.0)])
    monkeypatch.setattr(doctor.Finding, "passed", False, raising=False)
    assert [finding.state for finding in diagnose()] == ["failed"]
    monkeypatch.undo()
    only("relaxation")

    def backwards(*arguments, **vesicles):
        found = run(*arguments, **vesicles)
        found.diagnostics["bending_energy"][:-1] = found.diagnostics["bending_energy"][:-1][::-1]
        return found

    monkeypatch.setattr(doctor, "_run", backwards)
    assert [finding.state for finding in diagnose()] == ["failed"]


def test_a_far_field_that_errs_fails(monkeypatch, only):
    if "finufft" not in sys.modules:
        pytest.importorskip("finufft")
    only("far_field")
    assert [finding.state for finding in diagnose()] == ["ok"]
    exact = doctor.pair_sum

    def wrong(targets, X, mu, far_field, tolerance):
        return exact(targets, X, mu if far_field == "direct" else 1.0001 * mu, far_field=far_field, tolerance=tolerance)

    monkeypatch.setattr(doctor, "pair_sum", wrong)
    assert [finding.state for finding in diagnose()] == ["failed"]


def test_what_is_not_installed_is_absent_and_no_failure(monkeypatch):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    for check, what in ((doctor.far_field, "finufft"), (doctor.networks, "surrogate"), (doctor.two_processes, "mpi4py")):
        with pytest.raises(Absent, match=what):
            check()
    assert doctor._devices() == ["cpu: NumPy"]
    monkeypatch.setattr(doctor, "_checks", lambda: iter([("far field", doctor.far_field)]))
    assert cli("doctor").exit_code == 0


def test_a_launcher_that_does_not_start_processes_is_told(monkeypatch, tmp_path):
    if doctor.find_spec("mpi4py") is None:
        pytest.skip("mpi4py is not installed")
    for program, passed in (("echo 2 1.0", True), ("echo 1 0.0", False), ("echo no such host >&2; exit 1", False)):
        launcher = tmp_path / "mpirun"
        launcher.write_text(f"#!/bin/sh\n{program}\n")
        launcher.chmod(0o755)
        monkeypatch.setattr(doctor, "_mpirun", lambda launcher=launcher: str(launcher))
        found, detail = doctor.two_processes()
        assert found == passed
    assert "no such host" in detail
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    monkeypatch.setattr(doctor, "_mpirun", lambda: None)
    with pytest.raises(Absent, match="no mpirun"):
        doctor.two_processes()
