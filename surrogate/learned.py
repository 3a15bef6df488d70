"""Learned maps behind the seam `biem.membrane.maps.MembraneMaps`: standardize -> network -> undo, batched over vesicles and modes.

A network knows curves of length 1 in the standard pose, in the units mu = kappa_b = 1; `Pose` says how its answers scale. A residual
network corrects `ExactMaps` built at few nodes. Relaxation knows the time steps that it was trained for; of the converged flow any sum of
them is composed, and what remains of a step is left to exact maps, and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import isfinite, pi
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from biem.backend import Array, Latest, array_namespace, count, from_numpy, on_cpu, parallel_map, shares, to_numpy
from biem.curves.curve import center_of_nodes, cross, curvature, dot, length, speed, tangent
from biem.curves.fourier import derivative
from biem.curves.pose import Pose, standardize
from biem.errors import NumericalFailure
from biem.membrane.maps import ExactMaps
from surrogate.damping import damped
from surrogate.distribution import Distribution
from surrogate.features import frame
from surrogate.networks import LearnedMap
from surrogate.targets import from_frame
from surrogate.weights import Card, read_distribution, read_weights

CPU_CHUNK, DEVICE_CHUNK = 128, 4096  # vesicles at a time: their operators stay in the cache, in the memory
SAME_DT = 1e-2  # relative difference of time steps that counts as none: lengths of membranes vary by less than a third of it
KEPT = 4  # standardized shapes: of a step all vesicles, those with near pairs, and those that are being moved
LIMITS = ("flag", "exact", "refuse")


@dataclass(frozen=True)
class Loaded:
    """A network and what it is of. base: the exact maps that a residual network corrects."""

    network: LearnedMap
    card: Card
    base: ExactMaps | None = None

    @property
    def distribution(self) -> Distribution:
        return self.network.distribution


@dataclass(frozen=True)
class Deferred:
    """A `Loaded` whose network is read at its first use, and counted as "MAP_networks_loaded". card: what its file said before."""

    path: Path
    card: Card
    base: ExactMaps | None = None

    @cached_property
    def network(self) -> LearnedMap:
        """Raises OSError for a file that is not what it was, or whose values are not finite: what no time step mends."""
        count(f"{self.card.network.map}_networks_loaded")
        try:
            network, card = read_weights(self.path)
        except ValueError as error:
            raise OSError(str(error)) from None
        if card != self.card:
            raise OSError(f"{self.path} is not the file that the run began with: restore it, and go on with --resume")
        return network

    @cached_property
    def distribution(self) -> Distribution:
        """Of the training shapes, read without the network."""
        return read_distribution(self.path)


Part = Loaded | Deferred


@dataclass(frozen=True)
class Standard:
    """Curves in the standard pose, X (M, 2, N) float64, and their frames, as tensors."""

    X: Tensor
    frames: Tensor
    pose: Pose


@dataclass(frozen=True)
class LearnedMaps:
    """`MembraneMaps` of networks. loaded: by slot; relax: several, by time step. exact: for what the networks do not know.

    limits: what to do with vesicles outside the training distribution: "flag" them in the diagnostics, answer by "exact" maps, or "refuse".
    A map whose slot is not loaded, other than near, raises KeyError.
    """

    loaded: Mapping[str, tuple[Part, ...]]
    kappa_b: float = 1.0
    mu: float = 1.0
    exact: ExactMaps = field(default_factory=ExactMaps)
    limits: str = "flag"
    _standard: Latest = field(default_factory=partial(Latest, KEPT), init=False, repr=False, compare=False)
    _outside: Latest = field(default_factory=Latest, init=False, repr=False, compare=False)
    _operator: dict[str, Latest] = field(default_factory=dict, init=False, repr=False, compare=False)

    def advect(self, X: Array, u: Array) -> Array:
        """(1 - M) u (M, 2, N)."""

        def learned(X: Array, u: Array) -> Array:
            rigid, base = rigid_motion(X, u), self._base("advection")
            v, pose = self._applied("advection", X, u - rigid)
            v = pose.vectors_back(v[:, 0])
            return rigid + keeping_length(X, v) if base is None else base.advect(X, u) + v

        return self._limited(learned, self.exact.advect, X, u)

    def flow_tension(self, X: Array, u: Array) -> Array:
        """L^-1 P u (M, N)."""

        def learned(X: Array, u: Array) -> Array:
            v, pose = self._applied("flow_tension", X, u - rigid_motion(X, u))
            return _plus(self.mu * pose.scalars_back(v[:, 0, 0]), self._base("flow_tension"), lambda base: base.flow_tension(X, u))

        return self._limited(learned, self.exact.flow_tension, X, u)

    def near_layers(self, X: Array, f: Array) -> Array:
        """S[X, f] on the layers (M, n_layers, 2, N); by exact maps where there is no network, as for "hybrid"."""
        if "near" not in self.loaded:
            return self.exact.near_layers(X, f)

        def learned(X: Array, f: Array) -> Array:
            v, pose = self._applied("near", X, f)
            xp = array_namespace(X)
            N = X.shape[-1]
            total = xp.sum(f * speed(X)[:, None, :], axis=-1) * (2.0 * pi / N)  # int f ds
            constant = -total * (xp.log(pose.scale) / (4.0 * pi * self.mu))[:, None]
            return pose.vectors_back(v) * (pose.scale / self.mu)[:, None, None, None] + constant[:, None, :, None]

        return self._limited(learned, self.exact.near_layers, X, f)

    def self_tension(self, X: Array) -> Array:
        """L^-1 P B X (M, N)."""

        def learned(X: Array) -> Array:
            part = self._part("self_tension")
            standard = self._standardized(X)
            count("self_tension_network", X.shape[0])
            sigma = _back(_at(part.network, standard.X)(standard.X)[:, 0, 0], X)
            back = standard.pose.scalars_back(sigma) * (self.kappa_b / standard.pose.scale**2)[:, None]
            return _plus(back, part.base, lambda base: base.self_tension(X))

        return self._limited(learned, self.exact.self_tension, X)

    def relax(self, X: Array, dt: float) -> Array:
        """X_next (M, 2, N) after dt: the steps that networks know, and the rest by exact maps."""
        scaled = dt * self.kappa_b / (self.mu * float(array_namespace(X).mean(length(X))) ** 3)
        if not isfinite(scaled):
            return X + float("nan")  # as exact maps answer to what is not finite: it is the guard's to reject
        steps, rest = composition(scaled, [part.card.dt or 0.0 for part in self.loaded["relax"]])
        for part, times in zip(self.loaded["relax"], steps, strict=True):
            each = dt * (part.card.dt or 0.0) / scaled
            learned = partial(self._relaxed, part=part, dt=each)
            for _ in range(times):
                X = self._limited(learned, partial(self.exact.relax, dt=each), X)
        if rest > 0.0:
            count("relaxation_rest_by_exact_maps", X.shape[0])
            X = self.exact.relax(X, dt * rest / scaled)
        return X

    def diagnostics(self, X: Array) -> Mapping[str, float]:
        """Vesicles outside the training distribution, and those of them that exact maps answer for."""
        outside = float(np.sum(self._is_outside(X)))
        return {"out_of_distribution": outside, "by_exact_maps": outside if self.limits == "exact" else 0.0}

    def _relaxed(self, X: Array, part: Part, dt: float) -> Array:
        standard = self._standardized(X)
        count("relax_network", X.shape[0])
        increments = from_frame(_at(part.network, standard.X)(standard.X)[:, 0].double(), standard.frames)
        if part.base is not None:
            scale = standard.pose.scale[:, None, None]
            return part.base.relax(X, dt) + standard.pose.vectors_back(_back(increments, X)) * scale
        if part.card.damped_from is not None:
            increments = damped(increments, standard.X, part.card)
        return standard.pose.points_back(_back(standard.X + increments, X))

    def _applied(self, slot: str, X: Array, u: Array) -> tuple[Array, Pose]:
        """The network's answer (M, S, C, N) to u, in the standard frame, and the pose."""
        standard = self._standardized(X)
        network = _at(self._part(slot).network, standard.X)
        u_std = _tensor(standard.pose.vectors(u))

        def make() -> Tensor:
            count(f"{slot}_network", X.shape[0])
            return _chunked(lambda chunk: network.operators(standard.X[chunk]), standard.X)

        operators = self._operator.setdefault(slot, Latest()).of(X, make)

        def at(chunk: slice) -> Tensor:
            frames = standard.frames[chunk]
            v = network.apply_to(operators[chunk], u_std[chunk], frames)
            return from_frame(v.double(), frames) if v.shape[2] == 2 else v.double()

        return _back(_chunked(at, standard.X), X), standard.pose

    def _standardized(self, X: Array) -> Standard:
        def make() -> Standard:
            X_std, pose = standardize(X)
            tensor = _tensor(X_std)
            return Standard(tensor, frame(tensor), pose)

        return self._standard.of(X, make)

    def _part(self, slot: str) -> Part:
        return self.loaded[slot][0]

    def _base(self, slot: str) -> ExactMaps | None:
        return self._part(slot).base

    def _is_outside(self, X: Array) -> np.ndarray:
        """(M,) bool, by the statistics of the first map loaded."""

        def make() -> np.ndarray:
            X_std = self._standardized(X).X
            distribution = next(iter(self.loaded.values()))[0].distribution.to(X_std.device)
            outside = (distribution(X_std) > distribution.limit).cpu().numpy()
            if self.limits == "refuse" and outside.any():
                raise NumericalFailure(
                    f"vesicle {np.flatnonzero(outside)[0]} (and {outside.sum() - 1} more) is unlike the shapes of the networks' training: "
                    'solver.out_of_distribution = "exact" answers by exact maps, "flag" goes on'
                )
            return outside

        return self._outside.of(X, make)

    def _limited(self, learned: Callable[..., Array], exact: Callable[..., Array], X: Array, *fields: Array) -> Array:
        """learned(X, *fields), where the limits ask for it by exact(X, *fields) for vesicles outside the distribution."""
        if self.limits == "flag":
            return learned(X, *fields)
        outside = self._is_outside(X)
        if not outside.any():
            return learned(X, *fields)
        count("by_exact_maps", int(outside.sum()))
        xp = array_namespace(X)
        which = from_numpy(np.flatnonzero(outside), X)
        out = xp.asarray(learned(X, *fields), copy=True)
        out[which] = exact(X[which], *(f[which] for f in fields))
        return out


