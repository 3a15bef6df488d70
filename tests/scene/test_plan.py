"""What a scene does not require is not built: counts of real steps, and `plan` tells the same story. Steps and times."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from limits import LIMIT
from scene_helpers import DT, PAIR, cli, scene_of, table, write_scene

from biem.run.simulate import simulate
from biem.scene.build import build
from biem.scene.config import make_scene
from biem.scene.plan import memory_estimate, trajectory_bytes

COUPLING = {"pair_sum", "near_search", "near_rows", "coupled_response"}
AREA, NODES = {"area_length_restored"}, {"redistributed"}
REST = {"flow": {"kind": "quiescent", "rate": None}}
FAR = {"vesicles": {"centers": [[-4.0, 0.0], [4.0, 0.0]]}}
CLOSE = {"vesicles": {"centers": [[-0.18, 0.0], [0.18, 0.0]], "angles": [1.57, 1.57]}}
# changes of the scene, counts that must be there, counts that must not, and whether there is a tension in the end
CASES = {
    "rest": (REST, AREA | NODES, COUPLING, False),
    "flow": ({}, AREA | NODES, COUPLING, False),
    "tension": ({"output": {"tension": True}}, AREA | NODES, COUPLING, True),
    "tension at rest": ({**REST, "output": {"tension": True}}, AREA | NODES, COUPLING, True),
    "no corrections": ({"solver": {"corrections": []}}, set(), COUPLING | AREA | NODES, False),
    "redistribution alone": ({"solver": {"corrections": ["redistribute"]}}, NODES, COUPLING | AREA, False),
    "area and length alone": ({"solver": {"corrections": ["area_length"]}}, AREA, COUPLING | NODES, False),
    "far pair": (FAR, COUPLING - {"near_rows"} | AREA | NODES, {"near_rows"}, True),
    "far pair at rest": ({**FAR, **REST}, COUPLING - {"near_rows"} | NODES, {"near_rows"}, True),
    "close pair": (CLOSE, COUPLING | AREA | NODES, set(), True),
    "no near field": ({**CLOSE, "solver": {"near_field": "none"}}, {"pair_sum", "coupled_response"}, {"near_rows"}, True),
}
# parts that `plan` prints, and the count that shows that the part was at work
PARTS = {
    "vesicle-vesicle coupling": "pair_sum",
    "area and length correction": "area_length_restored",
    "redistribution of nodes": "redistributed",
}


def printed_plan(tmp_path, changes):
    """part -> whether `plan` says that it is needed."""
    result = cli("plan", write_scene(tmp_path, changes), "--no-measure")
    assert result.exit_code == 0, result.output
    rows = re.findall(r"^  (yes| - )  (\S+(?: \S+)*?)(?:  |$)", result.output, re.MULTILINE)
    return {name: mark == "yes" for mark, name in rows}


@pytest.mark.parametrize("case", CASES)
def test_only_what_is_required_is_built(case):
    changes, present, absent, tension = CASES[case]
    done = simulate(scene_of(changes, time={"horizon": 3 * DT}))
    used = {name for name, n in done.counts.items() if n > 0}
    assert present <= used
    assert not absent & used
    assert (done.trajectory.sigma is not None) == tension
    M = done.trajectory.X.shape[1]
    assert done.counts["relaxation_matrix"] == 3 * M  # one solve a vesicle and step, not more
    assert done.counts["single_layer_matrix"] == 3 * M


@pytest.mark.parametrize("case", CASES)
def test_plan_tells_what_the_run_does(tmp_path, case):
    changes, _, _, tension = CASES[case]
    plan = printed_plan(tmp_path, changes)
    done = simulate(scene_of(changes, time={"horizon": 3 * DT}))
    assert plan["relaxation"]
    assert plan["tension"] == tension
    assert plan["background flow"] == ("flow" not in changes)
    assert plan["near field"] == (done.trajectory.X.shape[1] > 1 and case != "no near field")
    assert not plan["walls"]
    for part, count in PARTS.items():
        assert plan[part] == (done.counts[count] > 0), part


def test_plan_prints_sizes_and_times(tmp_path):
    path = write_scene(tmp_path, PAIR, time={"dt": "0.01 t_gamma", "horizon": "0.3 t_gamma"})
    result = cli("plan", path, "--set", "vesicles.points=32")
    assert result.exit_code == 0
    out = result.output
    assert "2 vesicle(s) of 32 nodes" in out
    assert "30 steps of dt = 0.0001 (0.01 t_gamma) to 0.3 t_gamma" in out
    assert float(re.search(r"memory of a step: (\S+) MB", out)[1]) > 0
    seconds = float(re.search(r"time: (\S+) s a step", out)[1])
    assert 0 < seconds < 10
    assert "time:" not in cli("plan", path, "--no-measure").output


def test_plan_of_adaptive_steps_prices_the_first_dt(tmp_path):
    path = write_scene(tmp_path, PAIR, time={"dt": "0.01 t_gamma", "horizon": "0.3 t_gamma", "adaptive": True, "tolerance": 1e-4})
    out = cli("plan", path).output
    assert "number not known, the first one of dt = 0.0001 (0.01 t_gamma) to 0.3 t_gamma" in out
    assert re.search(r"yes  step size control +time\.tolerance = 0\.0001", out)
    assert "if all are as long as the first one" in out
    assert "30 steps" not in out
    problem = build(scene_of(PAIR, time={"dt": "0.01 t_gamma", "horizon": "0.3 t_gamma", "adaptive": True}))
    assert trajectory_bytes(problem) == trajectory_bytes(build(scene_of(PAIR, time={"dt": "0.01 t_gamma", "horizon": "0.3 t_gamma"})))
    assert " -   step size control" in cli("plan", path, "--no-measure", "--set", "time.adaptive=false").output


def test_estimates_follow_what_is_there():
    done = simulate(scene_of(PAIR, time={"horizon": 30 * DT, "save_every": 2})).trajectory
    problem = build(scene_of(PAIR, time={"horizon": 30 * DT, "save_every": 2}))
    assert trajectory_bytes(problem) == pytest.approx(done.X.nbytes + done.sigma.nbytes, rel=0.1)
    finer = build(scene_of(PAIR, vesicles={"points": 64}))
    assert 6 * memory_estimate(problem) < memory_estimate(finer) < 20 * memory_estimate(problem)  # dense blocks: N^2


def test_times_in_units_of_the_flow_and_of_bending():
    mu, kappa_b, L, nu, rate = 3.0, 2.0, 1.5, 0.8, -40.0
    R = np.sqrt(nu) * L / (2 * np.pi)  # pi R^2 = nu L^2 / (4 pi)
    changes = {"physics": {"mu": mu, "kappa_b": kappa_b}, "vesicles": {"length": L, "points": 96}, "flow": {"rate": rate}}
    problem = build(scene_of(changes, time={"dt": "0.01 t_gamma", "horizon": "2 t_kappa"}))
    assert problem.dt == pytest.approx(0.01 / 40.0, rel=1e-14)
    assert problem.horizon == pytest.approx(2 * mu * R**3 / kappa_b, rel=1e-8)
    assert build(scene_of(time={"dt": "1e-3", "horizon": 0.5})).dt == 1e-3


def test_number_of_steps():
    assert build(scene_of(time={"dt": 0.1, "horizon": 0.35})).steps == 4
    assert build(scene_of(time={"dt": 0.01, "horizon": 0.07})).steps == 7  # 0.07/0.01 > 7 in floating point


def test_steps_beyond_counting_are_refused():
    with pytest.raises(ValueError, match=r"time\."):
        _ = build(scene_of(time={"dt": 1e-310, "horizon": 1.0})).steps


def test_a_fluid_at_rest_has_no_flow_time():
    rest = table(flow={"kind": "quiescent", "rate": None}, time={"dt": "0.01 t_gamma"})
    with pytest.raises(ValueError, match=r"time\.dt = \"0\.01 t_gamma\".*no t_gamma"):
        build(make_scene(rest))
    assert build(make_scene({**rest, "time": {"dt": "0.1 t_kappa", "horizon": 1.0}})).dt > 0


# The split solver: what it needs, and what it takes

SPLIT = {"solver": {"kind": "split"}}
CORRECTED = {"area and length correction", "redistribution of nodes"}
SPLIT_PLANS = {  # changes of the scene and what is needed beyond relaxation and corrections
    "rest": (REST, set()),
    "flow": ({}, {"background flow", "advection"}),
    "tension at rest": ({**REST, "output": {"tension": True}}, {"tension"}),
    "pair": (CLOSE, {"background flow", "advection", "tension", "vesicle-vesicle coupling", "far field", "near field"}),
    "pair at rest": ({**CLOSE, **REST}, {"advection", "tension", "vesicle-vesicle coupling", "far field", "near field"}),
    "no near field": (
        {**CLOSE, "solver": {"near_field": "none"}},
        {"background flow", "advection", "tension", "vesicle-vesicle coupling", "far field"},
    ),
    "between walls": (
        {"flow": {"kind": None, "rate": None}, "walls": {"kind": "circle", "radius": 0.5, "omega": 100.0}},
        {"background flow", "advection", "tension", "far field", "near field", "walls"},
    ),
    "adaptive, order 2": (
        {"time": {"adaptive": True, "order": 2}},
        {"background flow", "advection", "extrapolation", "step size control"},
    ),
}


@pytest.mark.parametrize("case", SPLIT_PLANS)
def test_plan_of_the_split_solver_lists_what_is_needed_and_no_more(tmp_path, case):
    changes, needed = SPLIT_PLANS[case]
    changes = {**changes, "solver": {**SPLIT["solver"], **changes.get("solver", {})}}
    plan = printed_plan(tmp_path, changes)
    assert {name for name, yes in plan.items() if yes} == needed | {"relaxation", *CORRECTED}
    counts = simulate(scene_of(changes, time={"horizon": 3 * DT})).counts
    factors = counts["tension_matrix"] > 0  # of the maps that advection and tension are made by
    assert factors == bool(needed & {"advection", "tension"})
    assert (counts["pair_sum"] > 0) == ("far field" in needed)
    assert (counts["near_search"] > 0) == ("near field" in needed)


def test_plan_names_the_far_field_near_field_and_repulsion_of_a_scene(tmp_path):
    options = ["--set", 'solver.near_field="layers"', "--set", "solver.repulsion={reach = 0.1}", "--set", 'solver.far_field="direct"']
    out = cli("plan", write_scene(tmp_path, CLOSE, SPLIT), "--no-measure", *options).output
    assert re.search(r"yes  far field +direct sum of 32 points", out)
    assert re.search(r"yes  near field .*layers within 1 h", out)
    assert re.search(r"yes  repulsion +where a gap is below 0\.1 lengths", out)
    assert re.search(r"yes  vesicle-vesicle coupling +2 vesicles: explicit", out)


def crowd(M, N=32, **solver):
    """A split problem of M copies of one shape on a square grid at an area fraction of about 0.25, made without any search."""
    table_ = {"vesicles": {"points": N, "reduced_area": 0.65}, "solver": {"kind": "split", **solver}}
    one = build(scene_of(table_))
    side = int(np.ceil(np.sqrt(M)))
    pitch = np.sqrt(np.pi * one.radius**2 / 0.25)
    centers = pitch * np.stack([np.arange(M) % side, np.arange(M) // side], axis=1)
    return replace(one, X=one.X + centers[:, :, None])


@pytest.mark.parametrize("options", [{}, {"far_tolerance": 1e-5, "near_tolerance": 1e-5}, {"dtype": "float32"}, {"device": "torch"}])
def test_memory_of_the_split_solver_is_linear_in_the_number_of_vesicles(options):
    few, many = (memory_estimate(crowd(M, **options)) for M in (2000, 8000))
    assert 3.5 < many / few < 4.5


def test_single_precision_takes_less():
    for M in (100, 2000):
        assert memory_estimate(crowd(M, dtype="float32")) < 0.9 * memory_estimate(crowd(M))


STEP_OF_MANY = """
import re, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_plan import crowd
from biem.run.reports import seconds_a_step
from biem.scene.plan import memory_estimate
# of this program alone: the ru_maxrss of getrusage starts from that of the process which started it
peak = lambda: 1024.0 * float(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
seconds_a_step(crowd(20))  # libraries loaded, loops compiled
problem = crowd({M})
before = peak()
seconds_a_step(problem)
print(peak() - before, memory_estimate(problem))
"""


def test_memory_estimate_is_what_a_step_takes():
    """Within a factor of 3 of the measured growth of the peak."""
    program = STEP_OF_MANY.format(tests=str(Path(__file__).parent), M=500)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, timeout=LIMIT)
    measured, estimated = map(float, done.stdout.split())
    assert measured > 10e6
    assert 1 / 3 < estimated / measured < 3, (measured, estimated)
