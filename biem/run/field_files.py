"""Files of fields: HDF5 of grids or points, text of points.

out.h5, of grids: t (F,), frame (F,), x (F, nx), y (F, ny), inside (F, ny, nx), and of the quantities velocity (F, ny, nx, 2),
pressure and vorticity (F, ny, nx), stress (F, ny, nx, 2, 2). Of points: points (P, 2), and the same with P in place of ny, nx.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from biem.run.fields import FrameFields, Request
from biem.run.files import atomic_h5, write_atomically

ABOUT = "on a membrane pressure, vorticity and stress are those of the fluid outside"
MEANING = {  # unit and definition
    "t": ("time", "of the frame"),
    "frame": ("1", "number of the frame in the trajectory, from 0"),
    "x": ("length", "of the grid's points"),
    "y": ("length", "of the grid's points"),
    "points": ("length", "x and y"),
    "inside": ("1", "the vesicle that a point is in, from 0; -1 in the fluid between, -2 beyond a wall"),
    "velocity": ("length/time", "u along x, v along y"),
    "pressure": ("kappa_b/length^3", "p; 0 far away where the fluid is unbounded, up to a constant between walls"),
    "vorticity": ("1/time", "omega = dv/dx - du/dy"),
    "stress": ("kappa_b/length^3", "s = -p I + mu (grad u + grad u^T), mu that of the fluid there; rows and columns x, y"),
}
COLUMNS = {"velocity": ("u", "v"), "pressure": ("p",), "vorticity": ("omega",), "stress": ("s_xx", "s_xy", "s_yx", "s_yy")}


def write_fields(path: Path, request: Request, frames: Sequence[FrameFields], attributes: Mapping[str, Any]) -> None:
    """All frames as HDF5."""
    shape = request.grids[0].shape if request.grids else (request.size,)
    with atomic_h5(path) as file:
        file["t"] = np.array([frame.t for frame in frames])
        file["frame"] = np.array([frame.frame for frame in frames])
        if request.grids:
            file["x"], file["y"] = (np.stack([getattr(grid, axis) for grid in request.grids]) for axis in ("x", "y"))
        else:
            file["points"] = request.points
        for name in ("inside", *request.quantities):
            values = np.stack([frame.values[name] for frame in frames])
            file[name] = values.reshape(len(frames), *shape, *values.shape[2:])
        for name, values in file.items():
            values.attrs["unit"], values.attrs["definition"] = MEANING[name]
        file.attrs.update({"about": ABOUT, "disturbance": request.disturbance, "tolerance": request.tolerance, **attributes})


def write_table(path: Path, request: Request, frames: Sequence[FrameFields]) -> None:
    """Points of all frames as text, a row each, columns apart by commas."""
    assert request.points is not None
    names = ["t", "x", "y", "inside", *(column for name in request.quantities for column in COLUMNS[name])]
    rows = []
    for frame in frames:
        columns = [np.full(request.size, frame.t), *request.points.T, frame.values["inside"]]
        for name in request.quantities:
            columns += list(frame.values[name].reshape(request.size, -1).T)
        rows.append(np.stack(columns, axis=-1))
    text = io.StringIO()
    about = {"t": ["t"], "points": ["x", "y"], "inside": ["inside"]} | {name: [*COLUMNS[name]] for name in request.quantities}
    for name, columns_of in about.items():
        text.write(f"# {', '.join(columns_of)} [{MEANING[name][0]}]: {MEANING[name][1]}\n")
    text.write(f"# {ABOUT}\n{','.join(names)}\n")
    form = ["%.17g", "%.17g", "%.17g", "%d", *("%.17g",) * (len(names) - 4)]
    np.savetxt(text, np.concatenate(rows), fmt=form, delimiter=",")
    write_atomically(path, text.getvalue().encode())
