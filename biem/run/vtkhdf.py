"""Time series in VTKHDF 2.0, which ParaView reads from 5.12 on and the vtkHDFReader of VTK from 9.3 on.

PolyData: all steps have the same cells on as many points; the points and their data lie step after step in arrays of the file, and the
group Steps says where. ImageData: values (F, ny, nx, ...) on a flat grid that stands still. Vectors have a third component, 0.
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/index.html
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np

from biem.run.files import atomic_h5

VERSION = (2, 0)
CELLS = ("Vertices", "Lines", "Polygons", "Strips")


def write_polydata(
    path: Path,
    t: np.ndarray,
    points: np.ndarray,
    cells: Sequence[np.ndarray],
    kind: str,
    point_data: Mapping[str, np.ndarray],
    cell_data: Mapping[str, np.ndarray],
) -> None:
    """Points (F, P, 2) at times t (F,), and the cells of one kind ("Vertices" or "Lines") that they make, each an array of their numbers.

    point_data: arrays (F, P), (F, P, 2) or (F, P, 2, 2); cell_data: (C,), the same at all times.
    """
    F, P = points.shape[:2]
    with atomic_h5(path) as file:
        root = _root(file, "PolyData")
        root["NumberOfPoints"] = np.full(F, P)
        root["Points"] = _three(points, 2).reshape(F * P, 3)
        for name in CELLS:
            group, mine = root.create_group(name), name == kind
            connectivity = np.concatenate([*cells, np.zeros(0, dtype=np.int64)]) if mine else np.zeros(0, dtype=np.int64)
            offsets = np.cumsum([0, *(len(cell) for cell in cells)]) if mine else np.zeros(1, dtype=np.int64)
            group["NumberOfCells"] = np.full(F, len(offsets) - 1)
            group["NumberOfConnectivityIds"] = np.full(F, len(connectivity))
            group["Offsets"], group["Connectivity"] = offsets, connectivity.astype(np.int64)
        data = root.create_group("PointData")
        for name, values in point_data.items():
            flat = _three(values, 2)
            data[name] = flat.reshape(F * P, *flat.shape[2:])
        data = root.create_group("CellData")
        for name, values in cell_data.items():
            data[name] = values

        steps = _steps(root, t)
        zero, points_before = np.zeros(F, dtype=np.int64), P * np.arange(F)
        steps["PartOffsets"] = np.arange(F)
        steps["NumberOfParts"] = np.ones(F, dtype=np.int64)
        steps["PointOffsets"] = points_before
        steps["CellOffsets"] = steps["ConnectivityIdOffsets"] = np.zeros((F, len(CELLS)), dtype=np.int64)
        for name in point_data:
            steps[f"PointDataOffsets/{name}"] = points_before
        for name in cell_data:
            steps[f"CellDataOffsets/{name}"] = zero


def write_image(path: Path, t: np.ndarray, x: np.ndarray, y: np.ndarray, point_data: Mapping[str, np.ndarray]) -> None:
    """Values (F, ny, nx), (F, ny, nx, 2) or (F, ny, nx, 2, 2) at times t (F,) on the grid x (nx,), y (ny,)."""
    with atomic_h5(path) as file:
        root = _root(file, "ImageData")
        root.attrs["WholeExtent"] = np.array([0, len(x) - 1, 0, len(y) - 1, 0, 0])
        root.attrs["Origin"] = np.array([x[0], y[0], 0.0])
        root.attrs["Spacing"] = np.array([np.ptp(x) / (len(x) - 1), np.ptp(y) / (len(y) - 1), 1.0])
        root.attrs["Direction"] = np.eye(3).ravel()
        data = root.create_group("PointData")
        for name, values in point_data.items():
            data[name] = _three(values, 3) if len(t) > 1 else _three(values, 3)[0]
        if len(t) == 1:  # which readers do not take for a series
            return
        steps = _steps(root, t)
        for name in point_data:
            steps[f"PointDataOffsets/{name}"] = np.arange(len(t))


def _root(file: h5py.File, kind: str) -> h5py.Group:
    root = file.create_group("VTKHDF")
    root.attrs["Version"] = np.array(VERSION)
    root.attrs.create("Type", kind.encode("ascii"), dtype=h5py.string_dtype("ascii", len(kind)))
    return root


def _steps(root: h5py.Group, t: np.ndarray) -> h5py.Group:
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = len(t)
    steps["Values"] = t
    return steps


def _three(values: np.ndarray, lead: int) -> np.ndarray:
    """Scalars as they are, vectors (..., 2) with a third component, tensors (..., 2, 2) as nine; the first `lead` axes are places."""
    if values.ndim == lead:
        return values
    if values.ndim == lead + 1:
        return np.concatenate([values, np.zeros((*values.shape[:-1], 1))], axis=-1)
    tensors = np.zeros((*values.shape[:lead], 3, 3))
    tensors[..., :2, :2] = values
    return tensors.reshape(*values.shape[:lead], 9)
