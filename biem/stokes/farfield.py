"""The pair sum of Stokeslets: direct or by Ewald's method; in a periodic box always by Ewald's. Names, choice, and what it takes."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Protocol

from array_api_compat import is_torch_array

from biem.backend import Array
from biem.curves.lattice import Lattice
from biem.stokes.farfield_direct import DirectSum
from biem.stokes.farfield_ewald import EwaldSum, Grid, Split, nufft_module, uniform_grid
from biem.stokes.farfield_periodic import PeriodicSum, choose, periodic_bytes, periodic_schemes, spread_evenly

FAR_FIELDS = ("auto", "direct", "ewald")


class PairSum(Protocol):
    """The sum for fixed points."""

    def velocity(self, weighted_force: Array) -> Array:
        """(P, 2) for weighted_force = f ds (M, 2, N)."""
        ...


# Seconds on one core, measured with 32 nodes a curve (docs/measurements.md); the two meet at about 2,000 points at any tolerance.
DIRECT_COST = 3.5e-9  # per pair
POINT_COST, FIXED_COST = 1.5e-6, 2e-3  # of Ewald's sum beyond its `Grid.cost`, per point and at all


def far_scheme(far_field: str, targets: int, sources: int, tolerance: float, cuda: bool = False, lattice: Lattice | None = None) -> str:
    """ "direct" or "ewald" for so many targets and sources, as `far_field` says; "auto" takes the cheaper for evenly spread points.

    lattice: the images, in a periodic box, where both are Ewald's sum, its Fourier series as it stands or by nonuniform FFTs. Raises
    ValueError for an unknown name and for "ewald" without its library.
    """
    _check(far_field, tolerance, cuda)
    if far_field != "auto":
        return far_field
    if lattice is not None:
        return choose(lattice, targets, sources, tolerance, periodic_schemes(cuda), spread_evenly(lattice, sources))[0]
    if targets == 0 or find_spec("cufinufft" if cuda else "finufft") is None:
        return "direct"
    return "ewald" if _pays(uniform_grid((1.0, 1.0), sources, tolerance), targets, sources) else "direct"


def _check(far_field: str, tolerance: float, cuda: bool) -> None:
    if far_field not in FAR_FIELDS:
        raise ValueError(f'far_field = "{far_field}": expected ' + ", ".join(f'"{name}"' for name in FAR_FIELDS))
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"far_field tolerance = {tolerance}: expected a number between 0 and 1")
    if far_field == "ewald":
        nufft_module(cuda)


def _pays(grid: Grid, targets: int, sources: int) -> bool:
    return grid.cost + POINT_COST * (targets + sources) + FIXED_COST < DIRECT_COST * targets * sources


def pair_sum(
    targets: Array,
    X: Array,
    mu: float,
    exclude: Array | None = None,
    far_field: str = "auto",
    tolerance: float = 1e-6,
    of: int | None = None,
    lattice: Lattice | None = None,
) -> PairSum:
    """u(x_p) = sum over curves j and nodes n of G(x_p - X_jn) f_jn ds_jn for fixed targets (P, 2) and X (M, 2, N), for several forces.

    exclude (P,), integers: the curve whose nodes a target skips (-1: none). tolerance: relative L2 error of "ewald". "auto" decides by
    `far_scheme`, and takes "direct" where the points lie so unevenly that Ewald's sum would not be cheaper. of: the number of all targets
    where these are a part of them, so that "auto" decides the same for all parts. lattice: the images of the curves, in a periodic box; of
    its own curve a target then skips the nodes, not their images. Raises as `far_scheme`.
    """
    cuda = is_torch_array(X) and X.device.type == "cuda"
    P, S = targets.shape[0] if of is None else of, X.shape[0] * X.shape[2]
    if lattice is not None and targets.shape[0] > 0:
        _check(far_field, tolerance, cuda)
        schemes = periodic_schemes(cuda) if far_field == "auto" else (far_field,)
        return PeriodicSum(targets, X, mu, lattice, exclude, tolerance, schemes, of)
    if far_scheme(far_field, P, S, tolerance, cuda) == "direct" or targets.shape[0] == 0:
        return DirectSum(targets, X, mu, exclude)
    ewald = EwaldSum(targets, X, mu, exclude, tolerance)
    return ewald if far_field == "ewald" or _pays(ewald.grid, P, S) else DirectSum(targets, X, mu, exclude)


def far_field_bytes(
    P: int, M: int, N: int, scheme: str, tolerance: float, extent: tuple[float, float], lattice: Lattice | None = None
) -> float:
    """Peak memory of one float64 sum on the CPU beyond its arguments, for M N sources spread evenly over a box `extent`, or a periodic one.

    scheme: "direct" or "ewald". Ewald's modes are bounded by the number of points (`farfield_ewald.MODES_PER_POINT`).
    """
    S = M * N
    if lattice is not None:
        grid = choose(lattice, P, S, tolerance, (scheme,), spread_evenly(lattice, S))[1]
        return periodic_bytes(P, S, scheme, grid, lattice, tolerance)
    if scheme == "direct":
        return 8.0 * (5 * P + 4 * S)
    grid = uniform_grid(extent, S, tolerance)
    fine = 16.0 * Split.of(tolerance).upsampling ** 2  # the nonuniform FFTs' own grids, one in each of two plans
    return (2.0 * fine + 16.0 + 24.0) * grid.nx * grid.ny + 8.0 * (25 * P + 30 * S)
