"""Input channels of the networks, from curves X (M, 2, N) in the standard pose, in float64: high derivatives lose their digits in float32.

x y                 the nodes
normal_x normal_y   the outward normal
speed               |X_alpha|
curvature, curvature_s, curvature_ss
bending_n bending_t     normal and tangential part of the velocity -(1/(4 |D|)) X_ssss that bending would give a straight membrane
"""

from __future__ import annotations

from functools import lru_cache
from math import pi

import torch
from torch import Tensor

CHANNELS = ("x", "y", "normal_x", "normal_y", "speed", "curvature", "curvature_s", "curvature_ss", "bending_n", "bending_t")


@lru_cache(maxsize=8)
def _symbols(N: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Of the derivative in alpha, the Nyquist mode taken out, and of 1/(4 |D|) on a membrane of length 1."""
    k = torch.arange(N // 2 + 1, dtype=torch.float64, device=device)
    derivative = 1j * torch.where(k < N // 2, k, torch.zeros_like(k))
    return derivative, torch.where(k > 0, 1.0 / (8.0 * pi * torch.clamp(k, min=1.0)), torch.zeros_like(k))


def derivative(f: Tensor) -> Tensor:
    """d/d alpha of real f (..., N)."""
    symbol, _ = _symbols(f.shape[-1], f.device)
    return torch.fft.irfft(symbol * torch.fft.rfft(f), n=f.shape[-1])


def frame(X: Tensor) -> Tensor:
    """Outward normal and tangent of X (M, 2, N): (M, 2 [normal, tangent], 2 [x, y], N)."""
    X_alpha = derivative(X)
    t = X_alpha / X_alpha.norm(dim=1, keepdim=True)
    return torch.stack([torch.stack([t[:, 1], -t[:, 0]], dim=1), t], dim=1)


def features(X: Tensor, channels: tuple[str, ...] = CHANNELS) -> Tensor:
    """The channels (M, C, N) of X (M, 2, N), both float64."""
    N = X.shape[-1]
    X_alpha = derivative(X)
    speed = X_alpha.norm(dim=1, keepdim=True)
    t = X_alpha / speed
    n = torch.stack([t[:, 1], -t[:, 0]], dim=1)
    t_s = derivative(t) / speed
    curvature = (t[:, 0] * t_s[:, 1] - t[:, 1] * t_s[:, 0])[:, None]
    curvature_s = derivative(curvature) / speed
    X_ssss = derivative(derivative(t_s) / speed) / speed
    bending = -torch.fft.irfft(_symbols(N, X.device)[1] * torch.fft.rfft(X_ssss), n=N)
    made = {
        "x": X[:, :1],
        "y": X[:, 1:],
        "normal_x": n[:, :1],
        "normal_y": n[:, 1:],
        "speed": speed,
        "curvature": curvature,
        "curvature_s": curvature_s,
        "curvature_ss": derivative(curvature_s) / speed,
        "bending_n": (bending * n).sum(1, keepdim=True),
        "bending_t": (bending * t).sum(1, keepdim=True),
    }
    return torch.cat([made[name] for name in channels], dim=1)
