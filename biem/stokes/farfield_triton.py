"""The direct pair sum as one fused CUDA kernel: `kernels.stokeslet`, held to it by tests/stokes/test_farfield_triton.py.

Each program takes a block of targets and a share of the sources. Pairs are summed in the arrays' dtype over STRETCH sources, these sums in
float64. Importing this module loads Triton.
"""

from __future__ import annotations

from math import log

import triton
import triton.language as tl

from biem.backend import Array, array_namespace
from biem.stokes.kernels import LOG_SIGN

TARGETS, SOURCES = 64, 32  # block of pairs: 16 per thread with 4 warps
STRETCH = 1024
PROGRAMS = 2048  # enough to fill a large GPU; with few targets the sources are shared out


@triton.jit
def _kernel(  # type: ignore[no-untyped-def]
    x, y, g, skip, u, P, S, N, share, LOG_SCALE: tl.constexpr, TARGETS: tl.constexpr, SOURCES: tl.constexpr, STRETCH: tl.constexpr
):
    p = tl.program_id(0) * TARGETS + tl.arange(0, TARGETS)
    inside = p < P
    x0 = tl.load(x + 2 * p, inside, 0.0)[:, None]
    x1 = tl.load(x + 2 * p + 1, inside, 0.0)[:, None]
    own = tl.load(skip + p, inside, -1)[:, None]
    u0 = tl.zeros((TARGETS,), tl.float64)
    u1 = tl.zeros((TARGETS,), tl.float64)
    log_scale = tl.full((TARGETS,), LOG_SCALE, tl.float64)  # a float argument would arrive in float32
    first = tl.program_id(1) * share
    for stretch in range(first, tl.minimum(first + share, S), STRETCH):
        along_0 = tl.zeros((TARGETS, SOURCES), x0.dtype)
        along_1 = tl.zeros((TARGETS, SOURCES), x0.dtype)
        log_0 = tl.zeros((TARGETS, SOURCES), x0.dtype)
        log_1 = tl.zeros((TARGETS, SOURCES), x0.dtype)
        for start in range(stretch, stretch + STRETCH, SOURCES):
            k = start + tl.arange(0, SOURCES)
            there = k < S
            j = k // N
            at = k + j * N  # (M, 2, N): x at 2 j N + n
            rx = x0 - tl.load(y + at, there, 0.0)[None, :]
            ry = x1 - tl.load(y + at + N, there, 0.0)[None, :]
            g0 = tl.load(g + at, there, 0.0)[None, :]
            g1 = tl.load(g + at + N, there, 0.0)[None, :]
            r2 = rx * rx + ry * ry
            none = (r2 == 0.0) | (own == j[None, :])  # a point does not act on itself
            r2 = tl.where(none, 1.0, r2)
            along = tl.where(none, 0.0, (rx * g0 + ry * g1) / r2)
            log_r = tl.log2(r2)
            along_0 += along * rx
            along_1 += along * ry
            log_0 += log_r * g0
            log_1 += log_r * g1
        u0 += tl.sum(along_0, axis=1).to(tl.float64) + log_scale * tl.sum(log_0, axis=1).to(tl.float64)
        u1 += tl.sum(along_1, axis=1).to(tl.float64) + log_scale * tl.sum(log_1, axis=1).to(tl.float64)
    out = u + (tl.program_id(1) * P + p) * 2
    tl.store(out, u0, inside)
    tl.store(out + 1, u1, inside)


def sum_pairs(x: Array, y: Array, g: Array, skip: Array, scale: float) -> Array:
    """Velocity (P, 2) at x (P, 2) of forces g (M, 2, N) at y (M, 2, N), CUDA tensors; target p skips curve skip[p]."""
    xp = array_namespace(x)
    P, (M, _, N) = x.shape[0], y.shape
    if P == 0:
        return xp.zeros_like(x)
    S = M * N
    blocks = triton.cdiv(P, TARGETS)
    share = STRETCH * triton.cdiv(triton.cdiv(S, STRETCH), max(1, PROGRAMS // blocks))
    shares = triton.cdiv(S, share)
    u = xp.empty((shares, P, 2), dtype=xp.float64, device=x.device)
    x, y, g, skip = (a.contiguous() for a in (x, y, g, skip))
    _kernel[(blocks, shares)](x, y, g, skip, u, P, S, N, share, 0.5 * LOG_SIGN * log(2.0), TARGETS, SOURCES, STRETCH)
    return xp.astype(scale * xp.sum(u, axis=0), x.dtype)
