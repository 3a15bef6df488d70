"""Pressure, vorticity and stress of point forces far from their curves: directly, or by Ewald's method. X: (M, 2, N).

    Phi = sum_k q_k/r,   D = -sum_k (conj(r) q_k/r^2 + sign conj(q_k)/r),   r = z - y_k,   q = f ds/(4 pi)

are `goursat`'s functions by the trapezoid rule, for the single layer (sign 1). With q = i mu tau_alpha/N and sign -1 they are those of a
double layer. Targets skip the curves close to them, which are not taken out again afterwards: the kernels are singular.

Ewald's split, lengths in units of the cut-off, z = s^2 r^2, kappa = |k|^2/(4 s^2), k = k_x + i k_y:

                     near, on a cell list             the rest, smooth                      its transform
    1/r              e^-z/r                           (1 - e^-z)/r                          -2 pi i/k e^-kappa
    conj(r)/r^2      (1 + z) e^-z conj(r)/r^2         (1 - (1 + z) e^-z) conj(r)/r^2        2 pi i conj(k)/k^2 (1 + kappa) e^-kappa

In free space the smooth kernels are sampled, turned off beyond the points, and transformed, as in `farfield_ewald`. In a periodic box the
transforms are a Fourier series without the mode k = 0: pressure, vorticity and deviatoric stress have no mean over the box.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from math import ceil, pi
from typing import Protocol

import numpy as np
import scipy.fft
from scipy.special import erfc

from biem.backend import compiled, count, threads
from biem.curves.lattice import Lattice
from biem.stokes.farfield_ewald import (
    CELL,
    MODES_PER_THREAD,
    Split,
    cell_list,
    choose_grid,
    nufft_module,
    pairs_in_squares,
    visiting_order,
)
from biem.stokes.farfield_periodic import NufftSeries, PlainSeries, choose, modes_of, periodic_schemes

LOOPS = "biem.stokes.stress_loop"
DIRECT_COST = 2.0e-9  # seconds on one core, per pair
PAIR_FACTOR, POINT_COST, FIXED_COST = 3.0, 2e-6, 5e-3  # of Ewald's sum: near pairs over those of velocities; per point; at all


class StressSum(Protocol):
    """The sum for fixed points."""

    def evaluate(self, q: np.ndarray, sign: float = 1.0, deviator: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Phi and D, complex (P,), for complex q (M, N). deviator: whether D is asked for; otherwise it is whatever comes."""
        ...


def stress_sum(targets: np.ndarray, X: np.ndarray, first: np.ndarray, skip: np.ndarray, far_field: str, tolerance: float) -> StressSum:
    """In free space, for targets (P, 2). skip[first[p] : first[p + 1]], sorted: the curves that target p skips.

    far_field: "direct", "ewald", or "auto", the cheaper one. tolerance: aimed-at error of "ewald", relative to the largest values.
    """
    P, S = len(targets), X.shape[0] * X.shape[2]
    if far_field == "direct" or P == 0 or (far_field == "auto" and find_spec("finufft") is None):
        return DirectStress(targets, X, first, skip)
    ewald = EwaldStress(targets, X, first, skip, tolerance)
    pays = ewald.cost + POINT_COST * (P + S) + FIXED_COST < DIRECT_COST * P * S
    return ewald if far_field == "ewald" or pays else DirectStress(targets, X, first, skip)


class DirectStress:
    """Directly."""

    def __init__(self, targets: np.ndarray, X: np.ndarray, first: np.ndarray, skip: np.ndarray) -> None:
        origin = X.mean(axis=(0, 2))
        self.x, self.Y = np.ascontiguousarray(targets - origin), np.ascontiguousarray(X - origin[:, None])
        self.first, self.skip = first, skip

    def evaluate(self, q: np.ndarray, sign: float = 1.0, deviator: bool = True) -> tuple[np.ndarray, np.ndarray]:
        count("stress_sum")
        values = compiled(LOOPS).direct(self.x, self.Y, _parts(q), sign, self.first, self.skip)
        return values[:, 0], values[:, 1]


