"""Area and length restored exactly, by the smallest displacement of the membrane.

    X~ = X + lambda_1 n + lambda_2 c n     (n: gradient of the area, -c n: of the length)     with area(X~) = A_0, length(X~) = L_0

Both directions are taken at X, so that X~ and its derivative are linear in (lambda_1, lambda_2); two equations per vesicle are solved
by Newton's method, batched. Where A_0 and
L_0 leave next to no other shape than the circle, c n cannot take all modes away at once: there the second direction leads to the circle.
"""

from __future__ import annotations

from biem.backend import Array, array_namespace
from biem.curves.curve import center_of_nodes, cross, dot
from biem.curves.fourier import derivative, remove_nyquist
from biem.errors import NumericalFailure

TOLERANCE = 1e-10  # relative, of area and of length
MAX_ITERATIONS = 60
NEARLY_A_CIRCLE = 1e-3  # 1 - 4 pi A_0/L_0^2
SINGULAR = 1e-12  # |det J| over |J|^2 below which J counts as of rank one


def restore_area_length(X: Array, area_0: Array, length_0: Array, first: int = 0) -> tuple[Array, int]:
    """X (M, 2, N) with area and length equal to area_0, length_0 (M,) to 1e-10, and how many vesicles were changed.

    Vesicles within the tolerance are returned as they are. On a circle the two gradients are parallel: the least-squares step is
    taken there. Raises NumericalFailure, naming the vesicle (counted from `first`), where no such shape is near.
    """
    xp = array_namespace(X)
    r = X - center_of_nodes(X)
    r_alpha = derivative(r)
    off = _errors(r, r_alpha, area_0, length_0)
    wrong = ~(xp.max(xp.abs(off), axis=-1) <= TOLERANCE)  # true for NaN
    changed = int(xp.sum(xp.astype(wrong, xp.int64)))
    if changed == 0:
        return X, 0
    d = _directions(r, r_alpha, area_0, length_0)
    d_alpha = derivative(d)
    lambdas = xp.zeros((X.shape[0], 2), dtype=X.dtype, device=X.device)
    moved = lambda f, rate: f + xp.sum(lambdas[:, :, None, None] * rate, axis=1)
    Y, Y_alpha = r, r_alpha
    for _ in range(MAX_ITERATIONS):
        step = _least_squares(_derivatives(Y_alpha, d, d_alpha, area_0, length_0), -off)
        lambdas = xp.where((xp.max(xp.abs(off), axis=-1) > TOLERANCE)[:, None], lambdas + step, lambdas)
        Y, Y_alpha = moved(r, d), moved(r_alpha, d_alpha)
        off = _errors(Y, Y_alpha, area_0, length_0)
        if float(xp.max(xp.abs(off))) <= TOLERANCE:
            return moved(X, d), changed
    worst = int(xp.argmax(xp.max(xp.abs(off), axis=-1)))
    raise NumericalFailure(
        f"area and length of vesicle {first + worst} could not be restored: relative errors {float(off[worst, 0]):.1e}, "
        f"{float(off[worst, 1]):.1e} after {MAX_ITERATIONS} iterations; use smaller steps"
    )


def _directions(r: Array, r_alpha: Array, area_0: Array, length_0: Array) -> Array:
    """n, and c n or the way to the circle (M, 2, 2, N): displacements of curves r (M, 2, N) about their centres."""
    xp = array_namespace(r)
    v = xp.sqrt(dot(r_alpha, r_alpha))
    n = remove_nyquist(xp.stack([r_alpha[:, 1], -r_alpha[:, 0]], axis=1) / v[:, None, :])
    R = length_0[:, None] / (2.0 * xp.pi)
    bent = (R * cross(r_alpha, derivative(r_alpha)) / v**3)[:, None, :] * n
    to_circle = r * (R / xp.sqrt(dot(r, r)) - 1.0)[:, None, :]  # of that length about the centre, along the radii
    nearly = 1.0 - 4.0 * xp.pi * area_0 / length_0**2 < NEARLY_A_CIRCLE
    return xp.stack([n, remove_nyquist(xp.where(nearly[:, None, None], to_circle, bent))], axis=1)


def _least_squares(J: Array, b: Array) -> Array:
    """x (M, 2) of least squares and least norm with J x = b. J: (M, 2, 2), b: (M, 2)."""
    xp = array_namespace(J)
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    size = xp.sum(J * J, axis=(1, 2))
    regular = xp.abs(det) > SINGULAR * size
    adjugate = xp.stack([J[:, 1, 1] * b[:, 0] - J[:, 0, 1] * b[:, 1], J[:, 0, 0] * b[:, 1] - J[:, 1, 0] * b[:, 0]], axis=-1)
    rank_one = xp.sum(J * b[:, :, None], axis=1) / size[:, None]  # J^T b / |J|^2
    return xp.where(regular[:, None], adjugate / xp.where(regular, det, size)[:, None], rank_one)


def _errors(r: Array, r_alpha: Array, area_0: Array, length_0: Array) -> Array:
    """Relative errors (M, 2) of the area and the length of curves r (M, 2, N)."""
    xp = array_namespace(r)
    h = 2.0 * xp.pi / r.shape[-1]
    A = 0.5 * h * xp.sum(cross(r, r_alpha), axis=-1)
    L = h * xp.sum(xp.sqrt(dot(r_alpha, r_alpha)), axis=-1)
    return xp.stack([A / area_0 - 1.0, L / length_0 - 1.0], axis=-1)


def _derivatives(r_alpha: Array, d: Array, d_alpha: Array, area_0: Array, length_0: Array) -> Array:
    """Derivatives (M, 2, 2) of the relative area (first row) and length along the displacements d (M, 2, 2, N)."""
    xp = array_namespace(d)
    h = 2.0 * xp.pi / d.shape[-1]
    t = r_alpha / xp.sqrt(dot(r_alpha, r_alpha))[:, None, :]
    dA = h * xp.sum(cross(d, r_alpha[:, None]), axis=-1) / area_0[:, None]
    dL = h * xp.sum(dot(t[:, None], d_alpha), axis=-1) / length_0[:, None]
    return xp.stack([dA, dL], axis=1)
