"""How far a shape is from those that a network was trained on: the distance of its nodes in the training shapes' principal axes.

    d^2 = mean over AXES of (axis . (X - center) / deviation)^2  +  (what is left of X - center / its deviation)^2,   X in the standard pose

Shapes beyond `limit`, the distance that all but one in a thousand training shapes keep, are outside the distribution.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

AXES = 16
INSIDE = 0.999  # of the training shapes


class Distribution(nn.Module):
    """Statistics of standardized shapes of N nodes."""

    def __init__(self, points: int) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(2 * points, dtype=torch.float64))
        self.register_buffer("axes", torch.zeros(AXES, 2 * points, dtype=torch.float64))
        self.register_buffer("deviation", torch.ones(AXES + 1, dtype=torch.float64))
        self.register_buffer("limit", torch.tensor(float("inf"), dtype=torch.float64))

    def measure(self, X: Tensor) -> None:
        """Takes the statistics of X (n, 2, N)."""
        flat = X.flatten(1).double()
        self.center.copy_(flat.mean(dim=0))
        _, vectors = torch.linalg.eigh((flat - self.center).T @ (flat - self.center))
        self.axes.copy_(vectors.T.flip(0)[:AXES])
        self.deviation.copy_(self._coordinates(flat).square().mean(dim=0).sqrt().clamp(min=1e-12))
        self.limit.copy_(torch.quantile(self(X), INSIDE))

    def forward(self, X: Tensor) -> Tensor:
        """Distance (M,) of X (M, 2, N)."""
        z = self._coordinates(X.flatten(1).double()) / self.deviation
        return (z[:, :AXES].square().mean(dim=1) + z[:, AXES].square()).sqrt()

    def _coordinates(self, flat: Tensor) -> Tensor:
        """Along the axes, and the size of the rest (M, AXES + 1)."""
        local = flat - self.center
        z = local @ self.axes.T
        rest = local - z @ self.axes
        return torch.cat([z, rest.norm(dim=1, keepdim=True)], dim=1)
