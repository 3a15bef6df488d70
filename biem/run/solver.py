"""From a problem to its stepper: the solver that the scene names, on its device, with extrapolation and corrections around it."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from biem.membrane.contrast import ContrastMaps
from biem.membrane.maps import LAYERS, ExactMaps, MapsRequest, MembraneMaps
from biem.observe.instant import repulsion_of
from biem.ranks import ALONE, Ranks
from biem.scene.build import Problem
from biem.scene.config import Scene
from biem.scene.plan import memory_estimate, required_maps
from biem.steppers.corrections import Corrected
from biem.steppers.implicit import ImplicitStepper
from biem.steppers.order import Extrapolated
from biem.steppers.split import SplitStepper
from biem.steppers.stepper import Flow, State, Stepper
from biem.stokes.interaction import Fields

LEARNED_MAPS = "surrogate.provider"  # has make_maps(MapsRequest) -> MembraneMaps; imported where a scene asks for it, by its name alone


def check_device(name: str, key: str = "solver.device") -> int:
    """The number of CUDA devices, where `name` is one. Raises ValueError for a device or a library that this machine does not have."""
    if name != "cpu" and find_spec("torch") is None:
        raise ValueError(f'{key} = "{name}" needs PyTorch: pip install torch, or take "cpu"')
    if not name.startswith("cuda"):
        return 0
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if int(name.partition(":")[2] or 0) >= count:
        raise ValueError(f'{key} = "{name}": this machine has {count} CUDA device(s) that PyTorch can use; take "cpu"')
    return count


def check_machine(problem: Problem, ranks: Ranks = ALONE) -> None:
    """Raises ValueError, before the first step, for a device, a library or memory that this machine does not have."""
    devices = check_device(problem.scene.solver.device)
    free = free_memory()
    if devices:
        import torch

        free = float(torch.cuda.mem_get_info(ranks.rank % devices)[0])
    needed = memory_estimate(problem)
    if needed > free:
        M, _, N = problem.X.shape
        way = 'solver.kind = "split"' if problem.scene.solver.kind == "implicit" else 'solver.dtype = "float32"'
        if problem.walls is not None:
            way = f"a larger walls.spacing (the walls have {len(problem.walls.nodes)} nodes), or {way}"
        tracers = "" if problem.scene.tracers is None else " and tracers"
        raise ValueError(
            f"a step of {M} vesicles of {N} nodes{tracers} needs about {needed / 1e6:.3g} MB of memory, {free / 1e6:.3g} MB are free: take "
            f"fewer vesicles{tracers.replace(' and', ',')} or nodes, or {way}"
        )


def free_memory() -> float:
    """Bytes of memory that a process can still have."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable"):
            return 1024.0 * float(line.split()[1])
    return float("inf")


def make_stepper(problem: Problem, area_0: np.ndarray, length_0: np.ndarray, ranks: Ranks = ALONE) -> Stepper:
    """The stepper that the scene asks for, with its corrections. Raises ValueError for what the processes cannot do."""
    scene = problem.scene
    M = problem.X.shape[0]
    check_machine(problem, ranks)
    if ranks.size > M:
        raise ValueError(f"{ranks.size} processes for {M} vesicle(s): start at most as many processes as vesicles")
    if ranks.size > 1 and scene.solver.kind == "implicit":
        raise ValueError('solver.kind = "implicit" runs in one process: leave out mpirun, or take solver.kind = "split"')
    inner = _implicit(problem) if scene.solver.kind == "implicit" else _split(problem, ranks)
    if scene.time.order == 2 or scene.time.adaptive:
        inner = Extrapolated(inner, scene.time.order)
    return Corrected(inner, tuple(scene.solver.corrections), area_0, length_0, ranks)


def on_device(state: State, scene: Scene, ranks: Ranks = ALONE) -> State:
    """A state of NumPy arrays as arrays of the scene's device; with several devices, one a rank."""
    name = scene.solver.device
    if name == "cpu":
        return state
    import torch

    if name == "torch":
        name = "cpu"
    elif ":" not in name:
        name = f"cuda:{ranks.rank % max(1, torch.cuda.device_count())}"
    move = lambda a: torch.as_tensor(a, device=name)
    coupling = None if state.coupling is None else (state.coupling[0], move(state.coupling[1]), move(state.coupling[2]))
    return replace(state, X=move(state.X), sigma=None if state.sigma is None else move(state.sigma), coupling=coupling)


def _implicit(problem: Problem) -> Stepper:
    physics, solver = problem.scene.physics, problem.scene.solver
    return ImplicitStepper(
        physics.kappa_b,
        physics.mu,
        _flow(problem),
        solver.operator_points,
        solver.tolerance,
        solver.max_iterations,
        _fields(problem.scene),
        repulsion_of(problem),
        problem.scene.output.tension,
        problem.walls,
        problem.contrast,
        problem.box,
    )


def _split(problem: Problem, ranks: Ranks) -> Stepper:
    scene = problem.scene
    physics, solver = scene.physics, scene.solver
    maps = _maps(problem, ranks)
    fields = replace(_fields(scene), precision=solver.dtype, layers=maps.near_layers, offsets=LAYERS)
    return SplitStepper(
        maps,
        physics.kappa_b,
        physics.mu,
        _flow(problem),
        fields,
        repulsion_of(problem),
        scene.output.tension,
        ranks,
        walls=problem.walls,
        contrast=problem.contrast,
        box=problem.box,
    )


def _maps(problem: Problem, ranks: Ranks) -> MembraneMaps:
    """The maps that the scene asks for. Raises ValueError where what makes them is not there, or has not what is asked for."""
    physics, solver, time = problem.scene.physics, problem.scene.solver, problem.scene.time
    kinds = solver.map_kinds
    needed = frozenset(part.name for part in required_maps(problem) if part.needed)
    if problem.contrast is not None:
        mine = problem.contrast[ranks.mine(len(problem.X))]
        return ContrastMaps(physics.kappa_b, physics.mu, solver.operator_points, contrast=mine)
    if all(kinds[slot] == "exact" for slot in needed):
        return ExactMaps(physics.kappa_b, physics.mu, solver.operator_points, solver.dtype)
    try:
        provider = import_module(LEARNED_MAPS)
    except ImportError as error:
        raise ValueError(
            f'solver.kind = "vesnet" takes its maps from {LEARNED_MAPS}, which cannot be imported ({error}): install what is missing, '
            'or choose solver.maps = "exact"'
        ) from None
    request = MapsRequest(
        kinds=kinds,
        needed=needed,
        weights=None if solver.weights is None else problem.scene.folder / solver.weights,
        kappa_b=physics.kappa_b,
        mu=physics.mu,
        X=problem.X,
        dt=problem.dt,
        dts=(problem.dt, 0.5 * problem.dt) if time.order == 2 or time.adaptive else (problem.dt,),
        adaptive=time.adaptive,
        operator_points=solver.operator_points,
        dtype=solver.dtype,
        device=solver.device,
        out_of_distribution=solver.out_of_distribution,
    )
    return provider.make_maps(request)


def _fields(scene: Scene) -> Fields:
    near, far = scene.solver.tolerances
    return Fields(scene.solver.near_method, near, scene.solver.far_field, far)


def _flow(problem: Problem) -> Flow | None:
    return None if problem.flow.kind == "quiescent" else problem.flow.velocity
