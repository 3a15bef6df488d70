"""Compiled loops of the near field: cell lists of nodes, closest points of Fourier curves, single layers of single pairs.

A cell list holds classes of curves, each with square cells as wide as its curves reach; cells are hashed into one table, so that no
extent, however large, costs memory. Different cells that share a bucket cost time alone: every node is judged by its distance.
Results do not depend on the number of threads. Importing this module loads numba.
"""

from typing import Any

import numpy as np
from numba import njit, prange

ROW, CLASS = 0x5E3779B1, 0x45EBCA6B  # odd: rows of cells lie anywhere in the table, the cells of a row side by side
FARTHEST = 2.0**52  # cells from the origin: beyond, positions are coarser than a cell
BLOCK = 256  # targets that share their scratch memory
SLOTS = 6  # curves near a target that are kept from the first pass


@njit(error_model="numpy", cache=True)
def _bucket(i: Any, j: Any, klass: Any, mask: Any) -> Any:
    return ((i & mask) * ROW + j + klass * CLASS) & mask


@njit(parallel=True, error_model="numpy", cache=True)
def cell_list(nodes: Any, klass: Any, size: Any, mask: int) -> Any:
    """Nodes (M, n, 2) sorted by bucket, with size[klass[m]] the cells' width for curve m; curves of class -1 are left out.

    Returns start (mask + 4,), points and label = m n + k: bucket b holds points[start[b] : start[b + 1]]. Buckets 0 and 1 stand once
    more at the end, so that three cells side by side are always one range.
    """
    M, n, _ = nodes.shape
    bucket = np.empty((M, n), dtype=np.int64)
    for m in prange(M):
        width = size[klass[m]] if klass[m] >= 0 else 0.0
        for k in range(n):
            x, y = nodes[m, k, 0] / width, nodes[m, k, 1] / width
            bucket[m, k] = -1
            if abs(x) < FARTHEST and abs(y) < FARTHEST:
                bucket[m, k] = _bucket(np.int64(np.floor(x)), np.int64(np.floor(y)), klass[m], mask)
    start = np.zeros(mask + 4, dtype=np.int64)
    for b in bucket.flat:
        if b >= 0:
            start[b + 1] += 1
    start[mask + 2], start[mask + 3] = start[1], start[2]
    for b in range(mask + 3):
        start[b + 1] += start[b]
    points = np.empty((start[mask + 3], 2))
    label = np.empty(start[mask + 3], dtype=np.int64)
    end = start.copy()
    for m in range(M):
        for k in range(n):
            b = bucket[m, k]
            while 0 <= b <= mask + 2:
                points[end[b], 0], points[end[b], 1], label[end[b]] = nodes[m, k, 0], nodes[m, k, 1], m * n + k
                end[b] += 1
                b += mask + 1
    return start, points, label


@njit(error_model="numpy", cache=True)
def _closest_nodes(x: Any, y: Any, skip: Any, cells: Any, n: int, size: Any, reach: Any, best: Any, gap: Any) -> Any:
    """Labels of the closest node of every curve within its reach, sorted, into best, their squared distances into gap; the number."""
    start, points, label = cells
    found = 0
    mask = len(start) - 4
    for klass in range(len(size)):
        width = size[klass]
        cell_x, cell_y = x / width, y / width
        if not (abs(cell_x) < FARTHEST and abs(cell_y) < FARTHEST):
            continue
        i, j = np.int64(np.floor(cell_x)), np.int64(np.floor(cell_y))
        for row in range(i - 1, i + 2):
            b = _bucket(row, j - 1, klass, mask)
            for s in range(start[b], start[b + 3]):
                rx, ry = points[s, 0] - x, points[s, 1] - y
                r2 = rx * rx + ry * ry
                if r2 > width * width or skip * n <= label[s] < (skip + 1) * n:
                    continue
                m = label[s] // n
                if r2 > reach[m] * reach[m]:
                    continue
                slot, end = 0, found
                while slot < end:
                    middle = (slot + end) // 2
                    if best[middle] < m * n:
                        slot = middle + 1
                    else:
                        end = middle
                if slot < found and best[slot] < (m + 1) * n:
                    if r2 < gap[slot] or (r2 == gap[slot] and label[s] < best[slot]):
                        best[slot], gap[slot] = label[s], r2
                    continue
                for later in range(found, slot, -1):
                    best[later], gap[later] = best[later - 1], gap[later - 1]
                best[slot], gap[slot] = label[s], r2
                found += 1
    return found


