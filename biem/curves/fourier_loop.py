"""`fourier.evaluate` as a compiled loop, held to it by tests/curves/test_fourier.py. Importing this module loads numba."""

from typing import Any

import numpy as np
from numba import njit


@njit(error_model="numpy", fastmath={"contract", "nsz", "reassoc"}, cache=True, nogil=True)
def evaluate(c: Any, alpha: Any) -> Any:
    """Re sum_k c_k e^{i k alpha}. c: (Q, C, K) complex, alpha: (Q, P) -> (Q, C, P); e^{i k alpha} by its recurrence in k."""
    Q, C, K = c.shape
    P = alpha.shape[1]
    out = np.zeros((Q, C, P))
    step_re, step_im, re, im = np.empty(P), np.empty(P), np.empty(P), np.empty(P)
    for q in range(Q):
        for p in range(P):
            step_re[p], step_im[p] = np.cos(alpha[q, p]), np.sin(alpha[q, p])
            re[p], im[p] = 1.0, 0.0
        for k in range(K):
            for m in range(C):
                a, b = c[q, m, k].real, c[q, m, k].imag
                for p in range(P):
                    out[q, m, p] += a * re[p] - b * im[p]
            for p in range(P):
                following = re[p] * step_re[p] - im[p] * step_im[p]
                im[p] = re[p] * step_im[p] + im[p] * step_re[p]
                re[p] = following
    return out
