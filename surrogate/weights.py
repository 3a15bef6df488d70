"""Files of weights: safetensors with a model card in their metadata. No pickles: nothing in them is run.

A file holds one map: `make_network(settings)` and its tensors, some of them in half precision. What it is good for is in the card, and is
checked before it is used.
"""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import Field
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from biem.membrane.maps import LAYERS
from biem.run.files import one_line, write_atomically
from biem.scene.tables import Table, validated
from surrogate.distribution import Distribution
from surrogate.networks import LearnedMap, Settings, make_network

VERSION = 1
STATISTICS = "distribution."  # of the training shapes: what their tensors' names begin with
HALVED = ("core.", "basis")  # tensors that may be kept in half precision: the statistics are not


class Card(Table):
    """What a file of weights is of, and how good it is.

    settings: of the network. target: "full", or "residual" against exact maps at base_points nodes. dt: of relax, in mu length^3/kappa_b;
    relaxation: "implicit" step or "converged" flow over it; damped_from: mode from which its increments are not taken from the network
    (`surrogate.damping`), or None. layers: offsets of near layers, in arclength spacings. operator_points: of the
    labels. data: SHA-256 of the data set's manifest. errors: by mode ("all" where one network has them all), relative L2 on test runs.
    """

    version: int = VERSION
    settings: dict[str, Any]
    target: str
    base_points: int | None
    reduced_area: float
    dt: float | None
    relaxation: str | None
    damped_from: int | None = None
    layers: list[float] | None
    operator_points: int
    data: str
    shapes: int
    samples: int
    seconds: float
    seed: int
    commit: str
    errors: dict[str, dict[str, float]] = Field(default_factory=dict)

    @property
    def network(self) -> Settings:
        return Settings.from_dict(self.settings)


def save_weights(path: Path, network: LearnedMap, card: Card, half: bool = False) -> None:
    """Writes a file of weights, whole or not at all. half: weights and bases in 16 bits. Raises OSError."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    if half:
        tensors = {name: _halved(value) if name.startswith(HALVED) else value for name, value in tensors.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save(tensors, metadata={"card": card.model_dump_json()}))


def _halved(value: torch.Tensor) -> torch.Tensor:
    return value.half() if value.dtype == torch.float32 and float(value.abs().max()) < 6e4 else value


def read_card(path: Path) -> Card:
    """Raises FileNotFoundError, ValueError for what is not a file of weights."""
    with _opened(path) as file:
        return _card(path, file.metadata())


def read_weights(path: Path) -> tuple[LearnedMap, Card]:
    """The network, for inference, in float32, and its card.

    Raises FileNotFoundError; ValueError for a pickle, a file cut short, a card that is missing, tensors that are missing, too many, of
    another shape or not finite.
    """
    with _opened(path) as file:
        card = _card(path, file.metadata())
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (not a dictionary)
    network = _network_of(path, card, {name: tuple(value.shape) for name, value in tensors.items()})
    _check_values(path, tensors)
    expected = network.state_dict()
    network.load_state_dict({name: value.to(expected[name].dtype) for name, value in tensors.items()})
    return network.eval().requires_grad_(False), card


def check_weights(path: Path) -> None:
    """Raises what `read_weights` would, but for values that are not finite: the tensors are not read, only their names and shapes."""
    with _opened(path) as file:
        card = _card(path, file.metadata())
        shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    _network_of(path, card, shapes)


def read_distribution(path: Path) -> Distribution:
    """The statistics of the shapes that the network was trained on, without the network. Raises as `read_weights`."""
    with _opened(path) as file:
        card = _card(path, file.metadata())
        tensors = {name: file.get_tensor(name) for name in file.keys() if name.startswith(STATISTICS)}  # noqa: SIM118
    _check_values(path, tensors)
    distribution = Distribution(card.network.points)
    distribution.load_state_dict({name.removeprefix(STATISTICS): value for name, value in tensors.items()})
    return distribution


def _network_of(path: Path, card: Card, shapes: Mapping[str, tuple[int, ...]]) -> LearnedMap:
    """The network of a card, its weights not yet set. Raises ValueError where it has other tensors than those of these shapes."""
    try:
        network = make_network(card.network)
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"{path}: its card does not describe a network that there is: {one_line(error)}") from None
    expected = network.state_dict()
    missing, unknown = sorted(expected.keys() - shapes.keys()), sorted(shapes.keys() - expected.keys())
    if missing or unknown:
        what = f"has no tensor {missing[0]}" if missing else f"has a tensor {unknown[0]} that the network of its card has not"
        raise ValueError(f"{path} {what} (and {len(missing) + len(unknown) - 1} more): take the file as training wrote it")
    for name, shape in shapes.items():
        if shape != tuple(expected[name].shape):
            raise ValueError(f"{path}: {name} has shape {shape}, its card expects {tuple(expected[name].shape)}")
    return network


def _check_values(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    for name, value in tensors.items():
        unbounded = name.endswith(("lowest", "highest", "limit"))
        if not bool((~torch.isnan(value) if unbounded else torch.isfinite(value)).all()):
            raise ValueError(f"{path}: {name} has values that are not finite")


def _opened(path: Path) -> Any:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: train it with `python -m surrogate train`, or give a folder of weights")
    if path.suffix != ".safetensors":
        raise ValueError(f"{path} is not a safetensors file: weights are never read from pickles")
    try:
        return safe_open(path, framework="pt")
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} is no whole safetensors file ({one_line(error)}): it may be cut short, or a pickle") from None


def _card(path: Path, metadata: Mapping[str, str] | None) -> Card:
    if not metadata or "card" not in metadata:
        raise ValueError(f"{path} has no model card: take weights that `python -m surrogate train` or `merge` wrote")
    try:
        card = validated(Card, json.loads(metadata["card"]))
        _ = card.network
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: its model card is not one of version {VERSION}: {one_line(error)}") from None
    if card.version != VERSION:
        raise ValueError(f"{path} has a model card of version {card.version}: this program reads {VERSION}")
    if card.layers is not None and tuple(card.layers) != LAYERS:
        raise ValueError(f"{path} has layers at {card.layers} arclength spacings: this program uses {list(LAYERS)}")
    return card


def checkpoint_bytes(content: Mapping[str, Any]) -> bytes:
    """Of a training's checkpoint: tensors and plain values alone."""
    buffer = io.BytesIO()
    torch.save(dict(content), buffer)
    return buffer.getvalue()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Raises ValueError for what is not a whole checkpoint. Unpickles tensors and plain values alone."""
    try:
        found: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"{path} is not a whole checkpoint ({one_line(error)[:120]}): remove the folder and train again") from None
    return found
