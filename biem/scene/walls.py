"""From the table [walls] of a scene to `Walls`: shapes, their motion, and the rate that defines t_gamma.

    kind      velocity on the outer wall          rate (t_gamma = 1/rate)
    circle    omega (-y, x)                       |omega|
    couette   omega (-y, x), inner_omega inside   shear rate half way between the cylinders
    channel   u_max (1 - (y/W)^2) e_x             u_max / W
    file      omega (-y, x)                       |omega|

Where the outer wall of a circle or of a file stands still, the rate is the largest |omega| of the obstacles.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import shapely

from biem.curves import wall_shapes
from biem.curves.crossing import FINE, polygons
from biem.curves.curve import area
from biem.curves.shapes import place
from biem.scene.config import Obstacle, WallsTable
from biem.scene.flows import BackgroundFlow
from biem.stokes.walls import Walls

KEYS = {  # of each kind, those that it needs and those that it may have
    "circle": (("radius",), ("omega",)),
    "couette": (("radius", "inner_radius"), ("omega", "inner_omega")),
    "channel": (("length", "width"), ("u_max",)),
    "file": (("file",), ("omega",)),
}
COMMON = ("kind", "capillary", "spacing", "obstacles")
LEAST_NODES = {"circle": 64, "ellipse": 96, "polygon": 192, "star": 256, "channel": 256}
DRAFT = 512  # nodes of a shape that is measured
RESOLVED = 1e-3  # largest relative size of the highest modes of a wall given by points


def make_walls(table: WallsTable, mu: float, kappa_b: float, radius: float, spacing: float, folder: Path) -> tuple[Walls, BackgroundFlow]:
    """The walls, and the flow that they drive. radius: R of the vesicles; spacing: of the nodes where the table has none.

    Raises ValueError for what is missing, does not go together, or does not enclose a fluid.
    """
    _check_keys(table)
    spacing = table.spacing or spacing
    curves, motions, rate = _kind(table, mu, kappa_b, radius, spacing, folder)
    for obstacle in table.obstacles:
        curves.append(place(_obstacle(obstacle, spacing), np.asarray(obstacle.center), obstacle.angle))
        motions.append(_turning(obstacle.omega, np.asarray(obstacle.center)))
    _check_region(curves, len(curves) - len(table.obstacles))
    if rate == 0.0 and table.kind in ("circle", "file"):
        rate = max((abs(o.omega) for o in table.obstacles), default=0.0)
    moving = rate != 0.0 or any(o.omega for o in table.obstacles)
    driven = np.concatenate([motion(X) for motion, X in zip(motions, curves, strict=True)]) if moving else None
    inner = [shapely.get_coordinates(shapely.point_on_surface(body))[0] for body in polygons_of(curves[1:])]
    walls = Walls(tuple(curves), np.array([curves[0].mean(axis=1), *inner]), mu, driven)
    if driven is None:
        return walls, BackgroundFlow("quiescent", lambda X, t: 0.0 * X, None)
    return walls, BackgroundFlow("walls", walls.flow, rate or None, table.width)


def polygons_of(curves: list[np.ndarray]) -> list[shapely.Polygon]:
    """Fine polygons through closed curves (2, N)."""
    return [polygons(X[None], FINE)[0] for X in curves]


def _check_keys(table: WallsTable) -> None:
    needed, allowed = KEYS[table.kind]
    for key in needed:
        if getattr(table, key) is None:
            raise ValueError(f'walls.kind = "{table.kind}" needs walls.{key}')
    given = {key for key in table.model_fields_set if getattr(table, key) is not None}  # a resolved scene names all keys
    for key in given - {*needed, *allowed, *COMMON}:
        raise ValueError(f'walls.{key} does not go with walls.kind = "{table.kind}"; it takes ' + ", ".join((*needed, *allowed)))
    strengths = [key for key in ("capillary", "omega", "inner_omega", "u_max") if getattr(table, key) is not None]
    if table.capillary is not None and len(strengths) > 1:
        raise ValueError(f"walls.capillary and walls.{strengths[1]} both set the strength: keep one")


def _kind(
    table: WallsTable, mu: float, kappa_b: float, radius: float, spacing: float, folder: Path
) -> tuple[list[np.ndarray], list[Callable[[np.ndarray], np.ndarray]], float]:
    """Curves and motions of the kind's own walls, and the rate."""
    rate = None if table.capillary is None else table.capillary * kappa_b / (mu * radius**3)
    origin = np.zeros(2)
    if table.kind == "channel":
        assert table.length is not None
        assert table.width is not None
        if table.length <= 2 * table.width:
            raise ValueError(f"walls.length = {table.length:g} must be above twice walls.width = {table.width:g}, the half width")
        width = table.width
        u_max = rate * width / 2 if rate is not None else table.u_max or 0.0  # Ca = 2 mu R^3 rate / kappa_b, as in Poiseuille flow
        draft = wall_shapes.channel(DRAFT, table.length, width)
        X = wall_shapes.channel(wall_shapes.nodes_for(draft, spacing, LEAST_NODES["channel"]), table.length, width)
        return [X], [lambda X: np.stack([u_max * (1 - (X[1] / width) ** 2), 0 * X[1]], axis=1)], abs(u_max) / width
    if table.kind == "file":
        curves = _from_file(folder / str(table.file), spacing)
        omega = rate if rate is not None else table.omega or 0.0
        return curves, [_turning(omega, origin), *(_turning(0.0, origin) for _ in curves[1:])], abs(omega)
    assert table.radius is not None
    outer = _circle(table.radius, spacing)
    if table.kind == "circle":
        omega = rate if rate is not None else table.omega or 0.0
        return [outer], [_turning(omega, origin)], abs(omega)
    assert table.inner_radius is not None
    a, b = table.inner_radius, table.radius
    if a >= b:
        raise ValueError(f"walls.inner_radius = {a:g} must be below walls.radius = {b:g}")
    shear = 2 * a**2 * b**2 / ((b**2 - a**2) * (0.5 * (a + b)) ** 2)  # half way, for a unit difference of the angular velocities
    omega = rate / shear if rate is not None else table.omega or 0.0
    inner_omega = table.inner_omega or 0.0
    return [outer, _circle(a, spacing)], [_turning(omega, origin), _turning(inner_omega, origin)], shear * abs(omega - inner_omega)


