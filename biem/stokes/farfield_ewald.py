"""Pair sum of Stokeslets by Ewald's method in free space: near pairs on a cell list, the smooth rest by nonuniform FFTs.

Hasimoto's split in the plane, lengths in units of the cut-off r_c, z = s^2 r^2:
    4 pi mu G_R = (E1(z)/2 - e^-z) I + e^-z r r^T / r^2,        below e^-s^2 beyond r = 1, dropped there
    4 pi mu G_F = 4 pi mu (G - G_R) = S I + (D/2) [[cos 2t, sin 2t], [sin 2t, -cos 2t]],
                  S = -log r - E1(z)/2 + (1 + e^-z)/2,  D = 1 - e^-z,  t: direction of r
G_F is smooth with a spectrum like e^(-k^2/4s^2). It is needed only for separations within the box of the points, so there it is
sampled on a mesh of step pi/(2 s^2), turned off over |x| = half a period -+ 1 by erfc(s .)/2 in each direction, and transformed once:
the table depends on the numbers of modes and on s alone, not on the points or their unit of length. (Vico, Greengard & Ferrando 2016
cut radially instead, which takes a longer period, much longer in a thin box.) The two components of force travel as one complex
number g = g_x + i g_y: u^(k) = S^(k) g^(k) + (D/2 e^2it)^(k) conj(g^(-k)).

The curve that a target skips is included in both parts and subtracted by the exact kernel. With several threads the spreading of the
nonuniform FFT adds in no fixed order: results then agree to rounding, not bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from math import ceil, log, log2, pi, sqrt
from typing import Any

import numpy as np
import scipy.fft
from array_api_compat import is_torch_array
from scipy.special import erfc, exp1

from biem.backend import Array, array_namespace, compiled, count, from_numpy, threads, to_numpy
from biem.stokes.farfield_direct import own_sum, own_sum_of_arrays
from biem.stokes.kernels import stokeslet_prefactor

BITS, FIRST = 7, -24  # real-space table: 2^7 cubics an octave of r^2, from 2^-24
SAFETY = 0.3  # of the tolerance, for either truncation: forces that cancel make the velocity smaller than the sum of its parts
NARROW = 2e-10  # finest tolerance of finufft with upsampling 1.25, whose window is wider; with 2 it errs more, see `Split.of`
MODES_PER_THREAD = 1 << 19  # of the nonuniform FFT; more threads on fewer modes cost more than they save
MODES_PER_POINT, FEWEST_MODES = 32, 1 << 16  # memory of the Fourier part stays linear in the number of points
FFT_COST, PAIR_COST = 4.5e-9, 4.5e-9  # seconds: per mode and log2(modes), both transforms; per pair of the near sum (docs/measurements.md)
CHUNK = 1 << 20  # pairs of one temporary of the near sum on tensors


# ---------------------------------------------------------------------------------------------------------------- split and tables


@dataclass(frozen=True)
class Split:
    """What the tolerance fixes: s = xi r_c, the mesh step in units of r_c, the nonuniform FFT's tolerance and upsampling."""

    s: float
    mesh: float
    nufft: float
    upsampling: float

    @classmethod
    def of(cls, tolerance: float) -> Split:
        s2 = -log(SAFETY * tolerance)
        narrow = tolerance >= 1e-9
        nufft = max(0.1 * tolerance, 1.01 * NARROW) if narrow else max(0.03 * tolerance, 1e-14)
        return cls(sqrt(s2), 0.5 * pi / s2, nufft, 1.25 if narrow else 2.0)


