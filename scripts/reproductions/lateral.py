"""Lateral velocities of shapes that the reference went through near the centre line, by operators on 32 nodes, against resolved ones.

Of a vesicle at y the advection and the relaxation each move the centroid across the flow; they nearly cancel, and the rest brings it to the
centre. A rung rests beside the centre where its error is larger than that rest.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from biem.curves.curve import centroid
from biem.membrane.maps import ExactMaps, MembraneMaps
from biem.run.trajectory import Trajectory
from surrogate import load_maps

RESOLVED, SUBSTEPS = 256, 32  # nodes and relaxation steps of the truth
DT = 1e-5  # mu L^3/kappa_b, of a relaxation, over which its velocity is a mean
NEAR, LEAST = 0.03, 0.003  # of y/W
FRAMES = 8
SHIFT = 1e-7  # lengths along the velocity, for the derivative of the centroid


def lateral_velocities(trajectory: Trajectory, few: Callable[[np.ndarray], np.ndarray]) -> list[dict[str, float]]:
    """Of some frames of the reference with LEAST < y/W < NEAR: y/W, "true" and the errors of "exact 64" and "hybrid", over u_max.

    few: a function that gives the shape at 32 nodes.
    """
    W, unit = float(trajectory.attributes["flow_width"]), float(trajectory.attributes["t_gamma"])
    y = np.array([centroid(X)[0, 1] for X in trajectory.X]) / W
    frames = np.flatnonzero((y < NEAR) & (y > LEAST))
    if len(frames) < 2:
        return []
    ways: dict[str, tuple[MembraneMaps, int]] = {"exact 64": (ExactMaps(points=64), SUBSTEPS), "hybrid": (load_maps("hybrid"), 1)}
    rows = []
    for k in frames[np.linspace(0, len(frames) - 1, min(FRAMES, len(frames))).astype(int)]:
        X = trajectory.X[k]
        true = _across(ExactMaps(points=RESOLVED), X, W, unit, SUBSTEPS)
        row = {"y": float(y[k]), "true": true}
        rows.append(row | {name: _across(maps, few(X), W, unit, steps) - true for name, (maps, steps) in ways.items()})
    return rows


def _across(maps: MembraneMaps, X: np.ndarray, W: float, unit: float, steps: int) -> float:
    """Velocity of the centroid along y, over u_max = W / unit."""
    u_max = W / unit
    u = u_max * np.stack([1.0 - (X[:, 1] / W) ** 2, 0.0 * X[:, 0]], axis=1)
    start = centroid(X)[0, 1]
    carried = (centroid(X + SHIFT / u_max * maps.advect(X, u))[0, 1] - start) / SHIFT
    relaxed = X
    for _ in range(steps):
        relaxed = maps.relax(relaxed, DT / steps)
    return float(carried + (centroid(relaxed)[0, 1] - start) / DT / u_max)


def in_words(found: dict[str, list[dict[str, float]]]) -> str:
    """What the velocities of several cases say."""
    rows = [row for case in found.values() for row in case]
    size = lambda name: float(np.sqrt(np.mean([row[name] ** 2 for row in rows])))
    return (
        f"At {len(rows)} shapes that the reference went through at y/W = {min(r['y'] for r in rows):.3f} to "
        f"{max(r['y'] for r in rows):.3f} ({', '.join(found)}) the centroid's velocity across the flow is {size('true'):.1e} u_max (root "
        "mean square): what advection and relaxation, which nearly cancel, leave. Of these shapes at 32 nodes exact operators built at 64 "
        f"err by {size('exact 64'):.1e}, hybrid by {size('hybrid'):.1e}."
    )
