"""Layers next to their curves: velocity, pressure, vorticity and stress at any distance, by Goursat functions. X: (M, 2, N).

Complex notation, about the centre of each curve: w on the curve, t its unit tangent, z the target, C[g](z) = 1/(2 pi i) int g dw/(w - z).

    single layer of f:    a = -i/2 f/t,      b = -i/2 conj(f)/t
    double layer of tau:  a = mu tau_s/t,    b = mu conj(tau_s)/t

    Phi = C[a],   E = C[conj(w) a]' + C[b]
    p - i mu omega = 2 Phi                                        pressure and vorticity
    (s_xx - s_yy)/2 - i s_xy = conj(z) Phi' - E                   deviatoric stress
    2 mu u = P + z conj(Phi) - conj(Q) + kappa - 2 q log|z - c|,  P' = -Phi,  Q' = E

Outside, q = int f ds/(4 pi), c is a point inside the curve, P + q log(z - c) and Q - conj(q) log(z - c) are single-valued and, as P and Q
from here on, vanish at infinity, and kappa = q. Inside there is no logarithm, and kappa makes u continuous, or jump by tau.

All functions are holomorphic on either side. Their boundary values at n nodes come from the Cauchy integral with its singularity
subtracted, and from derivatives and integrals along the curve; their values at targets from the quotients

    v(z) = sum_k v_k p_k / S,    p_k = w'_k/(w_k - z),    S = sum_k p_k inside, sum_k p_k - i n outside.

n is doubled, from 128 or 2 N, until the boundary values are resolved. What an N-node curve and density are between the nodes is their
trigonometric interpolant. Barnett, Wu & Veerapaneni, SIAM J. Sci. Comput. 37 (2015); Pozrikidis (1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
import shapely

from biem.backend import compiled, count
from biem.curves.crossing import polygons
from biem.curves.curve import center_of_nodes
from biem.curves.fourier import derivative, resample

LOOPS = "biem.stokes.goursat_loop"
FIRST, LARGEST = 128, 2048  # nodes to begin with, at least, and to end with
TAIL = 0.25  # share of the modes, the highest ones, whose size tells whether the others are enough
DEVIATOR, POTENTIAL, ALL = (
    0,
    2,
    5,
)  # of the functions Phi', E, Phi, P, Q: where those of stress, of pressure begin, and those of velocity end


@dataclass(frozen=True)
class Close:
    """Values of layers, one curve each, at Q targets: velocity (Q, 2); Phi and D = conj(z) Phi' - E, complex (Q,). Empty: not asked for."""

    velocity: np.ndarray
    potential: np.ndarray
    deviator: np.ndarray


@dataclass(frozen=True)
class Level:
    """Curves on n nodes, V of them. vesicle (V,): which of all they are. Values are outside, then inside.

    w, w_alpha (V, 2, n) and values (2, V, 5, 2, n) of Phi', E, Phi, P, Q: real and imaginary parts; kappa (2, V), q, c and center (V,):
    complex.
    """

    vesicle: np.ndarray
    center: np.ndarray
    w: np.ndarray
    w_alpha: np.ndarray
    values: np.ndarray
    kappa: np.ndarray
    q: np.ndarray
    c: np.ndarray

    def subset(self, which: np.ndarray) -> Level:
        """The curves that a mask selects."""
        if which.all():
            return self
        by_side = {"values": self.values[:, which], "kappa": self.kappa[:, which]}
        names = (name for name in self.__dataclass_fields__ if name not in by_side)
        return Level(**{name: getattr(self, name)[which] for name in names}, **by_side)

    def functions(self, z: np.ndarray, curve: np.ndarray, side: np.ndarray, which: slice) -> np.ndarray:
        """Those of the five (which, Q) at z (Q,), about the centres of their curves."""
        values = np.ascontiguousarray(self.values[:, :, which])
        lift = np.array([-1j * self.w.shape[-1], 0.0])
        return compiled(LOOPS).quotients(z, curve, side, self.w, self.w_alpha, values, lift).T


