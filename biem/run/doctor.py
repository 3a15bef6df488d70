"""What this machine has, and whether the solvers work on it: versions, devices, MPI, FFT, threads, and small runs of known results.

Each check is a run or a sum whose result is known: from the literature of the method, or from another way to compute it. It is told as
"ok", "failed", or "absent" where an optional library is not installed, which is no failure.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from biem.backend import FFTW_PAYS_ABOVE, threads
from biem.curves.curve import centroid, effective_radius, inclination
from biem.ranks import LAUNCHERS
from biem.run.simulate import simulate
from biem.run.trajectory import Trajectory, read_trajectory
from biem.run.verify import verify
from biem.scene.config import make_scene
from biem.stokes.farfield import pair_sum

PACKAGES = (
    *("numpy", "scipy", "pyfftw", "numba", "h5py", "shapely", "pydantic", "typer", "matplotlib", "torch", "safetensors"),
    *("finufft", "cufinufft", "mpi4py", "mpich", "vtk"),
)
LEAST_ENERGY = 42.857  # kappa_b/length at reduced area 0.65
INCLINATION = 0.35526  # rad, in shear at reduced area 0.65, Ca = 5 (docs/measurements.md)
PATIENCE = 60.0  # s, for two processes to start
LAUNCHED_BY = ("PMI", "PMIX", "HYD", "MPI", "OMPI", "PRTE", "SLURM")  # beginnings of names of variables that a launcher sets

TWO_PROCESSES = (
    "from biem.ranks import world; import numpy as np; r = world(); x = r.gather(2, lambda s: np.arange(2.0)[s]); "
    "print(r.size, x.sum()) if r.rank == 0 else None"
)


class Absent(Exception):
    """What a check is of is not installed here."""


@dataclass(frozen=True)
class Finding:
    """One check. state: "ok", "failed" or "absent"; detail: the numbers behind it; seconds: what it took."""

    name: str
    state: str
    detail: str
    seconds: float


def examine() -> dict[str, Any]:
    """Versions, devices, and how work is shared, for `python -m biem doctor`."""
    cores = len(os.sched_getaffinity(0))
    return {
        "vesnet": _version("vesnet"),
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in PACKAGES},
        "cores": cores,
        "memory_bytes": os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
        "threads": threads(),
        "threads_by": "OMP_NUM_THREADS" if os.environ.get("OMP_NUM_THREADS") else "the cores that this process may run on",
        "blas": _blas(),
        "fft": f"pyFFTW for transforms of {FFTW_PAYS_ABOVE:,} values and more, SciPy below" if _version("pyfftw") else "SciPy",
        "far_field": "Ewald by finufft" if find_spec("finufft") else "direct sums: finufft is not installed, pip install 'vesnet[fast]'",
        "devices": _devices(),
        "mpirun": _mpirun(),
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _blas() -> str:
    from threadpoolctl import threadpool_info

    found = [f"{p['internal_api']} {p['version']}, {p['num_threads']} thread(s)" for p in threadpool_info() if p["user_api"] == "blas"]
    return ", ".join(dict.fromkeys(found))


def _devices() -> list[str]:
    """The names that solver.device takes here, each with what it is."""
    found = ["cpu: NumPy"]
    if find_spec("torch") is not None:
        import torch

        found.append("torch: PyTorch on the CPU")
        for k in range(torch.cuda.device_count() if torch.cuda.is_available() else 0):
            device = torch.cuda.get_device_properties(k)
            found.append(f"cuda:{k}: {device.name}, {device.total_memory / 2**30:.0f} GiB")
    return found


def _mpirun() -> str | None:
    """The launcher beside this Python, which mpi4py was installed with, or the one on the path."""
    return shutil.which("mpirun", path=str(Path(sys.executable).parent)) or shutil.which("mpirun")


def diagnose(progress: Callable[[Finding], None] = lambda _: None) -> list[Finding]:
    """All checks, about ten seconds; progress: called with each one as it is done. A check that raises has failed."""
    findings = []
    for name, check in _checks():
        begin = time.perf_counter()
        try:
            passed, detail = check()
            state = "ok" if passed else "failed"
        except Absent as absent:
            state, detail = "absent", str(absent)
        except Exception as error:  # whatever a broken installation does
            state, detail = "failed", f"{type(error).__name__}: {' '.join(str(error).split())}"
        findings.append(Finding(name, state, detail, time.perf_counter() - begin))
        progress(findings[-1])
    return findings


def _checks() -> Iterator[tuple[str, Callable[[], tuple[bool, str]]]]:
    yield "relaxation", relaxation
    yield "one vesicle in shear", steady_inclination
    yield "split against implicit", split_against_implicit
    yield "files and restart", files_and_restart
    yield "far field", far_field
    for device in _devices()[1:]:
        name = device.rpartition(": ")[0] if device.startswith("cuda") else "torch"
        yield f"device {name}", partial(on_device, name)
    yield "networks", networks
    yield "two processes", two_processes


def _scene(flow: Mapping[str, Any], time_table: Mapping[str, Any], solver: Mapping[str, Any], **vesicles: Any) -> Any:
    tables = {"vesicles": {"reduced_area": 0.65, "points": 32, **vesicles}, "flow": flow, "time": time_table, "solver": solver}
    return make_scene({"name": "doctor", **tables})


def _run(*arguments: Any, **vesicles: Any) -> Trajectory:
    return simulate(_scene(*arguments, **vesicles)).trajectory


def relaxation() -> tuple[bool, str]:
    """An ellipse relaxes: its energy falls at every step, to the known least one; area and length stay; nothing crosses."""
    run = _run({}, {"dt": "0.02 t_kappa", "horizon": "0.6 t_kappa"}, {"kind": "implicit"}, shape="ellipse")
    energy = run.diagnostics["bending_energy"]
    off = float(energy[-1] / LEAST_ENERGY - 1.0)
    kept = all(check.passed for check in verify(run))
    detail = f"energy {energy[0]:.2f} to {energy[-1]:.2f}, {LEAST_ENERGY} known; area and length {'kept' if kept else 'NOT kept'}"
    return bool((np.diff(energy) < 0).all() and abs(off) < 2e-3 and kept), detail


def steady_inclination() -> tuple[bool, str]:
    """The split solver, of second order with adaptive steps, against the known steady angle."""
    run = _run({"kind": "shear", "capillary": 5.0}, {"horizon": "10 t_gamma"}, {"accuracy": "balanced"}, shape="ellipse")
    angle = float(inclination(run.X[-1])[0])
    return abs(angle / INCLINATION - 1.0) < 3e-3, f"inclination {angle:.4f} rad, {INCLINATION} known"


def _pair(kind: str, **solver: Any) -> np.ndarray:
    """Two vesicles that pass in shear, after 1 t_gamma (2, 2, N)."""
    where = {"unit": "R", "centers": [[-2.3, 0.3], [0.0, 0.0]], "angles": [0.0, np.pi / 2]}
    steps = {"dt": "0.05 t_gamma", "horizon": "1 t_gamma", "order": 2}
    return _run({"kind": "shear", "capillary": 5.0}, steps, {"kind": kind, **solver}, **where).X[-1]


def split_against_implicit() -> tuple[bool, str]:
    """Two solvers that share kernels and operators but no step."""
    a, b = _pair("implicit"), _pair("split")
    off = float(np.abs(centroid(a) - centroid(b)).max() / effective_radius(a).mean())
    return off < 5e-3, f"centroids of two vesicles {off:.1e} R apart after 1 t_gamma"


def files_and_restart() -> tuple[bool, str]:
    """A run in two parts, through its files, against the same run in one."""
    scenes = [
        _scene({"kind": "shear", "capillary": 5.0}, {"dt": "0.02 t_gamma", "horizon": f"{end} t_gamma"}, {"kind": "split"}, points=16)
        for end in (0.1, 0.2)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.h5"
        simulate(scenes[0], path)
        simulate(scenes[1], path, resume=True)
        resumed = read_trajectory(path)
    same = np.array_equal(resumed.X, simulate(scenes[1]).trajectory.X)
    return same, f"{len(resumed)} frames written and read back; resumed {'bit for bit' if same else 'with a DIFFERENCE'}"


def far_field() -> tuple[bool, str]:
    """Ewald's sum against the direct one."""
    if find_spec("finufft") is None:
        raise Absent("finufft is not installed: sums are direct; pip install 'vesnet[fast]'")
    rng = np.random.default_rng(0)
    alpha = 2 * np.pi * np.arange(32) / 32
    circles = 0.1 * np.stack([np.cos(alpha), np.sin(alpha)]) + 3.0 * rng.random((60, 2, 1))
    f, targets = rng.standard_normal(circles.shape), 3.0 * rng.random((500, 2))
    direct, ewald = (pair_sum(targets, circles, 1.0, far_field=name, tolerance=1e-6).velocity(f) for name in ("direct", "ewald"))
    off = float(np.linalg.norm(ewald - direct) / np.linalg.norm(direct))
    return off < 1e-5, f"Ewald's sum of {circles.shape[0] * 32} points within {off:.0e} of the direct one"


