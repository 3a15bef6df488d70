"""From a validated scene to what a solver takes: initial membranes, flow and times. Physics is checked here, before the first step."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np
import shapely

from biem.curves.crossing import fluid_region, outside_region, pair_crossings, polygons, self_crossings
from biem.curves.curve import area, effective_radius, length, reduced_area
from biem.curves.fourier import remove_nyquist
from biem.curves.lattice import Box
from biem.curves.packing import assemble, grid, random_packing
from biem.curves.shapes import ellipse, equilibrium, perturbed
from biem.scene.config import FLOAT32_TOLERANCE, FlowTable, Scene, Solver, Vesicles, time_value
from biem.scene.flows import BackgroundFlow, capillary_factor, make_flow
from biem.scene.periodic import box_of, check_domain, check_flow, check_size, in_domain
from biem.scene.tracers import check_tracers
from biem.scene.walls import make_walls
from biem.stokes.walls import Walls

MOST_STEPS = 1e12
FARTHEST = 1e8  # from the origin, over the size of the largest vesicle: beyond, nodes keep fewer than eight digits of a shape
CIRCLE = 1e-6  # 1 - reduced area below which a vesicle counts as a circle
LARGEST_SHRINKAGE = 1000.0  # of adaptive steps, from the first one
LEAST_TOLERANCE = 1e-9  # of adaptive steps
PLACED_AT = 128  # nodes of the outlines that are placed, so that vesicles are where they are at any resolution
WALL_NODES_PER_LENGTH = 32  # on walls, by default, per membrane length
SOLVERS_WITH = {  # keys of [solver] that not every kind takes
    "device": ("split", "vesnet"),
    "dtype": ("split", "vesnet"),
    "tolerance": ("implicit",),
    "max_iterations": ("implicit",),
    "maps": ("vesnet",),
    "weights": ("vesnet",),
    "out_of_distribution": ("vesnet",),
}
SHAPES = {"equilibrium": equilibrium, "ellipse": ellipse}


@dataclass(frozen=True)
class Problem:
    """X (M, 2, N) at t = 0, the flow, dt, dt_min and horizon in the scene's units; notices: what was changed in the input.

    walls, region: the walls and the fluid between them, or None where there are none; then flow is what the walls drive.
    """

    scene: Scene
    X: np.ndarray
    flow: BackgroundFlow
    dt: float
    dt_min: float
    horizon: float
    t_kappa: float
    notices: tuple[str, ...] = ()
    walls: Walls | None = None
    region: shapely.Polygon | None = None

    @property
    def box(self) -> Box | None:
        """The periodic box, or None where there is none."""
        return box_of(self.scene, self.flow)

    @property
    def interacting(self) -> bool:
        """Whether a vesicle's force moves vesicles: others, or, in a periodic box, images of its own."""
        return len(self.X) > 1 or self.scene.domain is not None

    @property
    def contrast(self) -> np.ndarray | None:
        """Viscosity inside over outside of every vesicle (M,), or None where it is 1 for all."""
        values = np.full(len(self.X), self.scene.vesicles.contrast, dtype=np.float64)
        return None if np.all(values == 1.0) else values

    @property
    def steps(self) -> int:
        """Steps of dt to the horizon; the last one is shorter where dt does not divide it."""
        return max(1, int(np.ceil(self.horizon / self.dt - 1e-9)))

    @property
    def radius(self) -> float:
        """R: radius of the circle of the vesicles' mean area."""
        return float(np.sqrt(np.mean(area(self.X)) / np.pi))

    @property
    def length(self) -> float:
        """Mean length of the membranes."""
        return float(np.mean(length(self.X)))


