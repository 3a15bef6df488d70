"""What is compared: maps by networks of each kind, and exact maps at few nodes, as columns of the same tables."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from biem.backend import Array
from biem.curves.curve import length, normal
from biem.membrane.maps import LAYERS, SLOTS, ExactMaps
from biem.stokes.near import accurate_rows
from biem.stokes.near_search import locate
from surrogate.base import exact_labels
from surrogate.features import frame
from surrogate.learned import LearnedMaps, Part, composition
from surrogate.library import SHIPPED, Need, find, kind_of, load_maps
from surrogate.targets import TARGETS, carrier, demodulated, modes_of_kernel

NEAR_TOLERANCE = 1e-9  # as of `ExactMaps.near_layers`
Stats = dict[str, float | int | None]


@dataclass(frozen=True)
class Rung:
    """A column. slots: the maps that it has; digests: of what each is made of; points: of exact maps, None of networks."""

    name: str
    maps: LearnedMaps | ExactMaps
    slots: frozenset[str]
    digests: dict[str, str]
    points: int | None = None

    def knows(self, dt: float) -> bool:
        """Whether its relaxation over dt needs no other maps."""
        if not isinstance(self.maps, LearnedMaps):
            return True
        if "relax" not in self.slots:
            return False
        return composition(dt, [part.card.dt or 0.0 for part in self.maps.loaded["relax"]])[1] == 0.0

    def relaxations(self, dt: float) -> int:
        """How many of its own steps make one of dt."""
        if not isinstance(self.maps, LearnedMaps):
            return 1
        return sum(composition(dt, [part.card.dt or 0.0 for part in self.maps.loaded["relax"]])[0])


@dataclass(frozen=True)
class SteppedMaps(ExactMaps):
    """Exact maps that relax by several steps, or extrapolate one against two halves: rivals of networks that know the converged flow."""

    steps: int = 1
    extrapolated: bool = False

    def relax(self, X: Array, dt: float) -> Array:
        Y = X
        for _ in range(self.steps):
            Y = ExactMaps.relax(self, Y, dt / self.steps)
        return 2.0 * Y - ExactMaps.relax(self, X, dt) if self.extrapolated else Y


def stepped_rungs(points: int) -> list[Rung]:
    """Of relaxation alone."""
    ways = {f"{n} steps": SteppedMaps(points=points, steps=n) for n in (4, 16)}
    ways["extrapolated"] = SteppedMaps(points=points, steps=2, extrapolated=True)
    names = {f"exact {points}, {way}": maps for way, maps in ways.items()}
    return [Rung(name, maps, frozenset({"relax"}), {"relax": name}, points) for name, maps in names.items()]


def exact_rungs(points: Sequence[int]) -> list[Rung]:
    """Near layers do not depend on the nodes of the operators: only the first one has them."""
    rungs = []
    for i, n in enumerate(points):
        slots = frozenset(slot for slot in SLOTS if slot != "near" or i == 0)
        rungs.append(Rung(f"exact {n}", ExactMaps(points=n), slots, dict.fromkeys(SLOTS, f"exact {n}"), n))
    return rungs


def learned_rungs(kinds: Sequence[str], weights: Path | None, need: Need, exact: ExactMaps | None = None) -> tuple[list[Rung], list[str]]:
    """Of the kinds that have weights, with the slots that have, and a line for each that has not."""
    folder = weights or SHIPPED
    rungs, notes = [], []
    for kind in kinds:
        loaded: dict[str, tuple[Part, ...]] = {}
        digests: dict[str, str] = {}
        maps = None
        for slot in SLOTS:
            if kind == "hybrid" and slot == "near":
                continue
            try:
                maps = load_maps(kind, folder, need=need, slots=[slot], exact=exact)
                digests[slot] = _digest(folder, kind, slot)
            except (ValueError, FileNotFoundError) as error:
                notes.append(f"{kind} has no {slot}: {_shortened(str(error))}")
                continue
            loaded.update(maps.loaded)
        if maps is not None and loaded:
            rungs.append(Rung(kind, replace(maps, loaded=loaded), frozenset(loaded), digests))
    return rungs, notes


def _digest(folder: Path, kind: str, slot: str) -> str:
    files = [path for path, card in find(folder) if kind_of(card) == kind and card.network.map == slot]
    return hashlib.sha256(b"".join(hashlib.sha256(path.read_bytes()).digest() for path in files)).hexdigest()


def _shortened(text: str) -> str:
    return text if len(text) <= 240 else text[:240] + " ..."


@torch.no_grad()
def operators(rung: Rung, slot: str, X: Tensor) -> Tensor:
    """D_k of `targets` (n, K, 2 [re, im], 2 [d], S, C, N) float32 of a map that acts on velocities, X (n, 2, N) in the standard pose."""
    if rung.points is not None:
        return _exact_operators(slot, X, rung.points)
    assert isinstance(rung.maps, LearnedMaps)
    part = rung.maps.loaded[slot][0]
    A = part.network(X)
    settings = part.card.network
    D = A if settings.arch == "ivnet" else modes_of_kernel(A[:, 0], frame(X), settings.rolloff)
    return D if part.card.base_points is None else D + _exact_operators(slot, X, part.card.base_points)


def _exact_operators(slot: str, X: Tensor, points: int) -> Tensor:
    F, N = frame(X), X.shape[-1]
    if slot == "near":
        T = torch.from_numpy(_exact_near(X.numpy()))
    else:
        T = torch.from_numpy(exact_labels(X.numpy(), slot, points))
        T = T.reshape(*T.shape[:4], 1, TARGETS[slot].parts, N)
    return torch.stack([demodulated(T[:, k], k, F) for k in range(N // 2 + 1)], dim=1)


def _exact_near(X: np.ndarray) -> np.ndarray:
    """`ExactMaps.near_layers` of all modes as densities (n, K, 2 [re, im], 2 [d], S, 2, N): all with the rows of one quadrature."""
    n, _, N = X.shape
    phase = carrier(tuple(range(N // 2 + 1)), N).numpy()
    f = np.stack([np.cos(phase), np.sin(phase)], axis=1)  # (K, 2, N)
    f[[0, -1], 1] = 0.0
    h = (length(X) / N)[:, None, None]
    layers = np.stack([X + offset * h * normal(X) for offset in LAYERS], axis=1)  # (n, S, 2, N)
    points = layers.transpose(0, 1, 3, 2).reshape(-1, 2)
    vesicle = np.repeat(np.arange(n), len(LAYERS) * N)
    start = np.tile(2.0 * np.pi * np.arange(N) / N, n * len(LAYERS))
    rows = accurate_rows(X, points, locate(X, points, np.arange(len(points)), vesicle, start), 1.0, "upsample", NEAR_TOLERANCE)
    values = np.einsum("qcn,kpn->kpcq", rows, f).reshape(*f.shape[:2], 3, n, len(LAYERS), N)[:, :, [[0, 1], [1, 2]]]
    return np.ascontiguousarray(values.transpose(4, 0, 1, 2, 5, 3, 6))


def stats(errors: np.ndarray) -> Stats:
    """Quantiles, mean and maximum, of numbers of which some may be infinite (None here)."""
    v = np.asarray(errors, dtype=np.float64).ravel()
    v = np.where(np.isnan(v), np.inf, v)
    quantiles = {"p05": 0.05, "p25": 0.25, "median": 0.5, "p75": 0.75, "p95": 0.95}
    found = {name: float(np.quantile(v, q, method="linear" if np.isfinite(v).all() else "higher")) for name, q in quantiles.items()}
    found |= {"mean": float(v.mean()), "max": float(v.max())}
    return {**{name: value if np.isfinite(value) else None for name, value in found.items()}, "n": int(v.size)}
