"""The scene file: a TOML table per subject, validated; unknown keys are refused with the nearest valid name."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, PrivateAttr, SerializerFunctionWrapHandler, field_validator, model_serializer

from biem.membrane.maps import SLOTS
from biem.scene.accuracy import apply_accuracy
from biem.scene.tables import Table, override, read_toml, validated

Kind = Literal["quiescent", "shear", "extensional", "poiseuille", "taylor_green", "rotation", "custom"]
MapKind = Literal["ivnet", "mlp", "hybrid", "exact"]
MAP_KINDS = '"ivnet", "mlp", "hybrid" or "exact"'
TIMES = 'a positive, finite number or a number and a unit, as in "0.01 t_gamma"'
MOST_CONTRAST = 1e5  # a vesicle is as good as rigid at 1e4; at 1e6 the equations have lost their digits
EXPECTED = {  # for keys whose types or patterns say it badly
    "solver.device": '"cpu" (NumPy), "torch" (PyTorch on the CPU), "cuda" or "cuda:N"',
    **{f"solver.maps.{slot}": MAP_KINDS for slot in SLOTS},
    "solver.maps": f"{MAP_KINDS}, or a table of them with the keys {', '.join(SLOTS)}",
    "domain.periodic": "two positive, finite sides [Lx, Ly] of a box that repeats itself in both directions; one alone is not supported",
    "time.dt": TIMES,
    "time.horizon": TIMES,
    "time.dt_min": TIMES,
    "vesicles.contrast": f"a positive number up to {MOST_CONTRAST:.0e} (viscosity inside over outside), or a list of one for each vesicle",
}
LATER = ("domain", "observe", "tracers")  # optional tables of a scene that are left out of its resolved form
FLOAT32_TOLERANCE = 1e-5  # the least that sums in float32 can be asked for
Correction = Literal["redistribute", "area_length"]


class Physics(Table):
    """Bending stiffness and viscosity (of the fluid outside; inside it is vesicles.contrast times that), in any consistent units."""

    kappa_b: float = Field(1.0, gt=0)  # bending stiffness
    mu: float = Field(1.0, gt=0)  # viscosity


class Vesicles(Table):
    """What is suspended: a file, or shapes of one reduced area and where they are."""

    file: str | None = None  # HDF5 with a dataset X (M, 2, N), or a trajectory: its last frame
    placement: Literal["explicit", "grid", "random"] = "explicit"  # by centers and angles, or in a box without overlap
    shape: Literal["equilibrium", "ellipse", "perturbed"] = "equilibrium"  # of least bending energy; an ellipse; random, by seed
    reduced_area: float = Field(0.65, gt=0, le=1)  # 4 pi area / length^2: 1 for a circle
    points: int = Field(64, ge=16, multiple_of=2)  # nodes of a vesicle
    length: float = Field(1.0, gt=0)  # of a membrane
    seed: int = Field(0, ge=0)  # of random shapes and places
    centers: list[tuple[float, float]] | None = None  # placement = "explicit"; default one vesicle at the origin
    angles: list[float] | None = None  # of the long axes from the x axis, rad
    unit: Literal["length", "R"] = "length"  # of centers: the unit of `length`, or the radius of the circle of equal area
    count: int | None = Field(None, ge=1)  # placement = "grid" or "random": two of count, area_fraction, box
    area_fraction: float | None = Field(None, gt=0, lt=1)  # of the vesicles in the box
    box: tuple[float, float] | None = None  # width and height
    corner: tuple[float, float] | None = None  # of the box; default: the box is centred on the origin
    gap: float = Field(0.02, ge=0)  # smallest distance of membranes, in lengths
    contrast: float | list[float] = 1.0  # viscosity inside over outside, of all or of each vesicle; "implicit" and "split"

    @field_validator("contrast", mode="before")
    @classmethod
    def _positive(cls, contrast: Any) -> Any:
        values = contrast if isinstance(contrast, list) and contrast else [contrast]
        if not all(isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= MOST_CONTRAST for value in values):
            raise ValueError("not positive")  # said in words by EXPECTED
        return contrast

    @model_serializer(mode="wrap")
    def _as_table(self, inner: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without a contrast of 1: it reads as scenes did before there was one."""
        table = inner(self)
        if self.contrast == 1.0:
            table.pop("contrast", None)
        return table


