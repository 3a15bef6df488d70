"""Compiled loops of the Hausdorff distance of closed polygons, (corners, 2) each, side j from corner j to corner j + 1.

The distance from a point to one side is a convex function of the point: what lies between two points within r of one and the same side
lies within r of it. Where there is no such side, what lies between is halved (branch and bound), so that the farthest point may lie
anywhere on a side. All loops run on one thread. Importing this module loads numba.
"""

from typing import Any

import numpy as np
from numba import njit

RESOLUTION = 1e-10  # in longest sides: how exactly the farthest point of a side is found
PROBES = 16  # corners that are looked at first, to raise the distance early


@njit(error_model="numpy", cache=True)
def _squared(x: Any, y: Any, B: Any, j: Any) -> Any:
    """Squared distance from (x, y) to side j of B."""
    k = j + 1 if j + 1 < len(B) else 0
    tx, ty = B[k, 0] - B[j, 0], B[k, 1] - B[j, 1]
    rx, ry = x - B[j, 0], y - B[j, 1]
    along, whole = rx * tx + ry * ty, tx * tx + ty * ty
    if along >= whole:
        rx, ry = x - B[k, 0], y - B[k, 1]
    elif along > 0:
        along /= whole
        rx, ry = rx - along * tx, ry - along * ty
    return rx * rx + ry * ry


@njit(error_model="numpy", cache=True)
def _nearest(x: Any, y: Any, B: Any, first: Any, pitch: float, enough: float, most: float) -> Any:
    """The side of B nearest to (x, y) and its distance; or any side within `enough`; or, where none is within `most`, any side.

    Sides are visited outward from side `first`. m sides further the distance has fallen by at most m pitch, with the longest side as
    pitch: sides that cannot be nearer than what was found are skipped.
    """
    n = len(B)
    ahead, behind = first, first - 1
    side, found = first, np.inf
    forward = True
    while ahead - behind <= n:
        j = ahead if forward else behind
        if j >= n:
            j -= n
        elif j < 0:
            j += n
        r2 = _squared(x, y, B, j)
        if r2 < found * found:
            side, found = j, np.sqrt(r2)
            if found <= enough:
                break
        bound = min(found, most)
        skip = 1
        if r2 > (bound + pitch) ** 2:
            skip += int((np.sqrt(r2) - bound) / pitch)
        if forward:
            ahead += skip
        else:
            behind -= skip
        forward = not forward
    return side, found


@njit(error_model="numpy", cache=True)
def _longest_side(B: Any) -> float:
    longest = 0.0
    for j in range(len(B)):
        tx, ty = B[j, 0] - B[j - 1, 0], B[j, 1] - B[j - 1, 1]
        longest = max(longest, tx * tx + ty * ty)
    return np.sqrt(longest)


@njit(error_model="numpy", cache=True)
def _climb(x: Any, y: Any, tx: Any, ty: Any, B: Any, first: Any, pitch: float, far: float, most: float, stack: Any) -> float:
    """max(far, largest distance to B along the side from (x, y) to (x + tx, y + ty)), by branch and bound; stops at `most`.

    stack (depth, 3): right ends of the intervals that are left, with the side of B nearest to them and its distance.
    """
    size = np.hypot(tx, ty)
    slack = RESOLUTION * pitch
    left = 0.0
    j, r = _nearest(x, y, B, first, pitch, -1.0, most)
    k, s = _nearest(x + tx, y + ty, B, j, pitch, -1.0, most)
    far = max(far, r, s)
    stack[0, 0], stack[0, 1], stack[0, 2] = 1.0, k, s
    depth = 1
    while depth > 0 and far < most:
        right, k, s = stack[depth - 1, 0], int(stack[depth - 1, 1]), stack[depth - 1, 2]
        bound = (far + slack) ** 2
        if (
            0.5 * (r + s + (right - left) * size) <= far + slack
            or _squared(x + right * tx, y + right * ty, B, j) <= bound
            or _squared(x + left * tx, y + left * ty, B, k) <= bound
        ):
            left, j, r = right, k, s
            depth -= 1
            continue
        middle = 0.5 * (left + right)
        k, s = _nearest(x + middle * tx, y + middle * ty, B, j, pitch, -1.0, most)
        far = max(far, s)
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = middle, k, s
        depth += 1
    return far


@njit(error_model="numpy", cache=True)
def _covered(A: Any, i: Any, k: Any, B: Any, j: Any, far: float) -> bool:
    """Whether side j of B, or one of the two after it, is within `far` of both ends of the side from corner i to corner k of A."""
    bound = far * far
    for side in range(j, j + 3):
        side = side if side < len(B) else side - len(B)
        if _squared(A[k, 0], A[k, 1], B, side) <= bound and _squared(A[i, 0], A[i, 1], B, side) <= bound:
            return True
    return False


