"""Motion and order of membranes: rates from the velocity u of their nodes, distances, distributions over a width. X, u: (M, 2, N)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from biem.curves.curve import arclength_weights, area, centroid, dot, inertia_tensor, length, normal, tangent
from biem.curves.fourier import resample
from biem.curves.lattice import Lattice
from biem.scene.build import Problem
from biem.stokes.near_search import minimum_gap
from biem.stokes.walls import Walls

REFINEMENT = 4  # points a node at which the outermost point of a membrane is looked for


def centroid_velocity(X: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Velocity (M, 2) of the centroids: the mean of the velocity inside, 1/A int (x - c)(u.n) ds."""
    flux = dot(u, normal(X)) * arclength_weights(X)
    return ((X - centroid(X)[..., None]) * flux[:, None, :]).sum(axis=-1) / area(X)[:, None]


def tank_treading_frequency(X: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Angular frequency (M,) at which the membrane goes round, 2 pi/L times the mean of u.t, positive counterclockwise."""
    return 2.0 * np.pi * (dot(u, tangent(X)) * arclength_weights(X)).sum(axis=-1) / length(X) ** 2


def power(X: np.ndarray, f: np.ndarray, u: np.ndarray) -> np.ndarray:
    """int f.u ds (M,): what the force density f of the membrane does to the fluid in unit time."""
    return (dot(f, u) * arclength_weights(X)).sum(axis=-1)


def deformation(X: np.ndarray) -> np.ndarray:
    """Taylor's (a - b)/(a + b) (M,) of the half axes a >= b of the ellipse with the same moments of inertia."""
    moments = np.linalg.eigvalsh(inertia_tensor(X))  # pi/4 a b^3, pi/4 a^3 b
    b, a = np.sqrt(moments.T)
    return (a - b) / (a + b)


def pair_distances(c: np.ndarray, lattice: Lattice | None = None) -> np.ndarray:
    """Distances (P,) of the points c (M, 2), pairs in the order of `pairs`; with a lattice those of the nearest images."""
    i, j = pairs(len(c)).T
    d = c[i] - c[j]
    if lattice is not None:
        return np.hypot(*np.moveaxis(_in_all_rows(d, lattice), -1, 0)).min(axis=1)
    return np.hypot(*d.T)


def pairs(M: int) -> np.ndarray:
    """(P, 2): the pairs i < j of M vesicles."""
    return np.stack(np.triu_indices(M, 1), axis=1)


def nearest_distances(c: np.ndarray, lattice: Lattice | None = None) -> np.ndarray:
    """Distance (M,) of each point c (M, 2) to the nearest other one; with a lattice also to images, its own among them."""
    points = c
    if lattice is not None:
        c = lattice.wrapped(c)
        beside = np.array([[-lattice.width, 0.0], [0.0, 0.0], [lattice.width, 0.0]])
        points = (_in_all_rows(c, lattice)[:, :, None, :] + beside).reshape(-1, 2)
    return np.asarray(cKDTree(points).query(c, k=2)[0])[:, 1]


def _in_all_rows(d: np.ndarray, lattice: Lattice) -> np.ndarray:
    """Of d (P, 2) the image with the least |x| in each row (P, R, 2), for all rows that the one closest to the origin may be in."""
    reach = 0.5 * np.hypot(lattice.width, lattice.height)  # nothing is further from all of its images
    most = np.ceil(reach / lattice.height) + 1.0
    n = np.arange(-most, most + 1.0)
    rows = lattice.wrapped(d)[:, None, :] + lattice.displacement(np.stack([0.0 * n, n], axis=-1))
    rows[..., 0] -= lattice.width * np.round(rows[..., 0] / lattice.width)
    return rows


def lateral_distribution(y: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Share of the positions y (M,) in each bin over its width (B,); those outside all bins count in the whole. edges: (B + 1,)."""
    return np.histogram(y, edges)[0] / (len(y) * np.diff(edges))


def velocity_profile(X: np.ndarray, u: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Mean of u_x over the arcs of membranes in each bin of y (B,), NaN in bins that no node is in. edges: (B + 1,)."""
    y, ds = X[:, 1].ravel(), arclength_weights(X).ravel()
    weight = np.histogram(y, edges, weights=ds)[0]
    with np.errstate(invalid="ignore"):
        return np.histogram(y, edges, weights=ds * u[:, 0].ravel())[0] / weight


def smallest_gap(problem: Problem, X: np.ndarray, lattice: Lattice | None) -> float:
    """Smallest distance of a node to another membrane, also to an image, or to a wall; infinite where there is neither."""
    return min(minimum_gap(X, lattice), np.inf if problem.walls is None else _to_walls(problem.walls, X))


def cell_free_layer(problem: Problem, X: np.ndarray) -> float:
    """W less the largest |y| of a membrane in a parabolic flow or a channel, negative beyond; between other walls the distance to them."""
    width = channel_width(problem)
    if width is not None:
        outermost = np.abs(X[:, 1]).max(axis=-1)
        between_nodes = np.abs(np.diff(X[:, 1], axis=-1)).max()  # further out than that a membrane does not reach
        y = resample(X[outermost >= outermost.max() - between_nodes, 1], REFINEMENT * X.shape[-1])
        return width - float(np.abs(y).max())
    assert problem.walls is not None
    return _to_walls(problem.walls, X)


def channel_width(problem: Problem) -> float | None:
    """W, half the width of the parabolic flow or of the channel; None in other flows."""
    walls = problem.scene.walls
    if walls is not None:
        return walls.width if walls.kind == "channel" else None
    return problem.flow.width if problem.flow.kind == "poiseuille" else None


def _to_walls(walls: Walls, X: np.ndarray) -> float:
    """Smallest distance of a node to a wall."""
    return float(walls.distance(X.transpose(0, 2, 1).reshape(-1, 2)).min())
