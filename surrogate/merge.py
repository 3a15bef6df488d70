"""From training runs to a folder of weights: the networks of all modes of a map as one grouped network, batch norms folded away."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from surrogate.ivnet import Interpolation, Restriction, VBlock
from surrogate.library import find, kind_of
from surrogate.networks import IVNetMap, LearnedMap, make_network
from surrogate.weights import Card, read_weights, save_weights

PER_GROUP = ("input_mean", "input_scale", "output_mean", "output_scale", "lowest", "highest")


def merge(runs: Sequence[Path], output: Path, half: bool = True) -> list[Path]:
    """Weights of all runs below the folders, into output/KIND/MAP.safetensors (relax: MAP-DT). half: in 16 bits.

    Raises ValueError for networks of one map that do not belong together, or of which a mode is there twice, FileNotFoundError where there
    are none.
    """
    groups: dict[tuple[str, str, str], list[tuple[Path, Card]]] = defaultdict(list)
    for folder in runs:
        for path, card in find(folder):
            step = f"-{card.dt:g}" if card.dt is not None else ""
            groups[kind_of(card), card.network.map, step].append((path, card))
    made = []
    for (kind, name, step), members in sorted(groups.items()):
        network, card = _joined(members)
        path = output / kind / f"{name}{step}.safetensors"
        save_weights(path, network, card, half)
        made.append(path)
    return made


def _joined(members: list[tuple[Path, Card]]) -> tuple[LearnedMap, Card]:
    members = sorted(members, key=lambda item: item[1].network.modes)
    first_path, first = members[0]
    loaded = [read_weights(path)[0] for path, _ in members]
    if len(members) == 1:
        network = folded(loaded[0]) if isinstance(loaded[0], IVNetMap) else loaded[0]
        return network, first.model_copy(update={"settings": network.settings.as_dict()})
    modes = tuple(k for _, card in members for k in card.network.modes)
    if len(set(modes)) < len(modes) or not modes:
        raise ValueError(f"{first_path} and {members[1][0]} are of the same map and mode: merge one of them")
    for path, card in members[1:]:
        for what in ("target", "base_points", "reduced_area", "layers", "operator_points", "data"):
            if getattr(card, what) != getattr(first, what):
                raise ValueError(f"{path} has {what} {getattr(card, what)}, {first_path} has {getattr(first, what)}: they cannot be merged")
        if replace(card.network, modes=()) != replace(first.network, modes=()):
            raise ValueError(f"{path} is of other network settings than {first_path}: they cannot be merged")
    parts = [network for network in loaded if isinstance(network, IVNetMap)]
    errors = {k: e for _, card in members for k, e in card.errors.items()}
    network = merged([folded(part) for part in parts])
    update = {
        "settings": network.settings.as_dict(),
        "errors": errors,
        "samples": sum(card.samples for _, card in members),
        "seconds": round(sum(card.seconds for _, card in members), 1),
    }
    return network, first.model_copy(update=update)


def merged(parts: Sequence[IVNetMap]) -> IVNetMap:
    """One grouped network of networks of the same shape."""
    settings = replace(parts[0].settings, modes=tuple(k for part in parts for k in part.settings.modes))
    network = make_network(settings)
    assert isinstance(network, IVNetMap)
    states = [part.state_dict() for part in parts]
    of_groups = {name for name in states[0] if name.startswith("core.") or name in PER_GROUP}
    network.load_state_dict(
        {name: torch.cat([state[name] for state in states]) if name in of_groups else value for name, value in states[0].items()}
    )
    return network.eval()


def folded(network: IVNetMap) -> IVNetMap:
    """The same map without batch norms: their scales and shifts, as they are for inference, in the weights before them."""
    if network.settings.network.get("norm", "none") == "none":
        return network
    settings = replace(network.settings, network={**network.settings.network, "norm": "none"})
    plain = make_network(settings)
    assert isinstance(plain, IVNetMap)
    own, target = network.state_dict(), plain.state_dict()
    for name, value in own.items():
        if name in target:
            target[name] = value
    for index, block in enumerate(network.core.blocks):
        assert isinstance(block, VBlock)
        for step, (move, norm) in enumerate(zip(block.moves, block.norms, strict=True)):
            scale, shift = _scale_and_shift(norm, network.groups)
            prefix = f"core.blocks.{index}.moves.{step}."
            if isinstance(move, Restriction):
                half = scale.shape[-1] // 2
                pieces = {"narrow": slice(None, half), "wide": slice(half, None)}
                for piece, channels in pieces.items():
                    target[f"{prefix}{piece}.weight"] = own[f"{prefix}{piece}.weight"] * scale[..., channels]
                    target[f"{prefix}{piece}.bias"] = shift[..., channels]
            elif isinstance(move, Interpolation):
                target[f"{prefix}fine.weight"] = own[f"{prefix}fine.weight"] * scale.repeat(1, 1, 2)
                target[f"{prefix}fine.bias"] = shift.repeat(1, 1, 2)
    plain.load_state_dict(target)
    return plain.eval()


def _scale_and_shift(norm: torch.nn.Module, groups: int) -> tuple[Tensor, Tensor]:
    """Of a batch norm at inference, (G, 1, C) each."""
    assert isinstance(norm, torch.nn.BatchNorm1d)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    shift = norm.bias - norm.running_mean * scale
    return scale.reshape(groups, 1, -1).detach(), shift.reshape(groups, 1, -1).detach()
