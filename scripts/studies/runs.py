"""Runs that are kept: each in a process of its own, with what it cost; one that was stopped goes on, one that is finished is not repeated.

python -m studies.runs SCENE.json OUT.h5 [MODULE:ENDING]       what a process does: SCENE.json holds the resolved scene and its folder

Beside OUT.h5 lies OUT.json: wall, CPU and stage seconds a step, peak memory, what was counted, how it ended; and OUT.weights: which
networks it began with. With others it begins anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path

import numpy as np
from tqdm import tqdm

from biem.backend import counting, fft_backend, timing
from biem.curves.curve import area, length
from biem.errors import NumericalFailure
from biem.run.checkpoint import checkpoint_path
from biem.run.files import write_atomically
from biem.run.simulate import Enough, Stopped, commit, simulate
from biem.run.solver import make_stepper, on_device
from biem.run.trajectory import Trajectory, read_trajectory
from biem.scene.build import build
from biem.scene.config import Scene, make_scene
from biem.steppers.stepper import State
from surrogate.library import SHIPPED

Ending = Callable[[Scene, Trajectory | None], Enough]  # of a scene and the frames that are there: what ends its run before the horizon
SCRIPTS = Path(__file__).resolve().parents[1]
MEGABYTE = 1e6


@dataclass(frozen=True)
class Record:
    """What a run cost, per step (a rejected one counts into the next), and how it ended. failure: the line of an error, or nothing."""

    scene: str
    failure: str = ""
    until: float = 0.0  # time reached
    steps: int = 0
    wall_a_step: float = 0.0
    cpu_a_step: float = 0.0
    peak_bytes: float = 0.0
    seconds: Mapping[str, float] = field(default_factory=dict)  # CPU, a step, by stage
    counts: Mapping[str, float] = field(default_factory=dict)
    threads: int = 1
    commit: str = ""
    machine: str = ""
    weights: str = ""  # digest of the networks' files
    code: int = 0  # of the exit that `biem run` would take: 2 bad input, 3 step rejected
    warnings: Sequence[str] = ()  # that were shown, a line each


@dataclass(frozen=True)
class Kept:
    """A run with its files."""

    scene: Scene
    path: Path
    record: Record

    @property
    def trajectory(self) -> Trajectory:
        return read_trajectory(self.path)


def kept(scene: Scene, path: Path, threads: int = 1, ending: str = "", timeout: float | None = None) -> Kept:
    """The run of a scene, from its files where it is finished, or failed, there.

    ending: "module:name" of an `Ending`; timeout: s. Raises RuntimeError if its process dies, TimeoutError if it takes longer.
    """
    record = read_record(scene, path)
    if record is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        task = path.with_suffix(".scene.json")
        task.write_text(json.dumps({"scene": scene.model_dump(mode="json"), "folder": str(scene.folder.absolute())}))
        environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE"}
        environment["PYTHONPATH"] = os.pathsep.join([str(SCRIPTS), str(SCRIPTS.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "-m", "studies.runs", str(task), str(path), *filter(None, [ending])]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=timeout)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"the run of {path} took longer than {timeout:g} s") from None
        finally:
            task.unlink(missing_ok=True)
        record = read_record(scene, path)
        if record is None:
            raise RuntimeError(f"the run of {path} ended with code {done.returncode}: {done.stderr.strip().splitlines()[-1:] or 'no word'}")
    return Kept(scene, path, record)


def kept_all(
    tasks: Mapping[str, tuple[Scene, Path]], workers: int = 1, threads: int = 1, ending: str = "", desc: str = "runs"
) -> dict[str, Kept]:
    """Runs by name, `workers` at a time, in the order of the tasks, with a bar."""
    with ThreadPoolExecutor(workers) as pool, tqdm(total=len(tasks), desc=desc, unit="run", dynamic_ncols=True) as bar:
        futures = {}
        for name, (scene, path) in tasks.items():
            futures[name] = pool.submit(kept, scene, path, threads, ending)
            futures[name].add_done_callback(lambda _: bar.update())
        try:
            return {name: future.result() for name, future in futures.items()}
        except KeyboardInterrupt:  # what runs has been told too; what waits is not to begin
            pool.shutdown(cancel_futures=True)
            raise


def resolved(scene: Scene) -> str:
    """The scene as trajectories carry it."""
    return json.dumps(scene.model_dump(mode="json"))


def same_scene(stored: str, scene: Scene) -> bool:
    """Whether a resolved scene, also one from before a key with a default was added, is this one."""
    try:
        return make_scene(json.loads(stored)).model_dump() == scene.model_dump()
    except ValueError:
        return False


def read_record(scene: Scene, path: Path) -> Record | None:
    """The record beside a trajectory, if it is of this scene and tells of an end."""
    try:
        record = Record(**json.loads(path.with_suffix(".json").read_text()))
    except (FileNotFoundError, json.JSONDecodeError, TypeError):
        return None
    if record.weights and record.weights != weights_digest(scene):
        return None
    return record if same_scene(record.scene, scene) and (path.exists() or record.failure) else None


def weights_digest(scene: Scene) -> str:
    """Of the files of the networks that a scene may take; nothing where it takes none."""
    kinds = sorted(set(scene.solver.map_kinds.values()) - {"exact"})
    folder = SHIPPED if scene.solver.weights is None else scene.folder / scene.solver.weights
    files = [file for kind in kinds for file in sorted((folder / kind).glob("*.safetensors"))]
    return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()[:16] if files else ""


def run(scene: Scene, path: Path, ending: Ending | None = None) -> Record:
    """Runs a scene into its files, or goes on with it, and writes the record. Raises Stopped after a signal."""
    begun = _begun(scene, path)
    enough = None if ending is None else ending(scene, read_trajectory(path) if begun else None)
    failure = ""
    try:
        if not begun:
            write_atomically(path.with_suffix(".weights"), weights_digest(scene).encode())
            _warm_up(scene)
    except (NumericalFailure, ValueError, MemoryError):
        pass  # the run itself says it
    cpu, counts, code = time.process_time(), {}, 0
    first = int(read_trajectory(path).step[-1]) if begun else 0
    with timing(clock=time.process_time) as seconds, warnings.catch_warnings(record=True) as shown:
        try:
            counts = dict(simulate(scene, path, resume=begun, force=not begun, progress=True, enough=enough).counts)
        except (NumericalFailure, ValueError, MemoryError) as error:
            failure, code = str(error), 3 if isinstance(error, NumericalFailure) else 2
    cpu = time.process_time() - cpu
    steps = until = wall = 0.0
    if path.exists():
        trajectory = read_trajectory(path)
        steps, until = int(trajectory.step[-1]), float(trajectory.t[-1])
        wall = float((trajectory.diagnostics["wall_seconds"][1:] * np.diff(trajectory.step)).sum())
    here = max(1, steps - first)
    record = Record(
        scene=resolved(scene),
        failure=failure,
        until=until,
        steps=int(steps),
        wall_a_step=wall / max(1, steps),
        cpu_a_step=cpu / here,
        peak_bytes=_peak_bytes(),
        seconds={name: value / here for name, value in seconds.items()},
        counts=counts,
        threads=int(os.environ.get("OMP_NUM_THREADS", "0")),
        commit=commit(),
        weights=weights_digest(scene),
        machine=f"{platform.machine()}, {os.cpu_count()} cores",
        code=code,
        warnings=[f"{warning.category.__name__}: {warning.message}" for warning in shown],
    )
    write_atomically(path.with_suffix(".json"), json.dumps(asdict(record), indent=1).encode())
    return record


def _peak_bytes() -> float:
    """Of this process alone: getrusage gives what the parent had where that was more."""
    status = Path("/proc/self/status").read_text()
    return 1024.0 * float(status.partition("VmHWM:")[2].split()[0])


def _begun(scene: Scene, path: Path) -> bool:
    """Whether files of this very scene, and of these networks, are there to go on with."""
    if not checkpoint_path(path).exists():
        return False
    try:
        weights = path.with_suffix(".weights").read_text()
        return weights == weights_digest(scene) and same_scene(str(read_trajectory(path).attributes["scene"]), scene)
    except (ValueError, FileNotFoundError):
        return False


def _warm_up(scene: Scene) -> None:
    """One step that is thrown away: it compiles, plans and loads."""
    problem = build(scene)
    stepper = make_stepper(problem, area(problem.X), length(problem.X))
    with counting(), fft_backend(problem.X.size):
        stepper.step(on_device(State(0.0, problem.X), scene), problem.dt)


def main(arguments: Iterable[str]) -> None:
    task, path, *ending = arguments
    described = json.loads(Path(task).read_text())
    found = None
    if ending:
        module, _, name = ending[0].partition(":")
        found = getattr(import_module(module), name)
    try:
        run(make_scene(described["scene"], described["folder"]), Path(path), found)
    except Stopped as stopped:
        raise SystemExit(str(stopped)) from None


if __name__ == "__main__":
    main(sys.argv[1:])
