"""Curves with known parametrizations and reference quadratures for the tests, written without biem's own geometry.

The blob is an asymmetric smooth curve of length 1, r(t) = 1 + 0.2 cos(2t + 0.3) + 0.08 sin 3t, flattened by 0.8, with its density.
"""

from functools import cache

import numpy as np
import shapely
from scipy.spatial import cKDTree

gauss_legendre = cache(np.polynomial.legendre.leggauss)


def nodes(N):
    return 2 * np.pi * np.arange(N) / N


def ellipse(N, a=1.0, b=0.5):
    return np.stack([a * np.cos(nodes(N)), b * np.sin(nodes(N))])


def circle(N, radius=1.0, center=(0.0, 0.0)):
    return ellipse(N, radius, radius) + np.asarray(center)[:, None]


def blob(t):
    """Points (2, ...) of the blob at parameters t."""
    r = 1 + 0.2 * np.cos(2 * t + 0.3) + 0.08 * np.sin(3 * t)
    return BLOB_SCALE * np.stack([r * np.cos(t), 0.8 * r * np.sin(t)])


def blob_derivative(t):
    r = 1 + 0.2 * np.cos(2 * t + 0.3) + 0.08 * np.sin(3 * t)
    r_t = -0.4 * np.sin(2 * t + 0.3) + 0.24 * np.cos(3 * t)
    return BLOB_SCALE * np.stack([r_t * np.cos(t) - r * np.sin(t), 0.8 * (r_t * np.sin(t) + r * np.cos(t))])


def blob_normal(t):
    x_t, y_t = blob_derivative(t)
    return np.stack([y_t, -x_t]) / np.hypot(x_t, y_t)


def blob_density(t):
    return np.stack([np.cos(2 * t + 0.4) + 0.3, np.sin(t) - 0.5 * np.cos(3 * t)])


FEET = np.linspace(0.1, 6.2, 13)
BLOB_SCALE = 1.0
BLOB_SCALE = 1 / (2 * np.pi * np.hypot(*blob_derivative(nodes(2048))).mean())  # length 1


def rotate(X, angle):
    """X (..., 2, N) turned about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]) @ X


def mirror(f):
    """Values (..., N) on the curve traversed the other way round, node 0 kept: f(-alpha)."""
    return np.roll(f[..., ::-1], 1, axis=-1)


def reflect(X):
    """X (..., 2, N) reflected in the x axis and counterclockwise again."""
    return mirror(X * np.array([[1.0], [-1.0]]))


def blob_case(N):
    """The blob and its density on N nodes, (2, N) each."""
    return blob(nodes(N)), blob_density(nodes(N))


def standing_off(offset):
    """Targets (13, 2) at the signed distance from the blob, on the normals at FEET."""
    return (blob(FEET) + offset * blob_normal(FEET)).T


def two_blobs(N):
    """X, f (2, 2, N) of two blobs apart, and targets (27, 2): 0.3 h outside the first, 0.4 h inside the second, one far away."""
    X, f = blob_case(N)
    second = [rotate(a, 2.0) + np.array([[0.42], [0.0]]) for a in (X, standing_off(-0.4 / N).T)]
    return np.stack([X, second[0]]), np.stack([f, 2 * f[::-1]]), np.concatenate([standing_off(0.3 / N), second[1].T, [[3.0, 1.0]]])


def dumbbell(N, neck):
    """Two lobes of half width 1 joined by a neck of the given width; negative: its sides cross."""
    t = nodes(N)
    return np.stack([np.cos(t), np.sin(t) * (0.5 * neck + 0.4 * np.cos(t) ** 2)])


def crowd(N):
    """Four curves (4, 2, N) of unlike sizes and shapes, some inside one another."""
    lobes = 0.25 * rotate(dumbbell(N, 0.2), 0.4) + np.array([[0.1], [0.25]])
    return np.stack([blob(nodes(N)), lobes, 0.3 * ellipse(N, 1.0, 0.2) + 0.1, circle(N, 0.02, (0.3, -0.1))])


def stokeslet_sum(x, y, g):
    """sum_n G(x - y_n) g_n for mu = 1. x: (P, 2), y, g: (2, n) -> (P, 2)."""
    r = x[:, :, None] - y
    r2 = (r**2).sum(axis=1, keepdims=True)
    return (-0.5 * np.log(r2) * g + r * (r * g).sum(axis=1, keepdims=True) / r2).sum(-1) / (4 * np.pi)


def blob_layer_by_trapezoid(x, density=blob_density, n=4096):
    """S[blob, density] (P, 2) at x (P, 2), mu = 1, no closer than 1.5e-3 to the curve: error e^(-2 pi n distance)."""
    t = nodes(n)
    return stokeslet_sum(x, blob(t), density(t) * np.hypot(*blob_derivative(t)) * 2 * np.pi / n)


def blob_layer_by_sinh(offset, n=600):
    """S[blob, density] (13, 2) at `standing_off(offset)`, mu = 1, at any distance, zero included.

    Gauss-Legendre in u with t - t0 = e sinh(u), e = |offset| / speed, which takes the near-singularity out of the integrand.
    Johnston & Elliott, Int. J. Numer. Meth. Engng 62 (2005).
    """
    z, w = gauss_legendre(n)
    values = []
    for x, t0 in zip(standing_off(offset), FEET, strict=True):
        e = max(abs(offset), 1e-14) / np.hypot(*blob_derivative(t0))
        half = np.arcsinh(np.pi / e)
        t = t0 + e * np.sinh(half * z)
        weight = w * half * e * np.cosh(half * z) * np.hypot(*blob_derivative(t))
        values.append(stokeslet_sum(x[None], blob(t), blob_density(t) * weight)[0])
    return np.array(values)


def blob_layer_by_kress(N):
    """S[blob, density] (2, N) at the blob's N nodes (mu = 1) by the product rule for log(4 sin^2((t - s)/2)).

    Kress, Linear Integral Equations (2014), section 12.3; Martensen's weights R.
    """
    t = nodes(N)
    m = np.arange(1, N // 2)
    R = -(4 * np.pi / N) * (np.cos(m * t[:, None]) / m).sum(-1) - 4 * np.pi / N**2 * np.cos(N // 2 * t)
    R = R[(np.arange(N)[:, None] - np.arange(N)) % N]
    gap = t[:, None] - t
    speed = np.hypot(*blob_derivative(t))
    tau = blob_derivative(t) / speed
    r = blob(t)[:, :, None] - blob(t)[:, None, :]
    diagonal = np.eye(N, dtype=bool)
    r2 = np.where(diagonal, 1.0, (r**2).sum(axis=0))
    smooth = np.where(diagonal, -np.log(speed), -0.5 * np.log(r2 / np.where(diagonal, 1.0, 4 * np.sin(gap / 2) ** 2)))
    rr = np.where(diagonal, tau[:, None, :, None] * tau[None, :, :, None], r[:, None] * r[None, :] / r2)
    g = blob_density(t) * speed
    return ((smooth * 2 * np.pi / N - R / 2) @ g.T + np.einsum("abij,bj->ia", rr, g) * 2 * np.pi / N).T / (4 * np.pi)


def dense_distance(x, targets, n=1 << 15):
    """Distance (P,) of targets (P, 2) to the trigonometric interpolant of x (2, N), by n points of it, and which lie inside."""
    N = x.shape[-1]
    points = np.fft.irfft(np.fft.rfft(x), n).T * (n / N)
    return cKDTree(points).query(targets)[0], shapely.contains_xy(shapely.Polygon(points), targets)
