"""Velocity of vesicles due to all others, on their own nodes: pair sum plus near-field correction, for a fixed geometry. X: (M, 2, N).

Where there are walls, also the flow by which they answer to the vesicles, own ones included, so that the fluid rests on them. Vesicles
of another viscosity than the fluid's, contrast lambda_j, also act by a double layer of density (1 - lambda_j) u_j, u_j their velocity.
In a periodic box the others are all images of all vesicles, own ones included (biem.stokes.farfield_periodic).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from biem.backend import Array, array_namespace, from_numpy, stage, to_numpy
from biem.curves.curve import arclength_weights, length
from biem.curves.lattice import Lattice
from biem.stokes.double_layers import DoubleLayers
from biem.stokes.farfield import PairSum, pair_sum
from biem.stokes.near import apply_rows, near_correction, near_width
from biem.stokes.near_layers import METHODS, NearLayers
from biem.stokes.near_search import NearPairs, find_near
from biem.stokes.near_sums import NearSums
from biem.stokes.single_layer import near_scheme
from biem.stokes.walls import Walls


@dataclass(frozen=True)
class Fields:
    """How near and far fields are evaluated, and to which tolerance (relative). layers: the map S[X, f] on `offsets`, for near layers."""

    near_field: str = "auto"
    near_tolerance: float = 1e-8
    far_field: str = "auto"
    far_tolerance: float = 1e-10
    precision: str = "float64"  # of the pair sum
    layers: Callable[[Array, Array], Array] | None = None
    offsets: tuple[float, ...] = ()


DEFAULT_FIELDS = Fields()


class Correction(Protocol):
    """What near targets get on top of the pair sum."""

    def add(self, u: Array, f: Array) -> Array:
        """u (P, 2) with the correction for force densities f (M, 2, N)."""
        ...


@dataclass(frozen=True)
class NearRows:
    """The correction as stored rows, for many forces on one geometry."""

    pairs: NearPairs
    rows: Array

    def add(self, u: Array, f: Array) -> Array:
        return apply_rows(u, self.rows, self.pairs, f)


@dataclass(frozen=True)
class OfImages:
    """The correction by curves that are images of others: source (M + I,), see `Lattice.with_images`."""

    inner: Correction
    source: Array

    def add(self, u: Array, f: Array) -> Array:
        return self.inner.add(u, f[self.source])


@dataclass(frozen=True)
class ContrastSources:
    """Double layers of the vesicles whose contrast is not 1, at the targets of an interaction."""

    which: Array  # their indices among all vesicles
    factor: Array  # 1 - contrast of each, (., 1, 1)
    layers: DoubleLayers

    @classmethod
    def build(cls, X: Array, targets: Array, owner: Array, fields: Fields, contrast: np.ndarray) -> ContrastSources:
        """contrast (M,): not 1 everywhere. Targets skip the curve owner (P,)."""
        index = np.flatnonzero(contrast != 1.0)
        place = np.full(len(contrast) + 1, -1)  # the last one: of what no vesicle owns
        place[index] = np.arange(len(index))
        which = from_numpy(index, like=X)
        Y, skip = X[which], from_numpy(place, like=X)[owner]
        pairs = find_near(Y, targets, 0.0 if fields.near_field == "none" else near_width("upsample", fields.near_tolerance), skip)
        factor = from_numpy(1.0 - contrast[index], like=X)[:, None, None]
        return cls(which, factor, DoubleLayers.build(Y, targets, pairs, skip))

    def velocity(self, u: Array) -> Array:
        """(P, 2) for velocities u (M, 2, N) of all vesicles."""
        return self.layers.velocity(self.factor * u[self.which])


@dataclass(frozen=True)
class Interaction:
    """Velocity (m, 2, N) of the vesicles `mine` due to all others, and to the walls' answer to all."""

    weights: Array
    far: PairSum
    near: tuple[Correction, ...]
    nodes: Array  # of the vesicles `mine` (m N, 2)
    precision: str
    walls: Walls | None = None
    contrast: ContrastSources | None = None

    @classmethod
    def build(
        cls,
        X: Array,
        mu: float,
        fields: Fields,
        mine: slice = slice(None),
        stored: bool = False,
        walls: Walls | None = None,
        contrast: np.ndarray | None = None,
        lattice: Lattice | None = None,
    ) -> Interaction:
        """For vesicles X (M, 2, N); stored: keep the near rows, as an iterative solver needs them. contrast (M,), or None where all are 1.

        lattice: the images, in a periodic box; it goes without walls and contrasts.
        """
        xp = array_namespace(X)
        if lattice is not None:
            assert walls is None
            assert contrast is None
            X = lattice.wrapped_curves(X)
        M, _, N = X.shape
        index = np.arange(M)[mine]
        nodes = targets = xp.reshape(xp.permute_dims(X[mine], (0, 2, 1)), (len(index) * N, 2))
        owner = np.repeat(index, N)
        if walls is not None:
            targets = xp.concat([targets, from_numpy(walls.nodes, like=X)])
            owner = np.concatenate([owner, np.full(len(walls.nodes), -1)])
        owner = from_numpy(owner, like=X)
        dtype = getattr(xp, fields.precision)
        origin = xp.mean(X, axis=(0, 2))  # subtracted before the precision is lowered
        lower = lambda a: xp.astype(a, dtype, copy=False)
        with stage("far"):
            points = lower(targets - origin), lower(X - origin[None, :, None])
            of = M * N + targets.shape[0] - nodes.shape[0]
            how = fields.far_field, fields.far_tolerance
            far = pair_sum(*points, mu, owner, *how, of=of, lattice=lattice)
        with stage("near"):
            near = (_near if lattice is None else partial(_near_images, lattice))(X, targets, owner, mu, fields, stored)
        sources = None
        if contrast is not None:
            with stage("double layers"):
                sources = ContrastSources.build(X, targets, owner, fields, contrast)
        return cls(arclength_weights(X)[:, None, :], far, near, nodes, fields.precision, walls, sources)

    def velocity(self, f: Array, u_own: Array | None = None) -> Array:
        """(m, 2, N) for force densities f and, where there is a contrast, velocities u_own (M, 2, N) of all vesicles."""
        xp = array_namespace(f)
        with stage("far"):
            u = self.far.velocity(xp.astype(f * self.weights, getattr(xp, self.precision), copy=False))
            u = xp.astype(u, f.dtype, copy=False)
        with stage("near"):
            for correction in self.near:
                u = correction.add(u, f)
        if self.contrast is not None:
            assert u_own is not None
            with stage("double layers"):
                u = u + self.contrast.velocity(u_own)
        if self.walls is not None:
            P = self.nodes.shape[0]
            with stage("walls"):
                u = u[:P] + self.walls.answer(self.nodes, u[P:])
        return xp.permute_dims(xp.reshape(u, (-1, f.shape[-1], 2)), (0, 2, 1))