@njit(parallel=True, error_model="numpy", cache=True)
def candidates(x: Any, skip: Any, cells: Any, n: int, size: Any, reach: Any) -> Any:
    """Targets x (P, 2) with the closest node of every curve m that has a node within reach[m]: target, label, sorted by both."""
    P, M = len(x), len(reach)
    blocks = (P + BLOCK - 1) // BLOCK
    first = np.zeros(P + 1, dtype=np.int64)
    kept = np.empty((P, SLOTS), dtype=np.int64)
    for block in prange(blocks):
        best, gap = np.empty(M, dtype=np.int64), np.empty(M)
        for p in range(block * BLOCK, min(P, (block + 1) * BLOCK)):
            first[p + 1] = _closest_nodes(x[p, 0], x[p, 1], skip[p], cells, n, size, reach, best, gap)
            for slot in range(min(first[p + 1], SLOTS)):
                kept[p, slot] = best[slot]
    for p in range(P):
        first[p + 1] += first[p]
    target, node = np.empty(first[P], dtype=np.int64), np.empty(first[P], dtype=np.int64)
    for p in prange(P):
        here = node[first[p] : first[p + 1]]
        if len(here) > SLOTS:
            _closest_nodes(x[p, 0], x[p, 1], skip[p], cells, n, size, reach, here, np.empty(len(here)))
        else:
            for slot in range(len(here)):
                here[slot] = kept[p, slot]
        for q in range(first[p], first[p + 1]):
            target[q] = p
    return target, node


@njit(parallel=True, error_model="numpy", cache=True)
def smallest_node_distance(X: Any, other: Any) -> Any:
    """Smallest distance between a node of a curve m (X: (M, 2, N)) and one of curve other[m]."""
    M, _, N = X.shape
    r2 = np.full(M, np.inf)
    for m in prange(M):
        for k in range(N):
            for j in range(N):
                rx, ry = X[m, 0, k] - X[other[m], 0, j], X[m, 1, k] - X[other[m], 1, j]
                r2[m] = min(r2[m], rx * rx + ry * ry)
    return np.sqrt(r2.min())


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _point(c: Any, alpha: Any) -> Any:
    """X, X_alpha, X_alphaalpha at alpha from c (K, 4) = Re, Im of x, Re, Im of y: X = Re sum_k (c_0 + i c_1) e^{i k alpha}.

    The last mode is the Nyquist mode, which derivatives do not see.
    """
    K = len(c)
    cos_1, sin_1 = np.cos(alpha), np.sin(alpha)
    x, y = c[0, 0], c[0, 2]
    x_a = y_a = x_aa = y_aa = 0.0
    cos_k, sin_k = cos_1, sin_1
    for k in range(1, K - 1):
        real_x = c[k, 0] * cos_k - c[k, 1] * sin_k
        real_y = c[k, 2] * cos_k - c[k, 3] * sin_k
        x += real_x
        y += real_y
        x_a -= k * (c[k, 0] * sin_k + c[k, 1] * cos_k)
        y_a -= k * (c[k, 2] * sin_k + c[k, 3] * cos_k)
        x_aa -= k * k * real_x
        y_aa -= k * k * real_y
        cos_k, sin_k = cos_k * cos_1 - sin_k * sin_1, sin_k * cos_1 + cos_k * sin_1
    x += c[K - 1, 0] * cos_k - c[K - 1, 1] * sin_k
    y += c[K - 1, 2] * cos_k - c[K - 1, 3] * sin_k
    return x, y, x_a, y_a, x_aa, y_aa


@njit(parallel=True, error_model="numpy", cache=True)
def closest_points(c: Any, x: Any, vesicle: Any, alpha: Any, steps: int, accuracy: float) -> Any:
    """Newton's method of `near_search.locate` for every pair: r, X_alpha, X_alphaalpha (Q, 2) and alpha (Q,).

    c (M, K, 4): coefficients about each curve's centre, see `_point`; x (Q, 2): targets from that centre.
    """
    Q = len(alpha)
    r, X_a, X_aa, at = np.empty((Q, 2)), np.empty((Q, 2)), np.empty((Q, 2)), np.empty(Q)
    for q in prange(Q):
        curve = c[vesicle[q]]
        a = alpha[q]
        for _ in range(steps):
            x0, x1, xa0, xa1, xaa0, xaa1 = _point(curve, a)
            r0, r1 = x0 - x[q, 0], x1 - x[q, 1]
            speed2 = xa0 * xa0 + xa1 * xa1
            slope = speed2 + r0 * xaa0 + r1 * xaa1
            gradient = r0 * xa0 + r1 * xa1
            step = -gradient / (slope if slope > 0.25 * speed2 or abs(gradient) < 0.05 * slope else speed2)
            a += min(max(step, -0.5), 0.5)
            if abs(step) < accuracy:
                break
        x0, x1, X_a[q, 0], X_a[q, 1], X_aa[q, 0], X_aa[q, 1] = _point(curve, a)
        r[q, 0], r[q, 1], at[q] = x0 - x[q, 0], x1 - x[q, 1], a
    return r, X_a, X_aa, at
