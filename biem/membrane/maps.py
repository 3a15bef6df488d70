"""The seam between steppers and membrane physics: `MembraneMaps`, and its exact realisation by dense operators.

All maps are batched over M vesicles in the world frame. `ExactMaps` builds its operators on `points` nodes of the resampled curve and
low-passes what they give to the N nodes it was given; 2 N removes the aliasing of P and T that dominates at small N. Read at the nodes
instead, the modes that these cannot hold would alias into the shape, at every step and differently for every place of the nodes.
Other realisations are made elsewhere, from a `MapsRequest`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from biem.backend import Array, Latest, array_namespace
from biem.curves.curve import length, normal
from biem.curves.fourier import resample
from biem.membrane.resultants import Resultants
from biem.stokes.near import layer_values

SLOTS = ("relax", "self_tension", "advection", "flow_tension", "near")  # the maps by the names that scenes and weights give them
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


@runtime_checkable
class Monitored(Protocol):
    """What maps that know the limits of their validity offer besides."""

    def diagnostics(self, X: Array) -> Mapping[str, float]:
        """Of vesicles X (M, 2, N), by name: how many are "out_of_distribution", how many are answered "by_exact_maps"; counts add up."""
        ...


@runtime_checkable
class Contrasted(Protocol):
    """What maps of vesicles that contain another fluid offer besides (`membrane.contrast`)."""

    def velocity(self, X: Array, f: Array, u: Array) -> Array:
        """Of membranes X (M, 2, N), for their own force densities f and outer velocities u (M, 2, N)."""
        ...


@dataclass(frozen=True)
class MapsRequest:
    """What a scene asks of a maker of maps: `make_maps(request) -> MembraneMaps`.

    kinds: of every slot, "ivnet", "mlp", "hybrid" or "exact"; needed: the slots that the scene requires, the only ones to be loaded.
    weights: the folder, or None for the shipped ones. kappa_b, mu, X: in the scene's units, X (M, 2, N) the membranes at the start.
    dt: the scene's time step; dts: it and, where each step is made against two halves, the half. adaptive: these are the first steps,
    later ones may be longer or shorter. Beyond dts, `relax` is also called once with dt/2, on trial, in the first step of vesicles that
    move, and with what is left to the horizon in the last one. operator_points, dtype ("float64" or "float32"), device: as in the
    scene; the arrays that the maps are given say where they are. out_of_distribution: vesicles unlike those that a map was made for are
    counted ("flag"), answered by exact maps and counted ("exact"), or raise NumericalFailure that names the vesicle ("refuse").
    """

    kinds: Mapping[str, str]
    needed: frozenset[str]
    weights: Path | None
    kappa_b: float
    mu: float
    X: np.ndarray
    dt: float
    dts: tuple[float, ...]
    adaptive: bool
    operator_points: int | None
    dtype: str
    device: str
    out_of_distribution: str


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
        return resample(maps.project(resample(u, maps.X.shape[-1])), X.shape[-1])

    def relax(self, X: Array, dt: float) -> Array:
        return X + resample(self._build(X).relaxation(dt), X.shape[-1])

    def self_tension(self, X: Array) -> Array:
        return resample(self._resultants(X).self_tension(), X.shape[-1])

    def flow_tension(self, X: Array, u: Array) -> Array:
        maps = self._resultants(X)
        return resample(maps.flow_tension(resample(u, maps.X.shape[-1])), X.shape[-1])

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