class EwaldStress:
    """By Ewald's method in free space."""

    def __init__(self, targets: np.ndarray, X: np.ndarray, first: np.ndarray, skip: np.ndarray, tolerance: float) -> None:
        library, split = nufft_module(False), _split(tolerance)
        y = X.transpose(0, 2, 1).reshape(-1, 2)
        low, high = np.minimum(y.min(axis=0), targets.min(axis=0)), np.maximum(y.max(axis=0), targets.max(axis=0))
        extent = np.maximum(high - low, 1e-9 * float((high - low).max()))
        pairs, factor = pairs_in_squares(y - low, np.full(2, extent.max())), PAIR_FACTOR * len(targets) / len(y)
        grid = choose_grid(extent, max(len(targets), len(y)), lambda side: factor * pairs(side), split)
        self.cost, self.cutoff, self.shape, self.split = grid.cost, grid.cutoff, (grid.nx, grid.ny), split
        self.near = NearStress(targets, X, first, skip, grid.cutoff, split)
        workers = max(1, min(threads(), grid.nx * grid.ny // MODES_PER_THREAD))
        self.plans = []
        for kind, sign, points in ((1, -1, y), (2, 1, targets)):
            angles = [(points[:, i] - low[i]) / grid.cutoff * (2.0 * pi / (n * split.mesh)) for i, n in enumerate(self.shape)]
            plan = library.Plan(kind, self.shape, isign=sign, eps=split.nufft, modeord=1, nthreads=workers, upsampfac=split.upsampling)
            plan.setpts(*(np.ascontiguousarray(a) for a in angles))
            self.plans.append(plan)

    def evaluate(self, q: np.ndarray, sign: float = 1.0, deviator: bool = True) -> tuple[np.ndarray, np.ndarray]:
        count("stress_sum")
        count("ewald_stress")
        K1, K2 = _tables(*self.shape, self.split.s, self.split.mesh)
        modes = self.plans[0].execute(np.ascontiguousarray(q.ravel(), dtype=np.complex128))
        phi, D = self.near.evaluate(q, sign)
        phi = phi + self.plans[1].execute(K1 * modes)
        if deviator:
            D = D - self.plans[1].execute(K2 * modes + sign * K1 * _mirrored(modes))
        return phi / self.cutoff, D / self.cutoff


def periodic_cutoff(lattice: Lattice, targets: int, sources: int, tolerance: float) -> float:
    """The cheapest for so many."""
    pairs = lambda side: targets * sources * side * side / lattice.area
    return choose(lattice, targets, sources, tolerance, periodic_schemes(), pairs)[1].cutoff


class PeriodicStress:
    """In a periodic box. curves (M', 2, N): M curves and images of theirs, each of the curve source (M',), all that come within the cut-off
    of the targets (P, 2), which lie in the rectangle of the lattice.
    """

    def __init__(
        self,
        targets: np.ndarray,
        curves: np.ndarray,
        source: np.ndarray,
        first: np.ndarray,
        skip: np.ndarray,
        lattice: Lattice,
        tolerance: float,
        cutoff: float,
    ) -> None:
        split = _split(tolerance)
        self.source, self.cutoff = source, cutoff
        y = curves[: int(source.max()) + 1].transpose(0, 2, 1).reshape(-1, 2)
        shape = modes_of(lattice, split, cutoff)
        self.near = NearStress(targets, curves, first, skip, cutoff, split)
        of_sources, of_targets = 2.0 * pi * lattice.in_cell(y), 2.0 * pi * lattice.in_cell(targets)
        fast = "ewald" in periodic_schemes()
        self.series: NufftSeries | PlainSeries
        self.series = NufftSeries(of_sources, of_targets, shape, split, False) if fast else PlainSeries(of_sources, of_targets, shape)
        self.tables = _multipliers(lattice, *shape, split.s / cutoff)

    def evaluate(self, q: np.ndarray, sign: float = 1.0, deviator: bool = True) -> tuple[np.ndarray, np.ndarray]:
        count("stress_sum")
        count("periodic_stress")
        K1, K2 = self.tables
        modes = self.series.modes(np.ascontiguousarray(q.ravel(), dtype=np.complex128))
        phi, D = (near / self.cutoff for near in self.near.evaluate(q[self.source], sign))
        if deviator:
            D = D - self.series.values(K2 * modes + sign * K1 * _mirrored(modes))
        return phi + self.series.values(K1 * modes), D


class NearStress:
    """The near parts of the kernels within the cut-off, in its unit of length, less the smooth parts of the curves that a target skips."""

    def __init__(self, targets: np.ndarray, X: np.ndarray, first: np.ndarray, skip: np.ndarray, cutoff: float, split: Split) -> None:
        M, _, N = X.shape
        y = X.transpose(0, 2, 1).reshape(-1, 2)
        corner = y.min(axis=0)
        x, y = (targets - corner) / cutoff, (y - corner) / cutoff
        self.order, starts, nx, ny = cell_list(np, y)
        self.starts = starts[np.arange(nx)[:, None] * ny + np.arange(ny + 1)]
        self.x, self.visit = x, visiting_order(np, x, nx, ny)
        self.sorted, self.owner = y[self.order], self.order // N
        self.by_curve = np.ascontiguousarray(y.reshape(M, N, 2).transpose(0, 2, 1))
        self.first, self.skip, self.s2 = first, skip, split.s**2

    def evaluate(self, q: np.ndarray, sign: float) -> tuple[np.ndarray, np.ndarray]:
        flat = q.ravel()
        sources = np.stack([flat.real, flat.imag], axis=-1)[self.order]
        sorted_by_cell = self.sorted, sources, self.owner, self.starts, CELL, self.s2
        values = compiled(LOOPS).near_sum(self.x, self.visit, *sorted_by_cell, self.by_curve, _parts(q), sign, self.first, self.skip)
        return values[:, 0], values[:, 1]


def _parts(q: np.ndarray) -> np.ndarray:
    """Real and imaginary parts (M, 2, N)."""
    return np.ascontiguousarray(np.stack([q.real, q.imag], axis=1))


def _split(tolerance: float) -> Split:
    """Where (1 + z) e^-z, not e^-z, is small enough at the cut-off."""
    return Split.of(tolerance / (1.0 + Split.of(tolerance).s ** 2))


def _mirrored(modes: np.ndarray) -> np.ndarray:
    """conj of the modes of -k, in FFT order."""
    return np.roll(modes[::-1, ::-1], (1, 1), axis=(0, 1)).conj()


@lru_cache(maxsize=4)
def _tables(nx: int, ny: int, s: float, mesh: float) -> tuple[np.ndarray, np.ndarray]:
    """Transforms over nx ny, in FFT order, of the two smooth kernels, turned off beyond half a period."""
    beyond = ceil(1.0 / mesh)
    x, y = (mesh * np.arange(-(n // 2) - beyond, n // 2 + beyond + 1) for n in (nx, ny))
    window_x, window_y = (0.5 * erfc(s * (np.abs(t) - 0.5 * n * mesh)) for t, n in ((x, nx), (y, ny)))
    window = window_x[:, None] * window_y
    window[len(x) // 2, len(y) // 2] = 0.0  # both vanish at r = 0
    r = x[:, None] + 1j * y
    r[r == 0.0] = 1.0
    z = s * s * (r.real**2 + r.imag**2)
    decay = np.exp(-z)
    kernels = window * (1.0 - decay) / r, window * r.conj() / r**2 * (1.0 - (1.0 + z) * decay)
    K1, K2 = (_transform(kernel, beyond) / (nx * ny) for kernel in kernels)
    return K1, K2


def _transform(a: np.ndarray, beyond: int) -> np.ndarray:
    """FFT of samples about the centre, those beyond half a period added to their periodic images."""
    for _ in range(2):
        n = a.shape[0] - 2 * beyond - 1
        folded = a[beyond : beyond + n].copy()
        folded[n - beyond :] += a[:beyond]
        folded[: beyond + 1] += a[beyond + n :]
        a = np.fft.ifftshift(folded, axes=0).T
    return scipy.fft.fft2(a)


@lru_cache(maxsize=4)
def _multipliers(lattice: Lattice, nx: int, ny: int, xi: float) -> tuple[np.ndarray, np.ndarray]:
    """The transforms of the two smooth kernels over the area of the box (nx, ny), modes in FFT order; xi = s over the cut-off."""
    m, n = (np.fft.fftfreq(N, 1.0 / N) for N in (nx, ny))
    vectors = lattice.reciprocal @ np.array([1.0, 1.0j])
    k = m[:, None] * vectors[0] + n * vectors[1]
    k[0, 0] = 1.0
    kappa = (k.real**2 + k.imag**2) / (4.0 * xi * xi)
    K1 = -2j * pi / (lattice.area * k) * np.exp(-kappa)
    K2 = 2j * pi * k.conj() / (lattice.area * k * k) * (1.0 + kappa) * np.exp(-kappa)
    K1[0, 0] = K2[0, 0] = 0.0
    return K1, K2
