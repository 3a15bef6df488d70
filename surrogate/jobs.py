"""Which networks there are to train, on what data, and by which process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from surrogate.config import Training
from surrogate.pairs import Pairs
from surrogate.targets import TARGETS
from surrogate.train import Job

Work = tuple[Job, Pairs]


def pick(config: Training, data: Sequence[Pairs], out: Path, name: str, mode: int | None, grouped: bool = False) -> list[Work]:
    """The work on one map: for an IVNet of an operator one job a mode, or all modes at once; relax for every time step in the data.

    data: several files of pairs; of labels that two of them have (for relax: of one time step), the last one's are taken. Raises ValueError
    for a map or a mode that is not there.
    """
    if name not in TARGETS:
        raise ValueError(f"--map {name}: expected one of {', '.join(TARGETS)}")
    per_mode = config.of(name).network.arch == "ivnet" and TARGETS[name].operator
    if mode is not None and not per_mode:
        raise ValueError(f"--mode {mode}: only IVNets of advection, flow_tension and near have modes; leave it out for {name}")
    having = [pairs for pairs in data if name in pairs.maps]
    if not having:
        data[0].check(name)
    if name == "relax":
        steps = {pairs.dt: pairs for pairs in having}
        return [(Job(name, (), out, f"{dt:g}"), pairs) for dt, pairs in sorted(steps.items())]
    pairs = having[-1]
    if not per_mode:
        return [(Job(name, (), out), pairs)]
    every = range(pairs.points // 2 + 1)
    if mode is not None and mode not in every:
        raise ValueError(f"--mode {mode}: curves of {pairs.points} nodes have modes 0 to {every[-1]}")
    modes = tuple(every) if mode is None else (mode,)
    pairs.check(name, modes)
    return [(Job(name, modes, out), pairs)] if grouped else [(Job(name, (k,), out), pairs) for k in modes]


def pick_all(config: Training, data: Sequence[Pairs], out: Path, grouped: bool = False) -> list[Work]:
    """The work on all maps that the data have labels of; residual networks correct all but near."""
    maps = [name for name in TARGETS if any(name in pairs.maps for pairs in data)]
    maps = [name for name in maps if name != "near" or config.of(name).network.target == "full"]
    return [work for name in maps for work in pick(config, data, out, name, None, grouped)]


def cost(config: Training, work: Work) -> float:
    """Of a job, in samples of a map with one layer."""
    job, _ = work
    return float(config.of(job.map).training.samples * TARGETS[job.map].layers * max(1, len(job.modes)))


def dealt(works: Iterable[Work], cost: Callable[[Work], float], parts: int) -> list[list[Work]]:
    """The work dealt out to so many processes, the largest first, each to the one with the least so far."""
    hands: list[list[Work]] = [[] for _ in range(parts)]
    loads = [0.0] * parts
    for work in sorted(works, key=lambda w: -cost(w)):
        least = loads.index(min(loads))
        hands[least].append(work)
        loads[least] += cost(work)
    return hands
