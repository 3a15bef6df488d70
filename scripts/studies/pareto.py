"""Which of several runs no other one beats in both cost and error."""

from __future__ import annotations

from collections.abc import Sequence


def front(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices of those that no other one equals in both and beats in one, by ascending cost. Of equal ones the first; NaN stays out."""
    finite = [k for k in range(len(costs)) if costs[k] == costs[k] and errors[k] == errors[k]]
    kept: list[int] = []
    for k in sorted(finite, key=lambda k: (costs[k], errors[k], k)):
        if not kept or errors[k] < errors[kept[-1]]:
            kept.append(k)
    return kept
