"""Pair sum of Stokeslets in a doubly periodic box by Ewald's method: near images on a cell list, the smooth rest as a Fourier series.

Hasimoto's split in the plane, z = xi^2 r^2 and kappa = k^2/(4 xi^2), l over the lattice of images, k over the reciprocal one, V the box:
    4 pi mu G(r) = sum_l G_R(r + l) + (4 pi/V) sum_{k != 0} (1 + kappa) e^-kappa (I - k k^T/k^2)/k^2 e^{i k.r}
    G_R = (E1(z)/2 - e^-z) I + e^-z r r^T/r^2,        the one of `farfield_ewald`, dropped beyond the cut-off
The mode k = 0 is left out and G_R has no mean: the velocity of any forces has the mean zero over the box, and its gradient too. Forces
of total F go with a mean pressure gradient of F/V that keeps the fluid in balance; membranes have F = 0, and no mean pressure gradient.
Hasimoto, J. Fluid Mech. 5 (1959); Pozrikidis, J. Eng. Math. 30 (1996).

The lattice may be any, so also that of a sheared box. The Fourier series is summed by nonuniform FFTs in the coordinates of the lattice,
or, without finufft, as it stands: a product of exponentials in either direction, which is two matrix products ("direct"). Both are cut
where e^-kappa is below the tolerance.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from math import ceil, log, log2, pi
from typing import Any

import numpy as np
from array_api_compat import is_torch_array

from biem.backend import Array, array_namespace, count, from_numpy, threads, to_numpy
from biem.curves.lattice import Lattice
from biem.stokes.farfield_direct import own_sum, own_sum_of_arrays
from biem.stokes.farfield_ewald import (
    FEWEST_MODES,
    FFT_COST,
    MODES_PER_POINT,
    MODES_PER_THREAD,
    PAIR_COST,
    ArrayNear,
    CompiledNear,
    Grid,
    Split,
    nufft_module,
    pairs_in_squares,
)
from biem.stokes.kernels import stokeslet_prefactor

SCHEMES = ("direct", "ewald")
CUTOFFS = 3  # an octave, of those that are tried
POINT_COST, FIXED_COST = 5e-7, 2e-3  # seconds on one core: of nonuniform FFTs beyond FFT_COST, per point and at all
PRODUCT_COST, EXPONENTIAL_COST = 1.5e-9, 3e-8  # of the series as it stands: per point and mode, per point and mode of one direction
IMAGE_COST = 5e-8  # per image of a point
FARTHEST = 1e9  # sides of the box from the origin
CHUNK = 1 << 13  # points whose exponentials are multiplied at a time


def periodic_schemes(cuda: bool = False) -> tuple[str, ...]:
    """Those that this machine has libraries for."""
    return SCHEMES if find_spec("cufinufft" if cuda else "finufft") is not None else SCHEMES[:1]


def choose(
    lattice: Lattice, targets: int, sources: int, tolerance: float, schemes: tuple[str, ...], pairs: Callable[[float], float]
) -> tuple[str, Grid]:
    """The cheapest of the schemes and its cut-off and modes; pairs(side): pairs of sources that share a square of that side."""
    split = Split.of(tolerance)
    points, area = targets + sources, lattice.area
    shortest = min(lattice.width, lattice.height)
    limit = max(FEWEST_MODES, MODES_PER_POINT * points)
    best: tuple[str, Grid] | None = None
    for step in range(60):
        cutoff = max(lattice.width, lattice.height) * 2.0 ** (-step / CUTOFFS)
        nx, ny = modes_of(lattice, split, cutoff)
        if best is not None and nx * ny > limit:
            break
        side = 2.5 * cutoff
        near = max(pairs(min(side, shortest)), sources * sources * side * side / area)
        images = sources * (1.0 + 2.0 * cutoff / lattice.width) * (1.0 + 2.0 * cutoff / lattice.height)
        shared = PAIR_COST * near + IMAGE_COST * images
        for scheme in schemes:
            if scheme == "ewald":
                cost = FFT_COST * nx * ny * log2(nx * ny) + POINT_COST * points + FIXED_COST
            else:
                cost = PRODUCT_COST * points * nx * ny + EXPONENTIAL_COST * points * (nx + ny)
            if best is None or shared + cost < best[1].cost:
                best = scheme, Grid(nx, ny, cutoff, shared + cost)
    assert best is not None
    return best


def modes_of(lattice: Lattice, split: Split, cutoff: float) -> tuple[int, int]:
    """Numbers of modes, odd, along b_1 and b_2, that hold all |k| <= 2 s^2/cutoff, where (1 + kappa) e^-kappa falls below the tolerance."""
    reach = pi / (split.mesh * cutoff)
    longest = np.hypot(*lattice.vectors.T)
    nx, ny = (2 * ceil(reach * a / (2.0 * pi)) + 1 for a in longest.tolist())
    return nx, ny


def spread_evenly(lattice: Lattice, sources: int) -> Callable[[float], float]:
    """`pairs` of `choose` for points all over the box."""
    return lambda side: sources * max(1.0, sources * min(1.0, side * side / lattice.area))


def periodic_bytes(P: int, S: int, scheme: str, grid: Grid, lattice: Lattice, tolerance: float) -> float:
    """Peak memory of one float64 sum on the CPU beyond its arguments, for P targets and S sources."""
    images = S * (1.0 + 2.0 * grid.cutoff / lattice.width) * (1.0 + 2.0 * grid.cutoff / lattice.height)
    modes = 16.0 * (2.0 * Split.of(tolerance).upsampling ** 2 + 5.0) * grid.nx * grid.ny
    exponentials = 16.0 * (P + S) * (grid.nx + grid.ny) + 48.0 * min(CHUNK, P + S) * max(grid.nx, grid.ny) if scheme == "direct" else 0.0
    return modes + exponentials + 8.0 * (20 * P + 12 * S + 14 * images)


@lru_cache(maxsize=4)
def multiplier(lattice: Lattice, nx: int, ny: int, xi: float) -> tuple[np.ndarray, np.ndarray]:
    """A and D (nx, ny), modes in FFT order: u^(k) = A g^(k) + D conj(g^(-k)) for velocity and force as u_x + i u_y, 4 pi mu u.

    I - k k^T/k^2 = (I - Q)/2 with the reflection Q g = e^{2 i theta} conj(g), theta: direction of k.
    """
    n = [np.fft.fftfreq(N, 1.0 / N) for N in (nx, ny)]
    b = lattice.reciprocal
    k = n[0][:, None, None] * b[0] + n[1][:, None] * b[1]
    k2 = (k * k).sum(-1)
    k2[0, 0] = 1.0
    kappa = k2 / (4.0 * xi * xi)
    A = 2.0 * pi / lattice.area * (1.0 + kappa) * np.exp(-kappa) / k2
    A[0, 0] = 0.0
    z = k[..., 0] + 1j * k[..., 1]
    return A, -A * (z * z / k2)


class PeriodicSum:
    """The pair sum over curves and all their images, for fixed points: u(x_p) = sum of G(x_p - X_jn) f_jn ds_jn, for several forces.

    targets (P, 2) with P > 0, X (M, 2, N), anywhere; exclude (P,), integers: the curve whose own nodes, not those of its images, a target
    skips (-1: none). Relative L2 error below 3 tolerance. schemes, of: those of `choose`, and the number of all targets where these are a
    part of them; cutoff: of the real space sum, default the cheapest. compiled: as of `EwaldSum`. Coordinates that are not finite, or
    too large to be wrapped, give NaN: a target's at that target, a source's everywhere.
    """

    def __init__(
        self,
        targets: Array,
        X: Array,
        mu: float,
        lattice: Lattice,
        exclude: Array | None = None,
        tolerance: float = 1e-6,
        schemes: tuple[str, ...] = ("direct",),
        of: int | None = None,
        cutoff: float | None = None,
        compiled: bool | None = None,
    ) -> None:
        self.like, self.mu = X, mu
        cuda = is_torch_array(X) and X.device.type == "cuda"
        self.compiled = not cuda if compiled is None else compiled
        if self.compiled:
            targets, X = (np.asarray(to_numpy(a), dtype=np.float64) for a in (targets, X))
            exclude = None if exclude is None else to_numpy(exclude)
        xp = array_namespace(X)
        M, _, N = X.shape
        self.exclude = exclude
        y = xp.reshape(xp.permute_dims(X, (0, 2, 1)), (M * N, 2))
        (x, self.lost), (y, outside) = (_in_rectangle(points, lattice) for points in (targets, y))  # (P,), (S,)
        self.finite = not bool(xp.any(outside))
        self.x, self.y = targets, X
        split = Split.of(tolerance)
        box = np.array([lattice.width, lattice.height])
        finest = 1 << min(9, max(4, (M * N).bit_length() // 2))
        pairs = pairs_in_squares(np.clip(to_numpy(y) + 0.5 * box, 0.0, box), np.full(2, box.max()), finest)
        self.scheme, self.grid = choose(lattice, of or x.shape[0], M * N, tolerance, schemes, pairs)
        if cutoff is not None:
            self.grid = Grid(*modes_of(lattice, split, cutoff), cutoff, self.grid.cost)
        xi = split.s / self.grid.cutoff
        self.self_term = -(0.5 * np.euler_gamma + log(xi) + 1.0)  # less the smooth part of the point itself: it does not meet itself
        self.image, around = images_within(y, lattice, self.grid.cutoff)
        near = CompiledNear if self.compiled else ArrayNear
        self.near = near(x / self.grid.cutoff, around / self.grid.cutoff, split, self.self_term)
        tables = multiplier(lattice, self.grid.nx, self.grid.ny, xi)
        self.table = tables if self.compiled else tuple(_table_like(a, X) for a in tables)
        of_y, of_x = (2.0 * pi * lattice.in_cell(points) for points in (y, x))
        shape = (self.grid.nx, self.grid.ny)
        self.series: PlainSeries | NufftSeries
        self.series = PlainSeries(of_y, of_x, shape) if self.scheme == "direct" else NufftSeries(of_y, of_x, shape, split, cuda)

    def velocity(self, weighted_force: Array) -> Array:
        """(P, 2) for weighted_force = f ds (M, 2, N)."""
        count("pair_sum")
        count("periodic_sum")
        g = np.asarray(to_numpy(weighted_force), dtype=np.float64) if self.compiled else weighted_force
        xp = array_namespace(g)
        flat = xp.reshape(xp.permute_dims(g, (0, 2, 1)), (-1, 2))
        modes = self.series.modes(flat[:, 0] + 1j * flat[:, 1])
        A, D = self.table
        mirrored = xp.roll(xp.flip(modes, axis=(0, 1)), (1, 1), axis=(0, 1))  # of -k; the numbers of modes are odd
        smooth = self.series.values(A * modes + D * xp.conj(mirrored))
        u = self.near(xp.take(flat, self.image, axis=0)) + xp.stack([xp.real(smooth), xp.imag(smooth)], axis=-1)
        u = stokeslet_prefactor(self.mu) * u
        if self.exclude is not None:
            own = own_sum if self.compiled else own_sum_of_arrays
            u = u - own(self.x, self.y, g, self.exclude, self.mu)
        lost = self.lost if self.finite else xp.ones_like(self.lost)
        u = xp.where(lost[:, None], xp.full_like(u, xp.nan), u)
        return from_numpy(u, like=self.like) if self.compiled else u


def _in_rectangle(points: Array, lattice: Lattice) -> tuple[Array, Array]:
    """Points wrapped, and whether each cannot be: not finite, or so far away that few digits are left (it is then the origin)."""
    xp = array_namespace(points)
    known = (xp.abs(points[:, 0]) <= FARTHEST * lattice.width) & (xp.abs(points[:, 1]) <= FARTHEST * lattice.height)
    return lattice.wrapped(xp.where(known[:, None], points, xp.zeros_like(points))), ~known


def images_within(y: Array, lattice: Lattice, reach: float) -> tuple[Array, Array]:
    """The points y (S, 2), which lie in the rectangle, and their images within `reach` of it: number among y (Q,), place (Q, 2)."""
    xp = array_namespace(y)
    number, place = [xp.arange(y.shape[0], device=y.device)], [y]
    half = 0.5 * np.array([lattice.width, lattice.height]) + reach
    rows = ceil(reach / lattice.height)
    columns = ceil((reach + rows * abs(lattice.offset)) / lattice.width)
    for n in range(-rows, rows + 1):
        for m in range(-columns, columns + 1):
            if m == 0 and n == 0:
                continue
            dx, dy = m * lattice.width + n * lattice.offset, n * lattice.height
            inside = (xp.abs(y[:, 0] + dx) <= half[0]) & (xp.abs(y[:, 1] + dy) <= half[1])
            (index,) = xp.nonzero(inside)
            number.append(index)
            moved = xp.take(y, index, axis=0)
            place.append(xp.stack([moved[:, 0] + dx, moved[:, 1] + dy], axis=-1))
    return xp.concat(number), xp.concat(place, axis=0)


def _table_like(a: np.ndarray, like: Array) -> Array:
    xp = array_namespace(like)
    if a.dtype.kind == "f":
        return from_numpy(a, like=like)
    return xp.asarray(a, dtype=xp.complex64 if like.dtype == xp.float32 else xp.complex128, device=like.device)


class PlainSeries:
    """The two Fourier sums as they stand, as products of exponentials along b_1 and b_2. angles: 2 pi times coordinates in the cell."""

    def __init__(self, sources: Array, targets: Array, shape: tuple[int, int]) -> None:
        self.sources, self.targets = (
            [_exponentials(a[start : start + CHUNK], shape) for start in range(0, a.shape[0], CHUNK)] for a in (sources, targets)
        )

    def modes(self, g: Array) -> Array:
        """sum_n g_n e^{-i k.y_n} (nx, ny) for complex g (S,)."""
        xp = array_namespace(g)
        start, total = 0, 0.0
        for ex, ey in self.sources:
            part = g[start : start + ex.shape[0], None]
            total = total + xp.matmul(xp.conj(ex).T, part * xp.conj(ey))
            start += ex.shape[0]
        return total

    def values(self, modes: Array) -> Array:
        """sum_k modes e^{i k.x} (P,)."""
        xp = array_namespace(modes)
        return xp.concat([xp.sum(xp.matmul(ex, modes) * ey, axis=-1) for ex, ey in self.targets])


def _exponentials(angles: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """e^{i n angle} (Q, nx) and (Q, ny), n in FFT order."""
    xp = array_namespace(angles)
    columns = []
    for i, N in enumerate(shape):
        n = xp.asarray(np.fft.fftfreq(N, 1.0 / N), dtype=angles.dtype, device=angles.device)
        phase = angles[:, i : i + 1] * n
        columns.append(xp.cos(phase) + 1j * xp.sin(phase))
    return columns[0], columns[1]


class NufftSeries:
    """The same by nonuniform FFTs."""

    def __init__(self, sources: Array, targets: Array, shape: tuple[int, int], split: Split, cuda: bool) -> None:
        library: Any = nufft_module(cuda)
        self.on_device = cuda or not is_torch_array(sources)
        xp = array_namespace(sources)
        single = sources.dtype == xp.float32
        options: dict[str, Any] = {
            "eps": max(split.nufft, 1e-6) if single else split.nufft,
            "dtype": "complex64" if single else "complex128",
            "modeord": 1,
        }
        if not cuda:
            workers = max(1, min(threads(), shape[0] * shape[1] // MODES_PER_THREAD))
            options |= {"nthreads": workers, "upsampfac": split.upsampling}
        self.plans = []
        for kind, sign, angles in ((1, -1, sources), (2, 1, targets)):
            columns = [xp.asarray(angles[:, i], copy=True) for i in (0, 1)]  # contiguous
            plan = library.Plan(kind, shape, isign=sign, **options)
            plan.setpts(*(a if cuda else to_numpy(a) for a in columns))
            self.plans.append(plan)

    def modes(self, g: Array) -> Array:
        """As of `PlainSeries`."""
        return self._execute(0, g)

    def values(self, modes: Array) -> Array:
        """As of `PlainSeries`."""
        return self._execute(1, modes)

    def _execute(self, which: int, a: Array) -> Array:
        if self.on_device:
            return self.plans[which].execute(a)
        return array_namespace(a).asarray(self.plans[which].execute(to_numpy(a)))