class FlowTable(Table):
    """Background flow; its strength by one of rate, u_max, capillary, its width directly or by the confinement Cn = R/W."""

    kind: Kind = "quiescent"  # biem.scene.flows has the velocities
    rate: float | None = None
    u_max: float | None = None
    capillary: float | None = None
    width: float | None = Field(None, gt=0)
    confinement: float | None = Field(None, gt=0)
    function: str | None = None  # custom: "module.name" of velocity(x, y, t) -> (u, v), in a module beside the scene


class Obstacle(Table):
    """A rigid body in the fluid. size: radius of the circle of equal area; angle, rad; omega: its angular velocity."""

    shape: Literal["circle", "ellipse", "polygon", "star"] = "circle"  # corners are rounded
    center: tuple[float, float]  # of its area
    size: float = Field(gt=0)
    angle: float = 0.0
    aspect: float = Field(0.5, gt=0.05, le=1)  # ellipse: short over long axis
    sides: int = Field(4, ge=3, le=12)  # polygon: corners, rounded; star: arms
    omega: float = 0.0


class WallsTable(Table):
    """Rigid no-slip walls that enclose the fluid, and what drives it: turning walls, or flow through a channel's ends.

    circle: radius, omega. couette: radius, inner_radius, omega, inner_omega. channel: along x, length from end to end, width W (half,
    as of Poiseuille flow), u_max. file: text with two columns, a blank line between closed curves, the outer wall first; omega.
    Strength by capillary instead of omega or u_max: of the rate that defines t_gamma (biem.scene.walls).
    """

    kind: Literal["circle", "couette", "channel", "file"]  # of the outer wall
    radius: float | None = Field(None, gt=0)
    inner_radius: float | None = Field(None, gt=0)
    omega: float | None = None
    inner_omega: float | None = None
    length: float | None = Field(None, gt=0)
    width: float | None = Field(None, gt=0)
    u_max: float | None = None
    capillary: float | None = None
    file: str | None = None
    spacing: float | None = Field(None, gt=0)  # of the nodes on the walls, at most; default vesicles' length / 32
    obstacles: list[Obstacle] = Field([])


class DomainTable(Table):
    """A box that repeats itself in both directions in place of the unbounded plane; its centre is the origin. It goes without walls.

    Vesicles that leave it on one side come back on the other; the mean of the velocity that they give the fluid is zero over the box.
    """

    periodic: tuple[float, float]  # the sides [Lx, Ly], larger than any vesicle

    @field_validator("periodic", mode="before")
    @classmethod
    def _two_sides(cls, sides: Any) -> Any:
        numbers = [x for x in sides if isinstance(x, (int, float)) and not isinstance(x, bool)] if isinstance(sides, list) else []
        if len(numbers) != 2 or len(sides) != 2 or not all(0 < x < math.inf for x in numbers):
            raise ValueError("not two sides")  # said in words by EXPECTED
        return tuple(float(x) for x in numbers)


class Time(Table):
    """dt, horizon and dt_min: numbers, or in units of the flow or of bending: "0.01 t_gamma", "2 t_kappa" (t_kappa = mu R^3 / kappa_b).

    adaptive: dt is the first step, the next ones follow their errors; each step is made against two half steps, three times the work.
    """

    dt: float | str
    horizon: float | str
    save_every: int = Field(1, ge=1)  # steps between frames of the trajectory
    order: int = Field(1, ge=1, le=2)  # 2: each step against two half steps, locally extrapolated; three times the work
    adaptive: bool = False
    tolerance: float = Field(1e-3, gt=0, lt=1)  # adaptive: of a step's error in the membrane length, and in area and length, relative
    dt_min: float | str | None = None  # adaptive: the run ends where it would take a smaller step; default dt/1000


class RepulsionTable(Table):
    """Repulsion between membranes closer than `reach` (in lengths), growing linearly to `strength` (in kappa_b/length^3) at contact."""

    reach: float = Field(gt=0)
    strength: float = Field(1e3, gt=0)