@dataclass(frozen=True)
class GoursatFunctions:
    """Of the layers of some of the curves X (M, 2, N), and their evaluation."""

    mu: float
    levels: tuple[Level, ...]

    @classmethod
    def build(
        cls,
        X: np.ndarray,
        single: np.ndarray | None,
        double: np.ndarray | None,
        vesicle: np.ndarray,
        mu: float,
        tolerance: float,
    ) -> GoursatFunctions:
        """Single layers of the densities f, double layers of tau (M, 2, N), or both, of the curves vesicle (V,), each named once.

        tolerance: of the boundary values, relative to the largest.
        """
        count("goursat", len(vesicle))
        levels: list[Level] = []
        n = max(FIRST, 2 * X.shape[-1])
        while len(vesicle):
            f, tau = (None if density is None else density[vesicle] for density in (single, double))
            level, tail = _level(X[vesicle], f, tau, vesicle, n, mu)
            resolved = (tail <= tolerance) | (n >= LARGEST)
            if resolved.any():
                levels.append(level.subset(resolved))
            vesicle = vesicle[~resolved]
            n *= 2
        return cls(mu, tuple(levels))

    def evaluate(self, points: np.ndarray, vesicle: np.ndarray, outside: np.ndarray, velocity: bool = True, deviator: bool = True) -> Close:
        """At points (Q, 2), each of the curve vesicle[q] alone, on the side that `outside` (Q,) says, on the curve its limit from there.

        velocity, deviator: whether they are asked for; Phi comes always.
        """
        Q = len(points)
        u, phi, D = (np.empty(Q if asked else 0, dtype=np.complex128) for asked in (velocity, True, deviator))
        which = slice(DEVIATOR if deviator else POTENTIAL, ALL if velocity else POTENTIAL + 1)
        for level in self.levels:
            slot = np.full(1 + max(int(vesicle.max(initial=0)), int(level.vesicle.max())), -1)
            slot[level.vesicle] = np.arange(len(level.vesicle))
            here = np.flatnonzero(slot[vesicle] >= 0)
            curve, side = slot[vesicle[here]], np.where(outside[here], 0, 1)
            z = points[here] @ np.array([1.0, 1.0j]) - level.center[curve]
            found = level.functions(z, curve, side, which)
            phi[here] = found[POTENTIAL - which.start]
            if deviator:
                D[here] = z.conj() * found[0] - found[1]
            if velocity:
                value = found[-2] + z * phi[here].conj() - found[-1].conj() + level.kappa[side, curve]
                out = side == 0
                value[out] -= 2.0 * level.q[curve[out]] * np.log(np.abs(z[out] - level.c[curve[out]]))
                u[here] = value / (2.0 * self.mu)
        return Close(np.stack([u.real, u.imag], axis=-1), phi, D)


