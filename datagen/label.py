"""Training pairs: the exact maps of standardized shapes, on a basis of velocities and force densities, at the N nodes of a network.

Shapes X (n, 2, n_op) in the units mu = kappa_b = length = 1; the maps are those of `biem.ExactMaps(points=n_op)` for the n_op-node curve,
for a whole basis at once. The basis is e_{k,re} = cos(k alpha), e_{k,im} = sin(k alpha), k = 0..N/2, in the directions x and y, as N nodes
hold it: the im part of k = 0 and of k = N/2 is zero, and so are its labels. Axes after the shape: part (re, im) and direction of the input,
direction of the output, node. float32; shapes, velocities and tensions are low-passed to N nodes (`resample`).

    X_std           (n, 2, N)           X
    relax           (n, 2, N)           X_next - X after dt: the increment, of which X_next in float32 would keep but three or four digits
    self_tension    (n, N)              L^-1 P B X
    advection/k     (n, 2, 2, 2, N)     (1 - M) e
    flow_tension/k  (n, 2, 2, N)        L^-1 P e
    near/k          (n, 5, 2, 2, 2, N)  S[X, e] at X + o h normal, for o in LAYERS, h = length/N

The layers stand on the n_op-node curve, at its points of the N parameters and along its normals there, not on the low-passed curve: so
that they lie where their offsets say, and the layer of offset 0 is S on the curve itself, on the right side of no jump.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import pi

import numpy as np

from biem.backend import constant, one_blas_thread
from biem.curves.curve import length, speed
from biem.curves.fourier import derivative, differentiation_matrix, read_back, resample
from biem.errors import NumericalFailure
from biem.membrane.maps import LAYERS
from biem.membrane.resultants import Resultants
from biem.stokes.kernels import stokeslet
from biem.stokes.near import LEVELS, accurate_rows, upsampling
from biem.stokes.near_search import locate
from datagen.config import Label, MapName

CHUNK = 8  # shapes worked on at once: their matrices stay in the cache
LENGTH_TOLERANCE = 1e-3  # of the length 1 of a standardized shape: a low-pass to few operator points shortens the roughest
NEAR_TOLERANCE = 1e-9  # of the layers off the curve: below what float32 shows
Labels = dict[str, np.ndarray]


def label_shapes(X: np.ndarray, label: Label) -> Labels:
    """Training pairs (see above) of standardized shapes X (n, 2, n_op); of `label.maps` and `label.modes` alone.

    The labels of a shape are the same bits whatever other shapes there are, and whatever the number of threads (with SciPy's own FFT; FFTW
    chooses its plans by timing). Raises ValueError for numbers of nodes or modes that do not fit and for shapes that are not standardized
    or not finite, NumericalFailure for labels that are not finite.
    """
    arrays = label_arrays(label)
    X = _checked(X, label)
    labels = {name: np.empty((len(X), *shape), dtype=np.float32) for name, shape in arrays.items()}
    with one_blas_thread():
        for i in range(0, len(X), CHUNK):
            few = _Few(X[i : i + CHUNK], label.points, label_modes(label))
            labels["X_std"][i : i + CHUNK] = resample(few.X, label.points)
            for name in label.maps:
                for array, values in MAKERS[name](few, label).items():
                    labels[array][i : i + CHUNK] = values
    for array, values in labels.items():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
        if len(bad):
            raise NumericalFailure(f"{array} of shape {bad[0]} (and {len(bad) - 1} more) is not finite: does the shape touch itself?")
    return labels


def label_arrays(label: Label) -> dict[str, tuple[int, ...]]:
    """Names of the arrays that `label_shapes` makes, and their shapes after the first axis. Raises ValueError as it does."""
    N, each = label.points, label_modes(label)
    of_shape = {"relax": (2, N), "self_tension": (N,)}
    of_mode = {"advection": (2, 2, 2, N), "flow_tension": (2, 2, N), "near": (len(LAYERS), 2, 2, 2, N)}
    arrays = {"X_std": (2, N)} | {name: shape for name, shape in of_shape.items() if name in label.maps}
    return arrays | {f"{name}/{k}": shape for name, shape in of_mode.items() if name in label.maps for k in each}


def label_modes(label: Label) -> tuple[int, ...]:
    """The modes that labels are made of. Raises ValueError for modes, or numbers of nodes, that cannot be."""
    N = label.points
    if N % 2 or label.operator_points < N:
        raise ValueError(f"label.points is {N}: expected an even number, at most label.operator_points = {label.operator_points}")
    modes = tuple(range(N // 2 + 1)) if label.modes is None else tuple(label.modes)
    if not all(0 <= k <= N // 2 for k in modes) or len(set(modes)) < len(modes):
        wrong = next((k for k in modes if not 0 <= k <= N // 2), None)
        what = "has a mode twice" if wrong is None else f"has {wrong}"
        raise ValueError(f"label.modes {what}: expected different numbers from 0 to {N // 2}, half of label.points")
    return modes


@dataclass(frozen=True)
class _Few:
    """A few shapes X (m, 2, n), and what their maps share, each made when first asked for. Basis functions are (mode, part), C in all."""

    X: np.ndarray
    N: int
    modes: tuple[int, ...]

    @cached_property
    def maps(self) -> Resultants:
        return Resultants(self.X)

    @cached_property
    def K(self) -> np.ndarray:
        return self.maps.kernel()

    @cached_property
    def strain_matrices(self) -> tuple[np.ndarray, np.ndarray]:
        return self.maps.strain_matrices(self.K)

    def basis(self, n: int) -> np.ndarray:
        """(C, n)."""
        return constant(basis_functions, self.N, n, self.modes, like=self.X)

    @cached_property
    def tensions(self) -> np.ndarray:
        """L^-1 P e (m, n, direction, C)."""
        m, _, n = self.X.shape
        e_alpha = derivative(self.basis(n))
        rates = self.maps.t.transpose(0, 2, 1)[..., None] * e_alpha.T[:, None, :]
        return self.maps.tensions(rates.reshape(m, n, -1), self.strain_matrices[1]).reshape(rates.shape)

    def by_mode(self, name: str, values: np.ndarray, axis: int = 1) -> Labels:
        """values (m, ..., C, ...), C at the axis, as arrays (m, ..., part, ...), one for every mode."""
        values = values.reshape(*values.shape[:axis], len(self.modes), 2, *values.shape[axis + 1 :])
        return {f"{name}/{k}": values.take(i, axis) for i, k in enumerate(self.modes)}


def basis_functions(N: int, n: int, modes: tuple[int, ...]) -> np.ndarray:
    """cos(k alpha), sin(k alpha) for the modes in turn, on N nodes, brought to n of them (2 modes, n)."""
    alpha = 2 * pi * np.arange(N) / N
    zero = np.zeros(N)
    parts = [(np.cos(k * alpha), zero if k in (0, N // 2) else np.sin(k * alpha)) for k in modes]
    return resample(np.array(parts).reshape(-1, N), n)


def _rows(K: np.ndarray, N: int, bring: Callable[[np.ndarray, int], np.ndarray]) -> np.ndarray:
    """K (m, 3, n, n), which is symmetric, with its values brought to N nodes by `resample` or `read_back` (m, 3, N, n)."""
    return np.ascontiguousarray(bring(K, N).swapaxes(-1, -2))


def _relax(few: _Few, label: Label) -> Labels:
    if label.relaxation == "implicit":
        Z = label.dt * few.maps.velocity(few.maps.relaxed_resultant(label.dt, *few.strain_matrices))
    else:
        fine, coarse = label.substeps, label.substeps // 2  # errors as 1/fine and 1/coarse
        Z = (fine * _flow(few.X, label.dt, fine) - coarse * _flow(few.X, label.dt, coarse)) / (fine - coarse)
    return {"relax": resample(Z, few.N)}


def _flow(X: np.ndarray, dt: float, steps: int) -> np.ndarray:
    """X(dt) - X by semi-implicit steps."""
    Z = np.zeros_like(X)
    for _ in range(steps):
        Z = Z + Resultants(X + Z).relaxation(dt / steps)
    return Z


def _self_tension(few: _Few, label: Label) -> Labels:
    rates = few.maps.rate(few.maps.velocity(few.maps.bending))
    return {"self_tension": resample(few.maps.tensions(rates[..., None], few.strain_matrices[1])[..., 0], few.N)}


def _flow_tension(few: _Few, label: Label) -> Labels:
    return few.by_mode("flow_tension", resample(few.tensions.transpose(0, 3, 2, 1), few.N))


def _advection(few: _Few, label: Label) -> Labels:
    """e - h K D (sigma t)."""
    m, _, n = few.X.shape
    t = few.maps.t[:, :, None, :]
    rows = np.matmul(_rows(few.K, few.N, resample), few.maps.h * constant(differentiation_matrix, n, like=few.X))
    rows = np.concatenate([rows[:, k] * t[:, 0] + rows[:, k + 1] * t[:, 1] for k in (0, 1)], axis=1)  # (m, 2 N, n)
    moved = np.matmul(rows, few.tensions.reshape(m, n, -1)).reshape(m, 2, few.N, 2, -1)
    values = -moved.transpose(0, 4, 3, 1, 2)  # (m, C, direction in, out, N)
    e = resample(few.basis(n), few.N)
    for direction in (0, 1):
        values[:, :, direction, direction] += e
    return few.by_mode("advection", values)


def _near(few: _Few, label: Label) -> Labels:
    m, _, n = few.X.shape
    fine = Resultants(resample(few.X, 2 * n))  # K times the speed has twice the modes of X
    force = few.basis(2 * n) * (fine.h * fine.speed)[:, None, :]
    on_curve = np.matmul(_rows(fine.kernel(), few.N, read_back), force.swapaxes(-1, -2)[:, None])
    values = np.empty((m, len(LAYERS), *on_curve.shape[1:]))
    values[:, LAYERS.index(0.0)] = on_curve
    off = np.flatnonzero(LAYERS)
    for k in range(m):
        values[k, off] = _beside(few, k, np.array(LAYERS)[off])
    tensors = values.transpose(0, 1, 4, 2, 3)[:, :, :, [[0, 1], [1, 2]]]  # (m, layer, C, direction in, out, N)
    return few.by_mode("near", tensors, axis=2)


def _beside(few: _Few, k: int, offsets: np.ndarray) -> np.ndarray:
    """Components xx, xy, yy of S of the basis at the layers of one shape, off the curve (layers, 3, N, C).

    As `biem.stokes.near.accurate_rows`: by the trapezoid rule on as many nodes as the distance of a point from the curve, any part of it,
    asks for; here the basis takes the place of the nodal values, so that one product with it is all.
    """
    X = few.X[k : k + 1]
    n = X.shape[-1]
    X_alpha = read_back(few.maps.X_alpha[k], few.N)
    normal = np.stack([X_alpha[1], -X_alpha[0]]) / np.hypot(*X_alpha)
    layers = [read_back(X[0], few.N) + offset * length(X) / few.N * normal for offset in offsets]
    points = np.concatenate(layers, axis=1).T  # (Q, 2)
    Q = len(points)
    nearest = np.argmin((points[:, :1] - X[0, 0]) ** 2 + (points[:, 1:] - X[0, 1]) ** 2, axis=1)
    pairs = locate(X, points, np.arange(Q), np.zeros(Q, dtype=np.int64), 2 * pi * nearest / n)
    factor = upsampling(pairs.rho, n, NEAR_TOLERANCE)
    values = np.empty((3, Q, 2 * len(few.modes)))
    for level in LEVELS:
        index = np.flatnonzero(factor == level)
        if len(index):
            fine = resample(X, level * n)
            G = stokeslet(points[index, :1] - fine[0, 0], points[index, 1:] - fine[0, 1], 1.0)
            weighted = few.basis(level * n) * speed(fine) * (2 * pi / (level * n))
            for component in range(3):
                values[component, index] = np.matmul(G[component], weighted.T)
    index = np.flatnonzero(factor == 0)
    if len(index):
        rows = accurate_rows(X, points[index], pairs.subset(index), 1.0, "upsample", NEAR_TOLERANCE)
        values[:, index] = np.matmul(rows.swapaxes(0, 1), few.basis(n).T)
    return values.reshape(3, len(offsets), few.N, -1).swapaxes(0, 1)


MAKERS: dict[MapName, Callable[[_Few, Label], Labels]] = {
    "relax": _relax,
    "self_tension": _self_tension,
    "advection": _advection,
    "flow_tension": _flow_tension,
    "near": _near,
}


def _checked(X: np.ndarray, label: Label) -> np.ndarray:
    n = label.operator_points
    X = np.asarray(X, dtype=np.float64)
    if X.ndim != 3 or X.shape[1:] != (2, n):
        raise ValueError(f"shapes are an array {X.shape}: expected (n, 2, {n}), nodes as label.operator_points says")
    for what, wrong in (
        ("not finite", ~np.isfinite(X).all(axis=(1, 2))),
        (f"not standardized, its length is not 1 within {LENGTH_TOLERANCE:g}", np.abs(length(X) - 1.0) > LENGTH_TOLERANCE),
    ):
        if wrong.any():
            raise ValueError(f"shape {np.flatnonzero(wrong)[0]} (and {wrong.sum() - 1} more) is {what}: see biem.curves.pose.standardize")
    return X
