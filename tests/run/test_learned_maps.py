"""solver.kind = "vesnet" through `simulate` and the command line, with exact maps in the place of networks."""

import re
import subprocess
import sys

import h5py
import numpy as np
import pytest
from learned_stub import VESNET, WatchedMaps, put_in_place, seen_in
from limits import LIMIT
from PIL import Image
from scene_helpers import DT, PAIR, assert_same_frames, cli, scene_of, stop_after, the_error, write_scene

from biem.membrane.maps import SLOTS
from biem.run import solver
from biem.run.checkpoint import checkpoint_path, read_checkpoint
from biem.run.simulate import Stopped, simulate
from biem.run.trajectory import DIAGNOSTICS, MONITORED, read_trajectory

METHODS = ("relax", "self_tension", "advect", "flow_tension", "near_layers")  # of the maps, in the order of SLOTS
SPLIT = {"solver": {"kind": "split"}}
REST = {"flow": {"kind": "quiescent", "rate": None}}
WALLS = {"flow": {"kind": None, "rate": None}, "walls": {"kind": "circle", "radius": 0.8, "omega": 100.0, "spacing": 0.2}}
CLOSE = {"vesicles": {"points": 32, "centers": [[-0.095, 0.0], [0.095, 0.0]], "angles": [1.57, 1.57]}}
WAYS = {
    "order 1": {},
    "order 2": {"time": {"order": 2}},
    "adaptive": {"time": {"adaptive": True, "tolerance": 1e-4, "dt": DT / 2}},
    "float32": {"solver": {"dtype": "float32"}},
    "torch": {"solver": {"device": "torch"}},
    "walls": WALLS,
    "operator points": {"solver": {"operator_points": 48}},
    "repulsion": {"solver": {"repulsion": {"reach": 0.5}}},
}


@pytest.mark.parametrize("way", WAYS)
def test_with_the_maps_of_split_it_is_split_bit_for_bit(monkeypatch, way):
    requests = put_in_place(monkeypatch)
    a, b = (simulate(scene_of(PAIR, s, WAYS[way], time={"horizon": 3 * DT})) for s in (SPLIT, VESNET))
    assert_same_frames(a.trajectory, b.trajectory)
    assert a.counts == b.counts
    assert b.trajectory.attributes["solver"] == "vesnet"
    assert len(requests) == 1  # split asked for nothing


@pytest.mark.parametrize("near_field", ["auto", "layers", "layers_rbf"])
def test_a_near_network_makes_the_near_field_one_of_layers(monkeypatch, near_field):
    requests = put_in_place(monkeypatch)
    layers = "layers" if near_field == "auto" else near_field
    a, b = (
        simulate(scene_of(CLOSE, s, solver={"near_field": n}, time={"horizon": 2 * DT})).trajectory
        for s, n in ((SPLIT, layers), (VESNET, near_field))
    )
    assert_same_frames(a, b)
    assert requests[0].needed == set(SLOTS)


def test_the_hybrid_near_map_is_exact_and_auto_is_upsample(monkeypatch):
    requests = put_in_place(monkeypatch)
    vesnet = {"solver": {"kind": "vesnet"}}
    a, b = (simulate(scene_of(CLOSE, s, time={"horizon": 2 * DT})).trajectory for s in (SPLIT, vesnet))
    assert_same_frames(a, b)
    assert requests[0].kinds == {**dict.fromkeys(SLOTS, "hybrid"), "near": "exact"}
    assert "near" not in requests[0].needed


class OnlyWhatIsNeeded:
    """Maps that refuse the slots that were not asked for."""

    def __init__(self, maps, needed):
        self.called = set()
        for slot, method in zip(SLOTS, METHODS, strict=True):
            if slot in needed:
                setattr(self, method, self._noted(slot, getattr(maps, method)))

    def _noted(self, slot, method):
        return lambda *arguments: (self.called.add(slot), method(*arguments))[1]


NEEDED = {  # changes of the scene, and the maps that it needs
    "at rest": (REST, {"relax"}),
    "in flow": ({}, {"relax", "advection"}),
    "tension at rest": ({**REST, "output": {"tension": True}}, {"relax", "self_tension"}),
    "tension in flow": ({"output": {"tension": True}}, {"relax", "advection", "self_tension", "flow_tension"}),
    "pair": ({**CLOSE, "solver": {"near_field": "auto"}}, set(SLOTS)),
    "pair at rest": ({**CLOSE, **REST, "solver": {"near_field": "auto"}}, set(SLOTS)),
    "pair, upsample": (CLOSE, set(SLOTS) - {"near"}),
    "pair, no near field": ({**CLOSE, "solver": {"near_field": "none"}}, set(SLOTS) - {"near"}),
    "one by walls": (
        {**WALLS, "walls": {**WALLS["walls"], "radius": 0.235, "spacing": 0.03}, "solver": {"near_field": "auto"}},
        set(SLOTS),
    ),
}


