"""What a scene requires, and why; what it does not require is not built. `python -m biem plan` prints it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from biem.backend import threads
from biem.curves.curve import area
from biem.curves.lattice import Lattice
from biem.membrane.maps import LAYERS, operator_points
from biem.membrane.resultants import CPU_CHUNK, DEVICE_CHUNK
from biem.scene.build import Problem
from biem.scene.config import Solver
from biem.scene.tracers import tracers_from_file
from biem.stokes.farfield import far_field_bytes, far_scheme
from biem.stokes.near import near_width
from biem.stokes.near_layers import METHODS
from biem.stokes.single_layer import near_scheme

DENSE = ("exact", "hybrid")  # maps that factorise a dense matrix
MATRICES = {"self_tension": 0.0, "advection": 1.0, "flow_tension": 0.5, "near": len(LAYERS)}  # values over those of a (2N, 2N) matrix
VALUES_A_TRACER = 40  # float64 values in work while tracers are carried


@dataclass(frozen=True)
class Part:
    """One part of the solver: needed or not, and why."""

    name: str
    needed: bool
    why: str


def required_parts(problem: Problem) -> list[Part]:
    """The parts of the solver for this scene, in the order in which a step uses them."""
    M = problem.X.shape[0]
    solver, output, time = problem.scene.solver, problem.scene.output, problem.scene.time
    walled = problem.walls is not None
    many, flowing, split = problem.interacting, problem.flow.kind != "quiescent", solver.kind != "implicit"
    maps = required_maps(problem)
    solved = ": one dense solve a vesicle" if solver.map_kinds["relax"] in DENSE else ""
    parts = [
        Part("relaxation", True, f"bending is implicit{solved}"),
        Part("background flow", flowing, _flow(problem)),
    ]
    if split:
        parts.append(next(part for part in maps if part.name == "advection"))
    parts.append(
        Part(
            "tension",
            many or walled or output.tension,
            f"its force moves {_others(problem)}" if many else "the walls answer to its force" if walled else _asked(output.tension),
        )
    )
    how = "explicit, two sums a step" if split else "GMRES over pair sums"
    parts += [
        Part("vesicle-vesicle coupling", many, f"{M} vesicle{'s' * (M > 1)}{_and_images(problem)}: {how}" if many else "one vesicle"),
        _far_field(problem) if many or walled else Part("far field", False, "one vesicle"),
        _near_field(problem) if many or walled else Part("near field", False, "one vesicle"),
        _contrast(problem),
        Part(
            "repulsion",
            (many or walled) and solver.repulsion is not None,
            f"where a gap is below {solver.repulsion.reach:g} lengths" if solver.repulsion else "not asked for",
        ),
        Part("area and length correction", "area_length" in solver.corrections, "solver.corrections"),
        Part("redistribution of nodes", "redistribute" in solver.corrections, "solver.corrections"),
        Part("extrapolation", time.order == 2, f"time.order = {time.order}"),
        Part("step size control", time.adaptive, f"time.tolerance = {time.tolerance:g}" if time.adaptive else "time.adaptive = false"),
        _walls(problem),
        *_tracers(problem),
    ]
    if solver.kind == "vesnet":
        parts += [Part(f"map {p.name}", p.needed, f"{solver.map_kinds[p.name]}: {p.why}" if p.needed else p.why) for p in maps]
    return parts


def required_maps(problem: Problem) -> list[Part]:
    """The maps of `biem.membrane.maps` by their slots, as a split step of this scene calls them."""
    solver, asked = problem.scene.solver, problem.scene.output.tension
    many, flowing, walled = problem.interacting, problem.flow.kind != "quiescent", problem.walls is not None
    moved = ", ".join(["the flow"] * flowing + [_others(problem)] * many + ["the walls' answer"] * walled)
    still = "nothing moves the vesicle"
    wanted = f"its force moves {_others(problem)}" if many else "the walls answer to its force" if walled else _asked(asked)
    tension = many or walled or asked
    near = "one vesicle"
    if many or walled:
        near = f'solver.near_field = "{solver.near_field}"' + (f", that is {_near_name(solver)}" if solver.near_field == "auto" else "")
        near += f", on demand: where a membrane is within {max(LAYERS):g} h of another" if solver.near_method in METHODS else ""
    return [
        Part("relax", True, "bending is implicit"),
        Part("self_tension", tension, f"tension by bending: {wanted}"),
        Part("advection", bool(moved), f"the velocity by {moved} is made inextensible" if moved else still),
        Part("flow_tension", tension and bool(moved), f"tension by {moved}: {wanted}" if moved else still),
        Part("near", (many or walled) and solver.near_method in METHODS, near),
    ]


def _others(problem: Problem) -> str:
    others = "the other vesicles" if len(problem.X) > 1 else ""
    return others if problem.box is None else f"{others} and all images" if others else "its own images"


def _and_images(problem: Problem) -> str:
    box = problem.box
    if box is None:
        return ""
    sheared = "" if box.rate == 0.0 else f", sheared at {box.rate:g}"
    share = float(np.sum(area(problem.X))) / (box.width * box.height)
    whose = "their" if len(problem.X) > 1 else "its"
    return f" and {whose} images in a box of {box.width:g} x {box.height:g}, filled to {share:.3g}{sheared}"


def _tracers(problem: Problem) -> list[Part]:
    """Points that the flow carries along; scenes without them are not told so."""
    count = _tracer_count(problem)
    return [Part("tracers", True, f"{count}: one solve for the tension and their velocities twice a step")] if count else []


def _tracer_count(problem: Problem) -> int:
    table = problem.scene.tracers
    if table is None or table.file is None:
        return 0 if table is None else table.count or 0
    return len(tracers_from_file(problem.scene.folder / table.file))


def _near_name(solver: Solver) -> str:
    """The near field without "auto"."""
    return solver.near_method if solver.near_method in METHODS else near_scheme(solver.near_method)


def _flow(problem: Problem) -> str:
    kind = problem.flow.kind
    return {"quiescent": "the fluid is at rest", "walls": "driven by the walls"}.get(kind, f"flow {kind}")


def _asked(wanted: bool) -> str:
    return "asked for" if wanted else "not asked for"


def _walls(problem: Problem) -> Part:
    if problem.walls is None:
        return Part("walls", False, "none in the scene")
    how = "within GMRES" if problem.scene.solver.kind == "implicit" else "one explicit velocity"
    bodies = len(problem.walls.curves) - 1
    around = "an outer wall" + (f" and {bodies} {'body' if bodies == 1 else 'bodies'}" if bodies else "")
    return Part("walls", True, f"{around}, {len(problem.walls.nodes)} nodes, factorised once: {how}")


def _near_field(problem: Problem) -> Part:
    solver = problem.scene.solver
    layered = solver.near_method in METHODS
    scheme = "upsample" if layered else near_scheme(solver.near_method)
    if scheme == "none":
        return Part("near field", False, 'solver.near_field = "none"')
    others = "another" if problem.walls is None else "another or of a wall"
    others += "" if problem.box is None else " or of an image"
    where = f"{scheme}, on demand: where a membrane is within {near_width(scheme, solver.tolerances[0]):.1f} h of {others}"
    return Part("near field", True, where + (f"; {solver.near_method} within 1 h" if layered else ""))


def _far_field(problem: Problem) -> Part:
    scheme = _scheme(problem)
    tolerance = f", tolerance {problem.scene.solver.tolerances[1]:g}" if scheme == "ewald" else ""
    of_walls = "" if problem.walls is None else f", at these and at {len(problem.walls.nodes)} on walls"
    if problem.box is not None:
        series = "nonuniform FFTs" if scheme == "ewald" else "a plain Fourier series"
        scheme, tolerance = "periodic Ewald", f" by {series}, tolerance {problem.scene.solver.tolerances[1]:g}"
    return Part("far field", True, f"{scheme} sum of {problem.X.shape[0] * problem.X.shape[2]} points{of_walls}{tolerance}")


def _contrast(problem: Problem) -> Part:
    contrast = problem.contrast
    if contrast is None:
        return Part("viscosity contrast", False, "vesicles.contrast = 1")
    M, _, N = problem.X.shape
    sources = int(np.sum(contrast != 1.0))
    values = f"{contrast.min():g}" if np.all(contrast == contrast[0]) else f"{contrast.min():g} to {contrast.max():g}"
    own = f"{values}: dense operators with the double layer of each vesicle"
    others = f", direct sums of {sources * N} double layers" if M > 1 or problem.walls is not None else ""
    return Part("viscosity contrast", True, own + others)


def _scheme(problem: Problem) -> str:
    M, _, N = problem.X.shape
    solver = problem.scene.solver
    targets = M * N + (0 if problem.walls is None else len(problem.walls.nodes))
    return far_scheme(solver.far_field, targets, M * N, solver.tolerances[1], solver.device.startswith("cuda"), _lattice(problem))


def _lattice(problem: Problem) -> Lattice | None:
    return None if problem.box is None else problem.box.at(0.0)


def memory_estimate(problem: Problem) -> float:
    """Bytes of the largest arrays held at once during a step."""
    M, _, N = problem.X.shape
    solver = problem.scene.solver
    n = operator_points(N, solver.operator_points)
    size = 4.0 if solver.dtype == "float32" else 8.0
    near_pairs = M * N  # one close neighbour for every node
    extent = np.ptp(problem.X, axis=(0, 2))
    far = 8.0 * VALUES_A_TRACER * _tracer_count(problem)
    if problem.interacting:
        of = M * N, M, N, _scheme(problem), solver.tolerances[1], (float(extent[0]), float(extent[1]))
        far += far_field_bytes(*of, lattice=_lattice(problem))
    if problem.walls is not None:
        P = len(problem.walls.nodes)
        far += 8.0 * 2 * (2 * P) ** 2 + 16.0 * sum(X.shape[1] ** 2 for X in problem.walls.curves)  # the equations while they are made
    if problem.contrast is not None:
        kept = 14 * M * N**2 if solver.kind != "implicit" else 0  # by the maps: three times at once when they are made anew
        far += 8.0 * (40 * M * N + 3 * kept)
    if solver.kind != "implicit":
        chunk = min(M * n**2, threads() * CPU_CHUNK if solver.device in ("cpu", "torch") else DEVICE_CHUNK)
        maps = _maps_bytes(problem, n, size)
        return maps + 12 * 8.0 * chunk + 8.0 * (24 * M * 2 * n + 40 * M * 2 * N + 16 * near_pairs) + far
    one_chunk = 16 * (2 * n) ** 2  # operators of the vesicles in work
    if not problem.interacting and problem.walls is None:
        return 8.0 * one_chunk + far
    response = M * (2 * N) * (5 * N)
    krylov = 2 * M * N * 40
    return 8.0 * (2 * one_chunk + 2 * response + krylov + near_pairs * 4 * N) + far


def _maps_bytes(problem: Problem, n: int, size: float) -> float:
    """What maps keep of every vesicle: exact ones the factors that all but relax share, networks the matrix that a map is, in float32."""
    M, _, N = problem.X.shape
    kinds = problem.scene.solver.map_kinds
    kept = [part.name for part in required_maps(problem) if part.needed and part.name in MATRICES]
    factors = size * M * n**2 if any(kinds[slot] in DENSE for slot in kept if slot != "near") else 0.0
    return factors + 4.0 * M * (2 * N) ** 2 * sum(MATRICES[slot] for slot in kept if kinds[slot] != "exact")


def trajectory_bytes(problem: Problem) -> float:
    """Size of the trajectory file; of adaptive runs, if all steps are as long as the first one."""
    M, _, N = problem.X.shape
    frames = problem.steps // problem.scene.time.save_every + 2
    with_tension = problem.interacting or problem.walls is not None or problem.scene.output.tension
    return 8.0 * frames * (M * N * (3 if with_tension else 2) + 2 * _tracer_count(problem))
