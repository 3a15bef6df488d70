"""Selection: near-duplicates out, then runs, not shapes, dealt to training, validation and test.

Shapes are visited in a random order, so that those of the first runs are not preferred. One is dropped if its Hausdorff distance to one
that was kept before is less than its threshold: `distance`, or `hard_distance` if its bending energy is above the quantile `hard_above` of
all shapes. So every shape that is dropped lies within its threshold of one that is kept. Mirror images are different shapes.

Distances are those of the shapes as they are stored (`datagen.shapes`). Nothing depends on the number of threads, nor on how the shapes
come in parts: they are sorted by run, then by time, then as they came, before anything else.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from biem.curves.curve import bending_energy
from datagen.config import SPLITS, Dataset
from datagen.hausdorff import ROUNDING, candidates, descriptors, loops, polygons
from datagen.shapes import encode

CHUNK = 1024  # shapes that are visited together
ORDER, MOST, SPLIT = range(3)  # streams of random numbers
COLUMNS = {"run": np.int64, "family": np.int64, "time": np.float64, "capillary": np.float64}  # that are handed on


def select(config: Dataset, parts: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """What shapes.h5 holds, (n, ...) each, sorted by run, then by time: coefficients complex64, the `COLUMNS`, split, bending_energy.

    parts: each with X (n, 2, points), standardized, and the `COLUMNS` (n,); a run lies in one part. Raises ValueError for values that are
    not finite, for no shapes, and where a split would stay empty.
    """
    chosen = config.select
    check_fractions(chosen.fractions)
    shapes = _gathered(parts, config.shapes.modes)
    energy, D = _measured(shapes["coefficients"])
    hard = energy > np.quantile(energy, chosen.hard_above)
    hard_distance = chosen.distance if chosen.hard_distance is None else chosen.hard_distance
    order = _random(config, ORDER).permutation(len(energy))
    kept = thin(shapes["coefficients"], D, np.where(hard, hard_distance, chosen.distance), order)
    if chosen.most is not None:
        kept = _random(config, MOST).permutation(kept)[: chosen.most]
    kept = np.sort(kept)
    shapes = {name: values[kept] for name, values in shapes.items()}
    split = split_of_runs(shapes["run"], shapes["family"], chosen.fractions, _random(config, SPLIT))
    return shapes | {"split": split, "bending_energy": energy[kept].astype(np.float32)}


def thin(coefficients: np.ndarray, D: np.ndarray, threshold: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Indices of the shapes that are kept, ascending. coefficients (n, 2 modes), descriptors D (n, anchors), threshold, order (n,)."""
    column = int(D.std(axis=0).argmax())  # the kept ones are sorted by the anchor that separates best
    reach = np.where(threshold > 0, threshold + ROUNDING, -1.0)  # nothing is closer than 0
    kept = np.empty(0, dtype=np.int64)
    for rows in _chunks(len(order)):
        chunk = order[rows]
        start, near = candidates(D[kept], column, D[chunk], reach[chunk])
        needed, place = np.unique(near, return_inverse=True)
        P, old = polygons(coefficients[chunk]), polygons(coefficients[kept[needed]])
        kept = np.append(kept, chunk[loops().keep(P, D[chunk], threshold[chunk], reach[chunk], old, start, place)])
        kept = kept[np.argsort(D[kept, column], kind="stable")]
    return np.sort(kept)


def split_of_runs(run: np.ndarray, family: np.ndarray, fractions: Sequence[float], rng: np.random.Generator) -> np.ndarray:
    """Places in `SPLITS` (n,) int8 of shapes with run, family (n,): the runs that occur are dealt by the fractions, in each family.

    A split with a positive fraction gets one run at least. Raises ValueError where there are too few runs for that.
    """
    runs, first, of_run = np.unique(run, return_index=True, return_inverse=True)
    R, family_of = len(runs), family[first]
    if (family != family_of[of_run]).any():
        wrong = run[family != family_of[of_run]][0]
        raise ValueError(f"run {wrong} has shapes of several families: runs must be numbered over all families, harvest again")
    counts = _counts(R, fractions)
    order = rng.permutation(R)
    order = order[np.argsort(family_of[order], kind="stable")]
    dealt, split = np.zeros_like(counts), np.empty(R, dtype=np.int8)
    for number, r in enumerate(order, 1):  # to the split that lags most behind its part of the runs dealt so far
        split[r] = (counts * number - dealt * R).argmax()
        dealt[split[r]] += 1
    return split[of_run]


def check_fractions(fractions: Sequence[float]) -> None:
    """Raises ValueError unless they are not negative and sum to 1."""
    if not (min(fractions) >= 0 and abs(sum(fractions) - 1) <= 1e-9):
        names = ", ".join(SPLITS)
        raise ValueError(f"select.fractions = {tuple(fractions)}: expected numbers of at least 0 that sum to 1, for {names}")


def _counts(runs: int, fractions: Sequence[float]) -> np.ndarray:
    """Runs (3,) of each split: the whole numbers next to fraction * runs that sum to `runs`, but 1 at least for a positive fraction."""
    exact = np.array(fractions) * runs
    wanted = exact > 0
    if runs < wanted.sum():
        got = f"{runs} {'run has' if runs == 1 else 'runs have'} shapes that are kept, for select.fractions = {tuple(fractions)}"
        raise ValueError(f"{got}: a split would stay empty; harvest more runs, set a smaller select.distance, or fractions to zero")
    counts = np.maximum(np.floor(exact).astype(np.int64), wanted)
    while counts.sum() < runs:
        counts[np.where(wanted, counts - exact, np.inf).argmin()] += 1
    while counts.sum() > runs:
        counts[np.where(counts > 1, counts - exact, -np.inf).argmax()] -= 1
    return counts


def _gathered(parts: Iterable[Mapping[str, np.ndarray]], modes: int) -> dict[str, np.ndarray]:
    """Coefficients and `COLUMNS` of all parts, sorted by run, then by time, then as they came."""
    gathered: list[dict[str, np.ndarray]] = []
    for number, part in enumerate(parts):
        X, run = part["X"], part["run"]
        bad = np.flatnonzero(~np.isfinite(X).all(axis=(1, 2)))
        if len(bad):
            where = f"run {run[bad[0]]}, row {bad[0]} of part {number}"
            raise ValueError(f"{where}: the shape has values that are not finite, as have {len(bad) - 1} more; harvest this part again")
        gathered.append({"coefficients": encode(X, modes)} | {name: np.asarray(part[name], dtype) for name, dtype in COLUMNS.items()})
    if not sum(len(part["run"]) for part in gathered):
        raise ValueError(f"{len(gathered)} parts without a single shape: expected harvested shapes, let the runs go on for longer")
    together = {name: np.concatenate([part[name] for part in gathered]) for name in gathered[0]}
    order = np.lexsort((together["time"], together["run"]))
    return {name: values[order] for name, values in together.items()}


def _measured(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bending energies (n,) and descriptors (n, anchors)."""
    measured = []
    for rows in _chunks(len(coefficients)):
        P = polygons(coefficients[rows])
        measured.append((bending_energy(np.ascontiguousarray(P.transpose(0, 2, 1))), descriptors(P)))
    energy, D = zip(*measured, strict=True)
    return np.concatenate(energy), np.concatenate(D)


def _chunks(n: int) -> Iterator[slice]:
    return (slice(start, start + CHUNK) for start in range(0, n, CHUNK))


def _random(config: Dataset, stream: int) -> np.random.Generator:
    return np.random.default_rng([config.seed, stream])