def _level(
    X: np.ndarray, single: np.ndarray | None, double: np.ndarray | None, vesicle: np.ndarray, n: int, mu: float
) -> tuple[Level, np.ndarray]:
    """The curves on n nodes, and of each how large the highest modes of Phi', E and Phi are, relative (V,)."""
    center = center_of_nodes(X)
    fine = resample(X - center, n)
    w, w_alpha = _complex(fine), _complex(derivative(fine))
    inner = shapely.get_coordinates(shapely.point_on_surface(polygons(X - center)))
    c = inner[:, 0] + 1j * inner[:, 1]
    a, b, q, jump = (np.zeros_like(w) for _ in range(4))
    q = q[:, 0]
    if single is not None:
        force, speed = _complex(resample(single, n)), np.abs(w_alpha)
        a, b = -0.5j * speed / w_alpha * force, -0.5j * speed / w_alpha * force.conj()
        q = 0.5 * (force * speed).mean(axis=-1)
    if double is not None:
        tau = _complex(resample(double, n))
        slope = _derivative(tau)
        a, b, jump = a + mu * slope / w_alpha, b + mu * slope.conj() / w_alpha, 2.0 * mu * tau

    densities = np.stack([a, w.conj() * a, b], axis=1)
    outside = compiled(LOOPS).cauchy_outside(w, w_alpha, densities, _derivative(densities))
    to_c = w_alpha / (w - c[:, None])
    values = np.stack([_functions(outside, w_alpha, to_c, q), _functions(outside + densities, w_alpha, to_c, 0.0 * q)])
    values[0, :, 3:] += 1j * (values[0, :, 3:] * to_c[:, None]).mean(axis=-1, keepdims=True)  # less what they are at infinity
    outer, inner_side = (P + w * phi.conj() - Q.conj() for _, _, phi, P, Q in values.transpose(0, 2, 1, 3))
    outer = outer + (q - 2.0 * q * np.log(np.abs(w - c[:, None])).T).T
    kappa = np.stack([q, (outer - jump - inner_side).mean(axis=-1)])
    apart = lambda f, axis: np.ascontiguousarray(np.stack([f.real, f.imag], axis=axis))
    level = Level(vesicle, _complex(center)[:, 0], apart(w, 1), apart(w_alpha, 1), apart(values, 3), kappa, q, c)
    size = n * np.abs(a).max(axis=-1)  # what the functions are compared with where they are small, as outside of a circle under pressure
    least = np.stack([size / np.abs(w).max(axis=-1), size, size], axis=-1)
    return level, _tail(values[0, :, : POTENTIAL + 1], least)


def _functions(boundary: np.ndarray, w_alpha: np.ndarray, to_c: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Phi', E, Phi, P, Q (V, 5, n) on one side from the boundary values (V, 3, n) of C[a], C[conj(w) a], C[b].

    to_c (V, n): d/dalpha log(w - c), of which q (V,) and conj(q) times make P and Q single-valued.
    """
    phi, moment, rest = boundary.transpose(1, 0, 2)
    E = _derivative(moment) / w_alpha + rest
    P = _integral(q[:, None] * to_c - phi * w_alpha)
    Q = _integral(E * w_alpha - q[:, None].conj() * to_c)
    return np.stack([_derivative(phi) / w_alpha, E, phi, P, Q], axis=1)


def _tail(values: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Largest of the highest modes of each curve's functions (V, K, n) over the largest of all of them, or over `least` (V, K): (V,)."""
    n = values.shape[-1]
    size = np.abs(scipy.fft.fft(values))
    high = size[..., round(0.5 * (1.0 - TAIL) * n) : round(0.5 * (1.0 + TAIL) * n)]
    largest = np.maximum(size.max(axis=-1), least)
    return (high.max(axis=-1) / np.where(largest > 0.0, largest, 1.0)).max(axis=-1)


def _derivative(f: np.ndarray) -> np.ndarray:
    """df/dalpha of complex values (..., n)."""
    return scipy.fft.ifft(1j * _wavenumbers(f.shape[-1]) * scipy.fft.fft(f))


def _integral(f: np.ndarray) -> np.ndarray:
    """The periodic function of mean 0 whose derivative is f (..., n) less its mean."""
    k = _wavenumbers(f.shape[-1])
    return scipy.fft.ifft(np.where(k == 0.0, 0.0, -1j / np.where(k == 0.0, 1.0, k)) * scipy.fft.fft(f))


def _wavenumbers(n: int) -> np.ndarray:
    """In FFT order, the Nyquist mode set to zero."""
    k = np.fft.fftfreq(n, 1.0 / n)
    k[n // 2] = 0.0
    return k


def _complex(f: np.ndarray) -> np.ndarray:
    """x + i y (V, n) of f (V, 2, n)."""
    return f[:, 0] + 1j * f[:, 1]
