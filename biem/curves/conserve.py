"""Area and length restored exactly, by the smallest displacement of the membrane.

    X~ = X + lambda_1 n + lambda_2 c n     (n: gradient of the area, -c n: of the length)     with area(X~) = A_0, length(X~) = L_0

Both directions are taken at X; two equations in (lambda_1, lambda_2) per vesicle are solved by Newton's method, batched. Where A_0 and
L_0 leave next to no other shape than the circle, c n cannot take all modes away at once: there the second direction leads to the circle.
"""

from __future__ import annotations

from array_api_compat import array_namespace

from biem.backend import Array
from biem.curves.curve import area, center_of_nodes, cross, curvature, dot, length, normal, tangent
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
    off = _errors(X, area_0, length_0)
    wrong = ~(xp.max(xp.abs(off), axis=-1) <= TOLERANCE)  # true for NaN
    changed = int(xp.sum(xp.astype(wrong, xp.int64)))
    if changed == 0:
        return X, 0
    n = remove_nyquist(normal(X))
    bent = (curvature(X) * length_0[:, None] / (2 * xp.pi))[:, None, :] * n
    nearly = 1.0 - 4.0 * xp.pi * area_0 / length_0**2 < NEARLY_A_CIRCLE
    directions = [n, remove_nyquist(xp.where(nearly[:, None, None], _to_circle(X, length_0), bent))]
    Y = X
    for _ in range(MAX_ITERATIONS):
        J = xp.stack([_derivatives(Y, d, area_0, length_0) for d in directions], axis=-1)
        lambdas = _least_squares(J, -off)
        step = lambdas[:, 0, None, None] * directions[0] + lambdas[:, 1, None, None] * directions[1]
        Y = xp.where((xp.max(xp.abs(off), axis=-1) > TOLERANCE)[:, None, None], Y + step, Y)
        off = _errors(Y, area_0, length_0)
        if float(xp.max(xp.abs(off))) <= TOLERANCE:
            return Y, changed
    worst = int(xp.argmax(xp.max(xp.abs(off), axis=-1)))
    raise NumericalFailure(
        f"area and length of vesicle {first + worst} could not be restored: relative errors {float(off[worst, 0]):.1e}, "
        f"{float(off[worst, 1]):.1e} after {MAX_ITERATIONS} iterations; use smaller steps"
    )


def _to_circle(X: Array, length_0: Array) -> Array:
    """From X (M, 2, N) to the circles of that length about the means of the nodes, along their radii."""
    xp = array_namespace(X)
    r = X - center_of_nodes(X)
    return r * (length_0[:, None] / (2 * xp.pi) / xp.sqrt(dot(r, r)) - 1.0)[:, None, :]


def _least_squares(J: Array, b: Array) -> Array:
    """x (M, 2) of least squares and least norm with J x = b. J: (M, 2, 2), b: (M, 2)."""
    xp = array_namespace(J)
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    size = xp.sum(J * J, axis=(1, 2))
    regular = xp.abs(det) > SINGULAR * size
    adjugate = xp.stack([J[:, 1, 1] * b[:, 0] - J[:, 0, 1] * b[:, 1], J[:, 0, 0] * b[:, 1] - J[:, 1, 0] * b[:, 0]], axis=-1)
    rank_one = xp.sum(J * b[:, :, None], axis=1) / size[:, None]  # J^T b / |J|^2
    return xp.where(regular[:, None], adjugate / xp.where(regular, det, size)[:, None], rank_one)


def _errors(X: Array, area_0: Array, length_0: Array) -> Array:
    return array_namespace(X).stack([area(X) / area_0 - 1.0, length(X) / length_0 - 1.0], axis=-1)


def _derivatives(X: Array, d: Array, area_0: Array, length_0: Array) -> Array:
    """Directional derivatives (M, 2) of the relative area and length along d (M, 2, N)."""
    xp = array_namespace(X)
    h = 2.0 * xp.pi / X.shape[-1]
    dA = xp.sum(cross(d, derivative(X - center_of_nodes(X))), axis=-1) * h
    dL = xp.sum(dot(tangent(X), derivative(d)), axis=-1) * h
    return xp.stack([dA / area_0, dL / length_0], axis=-1)