@njit(error_model="numpy", cache=True)
def _reach(A: Any, B: Any, least: float, most: float, stack: Any) -> float:
    """max(least, largest distance from a point of A to B), or something of at least `most` as soon as that is known."""
    n, pitch = len(A), _longest_side(B)
    far = least
    for probe in range(PROBES):
        i = probe * n // PROBES
        far = max(far, _nearest(A[i, 0], A[i, 1], B, i % len(B), pitch, far, most)[1])
        if far >= most:
            return far
    j = 0
    for i in range(n):
        j, r = _nearest(A[i, 0], A[i, 1], B, j, pitch, far, most)
        far = max(far, r)
        k = i + 1 if i + 1 < n else 0
        if far < most and not _covered(A, i, k, B, j, far):
            far = _climb(A[i, 0], A[i, 1], A[k, 0] - A[i, 0], A[k, 1] - A[i, 1], B, j, pitch, far, most, stack)
        if far >= most:
            return far
    return far


@njit(error_model="numpy", cache=True)
def distance(A: Any, B: Any) -> float:
    """Hausdorff distance of two polygons."""
    stack = np.empty((64, 3))
    return _reach(B, A, _reach(A, B, 0.0, np.inf, stack), np.inf, stack)


@njit(error_model="numpy", cache=True)
def closer(A: Any, B: Any, threshold: float) -> bool:
    """Whether the Hausdorff distance is less than `threshold`."""
    stack = np.empty((64, 3))
    least = np.nextafter(threshold, -1.0)
    return _reach(A, B, least, threshold, stack) < threshold and _reach(B, A, least, threshold, stack) < threshold


@njit(error_model="numpy", cache=True)
def descriptors(P: Any, anchors: Any) -> Any:
    """Distances (n, anchors) of the anchors (anchors, 2) from the polygons P (n, corners, 2)."""
    D = np.empty((len(P), len(anchors)))
    for i in range(len(P)):
        pitch = _longest_side(P[i])
        side = 0
        for a in range(len(anchors)):
            side, D[i, a] = _nearest(anchors[a, 0], anchors[a, 1], P[i], side, pitch, -1.0, np.inf)
    return D


@njit(error_model="numpy", cache=True)
def _near(D: Any, E: Any, reach: float) -> bool:
    """Whether two descriptors differ by no more than `reach` anywhere."""
    a = 0
    while a < len(D) and abs(D[a] - E[a]) <= reach:
        a += 1
    return a == len(D)


@njit(error_model="numpy", cache=True)
def candidates(E: Any, first: Any, last: Any, D: Any, reach: Any) -> Any:
    """Rows first[i] <= m < last[i] of E (m, anchors) that differ from row i of D (n, anchors) by no more than reach[i] anywhere.

    Returns start (n + 1,) and the rows: those of i are rows[start[i] : start[i + 1]], ascending.
    """
    n = len(D)
    start = np.zeros(n + 1, dtype=np.int64)
    rows = np.empty(4 * n + 16, dtype=np.int64)
    found = 0
    for i in range(n):
        for m in range(first[i], last[i]):
            if _near(D[i], E[m], reach[i]):
                if found == len(rows):
                    more = np.empty(2 * found, dtype=np.int64)
                    for s in range(found):
                        more[s] = rows[s]
                    rows = more
                rows[found] = m
                found += 1
        start[i + 1] = found
    return start, rows[:found]


@njit(error_model="numpy", cache=True)
def keep(P: Any, D: Any, threshold: Any, reach: Any, old: Any, start: Any, near: Any) -> Any:
    """Which of the polygons P (n, corners, 2), in their order, are no closer than threshold[i] to one kept before: (n,) bool.

    Those kept before are old[near[start[i] : start[i + 1]]], and those of P itself, of which the descriptors D (n, anchors) tell all but
    few within reach[i].
    """
    n = len(P)
    kept = np.empty(n, dtype=np.int64)
    many = 0
    answer = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        free = True
        for s in range(start[i], start[i + 1]):
            if closer(P[i], old[near[s]], threshold[i]):
                free = False
                break
        for s in range(many if free else 0):
            if _near(D[i], D[kept[s]], reach[i]) and closer(P[i], P[kept[s]], threshold[i]):
                free = False
                break
        if free:
            kept[many] = i
            many += 1
            answer[i] = True
    return answer


@njit(error_model="numpy", cache=True)
def bounds(D: Any, i: int) -> Any:
    """Largest difference (n,) of the descriptors D (n, anchors) from the one in row i; infinite for itself."""
    bound = np.zeros(len(D))
    for m in range(len(D)):
        for a in range(D.shape[1]):
            bound[m] = max(bound[m], abs(D[m, a] - D[i, a]))
    bound[i] = np.inf
    return bound


@njit(error_model="numpy", cache=True)
def nearest(A: Any, P: Any, bound: Any, found: float) -> Any:
    """Which of the polygons P (n, corners, 2) is nearest to A, if it is closer than `found` (else -1), and the smaller distance.

    bound (n,): lower bounds of the distances, ascending.
    """
    best = -1
    for m in range(len(P)):
        if bound[m] >= found:
            break
        if closer(A, P[m], found):
            best, found = m, distance(A, P[m])
    return best, found