def build(scene: Scene, X: np.ndarray | None = None) -> Problem:
    """The problem of a scene. X (M, 2, N): its membranes at t = 0 where they are known, as from a trajectory, whose solver has run already.

    Raises ValueError with one line for what is wrong.
    """
    known = X is not None
    notices: tuple[str, ...] = ()
    if not known and scene.vesicles.file is not None:
        X, notices = _from_file(scene)
    check_domain(scene)
    if not known:
        check_tracers(scene)
    walls, region, flow = (None, None, None) if scene.walls is None else _between_walls(scene, X)
    if X is None:
        X = _membranes(scene, region)
    _check_membranes(X, region, None if scene.domain is None else Box(*scene.domain.periodic))
    radius = float(np.sqrt(np.mean(area(X)) / np.pi))
    if flow is None:
        flow = _flow(scene, radius)
        if flow.kind == "rotation":
            _check_rotation(X)
    if flow.kind != "quiescent" or len(X) > 1 or walls is not None or scene.domain is not None:
        _check_not_circles(X)
    t_kappa = scene.physics.mu * radius**3 / scene.physics.kappa_b
    units = {"t_gamma": flow.time_scale, "t_kappa": t_kappa}
    dt, dt_min, horizon = _times(scene, units)
    if flow.kind == "custom":
        flow.velocity(X, 0.0)  # it shows here what is wrong with it
    box = box_of(scene, flow)
    if box is not None:
        check_flow(box, flow, horizon)
    if not known:
        _check_solver(scene)
    _check_contrast(scene, len(X))
    points = scene.solver.operator_points
    if points is not None and points < X.shape[-1]:
        raise ValueError(f"solver.operator_points = {points} is below vesicles.points = {X.shape[-1]}: choose at least as many")
    return Problem(scene, X, flow, dt, dt_min, horizon, t_kappa, notices, walls, region)


def _check_solver(scene: Scene) -> None:
    """Options that the solver does not have, and tolerances that the precision does not give."""
    solver = scene.solver
    for key, kinds in SOLVERS_WITH.items():
        if solver.kind not in kinds and getattr(solver, key) != Solver.model_fields[key].default:
            others = " or ".join(f'"{kind}"' for kind in kinds)
            raise ValueError(f"solver.{key} goes with solver.kind = {others}; remove it or choose that solver")
    if solver.kind == "implicit" and solver.near_field.startswith("layers"):
        raise ValueError(f'solver.near_field = "{solver.near_field}" goes with solver.kind = "split"; "implicit" takes "upsample"')
    if solver.weights is not None and not (scene.folder / solver.weights).is_dir():
        raise ValueError(f"solver.weights {scene.folder / solver.weights} is no folder of weights (paths are relative to the scene)")
    if solver.dtype == "float32":
        for key in ("near_tolerance", "far_tolerance"):
            value = getattr(solver, key)
            if value is not None and value < FLOAT32_TOLERANCE:
                raise ValueError(
                    f'solver.{key} = {value:g} cannot be met in float32: choose at least {FLOAT32_TOLERANCE:g}, or dtype = "float64"'
                )


def _check_contrast(scene: Scene, vesicles: int) -> None:
    contrast, solver = scene.vesicles.contrast, scene.solver
    if isinstance(contrast, list) and len(contrast) != vesicles:
        raise ValueError(
            f"vesicles.contrast has {len(contrast)} entries for {vesicles} vesicle(s): give one number, or one for each vesicle"
        )
    learned = [f"{slot} = {kind}" for slot, kind in solver.map_kinds.items() if kind != "exact"]
    if learned and not np.all(np.asarray(contrast) == 1.0):
        raise ValueError(
            f'vesicles.contrast = {contrast}: networks are for a contrast of 1 ({learned[0]}); take solver.kind = "split" or "implicit"'
        )


def _times(scene: Scene, units: dict[str, float | None]) -> tuple[float, float, float]:
    """dt, dt_min, horizon."""
    time = scene.time
    dt = time_value(time.dt, "dt", units)
    dt_min = dt / LARGEST_SHRINKAGE if time.dt_min is None else time_value(time.dt_min, "dt_min", units)
    horizon = time_value(time.horizon, "horizon", units)
    if not horizon / dt < MOST_STEPS:
        raise ValueError(f"time.horizon is {horizon / dt:.3g} times time.dt: at most {MOST_STEPS:.0e} steps are made")
    if time.adaptive:
        if dt > horizon:
            raise ValueError(f"time.dt = {dt:.6g}, the first step, is longer than time.horizon = {horizon:.6g}: choose a smaller one")
        if dt_min > dt:
            raise ValueError(f"time.dt_min = {dt_min:.6g} is above time.dt = {dt:.6g}, the first step: choose a smaller one")
        if time.tolerance < LEAST_TOLERANCE:
            raise ValueError(
                f"time.tolerance = {time.tolerance:g} is below {LEAST_TOLERANCE:g}, where error estimates drown in the rounding and the "
                "GMRES tolerance of a step: choose a larger one"
            )
    return dt, dt_min, horizon


