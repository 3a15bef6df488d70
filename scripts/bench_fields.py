"""Seconds of the far field (one sum + its set-up) and of the near field (search; sums: set-up + two evaluations), N = 32, 30 % of the area.

python scripts/bench_fields.py
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_step import packing

from biem.curves.curve import arclength_weights
from biem.stokes.farfield import pair_sum
from biem.stokes.near import near_width
from biem.stokes.near_search import find_near
from biem.stokes.near_sums import NearSums

COUNTS, TOLERANCES = (48, 200, 504, 2000, 8000), (1e-4, 1e-5, 1e-6, 1e-9)
DIRECT_UP_TO = 504  # vesicles


def best(function: Callable[[], Any], repeat: int = 3) -> tuple[float, Any]:
    """Least wall seconds of `repeat` calls after one that compiles, and the result."""
    result, seconds = function(), []
    for _ in range(repeat):
        begin = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - begin)
    return min(seconds), result


def main() -> None:
    print("| points | " + " | ".join(f"{t:g}" for t in TOLERANCES) + " | direct | near pairs | search | sums |")
    print("|" + "---|" * (len(TOLERANCES) + 5))
    for count in COUNTS:
        X = packing(count, 32)
        targets, owner = X.transpose(0, 2, 1).reshape(-1, 2), np.repeat(np.arange(count), 32)
        f = np.random.default_rng(0).standard_normal(X.shape)
        g = f * arclength_weights(X)[:, None, :]
        cells = []
        for tolerance in TOLERANCES:
            setup, far = best(lambda: pair_sum(targets, X, 1.0, owner, "ewald", tolerance))  # noqa: B023
            cells.append(f"{best(lambda: far.velocity(g))[0]:.3f} + {setup:.3f}")  # noqa: B023
        direct = pair_sum(targets, X, 1.0, owner, "direct")
        cells.append(f"{best(lambda: direct.velocity(g), 1)[0]:.3f}" if count <= DIRECT_UP_TO else "")  # noqa: B023
        search, pairs = best(lambda: find_near(X, targets, near_width("upsample", 1e-5), owner))  # noqa: B023

        def sums() -> None:
            near = NearSums.build(X, targets, pairs, 1.0, 1e-5)  # noqa: B023
            near.add(near.add(0.0 * targets, f), f)  # noqa: B023

        cells += [f"{len(pairs)}", f"{search:.3f}", f"{best(sums)[0]:.3f}"]
        print(f"| {32 * count} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
