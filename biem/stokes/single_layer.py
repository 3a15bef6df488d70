"""Velocity of membranes at any points, near or far, inside or outside: the single layer with its near-singular correction."""

from __future__ import annotations

from biem.backend import Array
from biem.curves.curve import arclength_weights
from biem.stokes.farfield import pair_sum
from biem.stokes.near import SCHEMES, apply_rows, near_correction, near_width
from biem.stokes.near_search import find_near
from biem.stokes.near_sums import NearSums


def single_layer(
    X: Array,
    f: Array,
    targets: Array,
    mu: float = 1.0,
    near_field: str = "auto",
    far_field: str = "auto",
    tolerance: float = 1e-6,
    exclude: Array | None = None,
) -> Array:
    """u(x) = sum over curves of S[X, f](x) at targets (P, 2) -> (P, 2), velocity in units of f length / mu.

    X, f: (M, 2, N), counterclockwise curves and force densities. near_field: "auto" (= "upsample"), "upsample", "ying_zorin" or
    "none"; far_field: "auto", "direct" or "ewald". tolerance: aimed-at relative error of both. exclude (P,): a curve that a target
    skips (-1: none). Raises ValueError for unknown schemes or shapes that do not fit.
    """
    scheme = near_scheme(near_field)
    if X.ndim != 3 or X.shape[1] != 2 or f.shape != X.shape or targets.ndim != 2 or targets.shape[1] != 2:
        raise ValueError(
            f"single_layer got X {tuple(X.shape)}, f {tuple(f.shape)}, targets {tuple(targets.shape)}: "
            "expected X and f (M, 2, N), targets (P, 2)"
        )
    u = pair_sum(targets, X, mu, exclude, far_field, tolerance).velocity(f * arclength_weights(X)[:, None, :])
    if scheme == "none":
        return u
    pairs = find_near(X, targets, near_width(scheme, tolerance), exclude)
    if len(pairs) == 0:
        return u
    if scheme == "upsample":
        return NearSums.build(X, targets, pairs, mu, tolerance).add(u, f)
    return apply_rows(u, near_correction(X, targets, pairs, mu, scheme, tolerance), pairs, f)


def near_scheme(near_field: str) -> str:
    """The scheme that `near_field` names; "auto" is the more accurate one. Raises ValueError for an unknown name."""
    scheme = "upsample" if near_field == "auto" else near_field
    if scheme not in SCHEMES:
        raise ValueError(f'near_field = "{near_field}": expected "auto", ' + ", ".join(f'"{s}"' for s in SCHEMES))
    return scheme