def _between_walls(scene: Scene, X: np.ndarray | None) -> tuple[Walls, shapely.Polygon, BackgroundFlow]:
    """Walls, the fluid between them and what drives it. X: the membranes, where they are known already."""
    if scene.flow != FlowTable():
        raise ValueError("[walls] drive the flow between them: remove [flow]")
    assert scene.walls is not None
    if X is None:
        X = _shape(scene.vesicles, np.random.default_rng(scene.vesicles.seed))[None]
    radius, spacing = float(np.sqrt(np.mean(area(X)) / np.pi)), float(np.mean(length(X))) / WALL_NODES_PER_LENGTH
    walls, flow = make_walls(scene.walls, scene.physics.mu, scene.physics.kappa_b, radius, spacing, scene.folder)
    return walls, fluid_region(walls.curves), flow


def _membranes(scene: Scene, region: shapely.Polygon | None) -> np.ndarray:
    v = scene.vesicles
    single = _shape(v, np.random.default_rng(v.seed))
    if v.placement == "explicit":
        for name in ("count", "area_fraction", "box", "corner"):
            if getattr(v, name) is not None:
                raise ValueError(f'vesicles.{name} goes with placement = "grid" or "random"; "explicit" takes centers and angles')
        centers = np.array([(0.0, 0.0)] if v.centers is None else v.centers, dtype=np.float64).reshape(-1, 2)
        if len(centers) == 0:
            raise ValueError("vesicles.centers is empty: give at least one centre")
        angles = np.zeros(len(centers)) if v.angles is None else np.asarray(v.angles, dtype=np.float64)
        if len(angles) != len(centers):
            raise ValueError(f"vesicles.angles has {len(angles)} entries for {len(centers)} centers: give one angle for each centre")
        if v.unit == "R":
            centers = centers * float(effective_radius(single[None])[0])
        shapes = _shapes(v, single, len(centers))
        return assemble(shapes, centers, angles)
    if v.centers is not None or v.angles is not None:
        raise ValueError('vesicles.centers and angles go with placement = "explicit"')
    fine = v.model_copy(update={"points": PLACED_AT})
    outline = _shape(fine, np.random.default_rng(v.seed))
    one = float(area(outline[None])[0])
    if region is not None and v.placement == "random" and v.box is None:
        return _packed(v, single, outline, one, region)
    periodic = scene.domain is not None and v.box is None
    count, box = _count_and_box(in_domain(v, scene.domain.periodic) if scene.domain is not None and periodic else v, one)
    shapes, outlines = _shapes(v, single, count), _shapes(fine, outline, count)
    gap = v.gap * v.length
    if v.placement == "grid":
        centers, angles = grid(outlines, box, gap)
    else:
        centers, angles = random_packing(outlines, box, gap, np.random.default_rng([v.seed, 1]), periodic=periodic)
    corner = (-box[0] / 2, -box[1] / 2) if v.corner is None else v.corner
    return assemble(shapes, centers + np.asarray(corner), angles)


def _packed(v: Vesicles, single: np.ndarray, outline: np.ndarray, one: float, region: shapely.Polygon) -> np.ndarray:
    """Random positions all over the fluid between walls. outline: the single shape on PLACED_AT nodes, of area `one`."""
    if (v.count is None) == (v.area_fraction is None):
        raise ValueError('vesicles: placement = "random" between walls needs count or area_fraction (of the fluid), one of them')
    if v.corner is not None:
        raise ValueError("vesicles.corner goes with a box")
    count = v.count or max(1, round((v.area_fraction or 0.0) * region.area / one))
    shapes, outlines = _shapes(v, single, count), _shapes(v.model_copy(update={"points": PLACED_AT}), outline, count)
    x0, y0, x1, y1 = region.bounds
    moved = shapely.transform(region, lambda p: p - (x0, y0))
    rng = np.random.default_rng([v.seed, 1])
    centers, angles = random_packing(outlines, (x1 - x0, y1 - y0), v.gap * v.length, rng, moved)
    return assemble(shapes, centers + np.array([x0, y0]), angles)


