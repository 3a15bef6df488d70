"""Pictures and movies of fields on grids, with the vesicles, the walls and the tracers over them, and streamlines."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import animation
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from biem.curves.fourier import resample
from biem.observe.grid import Grid
from biem.run.fields import FrameFields
from biem.run.files import write_atomically
from biem.run.plot import WALL, _figure, _shown, _times
from biem.run.trajectory import Trajectory

WIDTH, MOST_HEIGHT, DPI, MOVIE_DPI, RATE = 8.0, 10.0, 150, 100, 15  # inches, dots an inch, frames a second
SHARE = 0.005  # of the values, at either end, that the colours leave out: next to a membrane fields are steep
STREAMLINES = 1.2  # density, in matplotlib's unit


@dataclass(frozen=True)
class Shown:
    """What a picture shows: the quantity that it is made of, how, its label, and whether it has two signs."""

    quantity: str
    values: Callable[[np.ndarray], np.ndarray]
    label: str
    signed: bool = True


SHOWN = {
    "speed": Shown("velocity", lambda u: np.hypot(u[:, 0], u[:, 1]), "speed [length/time]", False),
    "u": Shown("velocity", lambda u: u[:, 0], "velocity along x [length/time]"),
    "v": Shown("velocity", lambda u: u[:, 1], "velocity along y [length/time]"),
    "pressure": Shown("pressure", lambda p: p, "pressure [kappa_b/length^3]"),
    "vorticity": Shown("vorticity", lambda omega: omega, "vorticity [1/time]"),
    "shear_stress": Shown("stress", lambda s: s[:, 0, 1], "shear stress [kappa_b/length^3]"),
}


def quantities_shown(show: str, streamlines: bool) -> tuple[str, ...]:
    """What a picture needs. Raises ValueError for something that cannot be shown."""
    if show not in SHOWN:
        raise ValueError(f"--show {show}: expected one of " + ", ".join(SHOWN))
    return tuple(dict.fromkeys([SHOWN[show].quantity, *(["velocity"] if streamlines else [])]))


@dataclass(frozen=True)
class Painter:
    """Draws frames of a trajectory. limits: of the colours."""

    trajectory: Trajectory
    show: str
    limits: tuple[float, float]
    streamlines: bool

    @classmethod
    def of(cls, trajectory: Trajectory, show: str, frames: Iterable[FrameFields], streamlines: bool) -> Painter:
        """Colours for all of the frames."""
        shown = SHOWN[show]
        low, high = np.inf, -np.inf
        for frame in frames:
            values = shown.values(frame.values[shown.quantity])
            if np.isfinite(values).any():
                a, b = np.nanquantile(values, [SHARE, 1.0 - SHARE])
                low, high = min(low, float(a)), max(high, float(b))
        if not low < high:
            low, high = (low - 1.0, low + 1.0) if np.isfinite(low) else (0.0, 1.0)
        if shown.signed and show != "pressure":  # which is determined up to a constant
            low, high = -max(-low, high), max(-low, high)
        return cls(trajectory, show, (0.0 if show == "speed" else low, high), streamlines)

    def picture(self, frame: FrameFields, grid: Grid, path: Path) -> None:
        """One frame as a PNG."""
        figure, axes = self._figure(grid)
        self._draw(figure, axes, frame, grid, True)
        image = io.BytesIO()
        figure.savefig(image, dpi=DPI, format="png")
        write_atomically(path, image.getvalue())

    def movie(self, frames: Iterable[FrameFields], grids: Sequence[Grid], path: Path) -> None:
        """All frames as GIF or MP4, by the name's ending."""
        figure, axes = self._figure(grids[0])
        writer: animation.AbstractMovieWriter
        writer = animation.PillowWriter(fps=RATE) if path.suffix == ".gif" else animation.FFMpegWriter(fps=RATE)
        temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
        try:
            with writer.saving(figure, str(temporary), dpi=MOVIE_DPI):
                for k, frame in enumerate(frames):
                    axes.clear()
                    self._draw(figure, axes, frame, grids[k], k == 0)
                    if k == 0:
                        figure.draw_without_rendering()
                        figure.set_layout_engine("none")  # the layout is settled: nothing jumps
                    writer.grab_frame()
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    def _figure(self, grid: Grid) -> tuple[Figure, Any]:
        aspect = np.ptp(grid.y) / np.ptp(grid.x)
        figure, axes = _figure(WIDTH, float(np.clip(WIDTH * 0.8 * aspect + 0.9, 2.2, MOST_HEIGHT)))
        return figure, axes[0]

    def _draw(self, figure: Figure, axes: Any, frame: FrameFields, grid: Grid, with_bar: bool) -> None:
        shown = SHOWN[self.show]
        values = shown.values(frame.values[shown.quantity]).reshape(grid.shape)
        half = [0.5 * np.ptp(axis) / (len(axis) - 1) for axis in (grid.x, grid.y)]  # values are those at the centres of the pixels
        extent = (grid.x[0] - half[0], grid.x[-1] + half[0], grid.y[0] - half[1], grid.y[-1] + half[1])
        colours = {"cmap": "RdBu_r" if shown.signed else "viridis", "norm": Normalize(*self.limits)}
        image = axes.imshow(values, origin="lower", extent=extent, interpolation="bilinear", **colours)
        if with_bar:
            figure.colorbar(image, ax=axes, label=shown.label, fraction=0.06, aspect=30, extend="both" if shown.signed else "max")
        ink = "black" if shown.signed else "white"
        if self.streamlines:
            u, v = np.moveaxis(frame.values["velocity"].reshape(*grid.shape, 2), -1, 0)
            lines = np.ma.masked_invalid(u), np.ma.masked_invalid(v)
            axes.streamplot(grid.x, grid.y, *lines, density=STREAMLINES, color=ink, linewidth=0.5, arrowsize=0.6)
        for k, wall in enumerate(self.trajectory.attributes.get("walls", ())):
            outline = resample(wall, 2 * wall.shape[-1])
            axes.fill(*outline, facecolor="none" if k == 0 else WALL, edgecolor=WALL, linewidth=1.5, zorder=3)
        axes.add_collection(LineCollection(_closed(_shown(self.trajectory, frame.frame)), colors=ink, linewidths=1.0, zorder=4))
        if self.trajectory.tracers is not None:
            x, lattice = self.trajectory.tracers[frame.frame], self.trajectory.lattice(frame.frame)
            x = x if lattice is None else lattice.wrapped(x)
            axes.plot(*x.T, "o", color="tab:orange", markeredgecolor="black", markeredgewidth=0.3, markersize=2.5, zorder=5)
        axes.set_xlim(grid.x[0], grid.x[-1])
        axes.set_ylim(grid.y[0], grid.y[-1])
        axes.set_xlabel("x [length]")
        axes.set_ylabel("y [length]")
        time, unit = _times(self.trajectory)
        axes.set_title(f"{unit} = {time[frame.frame]:.4g}", fontsize=10)


def _closed(outlines: np.ndarray) -> list[np.ndarray]:
    """Polygons (M, P, 2) with their first corner at the end again."""
    return list(np.concatenate([outlines, outlines[:, :1]], axis=1))
