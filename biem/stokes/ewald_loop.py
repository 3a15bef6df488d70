"""Compiled loops of `farfield_ewald`: the sum over near pairs on a cell list, and the product with the Fourier multiplier.

Each target and each mode is written once, by one thread, so the result does not depend on their number. Importing this module loads
numba.
"""

from typing import Any

import numpy as np
from numba import njit, prange

u64, f64, i64 = np.uint64, np.float64, np.int64
MANTISSA_BITS, ONE_BITS, MANTISSA = u64(52), u64(0x3FF0000000000000), u64(0x000FFFFFFFFFFFFF)
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}


@njit(parallel=True, error_model="numpy", fastmath=FASTMATH, cache=True)
def near_sum(targets: Any, order: Any, sources: Any, starts: Any, side: float, table: Any, bits: int, first: int, self_term: float) -> Any:
    """4 pi mu G_R summed over the sources within 1 of each target, (P, 2), lengths in units of the cut-off.

    targets (P, 2), from the lower left corner of the cells; order (P,): the order to visit them in; sources (S, 4): x, y, g_x, g_y
    sorted by cell; starts (nx, ny + 1): where each cell begins; side: of a cell. table (rows, 8): cubics of F1 and F2 on 2^bits pieces
    of each octave of r^2 from 2^first to 1, then a row of zeros (beyond the cut-off) and the series for closer pairs. A source at the
    target itself counts with F1 = self_term.
    """
    nx, ny = starts.shape[0], starts.shape[1] - 1
    last = i64(table.shape[0] - 1)
    shift, pieces = MANTISSA_BITS - u64(bits), f64(1 << bits)
    base, piece = i64((1023 + first) << bits), i64((1 << bits) - 1)
    u = np.empty_like(targets)
    for q in prange(targets.shape[0]):
        p = order[q]
        x0, x1 = targets[p, 0], targets[p, 1]
        a0 = a1 = b0 = b1 = 0.0
        for i in range(i64(max(0.0, np.floor((x0 - 1.0) / side))), i64(min(nx - 1.0, np.floor((x0 + 1.0) / side))) + 1):
            away = max(side * i - x0, x0 - side * (i + 1), 0.0)
            reach = np.sqrt(max(1.0 - away * away, 0.0))
            low = i64(max(0.0, np.floor((x1 - reach) / side)))
            high = i64(min(ny - 1.0, np.floor((x1 + reach) / side))) + 1
            if low >= high:
                continue
            for k in range(starts[i, low], starts[i, high]):
                rx = x0 - sources[k, 0]
                ry = x1 - sources[k, 1]
                g0, g1 = sources[k, 2], sources[k, 3]
                r2 = rx * rx + ry * ry
                raw = f64(r2).view(u64)
                row = i64(raw >> shift) - base
                if row < 0:
                    f1 = self_term if r2 == 0.0 else table[last, 0] - 0.5 * np.log(r2) + table[last, 1] * r2
                    f2 = 0.0 if r2 == 0.0 else 1.0 / r2 + table[last, 2]
                else:
                    row = min(row, last - 1)
                    t = (u64((raw & MANTISSA) | ONE_BITS).view(f64) - 1.0) * pieces - f64(row & piece)
                    c = table[row]
                    f1 = c[0] + t * (c[2] + t * (c[4] + t * c[6]))
                    f2 = c[1] + t * (c[3] + t * (c[5] + t * c[7]))
                along = f2 * (rx * g0 + ry * g1)
                a0 += f1 * g0
                a1 += f1 * g1
                b0 += along * rx
                b1 += along * ry
        u[p, 0] = a0 + b0
        u[p, 1] = a1 + b1
    return u


@njit(parallel=True, error_model="numpy", fastmath=FASTMATH, cache=True)
def multiply(C: Any, S: Any, A: Any, B: Any) -> None:
    """C(k) <- S C(k) + (A + iB) conj(C(-k)) in place; modes in FFT order. S, A, B: the quadrant k_x, k_y >= 0; B is odd in both."""
    nx, ny = C.shape
    for i in prange(nx // 2 + 1):
        mirror_i = (nx - i) % nx
        stop = ny // 2 + 1 if mirror_i == i else ny
        for j in range(stop):
            mirror_j = ny - j if j > 0 else 0
            q = min(j, mirror_j)
            b = B[i, q] if j == q else -B[i, q]
            here, there = C[i, j], C[mirror_i, mirror_j]
            D = complex(A[i, q], b)
            C[i, j] = S[i, q] * here + D * np.conj(there)
            C[mirror_i, mirror_j] = S[i, q] * there + D * np.conj(here)
