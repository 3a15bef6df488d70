"""Errors of each map on labelled shapes: relative L2 errors of shapes, by mode, of all modes, and of operators as a whole.

    mode k       |D_k - label| / |label|        over directions, layers and nodes
    all modes    these, of all modes together
    operator     sqrt(sum_k w_k |D_k - label|^2 / sum_k w_k |label|^2),     w = 1, 2, ..., 2, 1:  the Frobenius norm over nodal velocities
    relax        |increment - label| / max(|label|, 0.1 median |label|)

A mode that is zero, the flow tension of a translation, is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from biem.backend import one_blas_thread
from surrogate.data import Source
from surrogate.evaluation.rungs import Rung, Stats, operators, stats
from surrogate.features import CHANNELS
from surrogate.networks import Settings
from surrogate.pairs import Pairs
from surrogate.targets import TARGETS, mode_weights

BLOCK = 256  # shapes at a time
ZERO = 1e-6  # norms of labels below which there is nothing to be relative to

Found = dict[str, Stats | dict[str, Stats]]


def test_rows(pairs: Pairs, most: int | None, seed: int) -> np.ndarray:
    """Rows of the test split, or so many of them by chance. Raises ValueError if there are none."""
    return _source(pairs, "relax").rows("test", most, seed)


def _source(pairs: Pairs, name: str) -> Source:
    """Labels mode by mode, demodulated."""
    modes = tuple(range(pairs.points // 2 + 1)) if TARGETS[name].operator else ()
    return Source(pairs, Settings(name, "ivnet", pairs.points, CHANNELS, modes))


def map_errors(pairs: Pairs, name: str, rungs: Sequence[Rung], rows: np.ndarray, tick: Callable[[int], None]) -> dict[str, Found]:
    """By rung: {"all": ...}, of an operator also {"operator": ..., "modes": {k: ...}}. tick: told of shapes done."""
    with one_blas_thread(), torch.no_grad():
        if TARGETS[name].operator:
            return _of_operator(pairs, name, rungs, rows, tick)
        return _of_shapes(pairs, name, rungs, rows, tick)


def _of_shapes(pairs: Pairs, name: str, rungs: Sequence[Rung], rows: np.ndarray, tick: Callable[[int], None]) -> dict[str, Found]:
    sizes: list[np.ndarray] = []
    errors: dict[str, list[np.ndarray]] = {rung.name: [] for rung in rungs}
    for block in _blocks(rows):
        X, labels = (pairs.read(what, block).astype(np.float64) for what in ("X_std", name))
        sizes.append(_norms(labels))
        for rung in rungs:
            values = rung.maps.self_tension(X) if name == "self_tension" else rung.maps.relax(X, pairs.dt) - X
            errors[rung.name].append(_norms(values - labels))
        tick(len(block))
    norms = np.concatenate(sizes)
    norms = np.maximum(norms, max(TARGETS[name].floor * float(np.median(norms)), ZERO * float(norms.max())))
    return {rung: {"all": stats(np.concatenate(parts) / norms)} for rung, parts in errors.items()}


def _of_operator(pairs: Pairs, name: str, rungs: Sequence[Rung], rows: np.ndarray, tick: Callable[[int], None]) -> dict[str, Found]:
    N = pairs.points
    modes = tuple(range(N // 2 + 1))
    pairs.check(name, modes)
    source = _source(pairs, name)
    sizes: list[Tensor] = []
    errors: dict[str, list[Tensor]] = {rung.name: [] for rung in rungs}
    weights = mode_weights(N).float()
    for block in _blocks(rows):
        X = source.shapes(block)
        labels = source.outputs(block, X)  # (n, K, 2, 2, S, C, N)
        sizes.append(labels.flatten(2).norm(dim=2))
        for rung in rungs:
            errors[rung.name].append((operators(rung, name, X) - labels).flatten(2).norm(dim=2))
        tick(len(block))
    norms = torch.cat(sizes)
    found: dict[str, Found] = {}
    kept = [k for k in modes if float(norms[:, k].median()) > ZERO * float(norms.max())]
    for rung in rungs:
        e = torch.cat(errors[rung.name])
        relative = (e / norms.clamp(min=1e-30)).numpy()
        whole = ((weights * e.square()).sum(1) / (weights * norms.square()).sum(1)).sqrt()
        by_mode = {str(k): stats(relative[:, k]) for k in kept}
        found[rung.name] = {"all": stats(relative[:, kept]), "operator": stats(whole.numpy()), "modes": by_mode}
    return found


def _norms(values: np.ndarray) -> np.ndarray:
    """(n,) of values (n, ...)."""
    return np.sqrt((values.reshape(len(values), -1) ** 2).sum(axis=1))


def _blocks(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[i : i + BLOCK] for i in range(0, len(rows), BLOCK)]
