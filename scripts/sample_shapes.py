"""A random sample of a shapes file, for tests and first steps: the sample in the repository is

python scripts/sample_shapes.py data/default/shapes.h5 -n 500 -o datagen/sample.h5
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from datagen.shapes import read_shapes
from datagen.shards import write_shard

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shapes", type=Path)
    parser.add_argument("-n", type=int, default=500, help="number of shapes")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    shapes = read_shapes(chosen.shapes)
    total = len(shapes["run"])
    if not 0 < chosen.n <= total:
        parser.error(f"-n {chosen.n}: {chosen.shapes} has {total} shapes")
    rows = np.sort(np.random.default_rng(chosen.seed).choice(total, chosen.n, replace=False))
    shard, _ = write_shard(chosen.output, {name: values[rows] for name, values in shapes.items()})
    print(f"{shard.rows} of {total} shapes, {shard.bytes} bytes, in {chosen.output}")
