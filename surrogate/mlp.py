"""Shared-trunk residual perceptron: one network for all modes of a map, its outputs coefficients in a basis that the data give.

    x -> W_0 x -> blocks times  h + W_2 silu(W_1 silu(h))  -> W silu(h): rank coefficients c;     output = mean + basis^T c

With the basis of the principal components of the targets (PCA-Net: Bhattacharya, Hosseini, Kovachki, Stuart 2021) the loss is a norm of
c, and the thousands of numbers of an operator are formed at inference alone.
"""

from __future__ import annotations

from torch import Tensor, nn


class ResidualBlock(nn.Module):
    """h + W_2 silu(W_1 silu(h)), at first h."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, h: Tensor) -> Tensor:
        return h + self.second(nn.functional.silu(self.first(nn.functional.silu(h))))


class MLP(nn.Module):
    """(B, into) -> (B, out). Raises ValueError for settings that cannot be."""

    def __init__(self, into: int, out: int, width: int = 512, blocks: int = 2) -> None:
        super().__init__()
        if min(into, out, width, blocks) < 1:
            raise ValueError(f"an MLP of width {width} and {blocks} blocks, {into} inputs, {out} outputs: all must be at least 1")
        self.layers = nn.Sequential(
            nn.Linear(into, width), *(ResidualBlock(width) for _ in range(blocks)), nn.SiLU(), nn.Linear(width, out)
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.layers(x)
        return out
