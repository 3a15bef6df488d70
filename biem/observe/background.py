"""Velocity, pressure, vorticity and stress of the background flows of `scene.flows`: they come from one velocity, in closed form.

    kind          pressure               vorticity            deviatoric stress d = (s_xx - s_yy)/2 + i s_xy = 2 mu du/dz*
    shear         0                      -rate                i mu rate
    extensional   0                      0                    2 mu rate
    poiseuille    -2 mu u_max x/W^2      2 u_max y/W^2        -2 i mu u_max y/W^2
    taylor_green  0                      2 k U sin sin        2 mu k U cos cos,   k = pi/W, of k x and k y
    rotation      0                      0                    -2 i mu rate W^2/(conj z)^2

taylor_green is no solution of the Stokes equations but with the body force 2 mu k^2 u, which holds it up. The pressure of a custom flow is
not known. z = x + i y; complex velocity u = u_x + i u_y.
"""

from __future__ import annotations

from math import pi

import numpy as np

from biem.scene.flows import SINGULAR_WITHIN, BackgroundFlow


def background_velocity(flow: BackgroundFlow, x: np.ndarray, t: float) -> np.ndarray:
    """(P, 2) at points x (P, 2); not a number at the centre of `rotation`."""
    u = np.full_like(x, np.nan)
    where = ~_singular(flow, x)
    if where.any():
        u[where] = flow.velocity(x[where].T[None], t)[0].T
    return u


def background_gradient(flow: BackgroundFlow, mu: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """p - i mu omega and conj(d), complex (P,), at points x (P, 2). Raises ValueError for a flow whose pressure is not known."""
    z = x[:, 0] + 1j * x[:, 1]
    rate, W = flow.rate or 0.0, flow.width or 1.0
    zero = 0.0 * z
    if flow.kind == "quiescent":
        return zero, zero
    if flow.kind == "shear":
        return zero + 1j * mu * rate, zero - 1j * mu * rate
    if flow.kind == "extensional":
        return zero, zero + 2.0 * mu * rate
    if flow.kind == "poiseuille":
        slope = 2.0 * mu * rate / W
        return -slope * z, 1j * slope * z.imag
    if flow.kind == "taylor_green":
        k = pi / W
        scale = 2.0 * mu * rate * W * k
        s, c = np.sin(k * x), np.cos(k * x)
        return -1j * scale * s[:, 0] * s[:, 1], scale * c[:, 0] * c[:, 1] + zero
    if flow.kind == "rotation":
        singular, nothing = _singular(flow, x), complex(np.nan, np.nan)
        D = 2j * mu * rate * W * W / np.where(singular, 1.0, z) ** 2
        return np.where(singular, nothing, zero), np.where(singular, nothing, D)
    raise ValueError(
        f'flow.kind = "{flow.kind}": only the velocity of this flow is known: ask for the velocity alone, or for the disturbance'
    )


def _singular(flow: BackgroundFlow, x: np.ndarray) -> np.ndarray:
    if flow.kind != "rotation":
        return np.zeros(len(x), dtype=bool)
    return np.hypot(*x.T) < SINGULAR_WITHIN * (flow.width or 1.0)
