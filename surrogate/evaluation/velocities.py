"""Errors of advection and flow tension for velocities as they occur: background flows, and a neighbour at a gap of one arclength spacing.

Reference: exact maps at the nodes of the resolved shape, low-passed to N nodes; the maps themselves get the low-passed shape and the
velocity at the N nodes. Shapes are of length 1, turned by chance. In units of length and rate:

    shear        u = (y, 0)                                     about the centroid
    poiseuille   u = (W - (y + y_0)^2/W, 0), W = R/0.4          y_0 by chance within W/2; the velocity of the centroid is taken out
    neighbour    S of bending and tension force of another test shape, the tension that it has alone, at a distance of 1/N
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from biem.backend import one_blas_thread
from biem.curves.crossing import polygons
from biem.curves.curve import centroid, effective_radius
from biem.curves.fourier import resample
from biem.membrane.maps import ExactMaps
from biem.membrane.operators import membrane_force
from biem.stokes.single_layer import single_layer
from surrogate.evaluation.rungs import Rung, Stats, stats

CONFINEMENT = 0.4  # R/W
NEAR_TOLERANCE = 1e-8
SLOTS = ("advection", "flow_tension")


def velocity_errors(X: np.ndarray, rungs: Sequence[Rung], points: int, seed: int) -> dict[str, dict[str, dict[str, Stats]]]:
    """By flow, slot and rung: relative L2 errors over the nodes, for resolved shapes X (n, 2, n_op); points: N."""
    rng = np.random.default_rng(seed)
    with one_blas_thread():
        X = _turned(X, rng)
        every = X.shape[-1] // points
        few = resample(X, points)
        exact = ExactMaps(points=X.shape[-1])
        found: dict[str, dict[str, dict[str, Stats]]] = {}
        for flow, u in velocities(X, 1.0 / points, rng).items():
            wanted = {"advection": resample(exact.advect(X, u), points), "flow_tension": resample(exact.flow_tension(X, u), points)}
            v = np.ascontiguousarray(u[..., ::every])
            found[flow] = {slot: {} for slot in SLOTS}
            for rung in rungs:
                for slot in rung.slots & set(SLOTS):
                    got = rung.maps.advect(few, v) if slot == "advection" else rung.maps.flow_tension(few, v)
                    found[flow][slot][rung.name] = stats(_size(got - wanted[slot]) / _size(wanted[slot]))
    return found


def velocities(X: np.ndarray, gap: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Velocities (n, 2, n_op) at the nodes of X, by name of the flow."""
    local = X - centroid(X)[..., None]
    y = local[:, 1]
    W = effective_radius(X)[:, None] / CONFINEMENT
    y_0 = rng.uniform(-0.5, 0.5, (len(X), 1)) * W
    return {
        "shear": np.stack([y, 0.0 * y], axis=1),
        "poiseuille": np.stack([(y_0**2 - (y + y_0) ** 2) / W, 0.0 * y], axis=1),
        "neighbour": _beside(X, gap, rng),
    }


def _beside(X: np.ndarray, gap: float, rng: np.random.Generator) -> np.ndarray:
    """What each shape has of the next one, turned by chance and moved along a line until the gap is left between them."""
    others = neighbours(X, gap, rng)
    sigma = -ExactMaps(points=X.shape[-1]).self_tension(others)
    f = membrane_force(others, sigma)
    u = [single_layer(others[i : i + 1], f[i : i + 1], X[i].T, tolerance=NEAR_TOLERANCE).T for i in range(len(X))]
    return np.stack(u)


def neighbours(X: np.ndarray, gap: float, rng: np.random.Generator) -> np.ndarray:
    """Shapes (n, 2, n_op), each at that distance from the shape of X beside which it is."""
    others = _turned(np.roll(X, 1, axis=0), rng)
    others = others - centroid(others)[..., None]
    angle = rng.uniform(0.0, 2.0 * np.pi, len(X))
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    own = polygons(X)
    origin = centroid(X)
    place = lambda d: others + (origin + d[:, None] * direction)[..., None]
    near, far = np.zeros(len(X)), np.full(len(X), 2.0)
    for _ in range(40):
        middle = 0.5 * (near + far)
        apart = shapely.distance(own, polygons(place(middle))) > gap
        near, far = np.where(apart, near, middle), np.where(apart, middle, far)
    return place(far)


def _turned(X: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0.0, 2.0 * np.pi, len(X))
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack([c * X[:, 0] - s * X[:, 1], s * X[:, 0] + c * X[:, 1]], axis=1)


def _size(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values.reshape(len(values), -1) ** 2).sum(axis=1))
