"""The file of a data set (TOML): which flows are harvested, which shapes are kept, which labels are made. Lengths are in membrane lengths.

Everything is in the natural units mu = kappa_b = length = 1. Each stage has its table; what a stage made with other values of its own
table, or of that of a stage before it, is refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import Field

from biem.scene.tables import Table, read_toml, validated

Flow = Literal["relaxation", "shear", "extensional", "poiseuille", "suspension"]
MapName = Literal["relax", "self_tension", "advection", "flow_tension", "near"]
MAPS: tuple[MapName, ...] = ("relax", "self_tension", "advection", "flow_tension", "near")
SPLITS = ("train", "validation", "test")
Range = tuple[float, float]


class Shapes(Table):
    """Of all vesicles. points: nodes of the harvested shapes; modes: Fourier modes |k| < modes are kept in the shapes file."""

    reduced_area: float = Field(0.65, gt=0, le=1)
    points: int = Field(128, ge=32, multiple_of=2)
    modes: int = Field(32, ge=8)


class Family(Table):
    """Runs of one kind of flow. A task is a batch of runs that advance as one array (of a suspension: one run).

    Capillary numbers are drawn evenly in their logarithm, a narrow part of the range for every task, so that the runs of a batch
    have similar time steps. Times are in t_gamma, of relaxation in t_kappa = mu R^3 / kappa_b.
    """

    flow: Flow
    runs: int = Field(ge=1)
    batch: int = Field(32, ge=1)  # runs of a task; not of suspensions
    capillary: Range = (1.0, 10.0)  # not of relaxation
    confinement: Range = (0.2, 0.8)  # poiseuille: Cn = R/W
    offset: Range = (0.0, 0.6)  # poiseuille: distance of the first centre from the centre line, in W
    initial: Literal["perturbed", "equilibrium", "ellipse"] = "perturbed"
    roughness: int = Field(6, ge=2)  # highest mode of perturbed shapes
    dt: float = Field(0.02, gt=0)
    horizon: float = Field(10.0, gt=0)
    shapes: int = Field(50, ge=1)  # taken of each vesicle, evenly spaced in time; the first one after a spacing
    vesicles: int = Field(10, ge=1)  # suspension: in the cylinder
    radius: float = Field(1.5, gt=0)  # suspension: of the cylinder
    obstacles: int = Field(3, ge=0)  # suspension: rigid, of several shapes


class Simulation(Table):
    """How runs are computed. points: nodes of the membranes, or "adaptive": the fewest of 32, 64, 128, 256 that resolve the shape."""

    points: int | Literal["adaptive"] = "adaptive"
    tolerance: float = Field(1e-3, gt=0, lt=1)  # adaptive: of the highest third of the shape's modes, relative
    device: str = Field("cpu", pattern=r"^(cpu|torch|cuda(:\d+)?)$")


class Select(Table):
    """Which shapes are kept. Shapes closer (Hausdorff) than `distance` to a kept one are dropped; hard ones, by their bending energy,

    only when closer than hard_distance, so that there are more of them. fractions: of the runs, for training, validation and test.
    """

    distance: float = Field(2e-3, ge=0)
    hard_distance: float | None = Field(None, ge=0)  # default: distance
    hard_above: float = Field(0.9, gt=0, lt=1)  # quantile of the bending energy above which a shape is hard
    most: int | None = Field(None, ge=1)  # keep at most so many, drawn at random
    fractions: tuple[float, float, float] = (0.8, 0.1, 0.1)


class Label(Table):
    """Training pairs. points: nodes N of the network's curves; operators are built at operator_points, their results low-passed to N.

    relaxation: "implicit" is one semi-implicit step of dt, "converged" the flow over dt, by `substeps` steps, extrapolated. modes:
    default all, 0..N/2. chunk: shapes of one task.
    """

    points: int = Field(32, ge=8)
    operator_points: int = Field(128, ge=16, multiple_of=2)
    dt: float = Field(1e-5, gt=0)
    relaxation: Literal["implicit", "converged"] = "implicit"
    substeps: int = Field(16, ge=2)
    maps: list[MapName] = Field(list(MAPS), min_length=1)
    modes: list[int] | None = Field(None, min_length=1)
    chunk: int = Field(256, ge=1)


class Dataset(Table):
    """A validated data set file."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    seed: int = Field(0, ge=0)
    shapes: Shapes = Shapes()
    harvest: list[Family] = Field(min_length=1)
    simulation: Simulation = Simulation()
    select: Select = Select()
    label: Label = Label()


EXPECTED = {
    "simulation.points": 'an even number of at least 16, or "adaptive"',
    "simulation.device": '"cpu" (NumPy), "torch" (PyTorch on the CPU), "cuda" or "cuda:N"',
}


def load_dataset(path: str | Path, overrides: Iterable[str] = ()) -> Dataset:
    """The data set in a TOML file, with overrides such as "label.points=64". Raises ValueError with one line for what is wrong."""
    path = Path(path)
    table = read_toml(path, "data set", "configs/datagen/smoke.toml", overrides)
    table.setdefault("name", path.stem)
    config = validated(Dataset, table, EXPECTED)
    for number, family in enumerate(config.harvest):
        for key in ("capillary", "confinement", "offset"):
            low, high = getattr(family, key)
            if not low <= high or low < 0 or (low == 0 and key != "offset"):
                raise ValueError(f"harvest.{number}.{key} = [{low:g}, {high:g}]: expected positive numbers, the smaller one first")
    for key, points in (("shapes.points", config.shapes.points), ("label.operator_points", config.label.operator_points)):
        if points < 2 * config.shapes.modes:
            raise ValueError(f"{key} = {points} nodes do not hold shapes.modes = {config.shapes.modes} modes: take twice as many nodes")
    return config
