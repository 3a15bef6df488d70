"""Shapes as files keep them: Fourier coefficients in single precision.

    z = x + i y = sum_k c_k e^{i k alpha},   -modes < k < modes,   c (n, 2 modes) complex64 in numpy.fft.fft's order, c_{-modes} = 0

A complex64 keeps seven digits of each coefficient, however small, so that fourth derivatives keep nearly as many (error 2e-7). Nodes in
float32 have one absolute error for all modes, which four derivatives multiply by k^4 (error 1e-4 with 64 nodes, 1e-3 with 128).
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from biem.run.files import one_line
from datagen.config import SPLITS

COLUMNS = ("run", "family", "time", "capillary", "split", "bending_energy")  # of shapes.h5, (n,) each, beside `coefficients`


def encode(X: np.ndarray, modes: int) -> np.ndarray:
    """Coefficients (n, 2 modes) complex64 of shapes X (n, 2, points), low-passed to |k| < modes. Raises ValueError for too few points."""
    if X.ndim != 3 or X.shape[1] != 2:
        raise ValueError(f"shapes of shape {X.shape}: expected (n, 2, points)")
    _check_points(X.shape[-1], modes)
    c = np.fft.fft(X[:, 0] + 1j * X[:, 1]) / X.shape[-1]
    zero = np.zeros_like(c[:, :1])
    return np.concatenate([c[:, :modes], zero, c[:, 1 - modes :]], axis=1).astype(np.complex64)


def decode(coefficients: np.ndarray, points: int) -> np.ndarray:
    """Shapes X (n, 2, points) float64 of coefficients (n, 2 modes). Raises ValueError for too few points."""
    _check_coefficients(coefficients)
    modes = coefficients.shape[1] // 2
    _check_points(points, modes)
    c = np.zeros((len(coefficients), points), dtype=np.complex128)
    c[:, :modes] = coefficients[:, :modes]
    c[:, 1 - modes :] = coefficients[:, 1 - modes :]
    z = np.fft.ifft(c) * points
    return np.stack([z.real, z.imag], axis=1)


def read_shapes(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of shapes.h5: coefficients (n, 2 modes) and `COLUMNS` (n,). Raises ValueError for what is not such a file."""
    try:
        with h5py.File(path, "r") as file:
            missing = [name for name in ("coefficients", *COLUMNS) if not isinstance(file.get(name), h5py.Dataset)]
            if missing:
                raise ValueError(
                    f"{path} has no dataset {', '.join(missing)}: expected a shapes file, as `python -m datagen select` makes it"
                )
            shapes = {name: file[name][...] for name in ("coefficients", *COLUMNS)}
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist: make it by `python -m datagen select`") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read as HDF5: {one_line(error)}") from None
    try:
        _check_coefficients(shapes["coefficients"])
        n = len(shapes["coefficients"])
        for name in COLUMNS:
            if shapes[name].shape != (n,):
                raise ValueError(f"{name} has the shape {shapes[name].shape}, expected ({n},)")
        if n and not 0 <= shapes["split"].min() <= shapes["split"].max() < len(SPLITS):
            raise ValueError(f"split has values outside 0..{len(SPLITS) - 1}, the places in {SPLITS}")
    except ValueError as error:
        raise ValueError(f"{path}: {error}: make it anew by `python -m datagen select`") from None
    return shapes


def _check_coefficients(coefficients: np.ndarray) -> None:
    if coefficients.ndim != 2 or coefficients.shape[1] % 2 or coefficients.shape[1] < 4 or coefficients.dtype.kind != "c":
        got = f"{coefficients.dtype} of shape {coefficients.shape}"
        raise ValueError(f"coefficients are {got}, expected complex numbers (n, 2 modes), modes at least 2")
    modes = coefficients.shape[1] // 2
    bad = np.flatnonzero(~np.isfinite(coefficients).all(axis=1) | (coefficients[:, modes] != 0))
    if len(bad):
        raise ValueError(f"coefficients of shape {bad[0]} (and of {len(bad) - 1} more) are not finite, or not zero for mode -{modes}")


def _check_points(points: int, modes: int) -> None:
    if modes < 2 or points < 2 * modes:
        raise ValueError(f"{modes} modes on {points} points: expected at least 2 modes, and at least {2 * modes} points for so many")
