"""Outputs of kernels by their parts even and odd under the symmetries of the standard pose: a quarter of the numbers, and of the work.

The symmetries are e, a turn and two mirrors, each its own inverse, the product of two the third. They act on a flat output Y (P,) as signed
permutations, (g Y)_p = s_g,p Y_{pi_g p}. With the characters chi_i(g) = +-1,

    Y = Y_0 + Y_1 + Y_2 + Y_3,     g Y_i = chi_i(g) Y_i,     Y_i orthogonal to each other

so that Y_i is known from its values at one point p of each orbit: Y_{i, pi_g p} = s_g,p chi_i(g) Y_{i, p}. A network's coefficients of the
i-th part only change their sign with chi_i(g) when it sees the image of a shape.

An operator A on velocities needs no more than its rows at one node r of each orbit of nodes, and is never formed whole:

    A u = sum_g g [sum_r w_g,r (g u)_r Y_g,r],     Y_g = sum_i chi_i(g) A_i,     w = 1 once for each point of the orbit of r
"""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor, nn

from surrogate.targets import SYMMETRIES, TARGETS

CHARACTERS = torch.tensor([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]], dtype=torch.float32)  # [i, g]


def actions(name: str, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """pi and s (4, P) of the symmetries, on the flat outputs of a map of this shape."""
    numbers = torch.arange(1, 1 + prod(shape), dtype=torch.float64).reshape(1, *shape)
    moved = [(g.kernel(numbers) if TARGETS[name].operator else g.parts(numbers)).flatten() for g in SYMMETRIES]
    return _signed(moved)


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


class Rows(nn.Module):
    """Operators by their rows: Y (n, 4, R, P) for R inputs, one of each orbit, P flat outputs. shape: of their kernels (2, N, S, C, N)."""

    def __init__(self, name: str, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.shape = shape
        self.parts = Parts(name, shape)
        into, sign_into = _actions_on_fields(shape[:2])
        goal, sign = _actions_on_fields(shape[2:])
        rows = torch.unique(into.min(dim=0).values)
        seen = torch.stack([(into[:g, rows] == into[g, rows]).any(dim=0) for g in range(4)])
        keep = {"rows": rows, "taken": into[:, rows], "weight": sign_into[:, rows] * ~seen, "goal": goal, "sign": sign}
        for key, value in keep.items():
            self.register_buffer(key, value, persistent=False)

    def of_part(self, index: int, values: Tensor) -> Tensor:
        """Rows (n, R P) of the index-th part, from its values (n, Q)."""
        zero = torch.zeros_like(values)
        whole = self.parts.put(torch.stack([values if i == index else zero for i in range(4)], dim=1))
        return whole.reshape(len(values), self.shape[0] * self.shape[1], -1)[:, self.rows].flatten(1)

    def images(self, parts: Tensor) -> Tensor:
        """Y from the rows of the parts (n, 4, R P)."""
        a, b = parts[:, 0] + parts[:, 1], parts[:, 2] + parts[:, 3]
        c, d = parts[:, 0] - parts[:, 1], parts[:, 2] - parts[:, 3]
        Y = torch.empty_like(parts)  # filled in place: these are the largest arrays of a step
        torch.add(a, b, out=Y[:, 0])
        torch.sub(a, b, out=Y[:, 1])
        torch.add(c, d, out=Y[:, 2])
        torch.sub(c, d, out=Y[:, 3])
        return Y.reshape(len(Y), 4, len(self.rows), -1)

    def apply_to(self, Y: Tensor, u: Tensor) -> Tensor:
        """(n, S, C, N) of parts u (n, 2, N) of velocities."""
        w = u.flatten(1)[:, self.taken] * self.weight
        n, _, R, P = Y.shape
        z = torch.bmm(w.reshape(4 * n, 1, R), Y.reshape(4 * n, R, P)).reshape(n, 4, P)
        moved = [z[:, g, self.goal[g]] * self.sign[g] for g in range(4)]
        return torch.stack(moved).sum(dim=0).reshape(n, *self.shape[2:])


def _actions_on_fields(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """The actions on the normal and tangential parts of fields, or on scalars, of this shape (..., C, N)."""
    numbers = torch.arange(1, 1 + prod(shape), dtype=torch.float64).reshape(shape)
    return _signed([g.parts(numbers).flatten() for g in SYMMETRIES])


def _signed(moved: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Signed permutations of 1, 2, ... as indices and signs."""
    signed = torch.stack(moved)
    return signed.abs().long() - 1, signed.sign().float()
