"""Outputs of kernels by their parts even and odd under the symmetries of the standard pose: a quarter of the numbers, and of the work.

The symmetries are e, a turn and two mirrors, each its own inverse, the product of two the third. They act on a flat output Y (P,) as signed
permutations, (g Y)_p = s_g,p Y_{pi_g p}. With the characters chi_i(g) = +-1,

    Y = Y_0 + Y_1 + Y_2 + Y_3,     g Y_i = chi_i(g) Y_i,     Y_i orthogonal to each other

so that Y_i is known from its values at one point p of each orbit: Y_{i, pi_g p} = s_g,p chi_i(g) Y_{i, p}. A network's coefficients of the
i-th part only change their sign with chi_i(g) when it sees the image of a shape.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from surrogate.targets import SYMMETRIES, TARGETS

CHARACTERS = torch.tensor([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]], dtype=torch.float32)  # [i, g]


def actions(name: str, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """pi and s (4, P) of the symmetries, on the flat outputs of a map of this shape."""
    numbers = torch.arange(1, 1 + int(torch.tensor(shape).prod()), dtype=torch.float64).reshape(1, *shape)
    moved = [(g.kernel(numbers) if TARGETS[name].operator else g.parts(numbers)).flatten() for g in SYMMETRIES]
    signed = torch.stack(moved)
    return signed.abs().long() - 1, signed.sign().float()


class Parts(nn.Module):
    """Between flat outputs (n, P) of a map and their parts (n, 4, Q), scaled so that norms agree: sum of |part|^2 = |Y|^2.

    Everything here follows from the map and the shape: nothing is learned, nothing is kept in files.
    """

    def __init__(self, name: str, shape: tuple[int, ...]) -> None:
        super().__init__()
        to, sign = actions(name, shape)
        P = to.shape[1]
        orbit = to.min(dim=0).values
        first = torch.unique(orbit)  # one point of each orbit
        size = torch.zeros(P).scatter_add_(0, orbit, torch.ones(P))[first]
        place = torch.full((P,), -1).scatter_(0, first, torch.arange(len(first)))[orbit]
        g = torch.stack([to[g, orbit] == torch.arange(P) for g in range(4)]).long().argmax(dim=0)  # that takes an orbit's point to p
        keep = {
            "where": to[:, first],
            "sign": sign[:, first],
            "root": size.sqrt(),
            "source": g * len(first) + place,
            "characters": CHARACTERS,
        }
        for key, value in keep.items():
            self.register_buffer(key, value, persistent=False)
        self.size = len(first)

    def take(self, Y: Tensor) -> Tensor:
        """(n, P) -> (n, 4, Q)."""
        images = Y[:, self.where] * self.sign  # (n, g, Q): (g Y) at the points
        return torch.einsum("ig,ngq->niq", self.characters, images) * (0.25 * self.root)

    def put(self, y: Tensor) -> Tensor:
        """Inverse of `take`."""
        at = torch.einsum("ig,niq->ngq", self.characters, y / self.root) * self.sign
        return at.flatten(1)[:, self.source]
