"""What the kept shapes cover: how many there are, how bent they are, how far apart they lie; as numbers and as a picture.

The distance to the nearest neighbour is that of a random sample of the shapes, each one's neighbour sought among all of them, exactly.
Nothing here depends on when or where it was made: the same shapes give the same bytes.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from biem.curves.curve import curvature
from biem.run.files import write_atomically
from datagen.config import SPLITS
from datagen.hausdorff import descriptors, nearest, polygons
from datagen.shapes import decode

SAMPLE = 2000  # shapes whose nearest neighbour is sought
STREAM = 3  # of random numbers
BINS, TICKS = 40, 5  # of a histogram
QUANTILES = (0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 1.0)
DECADES = 4  # that a histogram spans at most: what is smaller counts in its first bin
LEAST = 1e-12  # first edge of a histogram: below, all is rounding errors
PEAK, CHUNK = 1024, 256  # nodes that find the peak of a curvature; shapes measured together
HARD = 0.9  # the hardest tenth has a row of its own in the picture
COLUMNS, ROWS = 16, 3  # of the other shapes in the picture
LABELS = {
    "bending_energy": "bending energy",
    "largest_curvature": "largest curvature",
    "nearest_distance": "Hausdorff distance to the nearest neighbour",
}


def report(shapes: Mapping[str, np.ndarray], folder: Path, seed: int, flows: Sequence[str] = ()) -> dict[str, Any]:
    """Writes coverage.json and coverage.png of shapes, as shapes.h5 holds them, to a folder; returns what is in coverage.json.

    `families` tells the shapes of each split; counts of the histograms have a row for each family. flows: names for the families. Raises
    ValueError for no shapes.
    """
    n = len(shapes["run"])
    if n == 0:
        raise ValueError("there are no shapes to report on: expected those that `python -m datagen select` keeps")
    largest_curvature, D = _measured(shapes["coefficients"])
    sample = np.sort(np.random.default_rng([seed, STREAM]).permutation(n)[: SAMPLE if n > 1 else 0])
    distances = np.array([nearest(shapes["coefficients"], D, i)[1] for i in sample])
    family, split = shapes["family"], shapes["split"]
    families = np.unique(family)
    everyone = np.arange(n)
    measured = {
        "bending_energy": (shapes["bending_energy"].astype(np.float64), everyone),
        "largest_curvature": (largest_curvature, everyone),
        "nearest_distance": (distances, sample),
    }
    names = [f"{f} {flows[f]}" if flows else str(f) for f in families]
    stats: dict[str, Any] = {
        "shapes": n,
        "runs": {name: len(np.unique(shapes["run"][split == k])) for k, name in enumerate(SPLITS)},
        "families": {},
    }
    for f, name in zip(families, names, strict=True):
        stats["families"][name] = {part: int(((family == f) & (split == k)).sum()) for k, part in enumerate(SPLITS)}
    stats |= {name: _distribution(values, family[of], families) for name, (values, of) in measured.items()}
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "coverage.png", _picture(stats, shapes))
    write_atomically(folder / "coverage.json", (json.dumps(stats, indent=1) + "\n").encode())
    return stats


def summary(stats: Mapping[str, Any]) -> list[str]:
    """A few lines for the terminal."""
    total = {name: sum(counts[name] for counts in stats["families"].values()) for name in SPLITS}
    lines = [", ".join(f"{name} {total[name]} shapes of {stats['runs'][name]} runs" for name in SPLITS)]
    lines.append("shapes of family " + ", ".join(f"{f}: {sum(counts.values())}" for f, counts in stats["families"].items()))
    for name, label in LABELS.items():
        q = stats[name]["quantiles"]
        if q:
            among = f" (of {stats[name]['shapes']} shapes)" if stats[name]["shapes"] < stats["shapes"] else ""
            lines.append(f"{label}: {q['0']:.3g} to {q['1']:.3g}, half of them below {q['0.5']:.3g}{among}")
    return lines


def _measured(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest curvature (n,) at PEAK nodes, and descriptors (n, anchors)."""
    measured = []
    for start in range(0, len(coefficients), CHUNK):
        chunk = coefficients[start : start + CHUNK]
        measured.append((np.abs(curvature(decode(chunk, PEAK))).max(axis=-1), descriptors(polygons(chunk))))
    largest, D = zip(*measured, strict=True)
    return np.concatenate(largest), np.concatenate(D)


