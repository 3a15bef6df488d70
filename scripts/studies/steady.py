"""When one vesicle in a parabolic flow has come to rest across it: to end runs whose end is not known beforehand."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from biem.curves.curve import centroid
from biem.run.trajectory import Trajectory
from biem.scene.build import build
from biem.scene.config import Scene

WINDOW = 20.0  # t_gamma
CHANGE = 5e-4  # of y/W within a window, at most


@dataclass
class Steady:
    """Says True once y/W has changed by less than CHANGE over WINDOW. width: W; unit: t_gamma; earlier: frames of a run that goes on."""

    width: float
    unit: float
    earlier: Trajectory | None = None
    _path: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.earlier is not None:
            for t, X in zip(self.earlier.t, self.earlier.X, strict=True):
                self(float(t), X)

    def __call__(self, t: float, X: np.ndarray) -> bool:
        y = float(centroid(X)[0, 1]) / self.width
        self._path.append((t / self.unit, y))
        recent = [value for time, value in self._path if time >= t / self.unit - WINDOW]
        return t / self.unit >= WINDOW and max(recent) - min(recent) < CHANGE


def across_the_flow(scene: Scene, earlier: Trajectory | None) -> Steady:
    """`Steady` of a scene with one vesicle in a parabolic flow."""
    flow = build(scene).flow
    assert flow.width is not None
    assert flow.time_scale is not None
    return Steady(flow.width, flow.time_scale, earlier)