def _shape(v: Vesicles, rng: np.random.Generator) -> np.ndarray:
    if v.shape == "perturbed":
        return perturbed(v.points, v.reduced_area, v.length, rng)
    return SHAPES[v.shape](v.points, v.reduced_area, v.length)


def _shapes(v: Vesicles, single: np.ndarray, count: int) -> np.ndarray:
    """count shapes; perturbed ones differ from each other."""
    if v.shape == "perturbed":
        rng = np.random.default_rng(v.seed)
        return np.stack([_shape(v, rng) for _ in range(count)])
    return np.repeat(single[None], count, axis=0)


def _count_and_box(v: Vesicles, one: float) -> tuple[int, tuple[float, float]]:
    given = [name for name in ("count", "area_fraction", "box") if getattr(v, name) is not None]
    if len(given) != 2:
        raise ValueError(
            f'vesicles: placement = "{v.placement}" needs two of count, area_fraction and box, got {" and ".join(given) or "none"}'
        )
    if v.box is None:
        assert v.count is not None
        assert v.area_fraction is not None
        side = float(np.sqrt(v.count * one / v.area_fraction))
        return v.count, (side, side)
    if min(v.box) <= 0:
        raise ValueError(f"vesicles.box = {list(v.box)}: both sides must be positive")
    if v.count is not None:
        return v.count, v.box
    assert v.area_fraction is not None
    return max(1, round(v.area_fraction * v.box[0] * v.box[1] / one)), v.box


def _from_file(scene: Scene) -> tuple[np.ndarray, tuple[str, ...]]:
    v = scene.vesicles
    of_shapes = {name: field for name, field in Vesicles.model_fields.items() if name not in ("file", "contrast")}
    unused = [name for name, field in of_shapes.items() if getattr(v, name) != field.default]
    if unused:
        raise ValueError(f"vesicles.file excludes vesicles.{unused[0]}: the file holds the shapes and where they are")
    path = scene.folder / str(v.file)
    try:
        with h5py.File(path, "r") as file:
            if not isinstance(file.get("X"), h5py.Dataset):
                raise ValueError(f"vesicles.file {path} has no dataset X; it has {', '.join(file) or 'none'}")
            run = file.attrs.get("run")
            X = np.asarray(file["X"][-1] if file["X"].ndim == 4 else file["X"], dtype=np.float64)
        for newest in sorted(path.with_name(path.name + ".frames").glob("[0-9]*.h5"))[-1:]:  # of a run that did not end
            with h5py.File(newest, "r") as file:
                X = np.asarray(file["X"][-1], dtype=np.float64) if file.attrs.get("run") == run else X
    except FileNotFoundError:
        raise ValueError(f"vesicles.file {path} does not exist (paths are relative to the scene)") from None
    except OSError as error:
        raise ValueError(f"vesicles.file {path} cannot be read as HDF5: {' '.join(str(error).split())}") from None
    if X.ndim != 3 or X.shape[1] != 2 or X.shape[0] == 0:
        raise ValueError(f"vesicles.file {path}: X has shape {X.shape}, expected (M, 2, N)")
    if X.shape[2] < 16 or X.shape[2] % 2:
        raise ValueError(f"vesicles.file {path}: X has {X.shape[2]} nodes a vesicle, expected an even number, at least 16")
    if not np.isfinite(X).all():
        m, c, k = np.argwhere(~np.isfinite(X))[0]
        raise ValueError(f"vesicles.file {path}: X is {X[m, c, k]} at vesicle {m}, component {'xy'[c]}, node {k}")
    gap = np.hypot(*np.moveaxis(X - np.roll(X, -1, axis=-1), 1, 0))
    same = gap <= 1e-12 * gap.max()
    if same.any():
        m, k = np.argwhere(same)[0]
        raise ValueError(
            f"vesicles.file {path}: nodes {k} and {(k + 1) % X.shape[2]} of vesicle {m} are the same point; "
            "a closed curve does not repeat its first node"
        )
    clockwise = area(X) < 0
    notices = []
    if clockwise.any():
        X = X.copy()
        X[clockwise] = np.roll(X[clockwise][:, :, ::-1], 1, axis=-1)
        notices.append(f"{clockwise.sum()} clockwise vesicle(s) reoriented, the first is {np.flatnonzero(clockwise)[0]}")
    return remove_nyquist(X), tuple(notices)


