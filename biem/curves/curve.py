"""Geometry of closed curves X: (M, 2, N), counterclockwise, nodes alpha_k = 2 pi k / N, outward normal.

All integrals are trapezoid sums in alpha (spectrally accurate) about the mean node, so that a shift changes nothing.
    area = 1/2 int X.n ds      centroid = (1/3) int X (X.n) ds / area      length = int ds      E_b = kappa_b/2 int c^2 ds
"""

from __future__ import annotations

from biem.backend import Array, array_namespace
from biem.curves.fourier import derivative


def cross(a: Array, b: Array) -> Array:
    """a_x b_y - a_y b_x for a, b: (..., 2, N) -> (..., N)."""
    return a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :]


def dot(a: Array, b: Array) -> Array:
    """a . b for a, b: (..., 2, N) -> (..., N)."""
    return a[..., 0, :] * b[..., 0, :] + a[..., 1, :] * b[..., 1, :]


def center_of_nodes(X: Array) -> Array:
    """Mean node (M, 2, 1): the origin of every local frame."""
    return array_namespace(X).mean(X, axis=-1, keepdims=True)


def _alpha_derivative(X: Array) -> Array:
    """X_alpha in the local frame, so that a distant origin costs no digits."""
    return derivative(X - center_of_nodes(X))


def speed(X: Array) -> Array:
    """|dX/dalpha| (M, N)."""
    X_alpha = _alpha_derivative(X)
    return array_namespace(X).sqrt(dot(X_alpha, X_alpha))


def arclength_weights(X: Array) -> Array:
    """ds (M, N): speed * 2 pi / N, the trapezoid weights of an integral over the curve."""
    return speed(X) * (2.0 * _pi(X) / X.shape[-1])


def d_ds(f: Array, speed: Array) -> Array:
    """Arclength derivative f_alpha / speed. f: (M, N) or (M, 2, N); speed: (M, N)."""
    return derivative(f) / (speed if f.ndim == speed.ndim else speed[..., None, :])


def tangent(X: Array) -> Array:
    """Unit tangent X_s (M, 2, N)."""
    X_alpha = _alpha_derivative(X)
    return X_alpha / array_namespace(X).sqrt(dot(X_alpha, X_alpha))[..., None, :]


def normal(X: Array) -> Array:
    """Outward unit normal (M, 2, N)."""
    X_s = tangent(X)
    return array_namespace(X).stack([X_s[..., 1, :], -X_s[..., 0, :]], axis=-2)


def curvature(X: Array) -> Array:
    """Curvature (M, N), positive on a counterclockwise circle."""
    X_alpha = _alpha_derivative(X)
    return cross(X_alpha, derivative(X_alpha)) / dot(X_alpha, X_alpha) ** 1.5


def length(X: Array) -> Array:
    """Perimeter (M,)."""
    return array_namespace(X).sum(arclength_weights(X), axis=-1)


def area(X: Array) -> Array:
    """Signed enclosed area (M,), positive for counterclockwise curves."""
    xp = array_namespace(X)
    r = X - center_of_nodes(X)
    return xp.sum(cross(r, derivative(r)), axis=-1) * (_pi(X) / X.shape[-1])


def centroid(X: Array) -> Array:
    """Centroid of the enclosed area (M, 2)."""
    xp = array_namespace(X)
    origin = center_of_nodes(X)
    r = X - origin
    first_moment = xp.sum(r * cross(r, derivative(r))[..., None, :], axis=-1) * (2.0 * _pi(X) / (3.0 * X.shape[-1]))
    return origin[..., 0] + first_moment / area(X)[..., None]


def inertia_tensor(X: Array) -> Array:
    """J = int_omega (|r|^2 I - r r^T) dA about the centroid (M, 2, 2)."""
    xp = array_namespace(X)
    r = X - centroid(X)[..., None]
    moment = cross(r, derivative(r)) * (2.0 * _pi(X) / (4.0 * X.shape[-1]))  # (1/4) r.n ds
    xx = xp.sum(moment * r[..., 0, :] ** 2, axis=-1)
    yy = xp.sum(moment * r[..., 1, :] ** 2, axis=-1)
    xy = xp.sum(moment * r[..., 0, :] * r[..., 1, :], axis=-1)
    return xp.stack([xp.stack([yy, -xy], axis=-1), xp.stack([-xy, xx], axis=-1)], axis=-2)


def inclination(X: Array) -> Array:
    """Angle of the long axis (smallest moment of inertia) from the x axis, in (-pi/2, pi/2] (M,)."""
    xp = array_namespace(X)
    J = inertia_tensor(X)
    return 0.5 * xp.atan2(-2.0 * J[..., 0, 1], J[..., 1, 1] - J[..., 0, 0])


def effective_radius(X: Array) -> Array:
    """R (M,): radius of the circle of equal area."""
    return array_namespace(X).sqrt(area(X) / _pi(X))


def reduced_area(X: Array) -> Array:
    """4 pi area / length^2 (M,): 1 for a circle."""
    return 4.0 * _pi(X) * area(X) / length(X) ** 2


def bending_energy(X: Array, kappa_b: float = 1.0) -> Array:
    """kappa_b/2 int curvature^2 ds (M,)."""
    return 0.5 * kappa_b * array_namespace(X).sum(curvature(X) ** 2 * arclength_weights(X), axis=-1)


def _pi(X: Array) -> float:
    return float(array_namespace(X).pi)
