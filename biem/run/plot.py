"""Pictures of a trajectory: frames, energies and errors, a movie; for pairs their separation, for channels the lateral position."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import animation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from biem.backend import to_numpy
from biem.curves.curve import centroid, effective_radius
from biem.curves.fourier import resample
from biem.run.derived import check_finite
from biem.run.files import make_folder
from biem.run.trajectory import MONITORED, Trajectory

FACE, EDGE, WALL = "#e8a33d", "#7a3b00", "#4a5560"
MOST_PATHS = 200  # of vesicles drawn one by one
SNAPSHOTS = 6
MOVIE_FRAMES = 100
LEAST_CORNERS = 128


def draw_all(trajectory: Trajectory, folder: Path, movie: bool = True, progress: Callable[[Any], Any] = iter) -> list[Path]:
    """All pictures that this trajectory has, as files in `folder`; returns their paths. Raises ValueError for an empty or damaged one."""
    if len(trajectory) == 0:
        raise ValueError("the trajectory has no frames: there is nothing to draw")
    check_finite(trajectory)
    make_folder(folder)
    time, unit = _times(trajectory)
    files = [_snapshots(trajectory, time, unit, folder / "frames.png"), _history(trajectory, time, unit, folder / "energy.png")]
    scene = json.loads(trajectory.attributes["scene"])
    if trajectory.X.shape[1] == 2:
        files.append(_separation(trajectory, time, unit, folder / "separation.png"))
    if scene["flow"]["kind"] == "poiseuille" or (scene.get("walls") or {}).get("kind") == "channel":
        files.append(_lateral(trajectory, time, unit, folder / "lateral.png"))
    if movie and len(trajectory) > 1:
        files += _movie(trajectory, time, unit, folder / "movie", progress)
    return files


def separation(trajectory: Trajectory) -> np.ndarray:
    """Distance of the centroids of two vesicles over R (F,)."""
    c = np.stack([centroid(X) for X in trajectory.X])
    return np.hypot(*(c[:, 0] - c[:, 1]).T) / float(np.mean(effective_radius(trajectory.X[0])))


def _times(trajectory: Trajectory) -> tuple[np.ndarray, str]:
    """Times in units of the flow where it has one."""
    t_gamma = trajectory.attributes["t_gamma"]
    return (trajectory.t / t_gamma, r"$t / t_{\dot\gamma}$") if t_gamma else (trajectory.t, "$t$")


def _figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, np.atleast_1d(figure.subplots(rows, columns, **options))


def _outlines(X: np.ndarray) -> np.ndarray:
    """Polygon corners (M, P, 2)."""
    X = to_numpy(X)
    return resample(X, max(LEAST_CORNERS, X.shape[-1])).transpose(0, 2, 1)


def _shown(trajectory: Trajectory, frame: int) -> np.ndarray:
    """Outlines of a frame's vesicles; in a periodic box wrapped into it, with the images that reach into it."""
    X, lattice = trajectory.X[frame], trajectory.lattice(frame)
    return _outlines(X if lattice is None else lattice.with_images(X, 0.0, filled=True)[0])


