"""How far one trajectory is from another one of the same scene, over time.

Positions are in R, the radius of the circle of the vesicles' mean area. The reference is taken at the other's times, by a cubic spline
through its nodes; nodes of the two need not correspond.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from biem.curves.curve import area, bending_energy, centroid
from biem.curves.fourier import resample
from biem.run.trajectory import Trajectory
from datagen.hausdorff import distance

CORNERS = 256
MOST_FRAMES = 200  # compared, spread evenly
TOLERANCE = 1e-9  # of times, relative to the last one

MEANING = {
    "position": "largest distance of a centroid, R",
    "shape": "largest Hausdorff distance of membranes, moved to one centroid, R",
    "energy": "relative difference of the bending energy",
    "separation": "difference of the distance of the two centroids, R",
    "lateral": "largest difference of y, W",
    "tension": "largest difference of the tension, of its largest absolute value then",
}


@dataclass(frozen=True)
class Differences:
    """values: over the times t (F,), by the names in MEANING."""

    t: np.ndarray
    values: Mapping[str, np.ndarray]

    def largest(self, until: float = np.inf) -> dict[str, float]:
        """The largest of each up to a time."""
        early = self.t <= until * (1 + TOLERANCE)
        return {name: float(values[early].max()) for name, values in self.values.items()}


def differences(trajectory: Trajectory, reference: Trajectory, frames: int = MOST_FRAMES) -> Differences:
    """Of `trajectory` from `reference`, at the former's times that the latter reaches. Raises ValueError for other vesicles."""
    if trajectory.X.shape[1] != reference.X.shape[1]:
        raise ValueError(f"{trajectory.X.shape[1]} vesicles cannot be compared with {reference.X.shape[1]}: take runs of one scene")
    covered = np.flatnonzero(trajectory.t <= reference.t[-1] * (1 + TOLERANCE))
    chosen = covered[np.unique(np.linspace(0, len(covered) - 1, min(frames, len(covered))).round().astype(int))]
    t = trajectory.t[chosen]
    own, other = trajectory.X[chosen], at(reference.t, reference.X, t)
    R = float(np.sqrt(area(reference.X[0]).mean() / np.pi))
    c, c_other = np.stack([centroid(X) for X in own]), np.stack([centroid(X) for X in other])  # (F, M, 2)
    values = {
        "position": np.linalg.norm(c - c_other, axis=-1).max(axis=1) / R,
        "shape": np.array([_shapes_apart(*pair) for pair in zip(own, other, c, c_other, strict=True)]) / R,
    }
    energy, expected = (np.array([float(bending_energy(X).sum()) for X in frames_of]) for frames_of in (own, other))
    values["energy"] = np.abs(energy / expected - 1.0)
    if c.shape[1] == 2:
        apart, wanted = (np.linalg.norm(a[:, 0] - a[:, 1], axis=-1) for a in (c, c_other))
        values["separation"] = np.abs(apart - wanted) / R
    width = float(reference.attributes.get("flow_width", 0.0))
    if width:
        values["lateral"] = np.abs(c[..., 1] - c_other[..., 1]).max(axis=1) / width
    if trajectory.sigma is not None and reference.sigma is not None:
        sigma, sigma_other = trajectory.sigma[chosen], at(reference.t[1:], reference.sigma[1:], t)  # the first frame has none
        pairs = zip(own, other, c, c_other, sigma, sigma_other, strict=True)
        values["tension"] = np.array([0.0 if k == 0 else _tensions_apart(*pair) for k, pair in enumerate(pairs)])
    return Differences(t, values)


def at(times: np.ndarray, values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Values (F, ...) at other times; exactly theirs where the times are the same."""
    if len(times) < 4:
        nearest = np.abs(times[:, None] - t).argmin(axis=0)
        return values[nearest]
    return CubicSpline(times, values)(np.clip(t, times[0], times[-1]))


def _corners(X: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(resample(X, CORNERS).transpose(0, 2, 1))


def _shapes_apart(X: np.ndarray, other: np.ndarray, c: np.ndarray, c_other: np.ndarray) -> float:
    """Largest Hausdorff distance of X (M, 2, N) and other (M, 2, N'), each moved by its centroid."""
    polygons = zip(_corners(X - c[..., None]), _corners(other - c_other[..., None]), strict=True)
    return max(distance(A, B) for A, B in polygons)


def _tensions_apart(
    X: np.ndarray, other: np.ndarray, c: np.ndarray, c_other: np.ndarray, sigma: np.ndarray, sigma_other: np.ndarray
) -> float:
    """Largest difference over the largest absolute value, each node against the nearest point of the other membrane."""
    fine = resample(np.stack([sigma_other, sigma_other], axis=1), CORNERS)[:, 0]
    nodes, corners = (X - c[..., None]).transpose(0, 2, 1), _corners(other - c_other[..., None])
    apart = [np.abs(s - f[cKDTree(P).query(x)[1]]).max() for s, f, x, P in zip(sigma, fine, nodes, corners, strict=True)]
    return float(max(apart) / np.abs(fine).max())
