"""Runs under mpirun: the trajectory of one process, one voice, restarts with another number of processes, errors that end all of them."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from limits import LIMIT
from scene_helpers import DT, cli, error_line, write_flow, write_scene
from thread_ranks import Together, on_threads

from biem.ranks import Ranks, world
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.trajectory import read_trajectory

pytest.importorskip("mpi4py")
MPIRUN = Path(sys.executable).parent / "mpirun"
pytestmark = pytest.mark.skipif(not MPIRUN.exists(), reason="no mpirun beside the interpreter")

STEPS = 4
TEN = {
    "vesicles": {"placement": "grid", "reduced_area": 0.65, "points": 32, "count": 10, "area_fraction": 0.25},
    "time": {"horizon": STEPS * DT},
    "solver": {"kind": "split"},
}
SMALL = {**TEN, "vesicles": {**TEN["vesicles"], "points": 16, "count": 5}}
WAYS = {
    "order 1": {},
    "order 2": {"time": {"order": 2}},
    "adaptive": {"time": {"adaptive": True, "tolerance": 1e-5, "horizon": 3 * DT}},
    "walls": {"flow": {"kind": None, "rate": None}, "walls": {"kind": "circle", "radius": 1.5, "omega": 100.0, "spacing": 0.2}},
}

# Flows that go wrong on the second process alone, at the start or after two steps.
FLOW = """
import os

def _wrong(t, after):
    return os.environ.get("PMI_RANK") == "1" and t > after

def refuses_at_once(x, y, t):
    if _wrong(t, -1.0):
        raise ValueError("no flow here")
    return 100.0 * y, 0.0 * x

def refuses(x, y, t):
    if _wrong(t, {after}):
        raise ValueError("no flow here")
    return 100.0 * y, 0.0 * x

def divides(x, y, t):
    return 100.0 * y / (0 if _wrong(t, {after}) else 1), x * (1 / (0 if _wrong(t, {after}) else 1) - 1)

def leaves(x, y, t):
    if _wrong(t, {after}):
        raise SystemExit(7)
    return 100.0 * y, 0.0 * x

def is_not_a_number(x, y, t):
    return (float("nan") if _wrong(t, {after}) else 100.0) * y, 0.0 * x

def stops_the_first(x, y, t):
    if os.environ.get("PMI_RANK") == "0" and t >= {after} and os.environ.get("STOP"):
        os.kill(os.getpid(), 15)
    return 100.0 * y, 0.0 * x