def on_device(name: str) -> tuple[bool, str]:
    """The split solver on another device against NumPy."""
    off = float(np.abs(_pair("split", device=name) - _pair("split")).max())
    return off < 1e-7, f"nodes of two vesicles {off:.0e} lengths from those of NumPy"


def networks() -> tuple[bool, str]:
    """A relaxation by shipped corrections against one by exact maps."""
    if find_spec("surrogate") is None:
        raise Absent("the package surrogate is not installed")
    learned = _run({}, {"dt": 1e-5, "horizon": 1e-4}, {"kind": "vesnet"}, shape="ellipse").X
    exact = _run({}, {"dt": 2e-6, "horizon": 1e-4, "order": 2}, {"kind": "split", "operator_points": 96}, shape="ellipse").X
    off, moved = float(np.abs(learned[-1] - exact[-1]).max()), float(np.abs(exact[-1] - exact[0]).max())
    return off < 0.02 * moved, f"nodes within {off:.0e} lengths of those by exact maps, after moving {moved:.0e}"


def two_processes() -> tuple[bool, str]:
    """mpirun starts two processes that exchange arrays."""
    if find_spec("mpi4py") is None:
        raise Absent("mpi4py is not installed: one process; pip install 'vesnet[mpi]'")
    launcher = _mpirun()
    if launcher is None:
        raise Absent("there is no mpirun beside this Python or on the path")
    if any(name in os.environ for name in LAUNCHERS):
        raise Absent("this is a process of mpirun or srun itself")
    plain = {name: value for name, value in os.environ.items() if not name.startswith(LAUNCHED_BY)}
    command = [launcher, "-n", "2", sys.executable, "-c", TWO_PROCESSES]
    try:
        done = subprocess.run(command, env=plain, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return False, f"{launcher} -n 2 did not end within {PATIENCE:.0f} s"
    said = " ".join((done.stdout or done.stderr).split())
    return done.stdout.split() == ["2", "1.0"], f"{launcher} -n 2: " + ("they exchange arrays" if done.stdout else said[:300])


def as_report(found: Mapping[str, Any], findings: list[Finding]) -> dict[str, Any]:
    """For --json: what was found, the checks, and whether none has failed."""
    return {**found, "checks": [asdict(f) for f in findings], "passed": all(f.state != "failed" for f in findings)}


def lines(found: Mapping[str, Any]) -> list[str]:
    """What `examine` found, in words."""
    packages = [f"{name} {number}" for name, number in found["packages"].items() if number]
    absent = [name for name, number in found["packages"].items() if not number]
    return [
        f"vesnet {found['vesnet']}, Python {found['python']}",
        f"on {found['platform']}, {found['memory_bytes'] / 2**30:.0f} GiB",
        f"packages   {', '.join(packages)}" + (f"; not installed: {', '.join(absent)}" if absent else ""),
        f"threads    {found['threads']} of {found['cores']} cores, by {found['threads_by']}; BLAS: {found['blas']}",
        f"FFT        {found['fft']}",
        f"far field  {found['far_field']}",
        f"devices    {'; '.join(found['devices'])}",
        f"MPI        {found['mpirun'] or 'no mpirun: one process'}",
    ]
