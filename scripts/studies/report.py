"""The page of a comparison: one HTML file with its style, its script and its data within, that asks nothing from outside.

Membranes are embedded at times common to all runs: centroids as float32, nodes about them as int16. The page draws smooth curves.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from biem.curves.curve import centroid
from biem.curves.fourier import resample
from biem.run.trajectory import Trajectory
from studies.compared import COSTS, Compared
from studies.differences import Differences, at
from studies.pictures import COLOURS, DASHES, MOST_PATHS, some

HERE = Path(__file__).parent
SCRIPTS = ("report_data.js", "report_plots.js", "report_film.js", "report_page.js")
MOST_BYTES = 3_300_000  # of all membranes; base64 makes 4/3 of it
MOST_TIMES, LEAST_TIMES = 201, 41  # of the film
POINTS = (64, 48, 32, 24, 16)  # of an embedded membrane
LARGEST = np.iinfo(np.int16).max


def page(compared: Compared, found: Mapping[str, Any]) -> str:
    """The page as text. found: of `compared.results`, with the name of the scene."""
    data = dict(found) | {
        "costs": COSTS,
        "colours": COLOURS,
        "dashes": DASHES,
        "errors": [_over_time(compared.apart.get(ran.name), compared.scale) for ran in compared.rungs],
        "floor": _over_time(compared.floor, compared.scale),
        "film": _film(compared),
    }
    parts = {
        "title": html.escape(f"Solvers on {found['scene']}"),
        "style": (HERE / "report_page.css").read_text(encoding="utf-8"),
        "script": "\n".join((HERE / name).read_text(encoding="utf-8") for name in SCRIPTS),
        "data": json.dumps(data, separators=(",", ":"), allow_nan=False, default=_plain).replace("<", "\\u003c"),
    }
    template = (HERE / "report_page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], template)


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as JSON has them."""
    return value.tolist()


def _over_time(found: Differences | None, scale: float) -> dict[str, Any] | None:
    """Errors by quantity at their times, four digits."""
    if found is None:
        return None
    short = lambda values: [float(f"{value:.4g}") for value in values]
    return {"t": short(found.t / scale), "values": {name: short(values) for name, values in found.values.items()}}


def _film(compared: Compared) -> dict[str, Any]:
    """Membranes of all runs at common times, the reference first, in R; a run that ended early has fewer of them."""
    runs = [compared.truth, *(ran.trajectory for ran in compared.rungs)]
    M = compared.truth.X.shape[1]
    times, points = _size(M * sum(run is not None for run in runs))
    t = np.linspace(0.0, float(compared.truth.t[-1]), times)
    return {
        "times": [float(f"{value:.6g}") for value in t / compared.scale],
        "points": points,
        "paths": some(M, MOST_PATHS),
        "runs": [None if run is None else _encoded(run, t, points, compared.R) for run in runs],
        "walls": [(wall / compared.R).round(4).T for wall in compared.truth.attributes.get("walls", ())],
    }


def _size(membranes: int) -> tuple[int, int]:
    """Numbers of times and of points that keep `membranes` membranes a time within MOST_BYTES: first fewer times, then fewer points."""
    for points in POINTS:
        times = MOST_BYTES // (membranes * 4 * (points + 2))  # two int16 a point, two float32 a centroid
        if times >= LEAST_TIMES or points == POINTS[-1]:
            break
    return int(np.clip(times, 2, MOST_TIMES)), points


def _encoded(run: Trajectory, t: np.ndarray, points: int, R: float) -> dict[str, Any]:
    """centers: float32 (F, M, 2), shapes: int16 (F, M, P, 2) in `step`, both in R."""
    own = t[t <= run.t[-1] * (1 + 1e-9)]
    X = at(run.t, run.X, own) / R
    c = np.stack([centroid(frame) for frame in X])
    shapes = resample(X - c[..., None], points).transpose(0, 1, 3, 2)
    step = float(np.abs(shapes).max()) / LARGEST
    return {
        "frames": len(own),
        "centers": base64.b64encode(c.astype("<f4").tobytes()).decode(),
        "shapes": base64.b64encode((shapes / step).round().astype("<i2").tobytes()).decode(),
        "step": step,
    }
