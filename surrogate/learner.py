"""A network beside its training data: losses of batches, errors on held-out shapes, the average of its weights.

    loss of a network = mean over the batch of |error|/|target| + beta |error'|/|target'|,     ' along the nodes of the output

An IVNet's errors are nodal values; an MLP's are coefficients in an orthonormal basis, whose norms are the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surrogate.config import TrainingTable
from surrogate.data import Basis, BasisData, Floors, ModeData, Source, basis_data, mode_data, principal_components
from surrogate.features import derivative
from surrogate.networks import IVNetMap, LearnedMap, MLPMap, Settings, make_network
from surrogate.symmetric import Parts
from surrogate.targets import SYMMETRIES

VALIDATED = 2000  # shapes of a validation, at most
LEAST_SCALE = 1e-3  # of the largest scale of an output
BATCH = 1024  # rows at a time, where nothing is learned


@dataclass(frozen=True)
class Errors:
    """Relative L2 errors (networks, shapes) of held-out shapes."""

    values: np.ndarray

    def summary(self) -> dict[str, float]:
        """Median, mean and 95th percentile over all networks and shapes."""
        v = self.values
        return {"median": float(np.median(v)), "mean": float(v.mean()), "p95": float(np.quantile(v, 0.95))}


class Learner(ABC):
    """rows: of the training shapes in the file of pairs; inputs (rows of data, ...): of all their images."""

    network: LearnedMap
    inputs: Tensor
    slope: Tensor  # takes an error to what has the norm of its derivative

    def __init__(self, source: Source, training: TrainingTable, rank: int, device: str, kept: Mapping[str, Any] | None) -> None:
        self.source, self.training, self.rank, self.device = source, training, rank, device
        self._kept: tuple[tuple[str, int | None] | None, ModeData | BasisData | None] = (None, None)
        for split in ("val", "test"):
            source.rows(split, None)  # that there are none shows here, not after the training
        self.rows = source.rows("train", training.shapes, training.seed)
        self.images = len(SYMMETRIES) if training.augment else 1
        self._fill(kept or {})
        self.network.distribution.measure(source.shapes(self.rows))
        self.network.to(device)
        if training.compile:
            self.network.core.compile()
        self.slope = self.slope.to(device)
        self.average = {name: value.detach().clone() for name, value in self.network.core.state_dict().items()}

    @abstractmethod
    def _fill(self, kept: Mapping[str, Any]) -> None:
        """Makes the data and the network. kept: what `keep` gave for a checkpoint."""

    def keep(self) -> dict[str, Any]:
        """What a training that goes on must find as it was, and would not make the same bits of on another machine."""
        return {}

    @abstractmethod
    def _differences(self, data: ModeData | BasisData, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Errors (G, b, ...), and the norms (G, b) that they and their derivatives are relative to."""

    @abstractmethod
    def _held_out(self, split: str, most: int | None) -> ModeData | BasisData:
        """Data of another split, without images."""

    @property
    @abstractmethod
    def _data(self) -> ModeData | BasisData: ...

    def __len__(self) -> int:
        return len(self._data)

    def shape_of(self, row: int) -> tuple[int, int]:
        """The row in the file of pairs, and the number of the symmetry, of a row of the data."""
        return int(self.rows[row % len(self.rows)]), row // len(self.rows)

    def losses(self, rows: Tensor) -> Tensor:
        """(G,)."""
        e, norms, slopes = self._differences(self._data, rows.to(self.device))
        loss = (e.flatten(2).norm(dim=2) / norms).mean(1)
        beta = self.training.beta
        return loss if beta == 0 else loss + beta * ((e @ self.slope).flatten(2).norm(dim=2) / slopes).mean(1)

    @torch.no_grad()
    def errors_of(self, rows: Tensor) -> np.ndarray:
        """Largest relative error over the networks (b,), of rows of the training data."""
        e, norms, _ = self._differences(self._data, rows.to(self.device))
        return (e.flatten(2).norm(dim=2) / norms).amax(0).cpu().numpy()

    @torch.no_grad()
    def errors(self, split: str, most: int | None = None) -> Errors:
        """Of the averaged weights, on shapes of a split."""
        key = (split, most)
        if self._kept[0] != key:  # validations come again and again
            self._kept = (key, self._held_out(split, most))
        data = self._kept[1]
        assert data is not None
        found = []
        with self._averaged():
            for rows in torch.arange(len(data), device=self.device).split(BATCH):
                e, norms, _ = self._differences(data, rows)
                size = e.flatten(2).norm(dim=2)
                if isinstance(data, BasisData):
                    size = torch.hypot(size, data.missed[None, rows])
                found.append((size / norms).cpu())
        return Errors(torch.cat(found, dim=1).numpy())

    def step_average(self, decay: float) -> None:
        """One step of the exponential average of the weights."""
        with torch.no_grad():
            for name, value in self.network.core.state_dict().items():
                if value.is_floating_point():
                    self.average[name].lerp_(value, 1.0 - decay)
                else:
                    self.average[name].copy_(value)

    def clip(self, most: float) -> None:
        """The gradient of each network to this norm at most."""
        G = self.network.groups
        gradients = [p.grad.reshape(G, -1) for p in self.network.core.parameters() if p.grad is not None]
        norm = torch.cat([g.norm(dim=1, keepdim=True) for g in gradients], dim=1).norm(dim=1, keepdim=True)
        factor = (most / norm.clamp(min=1e-12)).clamp(max=1.0)
        for g in gradients:
            g.mul_(factor)

    @contextmanager
    def _averaged(self) -> Iterator[None]:
        own = {name: value.detach().clone() for name, value in self.network.core.state_dict().items()}
        self.network.core.load_state_dict(self.average)
        self.network.eval()
        try:
            yield
        finally:
            self.network.core.load_state_dict(own)
            self.network.train()

    def _drawn(self, settings: Settings) -> LearnedMap:
        """A network with weights drawn anew, for each mode those that it would have alone."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.training.seed)
            network = make_network(settings)
            torch.manual_seed(self.training.seed)
            one = make_network(replace(settings, modes=settings.modes[:1]))
            for p, q in zip(network.core.parameters(), one.core.parameters(), strict=True):
                p.data.copy_(q.data.repeat(max(1, len(settings.modes)), *(1,) * (q.ndim - 1)) if len(settings.modes) > 1 else q.data)
        return network


class ModeLearner(Learner):
    """Of IVNets, nodes as they are."""

    network: IVNetMap
    data: ModeData
    floors: Floors

    @property
    def _data(self) -> ModeData:
        return self.data

    def _fill(self, kept: Mapping[str, Any]) -> None:
        data, self.floors = mode_data(self.source, self.rows, self.images)
        network = self._drawn(self.source.settings)
        assert isinstance(network, IVNetMap)
        network.input_mean.copy_(data.inputs.mean((0, 1)).expand_as(network.input_mean))
        network.input_scale.copy_(data.inputs.std((0, 1)).clamp(min=1e-8).expand_as(network.input_scale))
        values = data.outputs.transpose(2, 3)  # (G, rows, N, out)
        network.output_mean.copy_(values.mean((1, 2), keepdim=True))
        scale = values.std((1, 2), keepdim=True)
        network.output_scale.copy_(scale.clamp(min=1e-12).maximum(LEAST_SCALE * scale.amax(-1, keepdim=True)))
        normal = (values - network.output_mean) / network.output_scale
        network.lowest.copy_(normal.amin((1, 2), keepdim=True))
        network.highest.copy_(normal.amax((1, 2), keepdim=True))
        self.network, self.data = network, data.to(self.device)
        self.slope = derivative(torch.eye(self.source.settings.points, dtype=torch.float64)).float()

    def _held_out(self, split: str, most: int | None) -> ModeData:
        return mode_data(self.source, self.source.rows(split, most, self.training.seed), 1, self.floors)[0].to(self.device)

    def _differences(self, data: ModeData | BasisData, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        y = self.network.normalized(data.inputs[rows]) * self.network.output_scale + self.network.output_mean
        return y.transpose(2, 3) - data.outputs[:, rows], data.norms[:, rows], data.slopes[:, rows]


class BasisLearner(Learner):
    """Of an MLP, coefficients in the principal components."""

    network: MLPMap
    data: BasisData

    @property
    def _data(self) -> BasisData:
        return self.data

    def _fill(self, kept: Mapping[str, Any]) -> None:
        if kept:
            parts = Parts(self.source.settings.map, self.source.settings.output_shape)
            self.basis = Basis(parts, kept["mean"], kept["vectors"], tuple(kept["ranks"]), (kept["floors"][0], kept["floors"][1]))
        else:
            self.basis = principal_components(self.source, self.rows, self.rank, self.training.seed)
        data = basis_data(self.source, self.rows, self.images, self.basis)
        network = self._drawn(replace(self.source.settings, ranks=self.basis.ranks))
        assert isinstance(network, MLPMap)
        network.basis.copy_(self.basis.vectors)
        network.output_mean.copy_(self.basis.mean)
        network.input_mean.copy_(data.inputs.mean(0))
        network.input_scale.copy_(data.inputs.std(0).clamp(min=1e-8))
        scale = data.outputs.square().mean(0).sqrt()
        network.output_scale.copy_(scale.clamp(min=1e-12).maximum(LEAST_SCALE * scale.max()))
        normal = data.outputs / network.output_scale
        network.lowest.copy_(normal.amin(0))
        network.highest.copy_(normal.amax(0))
        self.network, self.data = network, data.to(self.device)
        unit = torch.eye(len(self.basis.vectors))
        rows = network.outputs(unit) - network.outputs(0.0 * unit[:1])
        slopes = derivative(rows.double().reshape(len(unit), -1, self.source.settings.points)).flatten(1)
        values, vectors = torch.linalg.eigh(slopes @ slopes.T)
        self.slope = (vectors * values.clamp(min=0.0).sqrt()).float()

    def keep(self) -> dict[str, Any]:
        b = self.basis
        return {"mean": b.mean, "vectors": b.vectors, "ranks": list(b.ranks), "floors": list(b.floors)}

    def _held_out(self, split: str, most: int | None) -> BasisData:
        return basis_data(self.source, self.source.rows(split, most, self.training.seed), 1, self.basis).to(self.device)

    def _differences(self, data: ModeData | BasisData, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        y = self.network.normalized(data.inputs[rows]) * self.network.output_scale
        return (y - data.outputs[rows])[None], data.norms[None, rows], data.slopes[None, rows]


def make_learner(source: Source, training: TrainingTable, rank: int, device: str, kept: Mapping[str, Any] | None = None) -> Learner:
    """Of the kind that the network asks for. kept: of a checkpoint. Raises ValueError for data that have not what it needs."""
    return (ModeLearner if source.settings.arch == "ivnet" else BasisLearner)(source, training, rank, device, kept)
