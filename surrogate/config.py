"""Settings of a training: a TOML file, validated; `[map.NAME]` overrides them for one map."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from biem.scene.tables import Table, override, read_toml, validated
from surrogate.targets import TARGETS

Channel = Literal["x", "y", "normal_x", "normal_y", "speed", "curvature", "curvature_s", "curvature_ss", "bending_n", "bending_t"]


class NetworkTable(Table):
    """arch: "ivnet", one network a mode, or "mlp", one for all modes. target: "residual" is against exact maps at base_points nodes.

    rolloff: errors of advection and flow tension in mode k count as 1/(1 + (k/rolloff)^2), as velocities have them; of "mlp" alone.
    """

    arch: Literal["ivnet", "mlp"] = "mlp"
    target: Literal["full", "residual"] = "full"
    base_points: int = Field(48, ge=16, multiple_of=2)
    channels: list[Channel] = Field(["x", "y", "curvature", "curvature_s"], min_length=1)
    blocks: int = Field(2, ge=1)
    width: int = Field(512, ge=2)
    rank: int = Field(512, ge=1)  # mlp: coefficients of the output
    rolloff: float | None = Field(None, gt=0)
    levels: int = Field(2, ge=1)  # ivnet, as what follows
    growth: float = Field(1.5, gt=0)
    activation: Literal["silu", "relu", "gelu"] = "silu"
    norm: Literal["none", "batch"] = "none"


class TrainingTable(Table):
    """samples: shapes shown in all, the cosine's length. shapes: at most so many distinct ones. beta: weight of the derivative's error.

    augment: with the symmetries of the standard pose. ema: decay of the weights' average, which is what is kept. every: steps between
    validations, with a checkpoint each. compile: by torch.compile, which takes a minute and a C++ compiler or a GPU.
    """

    samples: int = Field(1_000_000, ge=1)
    shapes: int | None = Field(None, ge=16)
    batch: int = Field(256, ge=1)
    lr: float = Field(2e-3, gt=0)
    weight_decay: float = Field(1e-4, ge=0)
    beta: float = Field(0.1, ge=0)
    ema: float = Field(0.995, ge=0, lt=1)
    clip: float = Field(1.0, gt=0)  # of a network's gradient norm
    augment: bool = True
    seed: int = Field(0, ge=0)
    every: int = Field(500, ge=1)
    compile: bool = False


class Training(Table):
    """A validated training file. map: tables of keys of either table, by map."""

    network: NetworkTable = NetworkTable()
    training: TrainingTable = TrainingTable()
    map: dict[Literal["relax", "self_tension", "advection", "flow_tension", "near"], dict[str, Any]] = Field(default_factory=dict)

    def of(self, name: str) -> Training:
        """With the overrides of one map, and none left. Raises ValueError for keys that no table has."""
        if name not in TARGETS:
            raise ValueError(f"there is no map {name}: expected one of {', '.join(TARGETS)}")
        tables = {"network": self.network.model_dump(), "training": self.training.model_dump()}
        own = next((table for key, table in self.map.items() if key == name), {})
        for key, value in own.items():
            places = [table for table in tables.values() if key in table]
            if not places:
                raise ValueError(
                    f"map.{name}.{key} is not known: expected one of {', '.join(sorted(k for t in tables.values() for k in t))}"
                )
            places[0][key] = value
        return validated(Training, tables)


def load_training(path: str | Path | None, overrides: Iterable[str] = ()) -> Training:
    """The training file (None: defaults), with overrides such as "training.samples=1000". Raises ValueError with one line."""
    table: dict[str, Any] = {} if path is None else read_toml(Path(path), "training", "configs/train/mlp.toml")
    for text in overrides:
        override(table, text)
    config = validated(Training, table)
    for name in config.map:
        config.of(name)
    return config