@pytest.mark.parametrize("case", NEEDED)
def test_the_maps_that_are_asked_for_are_those_that_are_called(monkeypatch, case):
    changes, needed = NEEDED[case]
    requests, maps = put_in_place(monkeypatch), []
    make = sys.modules[solver.LEARNED_MAPS].make_maps

    def make_only(request):
        maps.append(OnlyWhatIsNeeded(make(request), request.needed | {"near"}))  # the fields are given it, needed or not
        return maps[0]

    monkeypatch.setattr(sys.modules[solver.LEARNED_MAPS], "make_maps", make_only)
    simulate(scene_of(VESNET, changes, time={"horizon": 2 * DT}))
    assert requests[0].needed == maps[0].called == needed


def test_the_request_is_what_the_scene_says(tmp_path, monkeypatch):
    requests = put_in_place(monkeypatch)
    (tmp_path / "nets").mkdir()
    options = {
        "maps": {"relax": "ivnet", "advection": "hybrid", "near": "mlp"},
        "weights": "nets",
        "out_of_distribution": "exact",
        "operator_points": 48,
        "dtype": "float32",
        "device": "torch",
    }
    physics = {"kappa_b": 2.0, "mu": 3.0}
    for time, dts in (({"order": 1}, (DT,)), ({"order": 2}, (DT, DT / 2)), ({"adaptive": True}, (DT, DT / 2))):
        done = simulate(scene_of(PAIR, VESNET, folder=tmp_path, solver=options, physics=physics, time={**time, "horizon": DT}))
        asked = requests.pop()
        assert asked.kinds == {**dict.fromkeys(SLOTS, "exact"), **options["maps"]}
        assert (asked.dt, asked.dts, asked.adaptive) == (DT, dts, "adaptive" in time)
        assert asked.weights == tmp_path / "nets"
        assert (asked.kappa_b, asked.mu, asked.operator_points) == (2.0, 3.0, 48)
        assert (asked.dtype, asked.device, asked.out_of_distribution) == ("float32", "torch", "exact")
        assert np.array_equal(asked.X, done.trajectory.X[0])


EXACT = {"all exact": {"maps": "exact"}, "no slot named": {"maps": {}}, "hybrid near alone": {"maps": {"near": "hybrid"}}}


@pytest.mark.parametrize("case", [*EXACT, "network that is not needed"])
def test_maps_that_are_exact_import_no_provider(monkeypatch, case):
    monkeypatch.setattr(solver, "LEARNED_MAPS", "no.such.module")
    changes = (VESNET, {"solver": EXACT.get(case, {"maps": {"near": "mlp", "self_tension": "ivnet"}})})
    scenes = PAIR if case in EXACT else {}  # one vesicle in flow
    assert_same_frames(simulate(scene_of(scenes, *changes)).trajectory, simulate(scene_of(scenes, SPLIT)).trajectory)


def test_biem_loads_no_networks_before_a_scene_asks_for_them():
    program = "import sys, biem, biem.__main__; print([m for m in sys.modules if m.partition('.')[0] in ('surrogate', 'torch')])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=LIMIT)
    assert done.stdout.strip() == "[]"


def test_a_provider_that_is_not_there_is_told_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(solver, "LEARNED_MAPS", "no_such_module.provider")
    path = write_scene(tmp_path, PAIR)
    message = the_error(cli("run", path, "-o", tmp_path / "out.h5", "--solver", "vesnet"), 2)
    assert "no_such_module" in message
    assert 'solver.maps = "exact"' in message
    assert [file.name for file in tmp_path.iterdir()] == ["scene.toml"]
    assert the_error(cli("plan", path, "--solver", "vesnet"), 2) == message
    assert cli("plan", path, "--solver", "vesnet", "--no-measure").exit_code == 0


def test_what_the_provider_refuses_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    put_in_place(monkeypatch)

    def refuse(request):
        raise ValueError(f"no weights for reduced area 0.8 in {request.weights}")

    monkeypatch.setattr(sys.modules[solver.LEARNED_MAPS], "make_maps", refuse)
    (tmp_path / "nets").mkdir()
    arguments = ("--solver", "vesnet", "--weights", tmp_path / "nets")
    message = the_error(cli("run", write_scene(tmp_path, PAIR), "-o", tmp_path / "out.h5", *arguments), 2)
    assert message == f"no weights for reduced area 0.8 in {tmp_path / 'nets'}"
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("name", ["nets", 'a "quoted" näme'])
def test_weights_on_the_command_line_are_relative_to_the_working_directory(tmp_path, monkeypatch, name):
    requests = put_in_place(monkeypatch)
    (tmp_path / "here" / name).mkdir(parents=True)
    path = write_scene(tmp_path, PAIR, VESNET, time={"horizon": DT})
    monkeypatch.chdir(tmp_path / "here")
    for command in (("run", path, "-o", tmp_path / "out.h5"), ("plan", path)):
        result = cli(*command, "--weights", name)
        assert result.exit_code == 0, result.output
        assert requests.pop().weights == tmp_path / "here" / name
    assert "solver.weights" in the_error(cli("plan", path, "--weights", "nowhere"), 2)
    assert 'solver.kind = "vesnet"' in the_error(cli("plan", path, "--solver", "split", "--weights", name), 2)


