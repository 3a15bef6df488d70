"""Two sums over the nodes of one curve per point, as compiled loops; `near_layers` has the same in array code, and a parity test.

Importing this module loads numba. The machine code is kept between processes, which is why everything stands at module level.
"""

from typing import Any

import numpy as np
from numba import njit, prange

from biem.stokes.kernels import LOG_SIGN
from biem.stokes.pair_loop import log


@njit(parallel=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"}, cache=True)
def sum_own(x: Any, own: Any, y: Any, g: Any, scale: float) -> Any:
    """Velocity (Q, 2) at x (Q, 2) of the forces g (m, 2, n) at the nodes y (m, 2, n) of curve own[q]; coincident points do not act."""
    Q, n = x.shape[0], y.shape[2]
    u = np.empty((Q, 2))
    for q in prange(Q):
        x0, x1 = x[q, 0], x[q, 1]
        j = own[q]
        y0, y1, g0, g1 = y[j, 0], y[j, 1], g[j, 0], g[j, 1]
        ux = uy = 0.0
        for k in range(n):
            rx = x0 - y0[k]
            ry = x1 - y1[k]
            r2 = rx * rx + ry * ry
            r2 = r2 if r2 > 0.0 else 1.0
            along = (rx * g0[k] + ry * g1[k]) / r2
            log_r = LOG_SIGN * 0.5 * log(r2)
            ux += log_r * g0[k] + along * rx
            uy += log_r * g1[k] + along * ry
        u[q, 0] = scale * ux
        u[q, 1] = scale * uy
    return u


@njit(parallel=True, error_model="numpy", cache=True)
def nearest_node(x: Any, own: Any, y: Any, speed2: Any) -> Any:
    """Node (Q,) of curve own[q] with the smallest |x - y|^2 / speed2, the squared distance in the parameter."""
    Q, n = x.shape[0], y.shape[2]
    node = np.empty(Q, dtype=np.int64)
    for q in prange(Q):
        x0, x1 = x[q, 0], x[q, 1]
        j = own[q]
        y0, y1, s2 = y[j, 0], y[j, 1], speed2[j]
        best, least = 0, np.inf
        for k in range(n):
            rx = x0 - y0[k]
            ry = x1 - y1[k]
            gap = (rx * rx + ry * ry) / s2[k]
            if gap < least:
                best, least = k, gap
        node[q] = best
    return node