class MapsTable(Table):
    """What each of a vesicle's maps is made by; those that are not named are exact."""

    relax: MapKind = "exact"  # a step of relaxation
    self_tension: MapKind = "exact"  # tension by bending
    advection: MapKind = "exact"  # an outer velocity made inextensible
    flow_tension: MapKind = "exact"  # tension by an outer velocity
    near: MapKind = "exact"  # there is no hybrid one: it is exact

    @classmethod
    def of_all(cls, kind: MapKind) -> MapsTable:
        """All maps of one kind."""
        return cls(relax=kind, self_tension=kind, advection=kind, flow_tension=kind, near=kind)


class Solver(Table):
    """The solver and what it is allowed to do. "implicit" runs in float64 on the CPU; "split" also on devices and in mixed precision.

    "vesnet" is "split" with maps by networks, alone ("ivnet", "mlp") or as corrections to exact ones ("hybrid").
    """

    kind: Literal["implicit", "split", "vesnet"] = "implicit"  # all coupled implicitly; advection, then relaxation; that by networks
    accuracy: Literal["fast", "balanced", "reference"] | None = None  # settings of biem.scene.accuracy for what the scene leaves open
    device: str = Field("cpu", pattern=r"^(cpu|torch|cuda(:\d+)?)$")  # split; "cpu": NumPy, "torch": PyTorch on the CPU, "cuda", "cuda:1"
    dtype: Literal["float64", "float32"] = "float64"  # split; of kernels, solves and pair sums: geometry and forces are float64
    maps: MapsTable = Field(MapsTable.of_all("hybrid"))  # vesnet; one kind for all, or a table by map: those not named are exact
    weights: str | None = None  # vesnet; folder of weights, default the shipped ones
    out_of_distribution: Literal["flag", "exact", "refuse"] = "flag"  # vesnet; vesicles unlike the training data: counted, by exact maps
    tolerance: float = Field(1e-10, gt=0, lt=1)  # implicit: of GMRES, relative
    max_iterations: int = Field(200, ge=1)  # implicit: of GMRES
    operator_points: int | None = Field(None, ge=16, multiple_of=2)  # nodes of a vesicle's operators; default 2 N below N = 96
    near_field: Literal["auto", "upsample", "ying_zorin", "layers", "layers_rbf", "none"] = "auto"  # auto: upsample
    near_tolerance: float | None = Field(None, gt=0, lt=1)  # default 1e-8, split 1e-6, in float32 1e-5
    far_field: Literal["auto", "direct", "ewald"] = "auto"  # auto: the cheaper one; ewald needs vesnet[fast]
    far_tolerance: float | None = Field(None, gt=0, lt=1)  # default 1e-10, split 1e-6, in float32 1e-5
    repulsion: RepulsionTable | None = None
    corrections: list[Correction] = Field(["area_length", "redistribute"])
    max_error: float = Field(1e-2, gt=0)  # relative error of area or length in one step (since the start, if not corrected)

    @field_validator("maps", mode="before")
    @classmethod
    def _one_kind_for_all(cls, maps: Any) -> Any:
        return dict.fromkeys(SLOTS, maps) if isinstance(maps, str) and maps in get_args(MapKind) else maps

    @property
    def map_kinds(self) -> dict[str, str]:
        """By slot, what each map is made by."""
        if self.kind != "vesnet":
            return dict.fromkeys(SLOTS, "exact")
        return {slot: "exact" if (slot, kind) == ("near", "hybrid") else kind for slot, kind in self.maps.model_dump().items()}

    @property
    def near_method(self) -> str:
        """near_field, where "auto" gives way to the layers that a network for them is made for."""
        return "layers" if self.near_field == "auto" and self.map_kinds["near"] != "exact" else self.near_field

    @property
    def tolerances(self) -> tuple[float, float]:
        """Of the near and of the far field."""
        near, far = (1e-8, 1e-10) if self.kind == "implicit" else (1e-6, 1e-6)
        if self.dtype == "float32":
            near = far = FLOAT32_TOLERANCE
        return self.near_tolerance or near, self.far_tolerance or far


