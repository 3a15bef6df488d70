"""The closest node of one curve per point, as a compiled loop; `near_layers` has the same in array code, and a parity test.

Importing this module loads numba. The machine code is kept between processes, which is why everything stands at module level.
"""

from typing import Any

import numpy as np
from numba import njit, prange


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
