"""A learned map: input channels, network and scaling in one module, from standardized curves to outputs in the units of the labels.

`Settings` say what it is, and make it anew; its buffers hold the statistics of the data. `IVNetMap` has one network for each mode in
`settings.modes`, `MLPMap` one for all of them. Outputs are clamped to the range that the training targets had: what lies beyond is not
known to the network.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from math import prod
from typing import Any, Literal

import torch
from torch import Tensor, nn

from surrogate.distribution import Distribution
from surrogate.features import features
from surrogate.ivnet import IVNet
from surrogate.mlp import MLP
from surrogate.symmetric import Parts
from surrogate.targets import TARGETS

Arch = Literal["ivnet", "mlp"]


@dataclass(frozen=True)
class Settings:
    """What a network is of. modes: of an operator, one network for each of "ivnet"; () for other maps, and all of them for "mlp".

    network: blocks, width, ... of the IVNet or MLP; ranks: coefficients of each part of an MLP's output (`surrogate.symmetric`).
    """

    map: str
    arch: Arch
    points: int
    channels: tuple[str, ...]
    modes: tuple[int, ...] = ()
    network: dict[str, Any] = field(default_factory=dict)
    ranks: tuple[int, ...] = ()

    @classmethod
    def from_dict(cls, table: dict[str, Any]) -> Settings:
        """Inverse of `as_dict`. Raises TypeError for other keys."""
        return cls(**{**table, "channels": tuple(table["channels"]), "modes": tuple(table["modes"]), "ranks": tuple(table["ranks"])})

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    @property
    def output_shape(self) -> tuple[int, ...]:
        """Of one network, of one curve."""
        target = TARGETS[self.map]
        tail: tuple[int, ...] = (target.layers, target.parts, self.points) if target.operator else (target.parts, self.points)
        if not target.operator:
            return tail
        return (2, 2, *tail) if self.arch == "ivnet" else (2, self.points, *tail)


class IVNetMap(nn.Module):
    """X (M, 2, N) float64 -> (M, G, *output_shape) float32, of G = max(1, modes) networks."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.distribution = Distribution(settings.points)
        self.groups = max(1, len(settings.modes))
        into, out = len(settings.channels), prod(settings.output_shape[:-1])
        self.core = IVNet(into, out, self.groups, **settings.network)
        for name, size in (("input", into), ("output", out)):
            self.register_buffer(f"{name}_mean", torch.zeros(self.groups, 1, 1, size))
            self.register_buffer(f"{name}_scale", torch.ones(self.groups, 1, 1, size))
        for name in ("lowest", "highest"):
            self.register_buffer(name, torch.full((self.groups, 1, 1, out), float("inf" if name == "highest" else "-inf")))

    def forward(self, X: Tensor) -> Tensor:
        return self.of_features(self.features(X))

    def features(self, X: Tensor) -> Tensor:
        """(M, N, C) float32."""
        return features(X, self.settings.channels).transpose(1, 2).to(self.input_mean.dtype)

    def of_features(self, values: Tensor) -> Tensor:
        """Outputs from input channels (M, N, C)."""
        y = self.normalized(values).clamp(self.lowest, self.highest) * self.output_scale + self.output_mean  # (G, M, N, out)
        return y.permute(1, 0, 3, 2).reshape(len(values), self.groups, *self.settings.output_shape)

    def normalized(self, values: Tensor) -> Tensor:
        """The core's outputs (G, M, N, out)."""
        return self.core(torch.asinh((values - self.input_mean) / self.input_scale))


class MLPMap(nn.Module):
    """X (M, 2, N) float64 -> (M, 1, *output_shape) float32. Coefficients of the parts stand one after the other, `ranks` of each."""

    groups = 1

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.distribution = Distribution(settings.points)
        self.parts = Parts(settings.map, settings.output_shape)
        into, rank = len(settings.channels) * settings.points, sum(settings.ranks)
        self.core = MLP(into, rank, **settings.network)
        self.register_buffer("input_mean", torch.zeros(into))
        self.register_buffer("input_scale", torch.ones(into))
        self.register_buffer("output_scale", torch.ones(rank))
        self.register_buffer("lowest", torch.full((rank,), -float("inf")))
        self.register_buffer("highest", torch.full((rank,), float("inf")))
        self.register_buffer("output_mean", torch.zeros(self.parts.size))  # of the even part: the others have none
        self.register_buffer("basis", torch.zeros(rank, self.parts.size))

    def forward(self, X: Tensor) -> Tensor:
        return self.outputs(self.coefficients(self.features(X))).reshape(len(X), 1, *self.settings.output_shape)

    def features(self, X: Tensor) -> Tensor:
        """(M, C N) float32."""
        return features(X, self.settings.channels).flatten(1).to(self.input_mean.dtype)

    def normalized(self, values: Tensor) -> Tensor:
        """The core's outputs (M, rank)."""
        return self.core(torch.asinh((values - self.input_mean) / self.input_scale))

    def coefficients(self, values: Tensor) -> Tensor:
        """Of the basis, from input channels (M, C N)."""
        return self.normalized(values).clamp(self.lowest, self.highest) * self.output_scale

    def outputs(self, coefficients: Tensor) -> Tensor:
        """Flat (M, P), from coefficients (M, rank)."""
        each = zip(coefficients.split(self.settings.ranks, dim=1), self.basis.split(self.settings.ranks), strict=True)
        parts = torch.stack([c @ vectors for c, vectors in each], dim=1)
        parts[:, 0] += self.output_mean
        return self.parts.put(parts)


LearnedMap = IVNetMap | MLPMap


def make_network(settings: Settings) -> LearnedMap:
    """The module of the settings, with weights drawn anew. Raises ValueError, TypeError for settings that cannot be."""
    return IVNetMap(settings) if settings.arch == "ivnet" else MLPMap(settings)
