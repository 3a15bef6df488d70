"""The runs of the harvest as they are drawn: initial shape, place, strength; and background flows with one strength a run.

Every run has its own random numbers, from the seed of the data set, its family and its number in it, so that it does not depend on the
batch that it is in. Run r of a family of n has its capillary number in the r-th of n strata, evenly spaced in the logarithm:

    Ca = low (high/low)^((r + u)/n),   u uniform in [0, 1)             rate = Ca kappa_b/(factor mu R^3)       `biem.scene.flows`
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from biem.backend import Array, from_numpy
from biem.curves.curve import centroid
from biem.curves.shapes import ellipse, equilibrium, perturbed, place
from biem.scene.flows import capillary_factor, make_flow
from biem.steppers.stepper import Flow
from datagen.config import Dataset, Family

DRAWN_POINTS = 256  # nodes of the shapes as they are drawn


@dataclass(frozen=True)
class Start:
    """Where a run starts: X (2, DRAWN_POINTS), capillary number (0 of relaxation), Cn = R/W (of Poiseuille flow; else 1)."""

    X: np.ndarray
    capillary: float
    confinement: float


def radius_of(reduced_area: float) -> float:
    """R of a membrane of length 1."""
    return sqrt(reduced_area) / (2.0 * pi)


def random_of(config: Dataset, family: int, number: int) -> np.random.Generator:
    """The random numbers of run `number` of that family."""
    return np.random.default_rng([config.seed, family, number])


def stratified(bounds: tuple[float, float], number: int, runs: int, rng: np.random.Generator) -> float:
    """A value within the stratum `number` of `runs` equal ones of the logarithm between the bounds."""
    low, high = bounds
    return float(low * (high / low) ** ((number + rng.uniform()) / runs))


def start_of(config: Dataset, family: int, number: int) -> Start:
    """Run `number` of that family, of any flow but a suspension: the shape anywhere around, in Poiseuille flow on either side."""
    f, rng = config.harvest[family], random_of(config, family, number)
    capillary = 0.0 if f.flow == "relaxation" else stratified(f.capillary, number, f.runs, rng)
    confinement, center = 1.0, np.zeros(2)
    if f.flow == "poiseuille":
        confinement = rng.uniform(*f.confinement)
        width = radius_of(config.shapes.reduced_area) / confinement
        center[1] = rng.choice([-1.0, 1.0]) * rng.uniform(*f.offset) * width
    angle = rng.uniform(0.0, 2.0 * pi)
    return Start(place(initial_shape(config, f, rng), center, angle), capillary, confinement)


def initial_shape(config: Dataset, family: Family, rng: np.random.Generator) -> np.ndarray:
    """(2, DRAWN_POINTS), of length 1."""
    reduced_area = config.shapes.reduced_area
    if family.initial == "perturbed":
        return perturbed(DRAWN_POINTS, reduced_area, 1.0, rng, family.roughness)
    return (equilibrium if family.initial == "equilibrium" else ellipse)(DRAWN_POINTS, reduced_area)


@dataclass(frozen=True)
class Flows:
    """The background flows of a batch of runs: rate and width (B,)."""

    kind: str
    rate: np.ndarray
    width: np.ndarray

    @classmethod
    def of(cls, kind: str, starts: list[Start], reduced_area: float) -> Flows:
        """Of these runs, in units mu = kappa_b = length = 1."""
        R = radius_of(reduced_area)
        capillary = np.array([s.capillary for s in starts])
        return cls(kind, capillary / (capillary_factor(kind) * R**3), R / np.array([s.confinement for s in starts]))

    def velocity(self, which: np.ndarray, like: Array) -> Flow | None:
        """The velocity of the runs `which`, None of relaxation: that of rate 1 and width 1, in the units of each run.

        Extensional flow carries all that is off its stagnation point away, exponentially; its frame moves with the centroid of each
        vesicle, u(X) - u(centroid), which is the same flow to the shape.
        """
        if self.kind == "relaxation":
            return None
        unit = make_flow(self.kind, 1.0, 1.0).velocity
        rate, width = (from_numpy(a[which, None, None], like) for a in (self.rate, self.width))

        def velocity(X: Array, t: float) -> Array:
            if self.kind == "extensional":
                X = X - centroid(X)[..., None]
            return rate * width * unit(X / width, t)

        return velocity
