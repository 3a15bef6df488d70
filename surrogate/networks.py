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
from surrogate.symmetric import Parts, Rows
from surrogate.targets import TARGETS, apply_modes, roughened, to_frame

Arch = Literal["ivnet", "mlp"]


@dataclass(frozen=True)
class Settings:
    """What a network is of. modes: of an operator, one network for each of "ivnet"; () for other maps, and all of them for "mlp".

    network: blocks, width, ... of the IVNet or MLP; ranks: coefficients of each part of an MLP's output (`surrogate.symmetric`).
    rolloff: of an MLP's kernels (`surrogate.targets`).
    """

    map: str
    arch: Arch
    points: int
    channels: tuple[str, ...]
    modes: tuple[int, ...] = ()
    network: dict[str, Any] = field(default_factory=dict)
    ranks: tuple[int, ...] = ()
    rolloff: float | None = None

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

    def operators(self, X: Tensor) -> Tensor:
        """Of velocities, all modes (M, G, *output_shape), for `apply_to`."""
        out: Tensor = self(X)
        return out

    def apply_to(self, operators: Tensor, u: Tensor, frames: Tensor) -> Tensor:
        """Parts (M, S, C, N) of the answers to velocities u (M, 2 [x, y], N)."""
        return apply_modes(operators, u)

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
        shape = settings.output_shape
        self.rows = Rows(settings.map, shape) if TARGETS[settings.map].operator else None
        self.parts = self.rows.parts if self.rows else Parts(settings.map, shape)
        into, rank = len(settings.channels) * settings.points, sum(settings.ranks)
        self.core = MLP(into, rank, **settings.network)
        self.register_buffer("input_mean", torch.zeros(into))
        self.register_buffer("input_scale", torch.ones(into))
        self.register_buffer("output_scale", torch.ones(rank))
        self.register_buffer("lowest", torch.full((rank,), -float("inf")))
        self.register_buffer("highest", torch.full((rank,), float("inf")))
        self.register_buffer("output_mean", torch.zeros(self.parts.size))  # of the even part: the others have none
        self.register_buffer("basis", torch.zeros(rank, self.parts.size))

        self._basis_rows: tuple[Tensor, list[Tensor], Tensor] | None = None  # basis, its rows, those of the mean

    def forward(self, X: Tensor) -> Tensor:
        return self.outputs(self.coefficients(self.features(X))).reshape(len(X), 1, *self.settings.output_shape)

    @torch.no_grad()
    def operators(self, X: Tensor) -> Tensor:
        """Of velocities, in the form that `apply_to` takes: less work than the whole kernel, that calling gives."""
        assert self.rows is not None
        basis, mean = self._rows_of_basis()
        c = self.coefficients(self.features(X)).split(self.settings.ranks, dim=1)
        parts = torch.empty((len(X), 4, mean.shape[1]), dtype=mean.dtype, device=mean.device)
        for i in range(4):
            torch.mm(c[i], basis[i], out=parts[:, i])
        parts[:, 0] += mean
        return self.rows.images(parts)

    def apply_to(self, operators: Tensor, u: Tensor, frames: Tensor) -> Tensor:
        """Parts (M, S, C, N) of the answers to velocities u (M, 2 [x, y], N)."""
        assert self.rows is not None
        return self.rows.apply_to(operators, to_frame(roughened(u, self.settings.rolloff), frames).to(operators.dtype))

    def _rows_of_basis(self) -> tuple[list[Tensor], Tensor]:
        """Made once of a basis."""
        assert self.rows is not None
        if self._basis_rows is None or self._basis_rows[0] is not self.basis:
            each = [self.rows.of_part(i, vectors) for i, vectors in enumerate(self.basis.split(self.settings.ranks))]
            self._basis_rows = self.basis, each, self.rows.of_part(0, self.output_mean[None])
        return self._basis_rows[1:]

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
