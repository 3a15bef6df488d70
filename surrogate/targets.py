"""What the networks learn: outputs and velocities in the local frame of the membrane, and what the symmetries of a shape do to them.

A vector is given by its normal and its tangential part at each node, which the tangents of the input then need not explain. An operator,
linear in a velocity u, has one of two forms, d or a the direction of the input, s the layer, c the part of the output, j the node:

    modes    D_k[d, s, c, j] = e^{-ik alpha_j} (A e^{ik alpha} e_d)[s, c, j]     complex, k = 0..N/2; a network for each k. Demodulated, it
             goes with the nodes when the first node is shifted
    kernel   A[a, i, s, c, j]     the response to the part a of w at node i; one network for all. Mode k of w is that of u over f_k: with
             f_k = 1/(1 + (k/rolloff)^2) a loss of kernels counts velocities as smooth as they are (w = u, f_k = 1 with no rolloff)

    S = 1 layer, c = normal, tangential: advection;   S = 1, C = 1: flow_tension;   S = 5, C = 2: near.   relax (2, N), self_tension (1, N)
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Literal

import torch
from torch import Tensor

Form = Literal["modes", "kernel"]


@dataclass(frozen=True)
class Target:
    """layers and parts of the output; operator: whether it acts on a velocity; floor: least norm of relative errors, in median norms."""

    layers: int
    parts: int
    operator: bool
    floor: float = 0.0


TARGETS = {
    "relax": Target(1, 2, False, 0.1),  # near equilibrium a relative error means nothing
    "self_tension": Target(1, 1, False),
    "advection": Target(1, 2, True),
    "flow_tension": Target(1, 1, True),
    "near": Target(5, 2, True),
}


@dataclass(frozen=True)
class Symmetry:
    """A symmetry of the standard pose: X'_j = (x_sign x, y_sign y) at the node sense j + shift N/2. It is its own inverse."""

    x_sign: int
    y_sign: int
    sense: int
    shift: int

    def nodes(self, values: Tensor) -> Tensor:
        """values (..., N) at the nodes that those of the image are of."""
        N = values.shape[-1]
        j = torch.arange(N, device=values.device)
        return values[..., (self.sense * j + self.shift * (N // 2)) % N]

    def points(self, X: Tensor) -> Tensor:
        """Image of X (n, 2, N)."""
        signs = torch.tensor([self.x_sign, self.y_sign], dtype=X.dtype, device=X.device)
        return self.nodes(X) * signs[:, None]

    def parts(self, values: Tensor) -> Tensor:
        """Image of a field (..., C, N): of its normal and tangential part, or of a scalar."""
        values = self.nodes(values)
        if values.shape[-2] == 1 or self.sense == 1:
            return values
        return values * torch.tensor([1.0, -1.0], dtype=values.dtype, device=values.device)[:, None]

    def modes(self, D: Tensor) -> Tensor:
        """Image of one mode's D (n, 2 [re, im], 2 [d], S, C, N)."""
        signs = torch.tensor([self.x_sign, self.y_sign], dtype=D.dtype, device=D.device)[:, None, None, None]
        D = self.parts(D) * signs
        return D if self.sense == 1 else D * torch.tensor([1.0, -1.0], dtype=D.dtype, device=D.device)[:, None, None, None, None]

    def kernel(self, A: Tensor) -> Tensor:
        """Image of A (n, 2 [a], N [i], S, C, N)."""
        A = self.parts(A)
        return self.parts(A.movedim(2, -1).movedim(1, -2)).movedim(-2, 1).movedim(-1, 2)


SYMMETRIES = (Symmetry(1, 1, 1, 0), Symmetry(-1, -1, 1, 1), Symmetry(1, -1, -1, 0), Symmetry(-1, 1, -1, 1))


def to_frame(v: Tensor, frames: Tensor) -> Tensor:
    """Normal and tangential parts of vectors v (n, ..., 2 [x, y], N); frames (n, 2 [normal, tangent], 2, N)."""
    F = frames.reshape(len(frames), *(1,) * (v.ndim - 3), 2, 2, -1).to(v.dtype)
    return (F * v[..., None, :, :]).sum(-2)


def from_frame(parts: Tensor, frames: Tensor) -> Tensor:
    """Inverse of `to_frame`."""
    F = frames.reshape(len(frames), *(1,) * (parts.ndim - 3), 2, 2, -1).to(parts.dtype)
    return (F * parts[..., :, None, :]).sum(-3)


def carrier(modes: tuple[int, ...] | Tensor, N: int, device: torch.device | None = None) -> Tensor:
    """k alpha_j (K, N) float64."""
    k = torch.as_tensor(modes, dtype=torch.float64, device=device)
    return 2.0 * pi / N * k[:, None] * torch.arange(N, dtype=torch.float64, device=device)


def demodulated(T: Tensor, k: int, frames: Tensor) -> Tensor:
    """D_k (n, 2 [re, im], 2 [d], S, C, N) float32 of the labels T of one mode, the same shape, C in x and y where it is 2."""
    if T.shape[-2] == 2:
        T = to_frame(T, frames)
    phase = carrier((k,), T.shape[-1])[0].to(T.dtype)
    c, s = torch.cos(phase), torch.sin(phase)
    return torch.stack([T[:, 0] * c + T[:, 1] * s, T[:, 1] * c - T[:, 0] * s], dim=1).float()


def spectrum(N: int, rolloff: float | None) -> Tensor:
    """f_k (N/2 + 1,) float64."""
    k = torch.arange(N // 2 + 1, dtype=torch.float64)
    return torch.ones_like(k) if rolloff is None else 1.0 / (1.0 + (k / rolloff) ** 2)


def roughened(u: Tensor, rolloff: float | None) -> Tensor:
    """w (n, 2, N) of velocities u."""
    if rolloff is None:
        return u
    N = u.shape[-1]
    return torch.fft.irfft(torch.fft.rfft(u) / spectrum(N, rolloff).to(u), n=N)


def kernel_of_modes(T: Tensor, frames: Tensor, rolloff: float | None = None) -> Tensor:
    """A (n, 2 [a], N [i], S, C, N) float32 of the labels T (n, K, 2 [re, im], 2 [d], S, C, N) of all modes k = 0..N/2.

    The w that is 1 at node i alone is sum_k w_k/N cos(k (alpha - alpha_i)), w_k = 1, 2, ..., 2, 1, of a u with f_k in each mode.
    """
    N = T.shape[-1]
    if T.shape[-2] == 2:
        T = to_frame(T, frames)
    phase = carrier(tuple(range(N // 2 + 1)), N).to(T.dtype)
    weights = (mode_weights(N) * spectrum(N, rolloff)).to(T.dtype)[:, None] / N
    basis = torch.stack([torch.cos(phase) * weights, torch.sin(phase) * weights], dim=1)  # (K, 2 [re, im], N [i])
    n = len(T)
    flat = T.movedim(3, 1).reshape(n * 2, basis.shape[0] * 2, -1)  # (n d, K re/im, S C N)
    nodal = torch.einsum("qi,mqf->mif", basis.reshape(-1, N), flat).reshape(n, 2, N, *T.shape[4:])
    F = frames.to(T.dtype)[:, :, :, :, None, None, None]  # (n, a, d, i, 1, 1, 1)
    return (F[:, :, 0] * nodal[:, None, 0] + F[:, :, 1] * nodal[:, None, 1]).float()


def mode_weights(N: int) -> Tensor:
    """(N/2 + 1,): how often a mode of the real transform counts."""
    w = torch.full((N // 2 + 1,), 2.0, dtype=torch.float64)
    w[0] = w[-1] = 1.0
    return w


def modes_of_kernel(A: Tensor, frames: Tensor, rolloff: float | None = None) -> Tensor:
    """D_k (n, K, 2 [re, im], 2 [d], S, C, N) of A (n, 2 [a], N [i], S, C, N): to compare both forms mode by mode."""
    n, _, N = A.shape[:3]
    F = frames.to(A.dtype)[:, :, :, :, None, None, None]
    nodal = F[:, 0] * A[:, 0, None] + F[:, 1] * A[:, 1, None]  # (n, d, i, S, C, N)
    phase = carrier(tuple(range(N // 2 + 1)), N).to(A.dtype)
    flat = nodal.reshape(n, 2, N, -1)
    re = torch.einsum("ki,ndif->nkdf", torch.cos(phase), flat).reshape(n, -1, 2, *A.shape[3:])
    im = torch.einsum("ki,ndif->nkdf", torch.sin(phase), flat).reshape(re.shape)
    c, s = torch.cos(phase)[:, None, None, None, :], torch.sin(phase)[:, None, None, None, :]
    return torch.stack([re * c + im * s, im * c - re * s], dim=2) / spectrum(N, rolloff).to(A)[:, None, None, None, None, None]


def apply_modes(D: Tensor, u: Tensor) -> Tensor:
    """Sum over modes of D (M, K, 2 [re, im], 2 [d], S, C, N), K = N/2 + 1, with the coefficients of u (M, 2, N): (M, S, C, N)."""
    N = u.shape[-1]
    c = torch.fft.rfft(u).movedim(-1, 1) * (mode_weights(N).to(u.device)[:, None] / N)  # (M, K, d)
    phase = carrier(tuple(range(N // 2 + 1)), N, u.device)
    turned = c[..., None] * torch.exp(1j * phase)[:, None]  # (M, K, d, N)
    # the im part of T belongs to sin: A(cos + i sin), so that Re(c T) = Re c Re T - Im c Im T
    both = torch.stack([turned.real, -turned.imag], dim=2).to(D.dtype)
    return (D * both[..., None, None, :]).sum(dim=(1, 2, 3))


def apply_kernel(A: Tensor, u: Tensor, frames: Tensor, rolloff: float | None = None) -> Tensor:
    """A (M, 2, N, S, C, N) on u (M, 2 [x, y], N): (M, S, C, N)."""
    M = len(A)
    parts = to_frame(roughened(u, rolloff), frames).to(A.dtype).reshape(M, 1, -1)
    return torch.bmm(parts, A.reshape(M, parts.shape[-1], -1)).reshape(M, *A.shape[3:])