def screened(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E1(z)/2 - e^-z and e^-z."""
    decay = np.exp(-z)
    return 0.5 * exp1(z) - decay, decay


@lru_cache(maxsize=16)
def real_table(s: float) -> np.ndarray:
    """Cubics of F1 = E1(z)/2 - e^-z and F2 = e^-z/r^2 in pieces of r^2, (pieces + 2, 8), interleaved; see `ewald_loop.near_sum`.

    A row of zeros stands for r >= 1; the last one holds the first terms of the series below the table.
    """
    nodes = 0.5 - 0.5 * np.cos(pi * (np.arange(4) + 0.5) / 4)  # Chebyshev
    octave = 2.0 ** np.arange(FIRST, 0)[:, None, None]
    r2 = octave * (1.0 + (np.arange(1 << BITS)[:, None] + nodes) / (1 << BITS))
    f1, decay = screened(s * s * r2)
    fit = np.linalg.inv(np.vander(nodes, 4, increasing=True)).T
    cubics = np.stack([(f @ fit).reshape(-1, 4) for f in (f1, decay / r2)], axis=-1).reshape(-1, 8)
    z_1 = s * s  # z at r = 1;  E1(z)/2 - e^-z = -gamma_E/2 - log(z)/2 - 1 + 3z/2,  e^-z/r^2 = 1/r^2 - s^2
    series = [-0.5 * np.euler_gamma - 0.5 * log(z_1) - 1.0, 1.5 * z_1, -z_1, 0, 0, 0, 0, 0]
    return np.concatenate([cubics, np.zeros((1, 8)), np.array([series])])


@lru_cache(maxsize=4)
def fourier_table(nx: int, ny: int, s: float, mesh: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """S^, A^, B^ (nx/2 + 1, ny/2 + 1): transforms of S and D/2 (cos 2t, sin 2t) for k >= 0 over nx ny; and the mean taken out of S."""
    beyond = ceil(1.0 / mesh)  # half the width over which the kernel is turned off, in mesh steps
    x, y = (mesh * np.arange(n // 2 + beyond + 1) for n in (nx, ny))
    window_x, window_y = (0.5 * erfc(s * (t - 0.5 * n * mesh)) for t, n in ((x, nx), (y, ny)))
    r2 = x[:, None] ** 2 + y**2
    r2[0, 0] = 1.0
    S, D = 0.5 - 0.5 * np.log(r2), np.ones_like(r2)
    close = s * s * r2 < 40.0
    f1, decay = screened(s * s * r2[close])
    S[close] -= f1 + 0.5 * decay
    D[close] -= decay
    S[0, 0], D[0, 0] = 0.5 * np.euler_gamma + log(s) + 1.0, 0.0
    window = window_x[:, None] * window_y
    D *= window / r2
    S = fold(S * window, beyond, 1)
    A = fold(0.5 * D * (x[:, None] ** 2 - y**2), beyond, 1)
    B = fold(D * x[:, None] * y, beyond, -1)
    S, A = (scipy.fft.dctn(a, type=1) / (nx * ny) for a in (S, A))
    B = np.pad(-scipy.fft.dstn(B[1:-1, 1:-1], type=1) / (nx * ny), 1)
    for a in (S, A, B):  # the modes +n/2 and -n/2 are one; they are below the tolerance
        a[-1], a[:, -1] = 0.0, 0.0
    mean, S[0, 0] = float(S[0, 0]), 0.0
    return S, A, B, mean


def fold(a: np.ndarray, beyond: int, sign: int) -> np.ndarray:
    """Add (sign -1: subtract) what lies beyond half a period to its mirror image, along both axes."""
    for _ in range(2):
        half = a.shape[0] - beyond - 1
        a[half - beyond : half + 1] += sign * a[: half - 1 : -1]
        a = a[: half + 1].T
    return a


# ------------------------------------------------------------------------------------------------------------------ cut-off and modes


@dataclass(frozen=True)
class Grid:
    """Numbers of modes, cut-off, and the seconds that one evaluation is expected to take on one core."""

    nx: int
    ny: int
    cutoff: float
    cost: float


def choose_grid(extent: np.ndarray, points: int, pairs: Callable[[float], float], split: Split) -> Grid:
    """The cheapest cut-off for `points` sources in a box `extent` (2,); pairs(side): pairs that share a square of that side.

    The period is 2 extent + 4 cut-offs: separations reach extent + 1 cut-off (targets may stand out by so much), and the kernel is
    turned off over two more, one on each side. The longer direction takes a size of a coarse list, so a slowly moving cloud keeps its
    tables.
    """
    longest = float(extent.max())
    limit = max(FEWEST_MODES, MODES_PER_POINT * points)
    best: Grid | None = None
    for n in sorted(m << e for m in (4, 5, 6) for e in range(2, 27)):
        if n * split.mesh < 6.0:
            continue
        cutoff = 2.0 * longest / (n * split.mesh - 4.0)
        nx, ny = (n if e == longest else 2 * scipy.fft.next_fast_len(ceil((e / cutoff + 2.0) / split.mesh), True) for e in extent)
        if best is not None and nx * ny > limit:
            break
        cost = FFT_COST * nx * ny * log2(nx * ny) + PAIR_COST * pairs(2.5 * cutoff)
        if best is None or cost < best.cost:
            best = Grid(nx, ny, cutoff, cost)
    assert best is not None
    return best


def pairs_in_squares(x: np.ndarray, extent: np.ndarray, finest: int = 512) -> Callable[[float], float]:
    """side -> number of pairs of points x (S, 2), 0 <= x <= extent, that share a square of that side, from a histogram of finest^2 bins."""
    side = float(extent.max()) / finest
    index = np.minimum((x / side).astype(np.int64), finest - 1)
    H = np.bincount(index[:, 0] * finest + index[:, 1], minlength=finest * finest).reshape(finest, finest).astype(np.float64)
    log_side, log_pairs = [], []
    while True:
        log_side.append(log(side * finest / H.shape[0]))
        log_pairs.append(log(float(np.sum(H * H))))
        if H.shape[0] == 1:
            return lambda side: float(np.exp(np.interp(log(side), log_side, log_pairs)))
        H = H.reshape(H.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3))


def uniform_grid(extent: tuple[float, float], points: int, tolerance: float) -> Grid:
    """The grid of points spread evenly over a box."""
    box = np.maximum(np.asarray(extent, dtype=np.float64), 1e-6 * max(extent))
    area = float(np.prod(box))
    return choose_grid(box, points, lambda side: points * max(1.0, points * min(1.0, side * side / area)), Split.of(tolerance))


# ---------------------------------------------------------------------------------------------------------------------------- the sum


def nufft_module(cuda: bool) -> Any:
    """finufft, or cufinufft for CUDA. Raises ValueError where it is not installed."""
    name, extra = ("cufinufft", "gpu") if cuda else ("finufft", "fast")
    try:
        return import_module(name)
    except ImportError:
        raise ValueError(f'far_field = "ewald" needs {name}: pip install \'vesnet[{extra}]\', or choose "direct"') from None


class EwaldSum:
    """The pair sum for fixed points. targets (P, 2) with P > 0, X (M, 2, N), exclude (P,); see `farfield_direct.direct_sum`.

    The relative L2 error against the direct sum is below 3 tolerance. compiled: whether the near sum runs in the compiled loop (float64
    on the CPU, whatever the dtype of the arrays) or as an array-API sum on the arrays' device and in their dtype; default: the loop on
    the CPU. Coordinates that are not finite give NaN: a target's at that target, a source's everywhere.
    """

    def __init__(
        self, targets: Array, X: Array, mu: float, exclude: Array | None = None, tolerance: float = 1e-6, compiled: bool | None = None
    ) -> None:
        self.like, self.mu = X, mu
        cuda = is_torch_array(X) and X.device.type == "cuda"
        self.compiled = not cuda if compiled is None else compiled
        self.library = nufft_module(cuda)
        if self.compiled:
            targets, X = (np.asarray(to_numpy(a), dtype=np.float64) for a in (targets, X))
            exclude = None if exclude is None else to_numpy(exclude)
        xp = array_namespace(X)
        M, _, N = X.shape
        self.exclude = exclude
        y = xp.reshape(xp.permute_dims(X, (0, 2, 1)), (M * N, 2))
        self.finite = bool(xp.all(xp.isfinite(y)))
        y = y if self.finite else xp.where(xp.isfinite(y), y, xp.zeros_like(y))
        low, high = xp.min(y, axis=0), xp.max(y, axis=0)
        center = 0.5 * (low + high)
        self.lost = ~xp.all(xp.isfinite(targets), axis=-1)  # (P,)
        x = xp.where(self.lost[:, None], xp.zeros_like(targets), targets - center)
        y = y - center
        self.x, self.y = x, xp.permute_dims(xp.reshape(y, (M, N, 2)), (0, 2, 1))
        split = Split.of(tolerance)
        self.grid = self._grid(to_numpy(x), to_numpy(y), split)
        self.self_term = log(self.grid.cutoff) - (0.5 * np.euler_gamma + log(split.s) + 1.0)
        x, y = x / self.grid.cutoff, y / self.grid.cutoff
        self.near = (CompiledNear if self.compiled else ArrayNear)(x, y, split, self.self_term)
        self.smooth = Smooth(x, y, self.grid, split, self.library, cuda)

    @staticmethod
    def _grid(x: np.ndarray, y: np.ndarray, split: Split) -> Grid:
        """From the sources alone where the targets lie among them, so that any part of the targets gets the same values."""
        low, high = y.min(axis=0), y.max(axis=0)
        reach = np.max([high - low, x.max(axis=0) - low, high - x.min(axis=0)], axis=0).astype(np.float64)
        longest = float((high - low).max()) or float(reach.max()) or 1.0
        extent = np.maximum((high - low).astype(np.float64), 1e-9 * longest)
        grid = choose_grid(extent, len(y), pairs_in_squares(y - low, np.asarray([longest, longest])), split)
        if np.all(reach <= extent + grid.cutoff):
            return grid
        extent = np.maximum(extent, reach)
        return choose_grid(extent, len(y), pairs_in_squares(y - low, np.full(2, extent.max())), split)

    def velocity(self, weighted_force: Array) -> Array:
        """(P, 2) for weighted_force = f ds (M, 2, N)."""
        count("pair_sum")
        count("ewald_sum")
        g = np.asarray(to_numpy(weighted_force), dtype=np.float64) if self.compiled else weighted_force
        xp = array_namespace(g)
        flat = xp.reshape(xp.permute_dims(g, (0, 2, 1)), (-1, 2))
        u = self.near(flat) + self.smooth(flat)
        u = u + (self.smooth.mean - log(self.grid.cutoff)) * xp.sum(flat, axis=0)
        u = stokeslet_prefactor(self.mu) * u
        if self.exclude is not None:
            own = own_sum if self.compiled else own_sum_of_arrays
            u = u - own(self.x, self.y, g, self.exclude, self.mu)
        lost = self.lost if self.finite else xp.ones_like(self.lost)
        u = xp.where(lost[:, None], xp.full_like(u, xp.nan), u)
        return from_numpy(u, like=self.like) if self.compiled else u


class Smooth:
    """4 pi mu G_F, but for the mean of S, at points x (P, 2) of forces at y (S, 2), in units of the cut-off, by nonuniform FFTs."""

    def __init__(self, x: Array, y: Array, grid: Grid, split: Split, library: Any, cuda: bool) -> None:
        S, A, B, self.mean = fourier_table(grid.nx, grid.ny, split.s, split.mesh)
        self.cuda, self.shape = cuda, (grid.nx, grid.ny)
        xp = array_namespace(x)
        self.compiled = not is_torch_array(x)
        self.table = (S, A, B) if self.compiled else tuple(from_numpy(a, like=x) for a in full_table(S, A, B))
        workers = max(1, min(threads(), grid.nx * grid.ny // MODES_PER_THREAD))
        single = x.dtype == xp.float32
        options: dict[str, Any] = {
            "eps": max(split.nufft, 1e-6) if single else split.nufft,
            "dtype": "complex64" if single else "complex128",
        }
        options |= {"modeord": 1} if cuda else {"modeord": 1, "nthreads": workers, "upsampfac": split.upsampling}
        self.plans = []
        for kind, sign, points in ((1, -1, y), (2, 1, x)):
            angles = [points[:, i] * (2.0 * pi / (n * split.mesh)) for i, n in enumerate(self.shape)]
            plan = library.Plan(kind, self.shape, isign=sign, **options)
            plan.setpts(*(a if cuda else np.ascontiguousarray(to_numpy(a)) for a in angles))
            self.plans.append(plan)

    def __call__(self, g: Array) -> Array:
        """(P, 2) for g (S, 2)."""
        xp = array_namespace(g)
        modes = self._execute(0, g[:, 0] + 1j * g[:, 1])
        if self.compiled:
            compiled("biem.stokes.ewald_loop").multiply(modes, *self.table)
        else:
            S, A, B = self.table
            mirrored = xp.roll(xp.flip(modes, axis=(0, 1)), (1, 1), axis=(0, 1))
            modes = S * modes + (A + 1j * B) * xp.conj(mirrored)
        u = self._execute(1, modes)
        return xp.stack([xp.real(u), xp.imag(u)], axis=-1)

    def _execute(self, which: int, a: Array) -> Array:
        if self.compiled or self.cuda:
            return self.plans[which].execute(a)
        return array_namespace(a).asarray(self.plans[which].execute(to_numpy(a)))


def full_table(*quadrants: np.ndarray) -> tuple[np.ndarray, ...]:
    """S^, A^, B^ on all modes in FFT order, from their quadrants; the last one is odd in both directions."""
    nx, ny = (2 * (n - 1) for n in quadrants[0].shape)
    k, q = np.arange(nx), np.arange(ny)
    sign = np.where(k < nx // 2, 1.0, -1.0)[:, None] * np.where(q < ny // 2, 1.0, -1.0)
    S, A, B = (a[np.ix_(np.minimum(k, nx - k), np.minimum(q, ny - q))] for a in quadrants)
    return S, A, sign * B


# ---------------------------------------------------------------------------------------------------------------------------- near sum

CELL = 0.25  # side of a cell in units of the cut-off


def cell_list(xp: Any, y: Array) -> tuple[Array, Array, int, int]:
    """Order of the sources by cell, first source of each cell (nx ny + 1,), nx, ny. y (S, 2): from the lower left corner."""
    cell = xp.astype(y / CELL, xp.int64)
    nx, ny = (int(xp.max(cell[:, i])) + 1 for i in (0, 1))
    key = cell[:, 0] * ny + cell[:, 1]
    order = xp.argsort(key, stable=True)
    return order, xp.searchsorted(xp.take(key, order), xp.arange(nx * ny + 1, device=key.device)), nx, ny


def visiting_order(xp: Any, x: Array, nx: int, ny: int) -> Array:
    """Order of the targets by cell, so that neighbours in it read the same sources."""
    cell = [xp.astype(xp.clip(xp.floor(x[:, i] / CELL), -1.0, float(n)), xp.int64) for i, n in ((0, nx), (1, ny))]
    return xp.argsort(cell[0] * (ny + 2) + cell[1], stable=True)


class CompiledNear:
    """4 pi mu G_R by the compiled loop. x (P, 2), y (S, 2) in units of the cut-off."""

    def __init__(self, x: np.ndarray, y: np.ndarray, split: Split, self_term: float) -> None:
        low = y.min(axis=0)
        self.x, self.self_term, self.table = x - low, self_term, real_table(split.s)
        y = y - low
        self.sources_order, starts, nx, ny = cell_list(np, y)
        self.starts = starts[np.arange(nx)[:, None] * ny + np.arange(ny + 1)]
        self.order = visiting_order(np, self.x, nx, ny)
        self.y = y[self.sources_order]

    def __call__(self, g: np.ndarray) -> np.ndarray:
        sources = np.concatenate([self.y, g[self.sources_order]], axis=1)
        near_sum = compiled("biem.stokes.ewald_loop").near_sum
        return near_sum(self.x, self.order, sources, self.starts, CELL, self.table, BITS, FIRST, self.self_term)


class ArrayNear:
    """4 pi mu G_R by sums over padded lists of near sources, on any device. x (P, 2), y (S, 2) in units of the cut-off."""

    def __init__(self, x: Array, y: Array, split: Split, self_term: float) -> None:
        xp = array_namespace(x)
        self.self_term, self.table = self_term, from_numpy(real_table(split.s), like=x)
        low = xp.min(y, axis=0)
        x, y = x - low, y - low
        self.sources_order, starts, nx, ny = cell_list(xp, y)
        order = visiting_order(xp, x, nx, ny)
        self.back = xp.argsort(order)
        self.x = xp.take(x, order, axis=0)
        around = xp.arange(-ceil(1 / CELL), ceil(1 / CELL) + 1, dtype=x.dtype, device=x.device)
        row = xp.floor(self.x[:, :1] / CELL) + around  # (P, rows)
        away = xp.clip(xp.maximum(CELL * row - self.x[:, :1], self.x[:, :1] - CELL * (row + 1.0)), 0.0, 1.0)
        reach = xp.sqrt(1.0 - away * away)
        ends = (xp.floor((self.x[:, 1:] - reach) / CELL), xp.floor((self.x[:, 1:] + reach) / CELL) + 1.0)
        inside = (row >= 0.0) & (row < nx)
        first = xp.where(inside, row, xp.zeros_like(row)) * ny
        begin, end = (xp.astype(first + xp.clip(a, 0.0, float(ny)), xp.int64) for a in ends)
        self.begin = xp.reshape(xp.take(starts, xp.reshape(begin, (-1,))), row.shape)
        end = xp.reshape(xp.take(starts, xp.reshape(end, (-1,))), row.shape)
        self.length = xp.where(inside, end - self.begin, xp.zeros_like(end))
        self.y = xp.take(y, self.sources_order, axis=0)
        longest = np.maximum(to_numpy(xp.max(self.length, axis=1)), 1)
        self.chunks = []
        start, rows = 0, int(row.shape[1])
        while start < len(longest):
            widest = np.maximum.accumulate(longest[start : start + CHUNK // rows])
            pairs = rows * widest * np.arange(1, len(widest) + 1)
            stop = start + max(1, int(np.searchsorted(pairs, CHUNK)))
            self.chunks.append((slice(start, stop), int(longest[start:stop].max())))
            start = stop

    def __call__(self, g: Array) -> Array:
        xp = array_namespace(g)
        g = xp.take(g, self.sources_order, axis=0)
        return xp.take(xp.concat([self._chunk(part, longest, g) for part, longest in self.chunks], axis=0), self.back, axis=0)

    def _chunk(self, part: slice, longest: int, g: Array) -> Array:
        xp = array_namespace(g)
        begin, length = self.begin[part, :, None], self.length[part, :, None]
        k = xp.arange(longest, device=begin.device)
        valid = k < length
        k = xp.reshape(xp.where(valid, begin + k, xp.zeros_like(begin)), (-1,))
        y, gk = (xp.reshape(xp.take(a, k, axis=0), (*valid.shape, 2)) for a in (self.y, g))
        r = self.x[part, None, None, :] - y
        r2 = xp.sum(r * r, axis=-1)
        one = xp.ones_like(r2[0, 0, 0])
        last = self.table.shape[0] - 1
        tabulated = valid & (r2 >= 2.0**FIRST) & (r2 < 1.0)
        z = xp.where(tabulated, r2, one)
        octave = xp.floor(xp.log2(z))
        place = (z * 2.0**-octave - 1.0) * (1 << BITS)
        piece = xp.floor(place)
        row = xp.where(tabulated, xp.astype((octave - FIRST) * (1 << BITS) + piece, xp.int64), xp.full_like(begin, last - 1))
        c = xp.reshape(xp.take(self.table, xp.reshape(row, (-1,)), axis=0), (*valid.shape, 8))
        t = place - piece
        f1, f2 = (c[..., i] + t * (c[..., i + 2] + t * (c[..., i + 4] + t * c[..., i + 6])) for i in (0, 1))
        series = self.table[last]
        here, close = valid & (r2 == 0.0), valid & (r2 > 0.0) & (r2 < 2.0**FIRST)
        z = xp.where(close, r2, one)
        f1 = xp.where(close, series[0] - 0.5 * xp.log(z) + series[1] * z, xp.where(here, self.self_term * one, f1))
        f2 = xp.where(close, 1.0 / z + series[2], f2)
        along = f2 * xp.sum(r * gk, axis=-1)
        return xp.sum(f1[..., None] * gk + along[..., None] * r, axis=(1, 2))