def _check_membranes(X: np.ndarray, region: shapely.Polygon | None, box: Box | None) -> None:
    away = np.abs(X.mean(axis=-1)).max(axis=-1) / np.ptp(X, axis=-1).max()
    if away.max() > FARTHEST:
        raise ValueError(
            f"vesicle {int(away.argmax())} is {away.max():.3g} times its size from the origin, where positions have lost too many digits: "
            f"move the scene to within {FARTHEST:g}"
        )
    crossed = self_crossings(X)
    if crossed:
        raise ValueError(f"vesicle {crossed[0]} crosses itself ({len(crossed)} in all do): give simple closed curves")
    if box is not None:
        check_size(box, X)
    pairs = pair_crossings(X, None, None if box is None else box.at(0.0))
    if pairs:
        i, j = pairs[0]
        which = f"vesicles {i} and {j} overlap" if i != j else f"vesicle {i} overlaps an image of its own"
        images = "" if box is None else ", images of the periodic box counted"
        raise ValueError(f"{which} ({len(pairs)} pair(s) in all do{images}): move them apart")
    out = [] if region is None else outside_region(X, region)
    if out:
        raise ValueError(f"vesicle {out[0]} is not between the walls ({len(out)} in all are not): move it into the fluid")
    nu = reduced_area(X)
    bad = np.flatnonzero(~((nu > 0) & (nu <= 1 + 1e-9)))
    if len(bad):
        raise ValueError(
            f"vesicle {bad[0]} has reduced area {nu[bad[0]]:.6g}: expected a value in (0, 1]; its nodes do not resolve a curve"
        )


def _check_not_circles(X: np.ndarray) -> None:
    circles = np.flatnonzero(reduced_area(X) > 1.0 - CIRCLE)
    if len(circles):
        raise ValueError(
            f"vesicle {circles[0]} is a circle ({len(circles)} in all are): a constant tension moves nothing on it, so that its tension is "
            f"not determined; take a reduced area of at most {1.0 - 10 * CIRCLE:g}"
        )


def _check_rotation(X: np.ndarray) -> None:
    inside = np.flatnonzero(shapely.intersects_xy(polygons(X), 0.0, 0.0))
    if len(inside):
        raise ValueError(f"vesicle {inside[0]} covers the origin, where the flow rotation is singular: move it away")


def _flow(scene: Scene, radius: float) -> BackgroundFlow:
    f = scene.flow
    strengths = [name for name in ("rate", "u_max", "capillary") if getattr(f, name) is not None]
    if len(strengths) > 1:
        raise ValueError(f"flow.{strengths[0]} and flow.{strengths[1]} both set the strength: keep one")
    if f.kind == "quiescent" and (strengths or f.width or f.confinement or f.function):
        raise ValueError('flow.kind = "quiescent" takes no other key: remove them or choose another kind')
    if f.function is not None and f.kind != "custom":
        raise ValueError('flow.function goes with flow.kind = "custom"')
    if f.kind in ("shear", "extensional") and (f.width is not None or f.confinement is not None):
        raise ValueError(f'flow.kind = "{f.kind}" has no width')
    if f.width is not None and f.confinement is not None:
        raise ValueError("flow.width and flow.confinement both set the width: keep one")
    if f.u_max is not None and f.kind not in ("poiseuille", "taylor_green"):
        raise ValueError(f"flow.u_max goes with poiseuille and taylor_green; give {f.kind} a rate or a capillary number")
    width = radius / f.confinement if f.confinement else f.width
    rate = f.rate
    if f.capillary is not None:
        physics = scene.physics
        rate = f.capillary * physics.kappa_b / (capillary_factor(f.kind) * physics.mu * radius**3)
    elif f.u_max is not None:
        if width is None:
            raise ValueError(f"flow {f.kind} needs a width (or a confinement)")
        rate = f.u_max / width
    return make_flow(f.kind, rate, width, f.function, scene.folder)
