"""Rectangular grids of points, as the command line names them, and the box around a suspension."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MARGIN = 0.15  # of the box around membranes, in its longer side
POINTS = 300  # along the longer side, by default


@dataclass(frozen=True)
class Grid:
    """Points (x_i, y_j), x fastest. x (nx,), y (ny,): evenly spaced."""

    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, box: tuple[float, float, float, float], shape: tuple[int, int]) -> Grid:
        """box: x and y from, x and y to; shape: nx, ny."""
        x0, y0, x1, y1 = box
        return cls(np.linspace(x0, x1, shape[0]), np.linspace(y0, y1, shape[1]))

    @property
    def points(self) -> np.ndarray:
        """(ny nx, 2)."""
        x, y = np.meshgrid(self.x, self.y)
        return np.stack([x.ravel(), y.ravel()], axis=-1)

    @property
    def shape(self) -> tuple[int, int]:
        """ny, nx: of values on the grid."""
        return len(self.y), len(self.x)

    def moved(self, by: np.ndarray) -> Grid:
        """The grid moved by (2,)."""
        return Grid(self.x + by[0], self.y + by[1])


def grid_shape(text: str | None, box: tuple[float, float, float, float]) -> tuple[int, int]:
    """nx, ny of "300x200", or of "300": so many along the longer side of the box, cells about square. Raises ValueError."""
    sides = (box[2] - box[0], box[3] - box[1])
    parts = (text or str(POINTS)).lower().split("x")
    try:
        numbers = [int(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2) or min(numbers, default=0) < 2:
        raise ValueError(f'--grid {text}: expected NXxNY as in "300x200", or the number along the longer side, at least 2')
    if len(numbers) == 2:
        return numbers[0], numbers[1]
    nx, ny = (max(2, round(numbers[0] * side / max(sides))) for side in sides)
    return nx, ny


def read_box(text: str) -> tuple[float, float, float, float]:
    """x0, y0, x1, y1 of "-1,-1,1,1". Raises ValueError."""
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        x0 = y0 = x1 = y1 = 0.0
    if not (np.isfinite([x0, y0, x1, y1]).all() and x0 < x1 and y0 < y1):
        raise ValueError(f'--box {text}: expected x0,y0,x1,y1 with x0 < x1 and y0 < y1, as in "-1,-1,1,1"')
    return x0, y0, x1, y1


def box_around(X: np.ndarray, walls: tuple[np.ndarray, ...] = ()) -> tuple[float, float, float, float]:
    """Around the outer wall, or around membranes X (..., 2, N) with a margin."""
    if walls:
        (x0, y0), (x1, y1) = walls[0].min(axis=1), walls[0].max(axis=1)
        margin = 0.02 * max(x1 - x0, y1 - y0)
    else:
        axes = tuple(k for k in range(X.ndim) if k != X.ndim - 2)
        (x0, y0), (x1, y1) = X.min(axis=axes), X.max(axis=axes)
        margin = MARGIN * max(x1 - x0, y1 - y0)
    return float(x0 - margin), float(y0 - margin), float(x1 + margin), float(y1 + margin)


def frames_named(text: str, count: int) -> list[int]:
    """Indices of frames of "-1", "all", "3,5" or a slice "0:100:10", among `count`. Raises ValueError."""
    try:
        if text.strip() == "all":
            chosen = list(range(count))
        elif ":" in text:
            chosen = list(range(count))[slice(*(int(part) if part.strip() else None for part in text.split(":")))]
        else:
            chosen = [range(count)[int(part)] for part in text.split(",")]
    except (ValueError, TypeError, IndexError):
        chosen = []
    if not chosen:
        raise ValueError(
            f'--frames {text}: the trajectory has frames 0 to {count - 1}; expected "all", numbers as in "3,5" or "-1", or a slice as in '
            '"0:100:10"'
        )
    return chosen