def _distribution(values: np.ndarray, family: np.ndarray, families: np.ndarray) -> dict[str, Any]:
    """Quantiles, and a histogram over evenly spaced logarithms with a row of counts for each of the families."""
    edges = _edges(values)
    counts = [np.histogram(np.maximum(values[family == f], edges[0]), edges)[0].tolist() for f in families]
    quantiles = np.quantile(values, QUANTILES).tolist() if len(values) else []
    named = {f"{q:g}": value for q, value in zip(QUANTILES, quantiles, strict=bool(quantiles))}
    return {"shapes": len(values), "quantiles": named, "edges": edges.tolist(), "counts": counts}


def _edges(values: np.ndarray) -> np.ndarray:
    """Bin edges (BINS + 1,) whose first and last bins hold the smallest and the largest value."""
    high = max(float(values.max(initial=0.0)), LEAST)
    low = max(float(values.min(initial=high)), high * 10.0**-DECADES, LEAST)
    if high < 1.1 * low:
        low, high = low / 1.1, high * 1.1
    edges = np.geomspace(low, high, BINS + 1)
    edges[[0, -1]] = low, high
    return edges


def _picture(stats: Mapping[str, Any], shapes: Mapping[str, np.ndarray]) -> bytes:
    """PNG: the three histograms by family, and shapes from the least bent to the most bent."""
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([list(LABELS), ["shapes"] * len(LABELS)], height_ratios=[1.0, 2.0])
    families = np.unique(shapes["family"])
    palette = colormaps["tab10" if len(families) <= 10 else "tab20"]
    colors = [palette(k % palette.N) for k in range(len(families))]
    for name, label in LABELS.items():
        _draw_histogram(axes[name], stats[name], label, list(stats["families"]), colors)
    axes["bending_energy"].legend(frameon=False, fontsize=8, title="family")
    _draw_shapes(axes["shapes"], shapes, np.array(colors)[np.searchsorted(families, shapes["family"])])
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    return content.getvalue()


def _draw_histogram(axes: Any, of: Mapping[str, Any], label: str, names: list[str], colors: list[Any]) -> None:
    edges = np.array(of["edges"])
    below = np.zeros(len(edges) - 1)
    for counts, name, color in zip(of["counts"], names, colors, strict=True):
        axes.stairs(below + counts, edges, baseline=below, fill=True, color=color, label=name)
        below = below + counts
    axes.set_xscale("log")
    axes.set_xticks(ticks := np.geomspace(edges[0], edges[-1], TICKS), [f"{tick:.3g}" for tick in ticks])
    axes.minorticks_off()
    axes.set_xlabel(label)
    axes.set_title(f"{of['shapes']} shapes", fontsize=9)


def _draw_shapes(axes: Any, shapes: Mapping[str, np.ndarray], colors: np.ndarray) -> None:
    energy = shapes["bending_energy"]
    by_energy = np.argsort(energy, kind="stable")
    last = len(energy) - 1
    spread = [np.unique(np.linspace(low, last, most).round().astype(int)) for low, most in ((0, ROWS * COLUMNS), (HARD * last, COLUMNS))]
    chosen = by_energy[np.concatenate(spread)]
    P = polygons(shapes["coefficients"][chosen])
    low, high = P.min(axis=(0, 1)), P.max(axis=(0, 1))
    step = np.array([1.1, 1.2]) * (high - low)
    place = np.concatenate([np.arange(len(spread[0])), ROWS * COLUMNS + np.arange(len(spread[1]))])
    row = place // COLUMNS
    origin = np.stack([(place % COLUMNS) * step[0], -(row + 0.2 * (row == ROWS)) * step[1]], axis=-1)
    axes.add_collection(PolyCollection(list(P + origin[:, None]), facecolor=colors[chosen].tolist(), edgecolor="black", linewidth=0.5))
    for k in range(len(chosen)):
        axes.text(origin[k, 0], origin[k, 1] + low[1] - 0.01, f"{energy[chosen[k]]:.3g}", ha="center", va="top", fontsize=6)
    axes.set_xlim(low[0] - 0.3 * step[0], (COLUMNS - 1) * step[0] + high[0] + 0.1 * step[0])
    axes.set_ylim(-(ROWS + 0.3) * step[1] + low[1], high[1] + 0.1 * step[1])
    axes.set_aspect("equal")
    axes.axhline(-(ROWS - 0.4) * step[1], color="gray", linewidth=0.5)
    for at, text in ((-(ROWS - 1) / 2, "all shapes"), (-(ROWS + 0.2), "the hardest tenth")):
        axes.text(low[0] - 0.25 * step[0], at * step[1], text, rotation=90, ha="center", va="center", fontsize=9)
    axes.set_title("shapes by their bending energy", fontsize=10)
    axes.axis("off")
