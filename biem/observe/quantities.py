"""The observables by name: where each one belongs, its unit, its definition, what it takes, and which scenes have it.

Units are those of the scene, in which [kappa_b] = [mu] length^3 / time; where kappa_b = mu = length = 1 all are natural.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from biem.curves.curve import bending_energy, inclination, length, reduced_area
from biem.observe import motion
from biem.observe.stress import reference_area
from biem.observe.view import View
from biem.scene.build import Problem

Place = Literal["suspension", "vesicles", "pairs", "bins"]  # one row of values per frame, or per frame and vesicle, pair, bin
Source = Literal["shape", "tension", "velocity"]  # what it is computed from, beside the shapes
XY, TENSOR = ("x", "y"), ("xx", "xy", "yy")
MOST_IN_PAIRS = 200  # vesicles, 19,900 pairs
PAIRS_BY_DEFAULT = 10


@dataclass(frozen=True)
class Quantity:
    """of: the value of a View, () or (C,) for the suspension, (M,) or (M, C), (P,), (B,) at the other places; C: components.

    without: why a scene does not have it, or nothing; offered: whether it is among those of a scene where none are named; costly:
    whether not during a run.
    """

    name: str
    place: Place
    unit: str
    definition: str
    source: Source
    of: Callable[[View], np.ndarray]
    components: tuple[str, ...] = ()
    without: Callable[[Problem], str] = lambda problem: ""
    offered: Callable[[Problem], bool] = lambda problem: True
    costly: bool = False

    def slow(self, problem: Problem) -> bool:
        """Whether it takes more than shapes and tension; where viscosities differ, stresses take velocities."""
        return self.costly or (self.source == "tension" and problem.contrast is not None)

    def shape(self, view: View) -> tuple[int, ...]:
        """Of a value."""
        M = view.X.shape[0]
        sizes: dict[str, tuple[int, ...]] = {
            "suspension": (),
            "vesicles": (M,),
            "pairs": (M * (M - 1) // 2,),
            "bins": (len(view.edges) - 1,),
        }
        return (*sizes[self.place], *([len(self.components)] if self.components else []))

    def evaluate(self, view: View) -> np.ndarray:
        """Its value, NaN where the tension that it takes is not known."""
        if self.source != "shape" and view.tension is None:
            return np.full(self.shape(view), np.nan)
        value = np.asarray(self.of(view), dtype=np.float64)
        assert value.shape == self.shape(view), self.name
        return value


def select(problem: Problem, names: Iterable[str] | None = None, running: bool = False) -> tuple[Quantity, ...]:
    """The quantities of these names, in the order of the table; without names, those that the scene has (running: and are cheap).

    Raises ValueError for a name that is unknown or that the scene does not have.
    """
    if names is None:
        return tuple(q for q in QUANTITIES.values() if not q.without(problem) and q.offered(problem) and not (running and q.slow(problem)))
    wanted = dict.fromkeys(names)
    known(wanted)
    for name in wanted:
        why = QUANTITIES[name].without(problem)
        if why:
            raise ValueError(f"{name} {why}")
    return tuple(q for q in QUANTITIES.values() if q.name in wanted)


def known(names: Collection[str]) -> None:
    """Raises ValueError for a name that no quantity has, and for none at all."""
    everything = ", ".join(QUANTITIES)
    if not names:
        raise ValueError(f"no quantity is named: name some of {everything}")
    for name in names:
        if name not in QUANTITIES:
            near = difflib.get_close_matches(name, QUANTITIES, n=1, cutoff=0.6)
            raise ValueError(f'unknown quantity "{name}": ' + (f"did you mean {near[0]}?" if near else f"there are {everything}"))


def _not_shear(problem: Problem) -> str:
    kind = problem.flow.kind
    return "" if kind == "shear" and problem.flow.rate else f'is defined in flow.kind = "shear" alone, this scene has "{kind}"'


def _no_area(problem: Problem) -> str:
    has = reference_area(problem)[2]
    return _not_shear(problem) or (
        "" if has else "takes an area of the suspension, which only domain.periodic or vesicles.box gives: take intrinsic_viscosity here"
    )


def _alone(problem: Problem) -> str:
    return "takes more than one vesicle" if len(problem.X) < 2 else ""


def _no_gap(problem: Problem) -> str:
    return "" if problem.walls is not None or problem.box is not None else _alone(problem)


def _too_many_pairs(problem: Problem) -> str:
    M = len(problem.X)
    return _alone(problem) or (
        f"of {M} vesicles would be {M * (M - 1) // 2} numbers a frame: at most {MOST_IN_PAIRS} vesicles, or take nearest_distance"
        if M > MOST_IN_PAIRS
        else ""
    )


def _no_width(problem: Problem) -> str:
    if motion.channel_width(problem) is None:
        return 'takes a width: flow.kind = "poiseuille" or walls.kind = "channel"'
    return ""


def _no_layer(problem: Problem) -> str:
    return "" if problem.walls is not None else _no_width(problem).replace("a width:", "a width or walls:")


def _tensor(S: np.ndarray) -> np.ndarray:
    """xx, xy, yy of S (..., 2, 2)."""
    return np.stack([S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]], axis=-1)


def _per_shear(stress: np.ndarray | float, problem: Problem, area: np.ndarray | float) -> np.ndarray:
    assert problem.flow.rate is not None
    return np.asarray(stress / (problem.scene.physics.mu * problem.flow.rate * area))


_TABLE = (
    # of the suspension
    Quantity(
        "stress",
        "suspension",
        "kappa_b/length^3",
        "particle stress Sigma_p = (1/A_ref) sum over the membranes of -int sym[x f^T] ds + (lambda - 1) mu int (u n^T + n u^T) ds, "
        "A_ref the reference area, f the force density of bending, tension and repulsion on the fluid, lambda the viscosity inside over "
        "mu: the mean stress is -p I + 2 mu E + Sigma_p (Batchelor)",
        "tension",
        lambda v: _tensor(v.stress),
        TENSOR,
    ),
    Quantity(
        "effective_viscosity",
        "suspension",
        "1",
        "1 + stress_xy / (mu rate), in units of mu; rate: the shear rate of u = (rate y, 0)",
        "tension",
        lambda v: 1.0 + _per_shear(v.stress[0, 1], v.problem, 1.0),
        without=_no_area,
    ),
    Quantity(
        "intrinsic_viscosity",
        "suspension",
        "1",
        "A_ref stress_xy / (mu rate A), A the area of all vesicles: what a unit of area fraction adds to the effective viscosity",
        "tension",
        lambda v: _per_shear(v.stress[0, 1] * v.reference_area, v.problem, v.area.sum()),
        without=_not_shear,
    ),
    Quantity(
        "normal_stress_difference",
        "suspension",
        "kappa_b/length^3",
        "stress_xx - stress_yy, x along the shear flow and y across it",
        "tension",
        lambda v: v.stress[0, 0] - v.stress[1, 1],
        without=_not_shear,
    ),
    Quantity(
        "smallest_gap",
        "suspension",
        "length",
        "smallest distance of a node to another membrane, also to an image in a periodic box, or to a wall",
        "shape",
        lambda v: np.asarray(motion.smallest_gap(v.problem, v.X, v.lattice)),
        without=_no_gap,
        costly=True,
    ),
    Quantity(
        "cell_free_layer",
        "suspension",
        "length",
        "W - max |y| over all membranes, W half the width of the parabolic flow (u = 0 at y = +-W) or of the channel, negative where one "
        "is beyond; between other walls the smallest distance of a node to them",
        "shape",
        lambda v: np.asarray(motion.cell_free_layer(v.problem, v.X)),
        without=_no_layer,
    ),
    Quantity(
        "mean_square_displacement",
        "suspension",
        "length^2",
        "means over the vesicles of (c_x(t) - c_x(0))^2 and (c_y(t) - c_y(0))^2, c the centroid (not wrapped in a periodic box), 0 the "
        "first frame of the trajectory; what the flow carries is not taken off",
        "shape",
        lambda v: ((v.centroid - v.start) ** 2).mean(axis=0),
        XY,
    ),
    # of each vesicle
    Quantity("area", "vesicles", "length^2", "area inside", "shape", lambda v: v.area),
    Quantity("length", "vesicles", "length", "length of the membrane", "shape", lambda v: length(v.X)),
    Quantity("reduced_area", "vesicles", "1", "4 pi area / length^2, 1 for a circle", "shape", lambda v: reduced_area(v.X)),
    Quantity(
        "bending_energy",
        "vesicles",
        "kappa_b/length",
        "kappa_b/2 int c^2 ds, c the curvature",
        "shape",
        lambda v: bending_energy(v.X, v.problem.scene.physics.kappa_b),
    ),
    Quantity("centroid", "vesicles", "length", "centroid of the area inside", "shape", lambda v: v.centroid, XY),
    Quantity(
        "inclination",
        "vesicles",
        "rad",
        "angle from the x axis, in (-pi/2, pi/2], of the axis through the centroid about which the area has the least moment of inertia",
        "shape",
        lambda v: inclination(v.X),
    ),
    Quantity(
        "deformation",
        "vesicles",
        "1",
        "Taylor's (a - b)/(a + b), a >= b the half axes of the ellipse with the ratio of the principal moments of inertia of the area",
        "shape",
        lambda v: motion.deformation(v.X),
    ),
    Quantity(
        "nearest_distance",
        "vesicles",
        "length",
        "distance of the centroid to the nearest other one, in a periodic box also to the nearest image",
        "shape",
        lambda v: motion.nearest_distances(v.centroid, v.lattice),
        without=_alone,
    ),
    Quantity(
        "stresslet",
        "vesicles",
        "kappa_b/length",
        "S = -int sym[(x - c) f^T] ds + (lambda - 1) mu int (u n^T + n u^T) ds as in stress, c the centroid; a positive xy raises the "
        "viscosity of a sheared suspension",
        "tension",
        lambda v: _tensor(v.stresslets),
        TENSOR,
    ),
    Quantity(
        "vesicle_intrinsic_viscosity",
        "vesicles",
        "1",
        "stresslet_xy / (mu rate area)",
        "tension",
        lambda v: _per_shear(v.stresslets[:, 0, 1], v.problem, v.area),
        without=_not_shear,
    ),
    Quantity(
        "velocity",
        "vesicles",
        "length/time",
        "of the centroid: mean of the fluid velocity inside, 1/area int (x - c)(u.n) ds",
        "velocity",
        lambda v: motion.centroid_velocity(v.X, v.velocity),
        XY,
        costly=True,
    ),
    Quantity(
        "tank_treading_frequency",
        "vesicles",
        "rad/time",
        "2 pi/length times the mean over the arc of u.t, t the counterclockwise tangent: the angular frequency of a membrane that goes "
        "round a resting shape; a shape that turns at Omega as a rigid body adds reduced_area Omega",
        "velocity",
        lambda v: motion.tank_treading_frequency(v.X, v.velocity),
        costly=True,
    ),
    Quantity(
        "power",
        "vesicles",
        "kappa_b/(length time)",
        "int f.u ds, what the membrane does to the fluid in unit time: where nothing repels it, minus the rate of bending_energy",
        "velocity",
        lambda v: motion.power(v.X, v.force, v.velocity),
        costly=True,
    ),
    # of pairs, and in bins across the flow
    Quantity(
        "pair_distance",
        "pairs",
        "length",
        "distance of the centroids of vesicles i < j, in a periodic box of the nearest images",
        "shape",
        lambda v: motion.pair_distances(v.centroid, v.lattice),
        without=_too_many_pairs,
        offered=lambda problem: len(problem.X) <= PAIRS_BY_DEFAULT,
    ),
    Quantity(
        "lateral_distribution",
        "bins",
        "1/length",
        "share of all centroids whose y is in the bin, over the bin's width",
        "shape",
        lambda v: motion.lateral_distribution(v.centroid[:, 1], v.edges),
        without=_no_width,
    ),
    Quantity(
        "velocity_profile",
        "bins",
        "length/time",
        "mean of u_x over the arcs of membranes in the bin, NaN where there are none",
        "velocity",
        lambda v: motion.velocity_profile(v.X, v.velocity, v.edges),
        without=_no_width,
        costly=True,
    ),
)
QUANTITIES = {quantity.name: quantity for quantity in _TABLE}
