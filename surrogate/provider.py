"""The maps that a scene with `solver.kind = "vesnet"` asks for: what `biem` calls, knowing no more than `MapsRequest`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from biem.backend import Array
from biem.membrane.maps import ExactMaps, MapsRequest, MembraneMaps
from surrogate.learned import LearnedMaps
from surrogate.library import load_maps, need_of


@dataclass(frozen=True)
class SlotMaps:
    """`MembraneMaps` with each map from its own maker: slots as in `biem.membrane.maps.SLOTS`."""

    slots: Mapping[str, MembraneMaps]

    def advect(self, X: Array, u: Array) -> Array:
        return self.slots["advection"].advect(X, u)

    def relax(self, X: Array, dt: float) -> Array:
        return self.slots["relax"].relax(X, dt)

    def self_tension(self, X: Array) -> Array:
        return self.slots["self_tension"].self_tension(X)

    def flow_tension(self, X: Array, u: Array) -> Array:
        return self.slots["flow_tension"].flow_tension(X, u)

    def near_layers(self, X: Array, f: Array) -> Array:
        return self.slots["near"].near_layers(X, f)

    def diagnostics(self, X: Array) -> Mapping[str, float]:
        """The largest of each number over the makers."""
        makers = {id(maps): maps for maps in self.slots.values() if isinstance(maps, LearnedMaps)}
        found = [maps.diagnostics(X) for maps in makers.values()]
        return {name: max(d[name] for d in found) for name in found[0]} if found else {}


def make_maps(request: MapsRequest) -> SlotMaps:
    """Maps for a scene, only those that it needs from files. Raises ValueError, FileNotFoundError for weights that do not fit."""
    if request.device == "cpu":
        torch.set_num_threads(1)  # vesicles are dealt out to threads in chunks: more threads within an operation only wait for each other
    exact = ExactMaps(request.kappa_b, request.mu, request.operator_points, request.dtype)
    slots: dict[str, MembraneMaps] = dict.fromkeys(request.kinds, exact)
    learned = {slot: kind for slot, kind in request.kinds.items() if slot in request.needed and kind != "exact"}
    if "relax" in learned and request.adaptive:
        raise ValueError('networks relax over time steps that they were trained for: time.adaptive needs solver.maps.relax = "exact"')
    need = need_of(request.X, request.kappa_b, request.mu, request.dts if "relax" in learned else ())
    for kind in dict.fromkeys(learned.values()):
        own = [slot for slot in learned if learned[slot] == kind]
        maps = load_maps(
            kind,
            request.weights,
            need=need,
            slots=own,
            kappa_b=request.kappa_b,
            mu=request.mu,
            exact=exact,
            limits=request.out_of_distribution,
        )
        slots.update(dict.fromkeys(own, maps))
    return SlotMaps(slots)