"""


def mpi(processes, *arguments, program=("-m", "biem"), **environment):
    """`python -m biem` on so many processes; its exit code, stdout and stderr. Fails where it does not end."""
    # one thread each; processes that outnumber the cores spin while they wait, which only costs time
    command = [MPIRUN, "-n", processes, sys.executable, *program, *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    try:
        done = subprocess.run([str(c) for c in command], env=environment, capture_output=True, text=True, check=False, timeout=LIMIT)
    except subprocess.TimeoutExpired as late:
        printed = (late.stderr or b"").decode()
        pytest.fail(f"does not end within {LIMIT} s: {' '.join(map(str, arguments))}; printed {printed!r}")
    return done.returncode, done.stdout, done.stderr


def together(folder, processes, commands):
    """What `mpi` gives of each command, all under one mpirun, one after the other; all processes end each with the same code."""
    (folder / "commands.json").write_text(json.dumps([[str(c) for c in command] for command in commands]))
    program = (Path(__file__).parents[1] / "mpi_program.py",)
    assert mpi(processes, folder, program=program) == (0, "", "")
    found = []
    for k in range(len(commands)):
        codes = {int((folder / f"{k}.{rank}.code").read_text()) for rank in range(processes)}
        assert len(codes) == 1, (commands[k], codes)
        found.append((codes.pop(), *((folder / f"{k}.{name}").read_text() for name in ("out", "err"))))
    return found


def the_mpi_error(done, *codes):
    """The one line of a failed mpirun."""
    exit_code, _, printed = done
    message = error_line(printed, exit_code, *codes)
    assert len(printed.strip().splitlines()) == 1, printed
    return message


def whole_run(folder, scene):
    """The frames of one process, in this one."""
    assert cli("run", scene, "-o", folder / "whole.h5", "--quiet").exit_code == 0
    return read_trajectory(folder / "whole.h5")


def assert_close_frames(a, b, scale=1.0):
    """Equal steps; times, nodes and tensions to 1e-10."""
    assert np.array_equal(a.step, b.step)
    assert np.allclose(a.t, b.t, rtol=1e-12, atol=0)
    assert np.abs(a.X - b.X).max() < 1e-10 * scale
    assert np.abs(a.sigma - b.sigma).max() < 1e-10 * np.abs(b.sigma).max()


@pytest.fixture(scope="module")
def wholes(tmp_path_factory):
    """The frames of each way by one process, which compiles what the others then load."""
    folders = {name: tmp_path_factory.mktemp("one") for name in WAYS}
    return {name: whole_run(folder, write_scene(folder, TEN, WAYS[name])) for name, folder in folders.items()}


@pytest.fixture(scope="module")
def of_three(tmp_path_factory, wholes):
    """A folder of runs on three processes: of each way, and of what three processes are too many for. What became of them, by name."""
    folder = tmp_path_factory.mktemp("three")
    paths = {}
    for name, changes in {**WAYS, "too few": {"vesicles": {"count": 2}}}.items():
        (folder / name).mkdir()
        paths[name] = write_scene(folder / name, TEN, changes)
    runs = together(folder, 3, [["run", path, "-o", folder / name / "out.h5"] for name, path in paths.items()])
    return {name: (path, folder / name / "out.h5", done) for (name, path), done in zip(paths.items(), runs, strict=True)}


@pytest.mark.parametrize(("processes", "way"), [(1, "order 1"), (2, "order 2"), *((3, way) for way in WAYS)])
def test_any_number_of_processes_gives_the_trajectory_of_one_and_speaks_once(tmp_path, wholes, of_three, processes, way):
    if processes == 3:
        _, out, (exit_code, printed, bars) = of_three[way]
    else:
        path, out = write_scene(tmp_path, TEN, WAYS[way]), tmp_path / "out.h5"
        exit_code, printed, bars = mpi(processes, "run", path, "-o", out)
    assert exit_code == 0, bars
    done, whole = read_trajectory(out), wholes[way]
    assert len(whole) > 2
    assert_close_frames(done, whole)
    for name in ("area_error", "length_error", "bending_energy", "min_gap", "dt", "rejected"):
        assert np.allclose(done.diagnostics[name], whole.diagnostics[name], rtol=1e-6), name
    assert printed.count("frames to t") == 1
    assert printed.count("smallest gap") == 1
    assert printed.count("\nused") == 1
    last = [line for line in bars.replace("\r", "\n").splitlines() if line.strip()]
    assert sum(f"{STEPS}/{STEPS}" in line for line in last) <= 2  # the last step and the end
    assert all(line.startswith("tiny:") for line in last), bars
    assert not re.search(r"error|warning", bars, re.IGNORECASE), bars
    assert not out.with_name("out.h5.frames").exists()


def test_checkpoint_of_some_processes_is_resumed_by_others(tmp_path):
    """One process, then two, then one."""
    path, out = write_scene(tmp_path, TEN, {"time": {"order": 2}}), tmp_path / "out.h5"
    whole = whole_run(tmp_path, path)

    def run(processes, *arguments):
        if processes == 1:
            assert cli("run", path, "-o", out, "--quiet", *arguments).exit_code == 0
        else:
            exit_code, printed, errors = mpi(processes, "run", path, "-o", out, "--quiet", *arguments)
            assert (exit_code, printed, errors) == (0, "", "")

    for steps, processes in ((1, 1), (3, 2)):
        run(processes, "--set", f"time.horizon={steps * DT}", *(["--resume"] if steps > 1 else []))
        checkpoint = read_checkpoint(checkpoint_path(out))
        assert checkpoint.step == steps
        assert checkpoint.state.coupling is not None
    run(1, "--resume")
    assert_close_frames(read_trajectory(out), whole)


def flow_scene(folder, function, *changes):
    """SMALL in a flow of FLOW that goes wrong, if it does, in the third step."""
    module = write_flow(folder, FLOW.replace("{after}", repr(1.5 * DT)))
    return write_scene(folder, SMALL, *changes, flow={"kind": "custom", "rate": None, "function": f"{module}.{function}"})


def test_a_signal_to_the_first_process_stops_all_and_the_run_goes_on(tmp_path):
    path, out = flow_scene(tmp_path, "stops_the_first", {"time": {"horizon": 6 * DT}}), tmp_path / "out.h5"
    message = the_mpi_error(mpi(2, "run", path, "-o", out, "--quiet", STOP="1"), 4)
    step = int(re.search(r"stopped at step (\d+) of 6", message)[1])
    assert 3 <= step < 6
    assert read_checkpoint(checkpoint_path(out)).step == step
    assert mpi(2, "run", path, "-o", out, "--quiet", "--resume") == (0, "", "")
    assert_close_frames(read_trajectory(out), whole_run(tmp_path, path))


def test_a_signal_to_mpirun_stops_all_and_the_run_goes_on(tmp_path):
    path, out = write_scene(tmp_path, SMALL, time={"horizon": 400 * DT, "save_every": 50}), tmp_path / "out.h5"
    command = [str(c) for c in (MPIRUN, "-n", 2, sys.executable, "-m", "biem", "run", path, "-o", out)]
    process = subprocess.Popen(
        command, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    printed = ""
    while "step/s" not in printed.replace("?step/s", ""):  # the bar shows a step
        printed += process.stderr.read(1)
    process.send_signal(signal.SIGTERM)
    _, rest = process.communicate(timeout=LIMIT)
    assert process.returncode != 0
    stopped = re.search(r"error: stopped at step (\d+) of 400; go on with --resume", printed + rest)
    assert stopped, rest
    step = int(stopped[1])
    assert read_checkpoint(checkpoint_path(out)).step == step
    shorter = ["--set", f"time.horizon={(step + 2) * DT}"]
    assert mpi(2, "run", path, "-o", out, "--quiet", "--resume", *shorter) == (0, "", "")
    assert read_trajectory(out).step[-1] == step + 2


REFUSED = {
    "implicit": (["--solver", "implicit"], r'"implicit" runs in one process: leave out mpirun, or take solver.kind = "split"'),
    "unknown key": (["--set", "solver.knd=1"], "unknown key solver.knd"),
    "nothing to resume": (["--resume"], "no readable checkpoint"),
}
UNWRITABLE = ("a file as folder", "a folder as file")


@pytest.fixture(scope="module")
def of_two(tmp_path_factory):
    """A folder of a scene and one named folder, what cannot be run in there on two processes, by name, and the files that it leaves."""
    folder, told = tmp_path_factory.mktemp("two"), tmp_path_factory.mktemp("told")
    path = write_scene(folder, SMALL)
    (folder / "folder").mkdir()
    outputs = [*(folder / "out.h5" for _ in REFUSED), path / "out.h5", folder / "folder"]
    arguments = [*(arguments for arguments, _ in REFUSED.values()), [], []]
    runs = together(told, 2, [["run", path, "-o", out, "--quiet", *more] for out, more in zip(outputs, arguments, strict=True)])
    return folder, dict(zip((*REFUSED, *UNWRITABLE), runs, strict=True))


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_run_is_told_once_by_all_processes(of_two, case):
    folder, told = of_two
    message = the_mpi_error(told[case], 2)
    assert re.search(REFUSED[case][1], message), message
    assert sorted(path.name for path in folder.iterdir()) == ["folder", "scene.toml"]
    assert not list((folder / "folder").iterdir())


def test_more_processes_than_vesicles_are_told_once(of_three):
    path, _, done = of_three["too few"]
    assert "3 processes for 2 vesicle(s)" in the_mpi_error(done, 2)
    assert [file.name for file in path.parent.iterdir()] == ["scene.toml"]


def test_a_refusal_is_the_exit_code_of_mpirun(tmp_path):
    path = write_scene(tmp_path, SMALL)
    message = the_mpi_error(mpi(2, "run", path, "-o", tmp_path / "out.h5", "--quiet", "--resume"), 2)
    assert "no readable checkpoint" in message


@pytest.mark.parametrize("where", UNWRITABLE)
def test_output_that_cannot_be_written_ends_all_in_one_line(of_two, where):
    folder, told = of_two
    message = the_mpi_error(told[where], 2, 5)
    assert str(folder / ("folder" if where == "a folder as file" else "scene.toml")) in message


@pytest.mark.parametrize("function", ["refuses_at_once", "refuses", "is_not_a_number"])
def test_input_wrong_on_one_process_alone_ends_all_with_one_line(tmp_path, function):
    path, out = flow_scene(tmp_path, function), tmp_path / "out.h5"
    exit_code, _, printed = mpi(2, "run", path, "-o", out, "--quiet")
    assert exit_code != 0
    told = [line for line in printed.splitlines() if line.startswith("error: ")]
    assert len(told) == 1, printed
    assert "not finite" in told[0] if function == "is_not_a_number" else "no flow here" in told[0]
    if function == "refuses_at_once":
        assert not list(tmp_path.glob("out*"))
    else:
        assert read_trajectory(out).step[-1] == 2  # the last good state


@pytest.mark.parametrize("function", ["divides", "leaves"])
def test_an_unexpected_end_of_one_process_ends_all(tmp_path, function):
    path = flow_scene(tmp_path, function)
    exit_code, _, printed = mpi(2, "run", path, "-o", tmp_path / "out.h5", "--quiet")
    assert exit_code != 0
    assert "division by zero" in printed if function == "divides" else True


# Ranks by themselves, on threads


@pytest.mark.parametrize("size", [1, 2, 3, 7])
@pytest.mark.parametrize("M", [7, 8, 20])
def test_every_vesicle_is_one_ranks_and_shares_differ_by_one_at_most(size, M):
    shares = [range(M)[Ranks(Together(size).of(rank)).mine(M)] for rank in range(size)]
    assert [k for share in shares for k in share] == list(range(M))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert min(map(len, shares)) >= 1
    assert range(M)[Ranks().mine(M)] == range(M)


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_uneven_shares_are_joined_in_order_on_all(size, dtype):
    X = np.arange(7 * 2 * 5).reshape(7, 2, 5).astype(dtype)
    for joined, others in on_threads(size, lambda ranks: ranks.gather_all(7, lambda mine: (X[mine].transpose(0, 2, 1), mine.start))):
        assert joined.dtype == dtype
        assert np.array_equal(joined, X.transpose(0, 2, 1))
        assert others == [7 * r // size for r in range(size)]
    assert all(np.array_equal(s, X[:, 0, 0]) for s in on_threads(size, lambda ranks: ranks.gather(7, lambda mine: X[mine, 0, 0])))


def test_tensors_stay_tensors():
    torch = pytest.importorskip("torch")
    X = torch.arange(20.0, dtype=torch.float32).reshape(5, 4)
    for joined in on_threads(2, lambda ranks: ranks.gather(5, lambda mine: X[mine])):
        assert joined.dtype == torch.float32
        assert torch.equal(joined, X)


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_an_error_on_one_rank_is_raised_on_all(wrong):
    def work(ranks):
        def mine(which):
            if ranks.rank == wrong:
                raise ZeroDivisionError(f"of rank {wrong}")
            return np.zeros(which.stop - which.start)

        return ranks.gather(5, mine)

    assert [repr(e) for e in on_threads(3, work)] == [f"ZeroDivisionError('of rank {wrong}')"] * 3


def test_what_the_first_rank_does_alone_is_known_to_all():
    def write(ranks):
        return ranks.on_root(lambda: f"by {ranks.rank}")

    def fail(ranks):
        return ranks.on_root(lambda: int("x"), share=False)

    assert on_threads(3, write) == ["by 0"] * 3
    assert on_threads(3, lambda ranks: ranks.on_root(lambda: ranks.rank, share=False)) == [0, None, None]
    assert [type(e) for e in on_threads(3, fail)] == [ValueError] * 3
    assert on_threads(3, lambda ranks: ranks.any(ranks.rank == 2)) == [True] * 3
    assert on_threads(3, lambda ranks: ranks.any(False)) == [False] * 3
    assert Ranks().on_root(lambda: 3) == 3


def test_no_launcher_no_mpi(monkeypatch):
    for name in ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS"):
        monkeypatch.delenv(name, raising=False)
    assert world().comm is None


def test_a_launcher_without_mpi4py_names_what_to_install(monkeypatch):
    monkeypatch.setenv("PMI_SIZE", "2")
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    with pytest.raises(ValueError, match=r"pip install 'vesnet\[mpi\]'"):
        world()


def test_the_mpi_of_another_launcher_is_not_taken_for_one(tmp_path):
    """Started by a launcher that mpi4py's MPI knows nothing of: every process would run the whole scene."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PMI", "OMPI"))} | {"OMPI_COMM_WORLD_SIZE": "2"}
    command = [sys.executable, "-m", "biem", "run", str(write_scene(tmp_path, SMALL)), "-o", str(tmp_path / "out.h5")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT)
    assert "mpirun" in error_line(done.stderr, done.returncode, 2)
    assert not list(tmp_path.glob("out*"))