class Output(Table):
    """trajectory: default path; tension: keep it also where the solver does not need it; checkpoint_every: steps, default save_every."""

    trajectory: str | None = None
    checkpoint_every: int | None = Field(None, ge=1)
    tension: bool = False


class ObserveTable(Table):
    """Observables during the run, beside the trajectory in NAME.observables.h5; the run then keeps its tension (output.tension)."""

    every: int | None = Field(None, ge=1)  # steps; default time.save_every
    quantities: list[str] | None = None  # of biem.observe.quantities; default those that the scene has and that cost little
    bins: int = Field(20, ge=1)  # of lateral_distribution and velocity_profile, over the width of the flow


class TracersTable(Table):
    """Points that the flow carries along, in the trajectory: random in a box, or from a file. Each step solves for the tension."""

    file: str | None = None  # text: rows of x and y
    count: int | None = Field(None, ge=1)  # points at random
    box: tuple[float, float] | None = None  # default: around the membranes, or all that the walls enclose
    corner: tuple[float, float] | None = None  # of the box; default: it is centred on the origin
    region: Literal["all", "outside", "inside"] = "all"  # of vesicles
    seed: int = Field(0, ge=0)  # of their places


class Scene(Table):
    """A validated scene."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")  # of the run and its files: letters, digits and _ . -
    physics: Physics = Physics()
    vesicles: Vesicles = Vesicles()
    flow: FlowTable = FlowTable()
    walls: WallsTable | None = None
    domain: DomainTable | None = None
    time: Time
    solver: Solver = Solver()
    output: Output = Output()
    observe: ObserveTable | None = None
    tracers: TracersTable | None = None
    _folder: Path = PrivateAttr(Path("."))

    @property
    def folder(self) -> Path:
        """Where the scene's files are looked for."""
        return self._folder

    @model_serializer(mode="wrap")
    def _as_table(self, inner: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the tables that came later and that the scene has not: it reads as scenes did before."""
        table = inner(self)
        return {key: value for key, value in table.items() if value is not None or key not in LATER}


def load_scene(path: str | Path, overrides: Iterable[str] = (), accuracy: str | None = None) -> Scene:
    """The scene in a TOML file, with overrides such as "vesicles.points=32". accuracy: a preset in place of what the file says, beneath
    the overrides. Raises ValueError with one line for what is wrong.
    """
    path = Path(path)
    table = read_toml(path, "scene", "configs/scenes/shear_pair.toml")
    if accuracy is not None:
        table = apply_accuracy(table, accuracy)
    for text in overrides:
        override(table, text)
    table.setdefault("name", path.stem)
    return make_scene(table, path.parent)


def make_scene(table: dict[str, Any], folder: str | Path = ".") -> Scene:
    """The scene of a dictionary in the layout of the file. Raises ValueError with one line for what is wrong."""
    table = apply_accuracy(table)
    if isinstance(table.get("observe"), dict) and isinstance(table.get("output", {}), dict):
        table = {**table, "output": {"tension": True, **table.get("output", {})}}
    scene = validated(Scene, table, EXPECTED)
    scene._folder = Path(folder)
    return scene


def time_value(value: float | str, key: str, units: dict[str, float | None]) -> float:
    """A positive time from a number or "0.01 t_gamma". units: values of the names; None: not defined in this scene."""
    number: float | None
    if isinstance(value, str):
        words = value.split()
        try:
            number = float(words[0])
        except (ValueError, IndexError):
            number = None
        if number is None or len(words) > 2 or (len(words) == 2 and words[1] not in units):
            raise ValueError(f'time.{key} = "{value}": expected a number or a number and a unit, as in "0.01 t_gamma" or "2 t_kappa"')
        if len(words) == 2:
            unit = units[words[1]]
            if unit is None:
                raise ValueError(f'time.{key} = "{value}": this flow has no {words[1]}; give a number, t_kappa, or flow or walls a rate')
            number *= unit
    else:
        number = float(value)
    if not (number > 0 and math.isfinite(number)):
        raise ValueError(f"time.{key} = {value}: expected a positive, finite time")
    return number