def _circle(radius: float, spacing: float) -> np.ndarray:
    draft = wall_shapes.circle(DRAFT, radius)
    return wall_shapes.circle(wall_shapes.nodes_for(draft, spacing, LEAST_NODES["circle"]), radius)


def _obstacle(obstacle: Obstacle, spacing: float) -> np.ndarray:
    def shape(N: int) -> np.ndarray:
        if obstacle.shape == "ellipse":
            return wall_shapes.ellipse(N, obstacle.size, obstacle.aspect)
        if obstacle.shape == "polygon":
            return wall_shapes.polygon(N, obstacle.size, obstacle.sides)
        if obstacle.shape == "star":
            return wall_shapes.star(N, obstacle.size, obstacle.sides)
        return wall_shapes.circle(N, obstacle.size)

    return shape(wall_shapes.nodes_for(shape(DRAFT), spacing, LEAST_NODES[obstacle.shape]))


def _turning(omega: float, center: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Velocity (N, 2) at X (2, N) of a body that turns about its center."""
    return lambda X: omega * np.stack([-(X[1] - center[1]), X[0] - center[0]], axis=1)


def _from_file(path: Path, spacing: float) -> list[np.ndarray]:
    """Curves through the points of a text file, each resampled to equal arclength."""
    try:
        blocks = [block for block in path.read_text(encoding="utf-8").split("\n\n") if block.strip()]
        points = [np.loadtxt(block.splitlines(), ndmin=2) for block in blocks]
    except FileNotFoundError:
        raise ValueError(f"walls.file {path} does not exist (paths are relative to the scene)") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"walls.file {path} cannot be read: {error}") from None
    except ValueError as error:
        what = " ".join(str(error).split()).rstrip(".;")
        raise ValueError(
            f"walls.file {path}: {what}; expected two columns, x and y, apart by spaces, a blank line between curves"
        ) from None
    if not points:
        raise ValueError(f"walls.file {path} has no points")
    curves = []
    for number, block in enumerate(points):
        where = f"walls.file {path}, curve {number}"
        if not np.isfinite(block).all():
            bad = int(np.flatnonzero(~np.isfinite(block).all(axis=1))[0])
            raise ValueError(f"{where}: point {bad} is {block[bad].tolist()}, expected finite numbers")
        if block.shape[1] != 2 or len(block) < 16 or len(block) % 2:
            repeated = " (the first one is repeated at the end: leave that out)" if np.array_equal(block[0], block[-1]) else ""
            raise ValueError(
                f"{where}: {len(block)} points of {block.shape[1]} columns{repeated}; expected two columns and an even number, at "
                "least 16, of points on a smooth curve"
            )
        X = block.T if float(area(block.T[None])[0]) > 0 else block.T[:, ::-1]
        modes = np.abs(np.fft.rfft(X - X.mean(axis=1, keepdims=True)))
        if modes[:, -max(2, modes.shape[1] // 8) :].max() > RESOLVED * modes.max():
            raise ValueError(
                f"{where}: its points do not resolve a smooth curve; give more, evenly spaced ones, and do not repeat the first"
            )
        curves.append(wall_shapes.resampled(X, wall_shapes.nodes_for(X, spacing, LEAST_NODES["circle"])))
    return curves


def _check_region(curves: list[np.ndarray], first: int) -> None:
    """Bodies inside the outer wall and apart from each other. first: number of the first obstacle among the curves."""
    shapes = polygons_of(curves)
    name = lambda k: "the outer wall" if k == 0 else f"walls.obstacles.{k - first}" if k >= first else f"inner wall {k}"
    for k, body in enumerate(shapes):
        if not body.is_valid:
            raise ValueError(f"{name(k)} crosses itself: give a simple closed curve")
        if k and not shapely.contains_properly(shapes[0], body):
            raise ValueError(f"{name(k)} is not inside the outer wall: move it or make it smaller")
        for j in range(1, k):
            if shapely.intersects(shapes[j], body):
                raise ValueError(f"{name(j)} and {name(k)} overlap: move them apart")
