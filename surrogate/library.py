"""Folders of weights, and the maps made of them: `load_maps`. The shipped folder is `surrogate/shipped`.

A folder holds safetensors at any depth; what a file is of stands in its model card, not in its name. kind "ivnet" and "mlp": full networks
of that architecture; "hybrid": residual ones.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from biem.curves.curve import area, length
from biem.membrane.maps import SLOTS, ExactMaps
from surrogate.learned import SAME_DT, Deferred, LearnedMaps, Loaded, Part, composition
from surrogate.targets import TARGETS
from surrogate.weights import Card, check_weights, read_card, read_weights

SHIPPED = Path(__file__).parent / "shipped"
KINDS = ("ivnet", "mlp", "hybrid")
SAME_REDUCED_AREA = 5e-3
ON_DEMAND = ("near",)  # slots that a run may never call: their networks are read when it does


@dataclass(frozen=True)
class Need:
    """What the weights must be for. dts: time steps in mu length^3/kappa_b, or () where any will do."""

    points: int
    reduced_area: float
    dts: tuple[float, ...] = ()


def kind_of(card: Card) -> str:
    """The kind of maps that a file is for."""
    return "hybrid" if card.target == "residual" else str(card.network.arch)


def need_of(X: np.ndarray, kappa_b: float = 1.0, mu: float = 1.0, dts: Sequence[float] = ()) -> Need:
    """Of vesicles X (M, 2, N) and time steps. Raises ValueError for vesicles that no one set of weights can serve."""
    L, A = length(X), area(X)
    v = 4.0 * np.pi * A / L**2
    if v.max() - v.min() > 2 * SAME_REDUCED_AREA:
        raise ValueError(
            f'vesicles have reduced areas from {v.min():.4g} to {v.max():.4g}: networks are for one; take solver.maps = "exact"'
        )
    if dts and L.max() > L.min() * (1.0 + SAME_DT / 3):
        raise ValueError(
            f'vesicles have lengths from {L.min():.4g} to {L.max():.4g}: networks relax those of one; take solver.maps.relax = "exact"'
        )
    return Need(X.shape[-1], float(np.mean(v)), tuple(dt * kappa_b / (mu * float(np.mean(L)) ** 3) for dt in dts))


def load_maps(
    kind: str,
    weights: str | Path | None = None,
    *,
    need: Need | None = None,
    slots: Collection[str] | None = None,
    kappa_b: float = 1.0,
    mu: float = 1.0,
    exact: ExactMaps | None = None,
    limits: str = "flag",
) -> LearnedMaps:
    """Maps of the shipped weights, or of those in a folder (or file). kind: "ivnet", "mlp" or "hybrid".

    need: what they must be for (default: reduced area 0.65, 32 nodes, any time step); slots: those to load (default all that the kind has).
    A slot that "hybrid" has no network for, near, is answered by exact maps; other networks of near are read at the first call of
    `near_layers`, their cards, names and shapes now. Raises FileNotFoundError, ValueError for weights that are missing, or are not for
    what is needed.
    """
    if kind not in KINDS:
        raise ValueError(f"there are no maps of kind {kind!r}: expected one of {', '.join(KINDS)}")
    need = need or Need(32, 0.65)
    exact = exact or ExactMaps(kappa_b, mu)
    wanted = [slot for slot in SLOTS if (slots is None or slot in slots) and not (kind == "hybrid" and slot == "near")]
    base = cache(lambda points: replace(exact, points=points))  # one for all maps of as many nodes: they share what it builds of a shape
    loaded = {slot: _load(kind, slot, Path(weights or SHIPPED), need, base) for slot in wanted}
    return LearnedMaps(loaded, kappa_b, mu, exact, limits)


def find(folder: Path) -> list[tuple[Path, Card]]:
    """All weights in a folder, or the one that a file is. Raises FileNotFoundError, ValueError."""
    if folder.is_dir():
        paths = sorted(folder.rglob("*.safetensors"))
        if not paths:
            raise FileNotFoundError(f"{folder} has no weights (*.safetensors): train some with `python -m surrogate train`")
    else:
        paths = [folder]
    return [(path, _card_of(path, path.stat().st_mtime_ns if path.exists() else 0)) for path in paths]


@lru_cache(maxsize=1024)
def _card_of(path: Path, changed: int) -> Card:
    return read_card(path)


def _load(kind: str, slot: str, folder: Path, need: Need, base: Callable[[int], ExactMaps]) -> tuple[Part, ...]:
    cards = [(path, card) for path, card in find(folder) if kind_of(card) == kind and card.network.map == slot]
    if not cards:
        raise ValueError(f"{folder} has no weights of {slot} for solver.maps = {kind!r}: train them, or choose other maps")
    fitting = [(path, card) for path, card in cards if not _misfit(card, need)]
    if not fitting:
        raise ValueError(f"no weights of {slot} ({kind}) in {folder} fit: " + "; ".join(sorted({_misfit(card, need) for _, card in cards})))
    fitting.sort(key=lambda item: -(item[1].dt or 0.0))
    for (path, card), (other, following) in pairwise(fitting):
        if card.dt == following.dt:
            raise ValueError(f"{folder} has several weights of {slot} ({kind}) that fit, such as {path.name} and {other.name}: leave one")
    if slot == "relax":
        _check_steps([card for _, card in fitting], need)
    if slot in ON_DEMAND:
        return tuple(_deferred(path, card, base) for path, card in fitting)
    return tuple(_read(path, base) for path, _ in fitting)


def _misfit(card: Card, need: Need) -> str:
    """Why weights are not for what is needed; "" where they are."""
    settings = card.network
    if settings.points != need.points:
        return f"they are for {settings.points} nodes, the scene has vesicles.points = {need.points}"
    if abs(card.reduced_area - need.reduced_area) > SAME_REDUCED_AREA:
        return f"they are for reduced area {card.reduced_area:g}, the scene has {need.reduced_area:.4g}"
    every = tuple(range(settings.points // 2 + 1))
    if settings.arch == "ivnet" and TARGETS[settings.map].operator and settings.modes != every:
        return f"they are of modes {list(settings.modes)}, all of 0 to {every[-1]} are needed: merge them with `python -m surrogate merge`"
    return ""


def _check_steps(cards: list[Card], need: Need) -> None:
    """Raises ValueError for time steps that are not made of those that the networks know."""
    known = [card.dt or 0.0 for card in cards]
    for dt in need.dts:
        times, rest = composition(dt, known)
        composed = all(card.relaxation == "converged" for card, n in zip(cards, times, strict=True) if n)
        if rest or (sum(times) > 1 and not composed):
            steps = ", ".join(f"{value:g}" for value in known)
            way = "a sum of them" if all(card.relaxation == "converged" for card in cards) else "one of them"
            raise ValueError(
                f"relax weights are for dt kappa_b/(mu L^3) = {steps}, the scene asks for {dt:.6g}: choose a time.dt that gives {way} "
                '(with time.order = 2, half of it too), other weights, or solver.maps.relax = "exact"'
            )


def _read(path: Path, base: Callable[[int], ExactMaps]) -> Loaded:
    network, card = read_weights(path)
    return Loaded(network, card, None if card.base_points is None else base(card.base_points))


def _deferred(path: Path, card: Card, base: Callable[[int], ExactMaps]) -> Deferred:
    check_weights(path)
    return Deferred(path, card, None if card.base_points is None else base(card.base_points))
