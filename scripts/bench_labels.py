"""Milliseconds a shape of each map's labels, on one core, as a Markdown table for docs/dataset.md.

OMP_NUM_THREADS=1 python scripts/bench_labels.py [--shapes 64] [--repeat 5]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from measure_reference import table

from datagen.config import MAPS, Label
from datagen.label import label_shapes
from datagen.shapes import decode, read_shapes

SAMPLE = Path(__file__).parents[1] / "datagen" / "sample.h5"
CASES = {
    **{name: Label(maps=[name]) for name in MAPS},
    "all": Label(),
    "all at N = 64": Label(points=64),
    "relax, converged, 16 substeps": Label(maps=["relax"], relaxation="converged"),
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", type=int, default=64)
    parser.add_argument("--repeat", type=int, default=5)
    chosen = parser.parse_args()
    X = decode(read_shapes(SAMPLE)["coefficients"][: chosen.shapes], 128)
    best = dict.fromkeys(CASES, float("inf"))
    label_shapes(X[:8], Label())  # compiles
    for _ in range(chosen.repeat):  # interleaved: the machine's moods hit all cases
        for name, label in CASES.items():
            begin = time.perf_counter()
            label_shapes(X, label)
            best[name] = min(best[name], (time.perf_counter() - begin) / len(X))
    table(["maps", "ms a shape"], [[name, f"{1e3 * seconds:.1f}"] for name, seconds in best.items()])