def rigid_motion(X: Array, u: Array) -> Array:
    """The translation and rotation (M, 2, N) next to u, in least squares: membranes follow them, without a tension, exactly."""
    xp = array_namespace(X)
    r = X - center_of_nodes(X)
    spin = xp.sum(cross(r, u), axis=-1) / xp.sum(dot(r, r), axis=-1)
    return center_of_nodes(u) + spin[:, None, None] * xp.stack([-r[:, 1], r[:, 0]], axis=1)


def keeping_length(X: Array, v: Array) -> Array:
    """v (M, 2, N) with so much of curvature times normal taken out that it leaves the lengths as they are, to first order in time."""
    xp = array_namespace(X)
    t = tangent(X)
    n = xp.stack([t[:, 1], -t[:, 0]], axis=1)
    bent = n * curvature(X)[:, None]
    growth = lambda w: xp.sum(dot(t, derivative(w)), axis=-1)
    return v - bent * (growth(v) / growth(bent))[:, None, None]


def composition(dt: float, known: list[float]) -> tuple[list[int], float]:
    """How often each known step is to be taken, the longest first, and what remains of dt: 0 where less than SAME_DT of it does."""
    times, rest = [0] * len(known), dt
    for i in sorted(range(len(known)), key=lambda i: -known[i]):
        times[i] = max(0, int((rest + SAME_DT * known[i]) / known[i]))
        rest -= times[i] * known[i]
    return times, rest if rest > SAME_DT * dt else 0.0


def _chunked(function: Callable[[slice], Tensor], like: Tensor) -> Tensor:
    """function of slices of the vesicles, on threads, joined."""
    M = like.shape[0]
    chunks = shares(0, M, 16, CPU_CHUNK) if on_cpu(like) else [slice(i, i + DEVICE_CHUNK) for i in range(0, M, DEVICE_CHUNK)]
    parts = parallel_map(function, chunks) if on_cpu(like) else [function(chunk) for chunk in chunks]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _at(network: LearnedMap, X: Tensor) -> LearnedMap:
    """The network on the device of X."""
    return network if network.distribution.center.device == X.device else network.to(X.device)


def _tensor(a: Array) -> Tensor:
    return a if isinstance(a, Tensor) else torch.from_numpy(np.ascontiguousarray(a))


def _back(a: Tensor, like: Array) -> Array:
    """As an array of the kind and dtype of `like`."""
    return a.to(like.dtype) if isinstance(like, Tensor) else to_numpy(a).astype(like.dtype, copy=False)


def _plus(values: Array, base: ExactMaps | None, exact: Callable[[ExactMaps], Array]) -> Array:
    return values if base is None else values + exact(base)
