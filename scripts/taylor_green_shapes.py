"""Shapes of a Taylor-Green suspension with their labels, on which no network was trained: what `python -m surrogate evaluate` takes.

OMP_NUM_THREADS=1 python scripts/taylor_green_shapes.py -o data/taylor_green

Runs configs/scenes/taylor_green_32.toml by exact operators on 64 nodes and takes 100 equal times of 32 vesicles. The folder gets the
trajectory, `taylor_green.h5` (as pairs.h5, docs/dataset.md: all maps but relax, all of the test split, and X (n, 2, 128), the standardized
shapes themselves) and for each --dt `taylor_green-flowDT.h5`, relaxation by the converged flow. About 12 minutes on one core.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from biem import load_scene, read_trajectory, simulate
from biem.curves.curve import reduced_area
from biem.curves.fourier import resample
from biem.curves.pose import standardize
from biem.run.files import atomic_h5, write_atomically
from datagen.config import SPLITS, Label
from datagen.label import label_modes, label_shapes

SCENE = Path(__file__).parents[1] / "configs" / "scenes" / "taylor_green_32.toml"
NAME = "taylor_green"
STEPS_A_FRAME = 35  # 3,500 steps of 0.01 t_gamma in 100 frames
BLOCK = 64  # shapes labelled at a time


def suspension(folder: Path, points: int, frames: int) -> np.ndarray:
    """X (frames, M, 2, points): the run's frames but for the first, where all vesicles have one shape."""
    path = folder / "trajectory.h5"
    step = 35 / (STEPS_A_FRAME * 100)
    overrides = [
        f"vesicles.points={points}",
        f"solver.operator_points={points}",
        f"time.dt={step} t_gamma",
        f"time.horizon={step * STEPS_A_FRAME * frames} t_gamma",
        f"time.save_every={STEPS_A_FRAME}",
    ]
    if not path.exists():
        simulate(load_scene(SCENE, overrides), path, progress=True)
    X = read_trajectory(path).X[1:]
    if len(X) < frames:
        raise SystemExit(f"{path} has {len(X)} frames after the first, {frames} are needed: remove it")
    return X[:frames]


def write_pairs(path: Path, X: np.ndarray, label: Label, extra: dict[str, np.ndarray]) -> None:
    """Labels of standardized shapes X (n, 2, operator_points), unless they are there."""
    if path.exists():
        return
    parts = [label_shapes(X[i : i + BLOCK], label) for i in tqdm(range(0, len(X), BLOCK), desc=path.stem, unit="block")]
    n = len(X)
    settings = {
        "shapes": {"reduced_area": round(float(np.mean(reduced_area(X))), 4), "points": X.shape[-1]},
        "label": {**label.model_dump(mode="json"), "modes": list(label_modes(label))},
    }
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    arrays |= {"split": np.full(n, SPLITS.index("test"), np.int8), "run": np.zeros(n, np.int64), "shape": np.arange(n), **extra}
    with atomic_h5(path) as file:
        for name, values in arrays.items():
            file[name] = values
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    write_atomically(
        path.with_suffix(".json"), json.dumps({"settings": settings, "scene": SCENE.name, "sha256": sha256}, indent=1).encode()
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder")
    parser.add_argument("--points", type=int, default=64, help="nodes of the run")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--dt", type=float, nargs="+", default=[1e-5, 1e-4], help="of relaxation, in mu length^3/kappa_b")
    parser.add_argument("--substeps", type=int, default=16, help="of relaxation")
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    frames = suspension(chosen.output, chosen.points, chosen.frames)
    F, M = frames.shape[:2]
    label = Label(maps=["self_tension", "advection", "flow_tension", "near"])
    n = label.operator_points
    X, _ = standardize(resample(frames.reshape(F * M, 2, -1), n))
    extra = {"X": X, "frame": np.repeat(np.arange(1, F + 1), M), "vesicle": np.tile(np.arange(M), F)}
    write_pairs(chosen.output / f"{NAME}.h5", X, label, extra)
    for dt in chosen.dt:
        flow = Label(maps=["relax"], dt=dt, relaxation="converged", substeps=chosen.substeps)
        write_pairs(chosen.output / f"{NAME}-flow{dt:g}.h5", X, flow, {})
    print(f"{len(X)} shapes in {chosen.output}")


if __name__ == "__main__":
    main()
