"""What a scene requires, and why; what it does not require is not built. `python -m biem plan` prints it."""

from __future__ import annotations

from dataclasses import dataclass

from biem.membrane.maps import operator_points
from biem.scene.build import Problem
from biem.stokes.near import near_width
from biem.stokes.single_layer import near_scheme


@dataclass(frozen=True)
class Part:
    """One part of the solver: needed or not, and why."""

    name: str
    needed: bool
    why: str


def required_parts(problem: Problem) -> list[Part]:
    """The parts of the implicit solver for this scene, in the order in which a step uses them."""
    M = problem.X.shape[0]
    solver, output = problem.scene.solver, problem.scene.output
    many, flowing = M > 1, problem.flow.kind != "quiescent"
    scheme = near_scheme(solver.near_field)
    if not many:
        near = Part("near field", False, "one vesicle")
    elif scheme == "none":
        near = Part("near field", False, 'solver.near_field = "none"')
    else:
        width = near_width(scheme, solver.near_tolerance)
        near = Part("near field", True, f"{scheme}, on demand: where a membrane is within {width:.1f} h of another")
    return [
        Part("relaxation", True, "bending is implicit: one dense solve a vesicle"),
        Part("background flow", flowing, f"flow {problem.flow.kind}" if flowing else "the fluid is at rest"),
        Part(
            "tension",
            many or output.tension,
            "its force moves the other vesicles" if many else "asked for" if output.tension else "not asked for",
        ),
        Part("vesicle-vesicle coupling", many, f"{M} vesicles: GMRES over pair sums" if many else "one vesicle"),
        near,
        Part("area and length correction", "area_length" in solver.corrections, "solver.corrections"),
        Part("redistribution of nodes", "redistribute" in solver.corrections, "solver.corrections"),
        Part("extrapolation", problem.scene.time.order == 2, f"time.order = {problem.scene.time.order}"),
        Part("walls", False, "none in the scene"),
    ]


def memory_estimate(problem: Problem) -> float:
    """Bytes of the largest arrays held at once during a step (64-bit floats)."""
    M, _, N = problem.X.shape
    n = operator_points(N, problem.scene.solver.operator_points)
    one_chunk = 16 * (2 * n) ** 2  # operators of the vesicles in work
    if M == 1:
        return 8.0 * one_chunk
    response = M * (2 * N) * (5 * N)
    krylov = 2 * M * N * 40
    near_rows = M * N * 4 * N  # one close neighbour for every node
    return 8.0 * (2 * one_chunk + 2 * response + krylov + near_rows)


def trajectory_bytes(problem: Problem) -> float:
    """Size of the trajectory file."""
    M, _, N = problem.X.shape
    frames = problem.steps // problem.scene.time.save_every + 2
    with_tension = M > 1 or problem.scene.output.tension
    return 8.0 * frames * M * N * (3 if with_tension else 2)