def _near_images(
    lattice: Lattice, X: Array, targets: Array, owner: Array, mu: float, fields: Fields, stored: bool
) -> tuple[Correction, ...]:
    """`_near` by all images of the wrapped curves X that come close to one of them."""
    scheme = "upsample" if fields.near_field in METHODS else near_scheme(fields.near_field)
    lengths = to_numpy(length(X))
    reach = near_width(scheme, fields.near_tolerance) * float(lengths.max(initial=0.0, where=np.isfinite(lengths))) / X.shape[-1]
    curves, source = lattice.with_images(X, reach)
    return tuple(OfImages(correction, source) for correction in _near(curves, targets, owner, mu, fields, stored))


def _near(X: Array, targets: Array, owner: Array, mu: float, fields: Fields, stored: bool) -> tuple[Correction, ...]:
    layered = fields.near_field in METHODS
    scheme = "upsample" if layered else near_scheme(fields.near_field)
    if scheme == "none":
        return ()
    pairs = find_near(X, targets, near_width(scheme, fields.near_tolerance), owner)
    if len(pairs) == 0:
        return ()
    if stored or scheme == "ying_zorin":
        return (NearRows(pairs, near_correction(X, targets, pairs, mu, scheme, fields.near_tolerance)),)
    if not layered:
        return (NearSums.build(X, targets, pairs, mu, fields.near_tolerance),)
    assert fields.layers is not None
    h = to_numpy(length(X)) / X.shape[-1]
    inner = np.abs(to_numpy(pairs.distance)) <= max(fields.offsets) * h[to_numpy(pairs.vesicle)]
    corrections: list[Correction] = []
    if inner.any():
        part = pairs.subset(np.flatnonzero(inner))
        corrections.append(NearLayers.build(X, targets, part, mu, fields.near_field, fields.layers, fields.offsets))
    if not inner.all():
        corrections.append(NearSums.build(X, targets, pairs.subset(np.flatnonzero(~inner)), mu, fields.near_tolerance))
    return tuple(corrections)