# Diagnostics of maps that watch over their validity


@pytest.mark.parametrize("way", ["order 1", "order 2", "adaptive", "torch"])
def test_a_stopped_run_goes_on_bitwise_with_its_diagnostics(tmp_path, monkeypatch, way):
    put_in_place(monkeypatch, WatchedMaps)
    scene = scene_of(PAIR, VESNET, WAYS[way], time={"horizon": 5 * DT, "save_every": 3})
    whole = simulate(scene)
    steps = int(whole.trajectory.step[-1])
    for stop in range(1, steps) if way == "order 1" else (2,):
        out = tmp_path / f"{stop}.h5"
        with monkeypatch.context() as patch:
            stop_after(patch, stop)
            with pytest.raises(Stopped, match=f"step {stop} "):
                simulate(scene, out)
        assert stop % 3 == 0 or set(MONITORED) <= set(read_checkpoint(checkpoint_path(out)).running)
        done = simulate(scene, out, resume=True)
        assert_same_frames(done.trajectory, whole.trajectory)
        assert done.counts == whole.counts
        for trajectory in (done.trajectory, read_trajectory(out)):
            assert set(trajectory.diagnostics) == {*DIAGNOSTICS, *MONITORED}
            for name, values in whole.trajectory.diagnostics.items():
                assert name == "wall_seconds" or np.array_equal(trajectory.diagnostics[name], values), name


def test_frames_keep_the_largest_since_the_last_one(tmp_path, monkeypatch):
    put_in_place(monkeypatch, WatchedMaps)
    time = {"horizon": 8 * DT}
    every = simulate(scene_of(PAIR, VESNET, time=time)).trajectory
    want = np.array([0.0, *(seen_in(X) for X in every.X[:-1])])  # of the state that a step begins with
    assert len(set(want)) > 3
    assert np.array_equal(every.diagnostics["out_of_distribution"], want)
    assert np.array_equal(every.diagnostics["by_exact_maps"], want / 2)
    some = simulate(scene_of(PAIR, VESNET, time={**time, "save_every": 4}), tmp_path / "out.h5").trajectory
    assert np.array_equal(some.diagnostics["out_of_distribution"], [0.0, want[1:5].max(), want[5:].max()])
    with h5py.File(tmp_path / "out.h5") as file:
        assert set(file["diagnostics"]) == {*DIAGNOSTICS, *MONITORED}


@pytest.mark.parametrize("solver_kind", ["implicit", "split", "vesnet"])
def test_runs_whose_maps_watch_nothing_have_no_such_columns(tmp_path, monkeypatch, solver_kind):
    put_in_place(monkeypatch)
    path = write_scene(tmp_path, PAIR, time={"horizon": 2 * DT})
    result = cli("run", path, "-o", tmp_path / "out.h5", "--solver", solver_kind)
    assert result.exit_code == 0, result.output
    assert "training" not in result.stdout
    with h5py.File(tmp_path / "out.h5") as file:
        assert set(file["diagnostics"]) == set(DIAGNOSTICS)
    with h5py.File(checkpoint_path(tmp_path / "out.h5")) as file:
        assert not set(MONITORED) & set(file["running"].attrs)


def test_the_summary_and_the_pictures_tell_of_them(tmp_path, monkeypatch):
    put_in_place(monkeypatch, WatchedMaps)
    out = tmp_path / "out.h5"
    result = cli("run", write_scene(tmp_path, PAIR, VESNET), "-o", out)
    assert result.exit_code == 0, result.output
    most = read_trajectory(out).diagnostics["out_of_distribution"].max()
    assert most > 0
    told = re.search(
        r"^outside the training distribution: at most (\d+) of 2 vesicles in a step; by exact maps: at most (\d)", result.stdout, re.M
    )
    assert told
    assert float(told[1]) == most
    assert result.stdout.index("outside") < result.stdout.index("used: ")
    assert cli("verify", out).exit_code == 0
    assert cli("plot", out, "--no-movie").exit_code == 0
    with Image.open(tmp_path / "out" / "energy.png") as image:
        assert image.height > 1.2 * image.width  # four panels, of which the last is theirs
