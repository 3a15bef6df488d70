"""What membranes add to the stress of the suspension (Batchelor): the stresslet of each one, and their sum per area. X: (M, 2, N).

    S_m = -int sym[(x - c_m) f^T] ds + (lambda_m - 1) mu int (u n^T + n u^T) ds,       Sigma_p = sum_m S_m / A_ref

f: the membrane's force density on the fluid, c_m: the centroid, lambda_m: viscosity inside over mu outside, u: velocity of the membrane.
The mean stress is -p I + 2 mu E + Sigma_p. Bending and tension are resultants, f = q_s with q = sigma t - kappa_b t_ss; by parts, exactly
so at the nodes too,

    -int x f^T ds = int sigma t t^T + kappa_b t_s t_s^T ds:     symmetric, as no torque acts, and the same about any origin.

Repulsion does push a membrane, so that its share of S_m is about c_m. In Sigma_p stands its virial, -sum (x - y) F^T over all pairs of a
node at x, pushed by F, and the point y of the other membrane (or of its image, in a periodic box) that it is pushed off from.
Batchelor, J. Fluid Mech. 41 (1970) 545; Pozrikidis (1992), 2.6 and 5.2.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from biem.curves.curve import arclength_weights, area, centroid, d_ds, normal, speed, tangent
from biem.curves.lattice import Lattice
from biem.membrane.repulsion import Repulsion
from biem.scene.build import Problem


def stresslets(X: np.ndarray, sigma: np.ndarray, kappa_b: float) -> np.ndarray:
    """S_m of bending and of tension sigma (M, N): (M, 2, 2)."""
    v, t, ds = speed(X), tangent(X), arclength_weights(X)
    t_s = d_ds(t, v)
    return _moments(sigma * ds, t, t) + kappa_b * _moments(ds, t_s, t_s)


def contrast_stresslets(X: np.ndarray, u: np.ndarray, contrast: np.ndarray, mu: float) -> np.ndarray:
    """S_m of the other viscosity inside: (M, 2, 2), for velocities u (M, 2, N) and contrast lambda (M,)."""
    flux = _moments(arclength_weights(X), u, normal(X))
    return ((contrast - 1.0) * mu)[:, None, None] * (flux + np.swapaxes(flux, 1, 2))


def repulsive_stress(repulsion: Repulsion, X: np.ndarray, lattice: Lattice | None) -> tuple[np.ndarray, np.ndarray]:
    """Of the repulsion between membranes: its share of each S_m (M, 2, 2), and of their sum in Sigma_p (2, 2).

    Walls push with forces from outside, which are no part of the suspension's stress. lattice: the images, in a periodic box.
    """
    between = replace(repulsion, walls=None)
    f, found = between.force(X, lattice), between.contacts(X, lattice)
    if f is None or found is None:
        return np.zeros((len(X), 2, 2)), np.zeros((2, 2))
    pairs, F = found
    strength = np.hypot(*F.T)
    n = F / np.where(strength == 0.0, 1.0, strength)[:, None]
    S = -_moments(arclength_weights(X), X - centroid(X)[..., None], f)
    return 0.5 * (S + np.swapaxes(S, 1, 2)), -(n * (pairs.distance * strength)[:, None]).T @ n


def reference_area(problem: Problem) -> tuple[float, str, bool]:
    """A_ref, what it is, and whether it is an area of the suspension; where the scene has none, it is that of the vesicles themselves."""
    v, box = problem.scene.vesicles, problem.box
    if box is not None:
        return box.width * box.height, "periodic box", True
    if v.file is None and v.placement != "explicit":
        if v.box is not None:
            return v.box[0] * v.box[1], "vesicles.box", True
        if problem.region is None and v.area_fraction is not None:
            return float(np.sum(area(problem.X))) / v.area_fraction, "area of the vesicles over vesicles.area_fraction", True
    if problem.region is not None:
        return float(problem.region.area), "area between the walls", True
    return float(np.sum(area(problem.X))), "area of the vesicles: stresses are those of a suspension over its area fraction", False


def _moments(weights: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """sum_k w_k a_ik b_jk (M, 2, 2). weights: (M, N); a, b: (M, 2, N)."""
    return (a * weights[:, None, :]) @ np.swapaxes(b, 1, 2)
