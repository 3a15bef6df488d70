"""Iterated V-shaped Net on closed curves (IVNet: Zhong, Kabacaoglu and Biros), in one dimension, `groups` networks as one.

    h_0 = lift(input);     h_{i+1} = h_i + V_i(h_i), i < blocks;     output = read(h_blocks)

    V: levels times   two convolutions of stride 2, of dilation 1 and 2, concatenated
       levels times   a transposed convolution of stride 2
       a mixing convolution

h (G, B, n, C): groups, batch, nodes of a circle, channels of a group. Every convolution is circular, so that a shift of the first node by
2^levels nodes shifts the output; each is one matrix product for a group on the neighbourhoods of all nodes (cuDNN's and oneDNN's
convolutions of so few channels are several times slower). No group sees another, and their weights lie one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import sqrt

import torch
from torch import Tensor, nn

KERNEL = 5
ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"silu": nn.functional.silu, "relu": nn.functional.relu, "gelu": nn.functional.gelu}
NORMS = ("none", "batch")


class Grouped(nn.Module):
    """A linear map of the last axis for each group: (G, ..., into) -> (G, ..., out)."""

    def __init__(self, into: int, out: int, groups: int, bias: bool = True) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(groups, into, out))
        self.bias = nn.Parameter(torch.zeros(groups, 1, out)) if bias else None
        nn.init.uniform_(self.weight, -1.0 / sqrt(into), 1.0 / sqrt(into))

    def forward(self, h: Tensor) -> Tensor:
        flat = h.reshape(h.shape[0], -1, h.shape[-1])
        out = torch.bmm(flat, self.weight) if self.bias is None else torch.baddbmm(self.bias, flat, self.weight)
        return out.reshape(*h.shape[:-1], -1)


def neighbourhoods(h: Tensor, kernel: int, stride: int = 1, dilation: int = 1) -> Tensor:
    """Of every stride-th node, the values at it and its neighbours on the circle: (G, B, n, C) -> (G, B, n/stride, kernel C)."""
    n = h.shape[2]
    reach = dilation * (kernel // 2)
    padded = torch.cat([h[:, :, n - reach :], h, h[:, :, :reach]], dim=2)
    return torch.cat([padded[:, :, dilation * j : dilation * j + n : stride] for j in range(kernel)], dim=-1)


class Restriction(nn.Module):
    """Two circular convolutions of stride 2, of dilation 1 and 2, concatenated."""

    def __init__(self, into: int, out: int, groups: int, bias: bool) -> None:
        super().__init__()
        self.narrow = Grouped(KERNEL * into, out // 2, groups, bias)
        self.wide = Grouped(KERNEL * into, out // 2, groups, bias)

    def forward(self, h: Tensor) -> Tensor:
        return torch.cat([self.narrow(neighbourhoods(h, KERNEL, 2)), self.wide(neighbourhoods(h, KERNEL, 2, 2))], dim=-1)


class Interpolation(nn.Module):
    """A circular transposed convolution of stride 2: of each coarse node and its neighbours two fine nodes."""

    def __init__(self, into: int, out: int, groups: int, bias: bool) -> None:
        super().__init__()
        self.fine = Grouped(3 * into, 2 * out, groups, bias)

    def forward(self, h: Tensor) -> Tensor:
        fine = self.fine(neighbourhoods(h, 3))
        return fine.reshape(*fine.shape[:2], 2 * fine.shape[2], -1)


class Convolution(nn.Module):
    """A circular convolution."""

    def __init__(self, into: int, out: int, groups: int) -> None:
        super().__init__()
        self.all = Grouped(KERNEL * into, out, groups)

    def forward(self, h: Tensor) -> Tensor:
        return self.all(neighbourhoods(h, KERNEL))


class BatchNorm(nn.BatchNorm1d):
    """Over batch and nodes, for each channel of each group."""

    def forward(self, h: Tensor) -> Tensor:
        G, B, n, C = h.shape
        flat = super().forward(h.permute(1, 2, 0, 3).reshape(B * n, G * C))
        return flat.reshape(B, n, G, C).permute(2, 0, 1, 3)


class VBlock(nn.Module):
    """One V: down, up, mix. width channels a group at the finest level, `growth` times as many each level further down."""

    def __init__(self, width: int, levels: int, growth: float, groups: int, activation: str, norm: str) -> None:
        super().__init__()
        widths = [2 * round(0.5 * width * growth**level) for level in range(levels + 1)]
        steps = list(pairwise(widths))
        bias = norm == "none"
        self.activation = ACTIVATIONS[activation]
        self.moves = nn.ModuleList(
            [Restriction(a, b, groups, bias) for a, b in steps] + [Interpolation(b, a, groups, bias) for a, b in reversed(steps)]
        )
        out = [*widths[1:], *reversed(widths[:-1])]
        self.norms = nn.ModuleList(nn.Identity() if bias else BatchNorm(groups * c) for c in out)
        self.mix = Convolution(widths[0], widths[0], groups)
        nn.init.zeros_(self.mix.all.weight)  # each V begins as nothing: the deep sum is trained from a shallow one

    def forward(self, h: Tensor) -> Tensor:
        for move, norm in zip(self.moves, self.norms, strict=True):
            h = self.activation(norm(move(h)))
        return self.mix(h)


class IVNet(nn.Module):
    """groups networks (G, B, N, into) -> (G, B, N, out), N a multiple of 2^levels.

    blocks: n_b; width: w, channels of a group; levels: L. norm: "none" or "batch", before each activation of a V. Raises ValueError for
    settings that cannot be.
    """

    def __init__(
        self,
        into: int,
        out: int,
        groups: int = 1,
        blocks: int = 4,
        width: int = 24,
        levels: int = 2,
        growth: float = 1.5,
        activation: str = "silu",
        norm: str = "none",
    ) -> None:
        super().__init__()
        if min(into, out, groups, blocks, width // 2, levels) < 1 or growth <= 0 or activation not in ACTIVATIONS or norm not in NORMS:
            raise ValueError(
                f"an IVNet of {blocks} blocks, width {width}, {levels} levels, growth {growth}, activation {activation}, norm {norm}: "
                f"numbers must be positive, the activation one of {', '.join(ACTIVATIONS)}, the norm one of {', '.join(NORMS)}"
            )
        width = 2 * (width // 2)
        self.lift = Convolution(into, width, groups)
        self.blocks = nn.ModuleList(VBlock(width, levels, growth, groups, activation, norm) for _ in range(blocks))
        self.read = Convolution(width, out, groups)

    def forward(self, x: Tensor) -> Tensor:
        h = self.lift(x)
        for block in self.blocks:
            h = h + block(h)
        return self.read(h)