def _view(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Centre (F, 2) and half width (2,) of a window of fixed size that holds every frame, moving where that makes it smaller.

    Where there are walls, the window holds the outer one; a periodic box is the window.
    """
    X = trajectory.X
    if "periodic" in trajectory.attributes:
        return np.zeros((len(X), 2)), 0.51 * np.asarray(trajectory.attributes["periodic"][:2])
    walls = trajectory.attributes.get("walls")
    if walls is not None:
        X = np.broadcast_to(walls[0], (len(X), 1, *walls[0].shape))
    low, high = X.min(axis=(1, 3)), X.max(axis=(1, 3))
    fixed = np.broadcast_to((low.min(axis=0) + high.max(axis=0)) / 2, low.shape)
    still = (high.max(axis=0) - low.min(axis=0)) / 2
    moving = (low + high) / 2
    follow = ((high - low) / 2).max(axis=0)
    center = np.where(follow < 0.5 * still, moving, fixed)
    half = np.where(follow < 0.5 * still, follow, still) * 1.08
    return center, np.maximum(half, 0.35 * half.max())


def _draw(axes: Any, trajectory: Trajectory, frame: int, center: np.ndarray, half: np.ndarray) -> PolyCollection:
    X = trajectory.X[frame]
    for k, wall in enumerate(trajectory.attributes.get("walls", ())):
        axes.fill(*resample(wall, 2 * wall.shape[-1]), facecolor="none" if k == 0 else WALL, edgecolor=WALL, linewidth=1.5 if k == 0 else 0)
    line = float(np.clip(5.0 * np.ptp(X, axis=2).max() / half[0], 0.1, 0.8))  # thinner where the vesicles are small
    shapes = PolyCollection(list(_shown(trajectory, frame)), facecolor=FACE, edgecolor=EDGE, linewidth=line)
    axes.add_collection(shapes)
    if "periodic" in trajectory.attributes:
        width, height, _ = trajectory.attributes["periodic"]
        box = Rectangle((-width / 2, -height / 2), width, height, fill=False, edgecolor=WALL, linewidth=1.0)
        axes.add_patch(box)
        shapes.set_clip_path(box)
    axes.set_aspect("equal")
    axes.set_xlim(center[0] - half[0], center[0] + half[0])
    axes.set_ylim(center[1] - half[1], center[1] + half[1])
    return shapes


def _snapshots(trajectory: Trajectory, time: np.ndarray, unit: str, path: Path) -> Path:
    chosen = np.unique(np.linspace(0, len(trajectory) - 1, SNAPSHOTS).round().astype(int))
    center, half = _view(trajectory)
    wide = half[0] > 2.0 * half[1]
    columns = 1 if wide and half[0] > 5 * half[1] else min(len(chosen), 2 if wide else 3)
    rows = -(-len(chosen) // columns)
    width = 10.0
    height = rows * (width / columns * half[1] / half[0] + 0.5)
    figure, axes = _figure(width, max(2.0, min(height, 14.0)), rows, columns, squeeze=False)
    for ax in axes.flat[len(chosen) :]:
        ax.axis("off")
    for ax, k in zip(axes.flat, chosen, strict=False):
        _draw(ax, trajectory, k, center[k], half)
        ax.set_title(f"{unit} = {time[k]:.4g}", fontsize=9)
        ax.tick_params(labelsize=7)
    figure.savefig(path, dpi=130)
    return path


def _history(trajectory: Trajectory, time: np.ndarray, unit: str, path: Path) -> Path:
    d = trajectory.diagnostics
    monitored = [name for name in MONITORED if name in d]
    rows = 3 + bool(monitored)
    figure, axes = _figure(7.0, 7.0 * rows / 3, rows, 1, sharex=True)
    axes[0].plot(time, d["bending_energy"], color=EDGE)
    axes[0].set_ylabel("bending energy")
    for name, label in (("area_error", "area"), ("length_error", "length")):
        axes[1].semilogy(time[1:], np.maximum(d[name][1:], 1e-17), label=label)
    if d["error_estimate"].any():
        axes[1].semilogy(time[1:], np.maximum(d["error_estimate"][1:], 1e-17), label="position (estimate)")
    axes[1].set_ylabel("relative error of a step,\nbefore correction")
    axes[1].legend(frameon=False)
    if trajectory.X.shape[1] > 1 or trajectory.attributes.keys() & {"walls", "periodic"}:
        axes[2].plot(time, d["min_gap"], color="tab:green")
        axes[2].set_yscale("log" if d["min_gap"].min() < 0.5 * d["min_gap"].max() else "linear")
        axes[2].set_ylabel("smallest gap")
    else:
        axes[2].plot(time[1:], d["wall_seconds"][1:], color="tab:gray")
        axes[2].set_ylabel("seconds a step")
    for name in monitored:
        axes[3].step(time[1:], d[name][1:], label=name.replace("_", " "))
        axes[3].set_ylabel("vesicles, at most")
        axes[3].legend(frameon=False)
    axes[-1].set_xlabel(unit)
    figure.savefig(path, dpi=130)
    return path


def _separation(trajectory: Trajectory, time: np.ndarray, unit: str, path: Path) -> Path:
    figure, axes = _figure(6.5, 4.0)
    axes[0].plot(time, separation(trajectory), color=EDGE)
    axes[0].set_xlabel(unit)
    axes[0].set_ylabel("separation of the centroids / R")
    axes[0].grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    return path


def _lateral(trajectory: Trajectory, time: np.ndarray, unit: str, path: Path) -> Path:
    y = np.stack([centroid(X)[:, 1] for X in trajectory.X]) / trajectory.attributes["flow_width"]
    figure, axes = _figure(6.5, 4.0)
    if y.shape[1] <= MOST_PATHS:
        axes[0].plot(time, y, color=EDGE, linewidth=0.8, alpha=max(0.5, y.shape[1] ** -0.5))
    else:
        for share, alpha in ((0.9, 0.15), (0.5, 0.3)):
            low, high = np.quantile(y, [0.5 - share / 2, 0.5 + share / 2], axis=1)
            axes[0].fill_between(time, low, high, color=FACE, alpha=alpha, linewidth=0, label=f"the middle {share:.0%}")
        axes[0].plot(time, np.median(y, axis=1), color=EDGE, label="median")
        axes[0].legend(frameon=False)
    axes[0].set_xlabel(unit)
    axes[0].set_ylabel("lateral position y / W")
    axes[0].grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    return path


def _movie(trajectory: Trajectory, time: np.ndarray, unit: str, path: Path, progress: Callable[[Any], Any]) -> list[Path]:
    """GIF, and MP4 where ffmpeg is installed."""
    chosen = np.unique(np.linspace(0, len(trajectory) - 1, MOVIE_FRAMES).round().astype(int))
    center, half = _view(trajectory)
    width = 7.0
    figure, axes = _figure(width, max(2.2, min(9.0, width * half[1] / half[0] + 0.8)))
    shapes = _draw(axes[0], trajectory, 0, center[0], half)
    title = axes[0].set_title("")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the layout is settled: nothing jumps
    writers: dict[Path, animation.AbstractMovieWriter] = {path.with_suffix(".gif"): animation.PillowWriter(fps=15)}
    if shutil.which("ffmpeg"):
        writers[path.with_suffix(".mp4")] = animation.FFMpegWriter(fps=15)
    for file, writer in writers.items():
        with writer.saving(figure, str(file), dpi=90):
            for k in progress(chosen):
                shapes.set_verts(list(_shown(trajectory, k)))
                axes[0].set_xlim(center[k, 0] - half[0], center[k, 0] + half[0])
                axes[0].set_ylim(center[k, 1] - half[1], center[k, 1] + half[1])
                title.set_text(f"{unit} = {time[k]:.2f}" if time[-1] > 1e-2 else f"{unit} = {time[k]:.3e}")
                writer.grab_frame()
    return list(writers)
