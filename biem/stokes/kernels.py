"""Fundamental solutions of the Stokes equations in the plane. The one home of the sign of the logarithm and of 1/(4 pi mu).

    single layer  u_i = G_ij f_j,        G    = 1/(4 pi mu) (-log|r| I + r r^T/|r|^2),   r = x - y
                  p   = p_j f_j,         p_j  = r_j / (2 pi |r|^2)
                  s   = T_ijk f_j n_k,   T    = -r_i r_j r_k / (pi |r|^4)
    double layer  u_i = D_ij q_j,        D    = r_i r_j (r.n) / (pi |r|^4)               (n: normal at the source y)
                  p   = P_j q_j,         P_j  = mu/pi (-n_j/|r|^2 + 2 (r.n) r_j/|r|^4)

The double layer of a constant density q is -q inside, -q/2 on and 0 outside a closed curve with outward normal.
Separations r are (..., 2, K) or given as two arrays of one shape. Pozrikidis, Boundary Integral and Singularity Methods (1992), 2.6.
"""

from __future__ import annotations

from math import pi

from biem.backend import Array, array_namespace

LOG_SIGN = -1.0  # with +log the flow is not divergence-free


def stokeslet_prefactor(mu: float) -> float:
    """1/(4 pi mu)."""
    return 1.0 / (4.0 * pi * mu)


def stokeslet(rx: Array, ry: Array, mu: float) -> tuple[Array, Array, Array]:
    """G_xx, G_xy, G_yy at separations (rx, ry), each of their shape; 0 where the points coincide."""
    xp = array_namespace(rx)
    r2 = rx * rx + ry * ry
    r2 = xp.where(r2 == 0.0, xp.ones_like(r2), r2)
    scale = stokeslet_prefactor(mu)
    log_term = (0.5 * LOG_SIGN * scale) * xp.log(r2)
    rx_scaled = scale * rx / r2
    return log_term + rx_scaled * rx, rx_scaled * ry, log_term + (scale / r2) * ry * ry


def pressure_of_force(rx: Array, ry: Array) -> tuple[Array, Array]:
    """p_x, p_y: pressure of a point force is p_j f_j."""
    scale = 1.0 / (2.0 * pi * (rx * rx + ry * ry))
    return scale * rx, scale * ry


def stress_of_force(r: Array, f: Array) -> Array:
    """Stress tensor sigma_ik = T_ijk f_j of point forces. r, f: (..., 2, K) -> (..., 2, 2, K)."""
    xp = array_namespace(r)
    r2 = r[..., 0, :] ** 2 + r[..., 1, :] ** 2
    scale = -(r[..., 0, :] * f[..., 0, :] + r[..., 1, :] * f[..., 1, :]) / (pi * r2 * r2)
    rows = [xp.stack([scale * r[..., i, :] * r[..., k, :] for k in (0, 1)], axis=-2) for i in (0, 1)]
    return xp.stack(rows, axis=-3)


def double_layer(rx: Array, ry: Array, nx: Array, ny: Array) -> tuple[Array, Array, Array]:
    """D_xx, D_xy, D_yy at separations (rx, ry) from sources with normal (nx, ny)."""
    r2 = rx * rx + ry * ry
    scale = (rx * nx + ry * ny) / (pi * r2 * r2)
    return scale * rx * rx, scale * rx * ry, scale * ry * ry


def pressure_of_double_layer(rx: Array, ry: Array, nx: Array, ny: Array, mu: float) -> tuple[Array, Array]:
    """P_x, P_y: pressure of a double layer density is P_j q_j."""
    r2 = rx * rx + ry * ry
    rn = 2.0 * (rx * nx + ry * ny) / r2
    scale = mu / (pi * r2)
    return scale * (rn * rx - nx), scale * (rn * ry - ny)
