"""The seam between steppers and membrane physics: `MembraneMaps`, and its exact realisation by dense operators.

All maps are batched over M vesicles in the world frame. `ExactMaps` builds its operators on `points` nodes of the resampled curve
and reads velocities and tensions back on the N nodes it was given; 2 N removes the aliasing of P and T that dominates at small N.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from array_api_compat import array_namespace

from biem.backend import Array, Latest
from biem.curves.curve import length, normal
from biem.curves.fourier import read_back, resample
from biem.membrane.resultants import Resultants
from biem.stokes.near import layer_values

LAYERS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # offsets of the near layers along the outward normal, in arclength spacings
RESOLVED_FROM = 96  # nodes from which the operators are built at N itself


class MembraneMaps(Protocol):
    """What a split stepper knows of a vesicle's physics. X, u, f: (M, 2, N)."""

    def advect(self, X: Array, u: Array) -> Array:
        """(1 - M) u (M, 2, N)."""
        ...

    def relax(self, X: Array, dt: float) -> Array:
        """X_next (M, 2, N) with (X_next - X)/dt = (1 - M[X]) B[X] X_next."""
        ...

    def self_tension(self, X: Array) -> Array:
        """L^-1 P B X (M, N)."""
        ...

    def flow_tension(self, X: Array, u: Array) -> Array:
        """L^-1 P u (M, N)."""
        ...

    def near_layers(self, X: Array, f: Array) -> Array:
        """S[X, f] at X + offset h n for the offsets LAYERS, h = length/N (M, n_layers, 2, N)."""
        ...


def operator_points(N: int, points: int | None = None) -> int:
    """Nodes that the operators of an N-node curve are built at. Raises ValueError for points odd or below N."""
    if points is None:
        return N if N >= RESOLVED_FROM else 2 * N
    if points < N or points % 2:
        raise ValueError(f"operators are built at {points} points for curves of {N} nodes: points must be even and at least {N}")
    return points


@dataclass(frozen=True)
class ExactMaps:
    """`MembraneMaps` by boundary integrals. kappa_b, mu in the units of X; points: nodes of the operators (default 2 N below 96).

    precision: "float64", or "float32" for kernels and solves, while geometry and forces stay float64. The factors of the curves last
    seen are kept, so that one factorisation serves every map of a step: arrays are not to be changed in place.
    """

    kappa_b: float = 1.0
    mu: float = 1.0
    points: int | None = None
    precision: str = "float64"
    _last: Latest = field(default_factory=Latest, init=False, repr=False, compare=False)

    def advect(self, X: Array, u: Array) -> Array:
        maps = self._resultants(X)
        return read_back(maps.project(resample(u, maps.X.shape[-1])), X.shape[-1])

    def relax(self, X: Array, dt: float) -> Array:
        # low-passed, not read back at the nodes: the stiff modes that N nodes cannot hold relax at once, whatever dt is, and would
        # alias into the shape at every step
        return X + resample(self._build(X).relaxation(dt), X.shape[-1])

    def self_tension(self, X: Array) -> Array:
        return read_back(self._resultants(X).self_tension(), X.shape[-1])

    def flow_tension(self, X: Array, u: Array) -> Array:
        maps = self._resultants(X)
        return read_back(maps.flow_tension(resample(u, maps.X.shape[-1])), X.shape[-1])

    def near_layers(self, X: Array, f: Array) -> Array:
        xp = array_namespace(X)
        M, _, N = X.shape
        h = (length(X) / N)[:, None, None]
        n = normal(X)
        layers = xp.stack([X + offset * h * n for offset in LAYERS], axis=1)  # (M, n_layers, 2, N)
        points = xp.reshape(xp.permute_dims(layers, (0, 1, 3, 2)), (M, len(LAYERS) * N, 2))
        u = layer_values(X, f, points, self.mu)
        return xp.permute_dims(xp.reshape(u, (M, len(LAYERS), N, 2)), (0, 1, 3, 2))

    def _resultants(self, X: Array) -> Resultants:
        return self._last.of(X, lambda: self._build(X))

    def _build(self, X: Array) -> Resultants:
        dtype = None if self.precision == "float64" else getattr(array_namespace(X), self.precision)
        return Resultants(resample(X, operator_points(X.shape[-1], self.points)), self.kappa_b, self.mu, dtype)
