"""Whether one vesicle in shear comes to rest at an angle (tank-treading) or turns over (tumbling): to end runs that will not tell more."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from biem.curves.curve import inclination
from biem.run.trajectory import Trajectory
from biem.scene.build import build
from biem.scene.config import Scene

WINDOW = 10.0  # t_gamma
CHANGE = 1e-3  # of the angle within a window, at most, rad: in the bottleneck before a tumble it changes faster


def angles(trajectory: Trajectory, vesicle: int = 0) -> np.ndarray:
    """Inclination (F,) of a vesicle in every frame, rad, followed over half turns; frames must be closer than a quarter turn."""
    return np.unwrap([float(inclination(X)[vesicle]) for X in trajectory.X], period=np.pi)


@dataclass
class Turned:
    """Says True once the angle is steady, or has fallen by some half turns. unit: t_gamma; earlier: frames of a run that goes on."""

    unit: float
    half_turns: int = 1
    earlier: Trajectory | None = None
    _path: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.earlier is not None:
            self._path = list(zip(self.earlier.t / self.unit, angles(self.earlier), strict=True))

    def __call__(self, t: float, X: np.ndarray) -> bool:
        now, angle = t / self.unit, float(inclination(X)[0])
        if self._path:
            angle += np.pi * round((self._path[-1][1] - angle) / np.pi)
        self._path.append((now, angle))
        if angle < self._path[0][1] - self.half_turns * np.pi:
            return True
        recent = [value for time, value in self._path if time >= now - WINDOW]
        return now >= WINDOW and max(recent) - min(recent) < CHANGE


def in_shear(scene: Scene, earlier: Trajectory | None, half_turns: int = 1) -> Turned:
    """`Turned` of a scene with one vesicle in shear."""
    unit = build(scene).flow.time_scale
    assert unit is not None
    return Turned(unit, half_turns, earlier)


def twice_in_shear(scene: Scene, earlier: Trajectory | None) -> Turned:
    """The same, to the second half turn, which is that of the shape that tumbles."""
    return in_shear(scene, earlier, 2)
