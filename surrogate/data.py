"""Training pairs as arrays: inputs, targets and the norms that errors are relative to, with all images under the symmetries.

`ModeData` is for an IVNet map: outputs node by node. `BasisData` is for an MLP map: coefficients of the outputs in their principal
components, so that no operator is kept whole. Both are made block by block from the file. Rows are the images of the shapes, image after
image: row = image * shapes + shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from surrogate.base import exact_labels
from surrogate.features import derivative, features, frame
from surrogate.networks import Settings
from surrogate.pairs import SPLITS, Pairs
from surrogate.symmetric import CHARACTERS, Parts
from surrogate.targets import SYMMETRIES, TARGETS, demodulated, kernel_of_modes, to_frame

Floors = tuple[Tensor, Tensor]  # least norms of outputs and of their derivatives, for each network
BLOCK = 1024  # shapes at a time
BASIS_SHAPES = 4000  # that principal components are taken of, at most
LEAST_DISTANCE = 0.3  # of the median: outputs closer to the mean count as if they were so far
LEAST_NORM = 1e-6  # of outputs: the flow tension of a translation, mode 0, is zero, and so is to be learned


@dataclass(frozen=True)
class Source:
    """The labels of one map for a network of some settings; base_points: nodes of the exact maps that targets are residuals against."""

    pairs: Pairs
    settings: Settings
    base_points: int | None = None

    def rows(self, split: str, most: int | None, seed: int = 0) -> np.ndarray:
        """Rows of a split, or so many of them by chance. Raises ValueError if there are none."""
        rows = np.flatnonzero(self.pairs.split == SPLITS.index(split))
        if not len(rows):
            raise ValueError(f"{self.pairs.path} has no shapes of the {split} split")
        if most is not None and most < len(rows):
            rows = np.sort(np.random.default_rng(seed).choice(rows, most, replace=False))
        return rows

    def shapes(self, rows: np.ndarray) -> Tensor:
        """(n, 2, N) float64."""
        return torch.from_numpy(self.pairs.read("X_std", rows).astype(np.float64))

    def outputs(self, rows: np.ndarray, X: Tensor, absolute: bool = False) -> Tensor:
        """(n, G, *output_shape) float32 as the network is to give them, of rows with shapes X. absolute: no residuals."""
        name, settings = self.settings.map, self.settings
        target, F = TARGETS[name], frame(X)
        names = [f"{name}/{k}" for k in self.modes] if target.operator else [name]
        labels = torch.from_numpy(np.stack([self.pairs.read(n, rows, whole=len(names) == 1) for n in names], axis=1))  # (n, K, ...)
        if self.base_points is not None and not absolute:
            base = exact_labels(X.numpy(), name, self.base_points, self.pairs.dt)
            base = base[:, list(self.modes)] if target.operator else base[:, None]
            labels = labels - torch.from_numpy(base).float()
        if not target.operator:
            return (to_frame(labels, F) if target.parts == 2 else labels[:, :, None]).float()
        if name == "near":
            labels = labels.movedim(2, 4)  # the layer beside the direction of the output
        else:
            labels = labels[:, :, :, :, None] if target.parts == 2 else labels[:, :, :, :, None, None]
        if settings.arch == "mlp":
            return kernel_of_modes(labels, F, settings.rolloff)[:, None]
        return torch.stack([demodulated(labels[:, i], k, F) for i, k in enumerate(self.modes)], dim=1)

    def image(self, outputs: Tensor, index: int) -> Tensor:
        """Image under a symmetry of outputs (n, G, *output_shape)."""
        symmetry = SYMMETRIES[index]
        n, G = outputs.shape[:2]
        flat = outputs.flatten(0, 1)
        if not TARGETS[self.settings.map].operator:
            flat = symmetry.parts(flat)
        else:
            flat = symmetry.kernel(flat) if self.settings.arch == "mlp" else symmetry.modes(flat)
        return flat.reshape(n, G, *outputs.shape[2:])

    @cached_property
    def modes(self) -> tuple[int, ...]:
        """That are read."""
        return tuple(range(self.settings.points // 2 + 1)) if self.settings.arch == "mlp" else self.settings.modes

    @property
    def images(self) -> int:
        return len(SYMMETRIES)


@dataclass(frozen=True)
class ModeData:
    """inputs (rows, N, C), outputs (G, rows, out, N), norms (G, rows) of outputs and of their derivative."""

    inputs: Tensor
    outputs: Tensor
    norms: Tensor
    slopes: Tensor

    def __len__(self) -> int:
        return len(self.inputs)

    def to(self, device: str) -> ModeData:
        """The same data there."""
        return ModeData(**{name: value.to(device) for name, value in self.__dict__.items()})


@dataclass(frozen=True)
class BasisData:
    """inputs (rows, C N), outputs (rows, rank): coefficients; missed (rows,): norm of what the basis leaves out; norms, slopes (rows,)."""

    inputs: Tensor
    outputs: Tensor
    missed: Tensor
    norms: Tensor
    slopes: Tensor

    def __len__(self) -> int:
        return len(self.inputs)

    def to(self, device: str) -> BasisData:
        """The same data there."""
        return BasisData(**{name: value.to(device) for name, value in self.__dict__.items()})


def inputs_of(settings: Settings, X: Tensor) -> Tensor:
    """(n, N, C) for an IVNet, (n, C N) for an MLP, float32."""
    values = features(X, settings.channels).float()
    return values.transpose(1, 2).contiguous() if settings.arch == "ivnet" else values.flatten(1)


def mode_data(source: Source, rows: np.ndarray, images: int, floors: Floors | None = None) -> tuple[ModeData, Floors]:
    """The data of some shapes, and the least norms (G, 1) of outputs and slopes, from these data unless given."""
    settings = source.settings
    columns: list[list[tuple[Tensor, ...]]] = [[] for _ in range(images)]
    for block in _blocks(rows):
        X = source.shapes(block)
        y, whole = _with_whole(source, block, X)
        G = y.shape[1]
        flat = whole.reshape(len(block), G, -1, settings.points)
        norms, slopes = flat.flatten(2).norm(dim=2), derivative(flat.double()).flatten(2).norm(dim=2).float()
        for image in range(images):
            outputs = source.image(y, image).reshape(len(block), G, -1, settings.points)
            columns[image].append((inputs_of(settings, SYMMETRIES[image].points(X)), outputs, norms, slopes))
    inputs, outputs, norms, slopes = _joined(columns)
    outputs, norms, slopes = outputs.transpose(0, 1).contiguous(), norms.T, slopes.T
    if floors is None:
        least = TARGETS[settings.map].floor
        norm, slope = (values.median(dim=1, keepdim=True).values for values in (norms, slopes))
        floors = ((least * norm).clamp(min=LEAST_NORM), (least * slope).clamp(min=LEAST_NORM))
    return ModeData(inputs, outputs, torch.maximum(norms, floors[0]), torch.maximum(slopes, floors[1])), floors


@dataclass(frozen=True)
class Basis:
    """Of the parts of outputs: mean (Q,) of the even one, vectors (rank, Q), `ranks` of each; floors: least norms of outputs and slopes."""

    parts: Parts
    mean: Tensor
    vectors: Tensor
    ranks: tuple[int, ...]
    floors: tuple[float, float]

    def coefficients(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """(n, rank) of outputs (n, ...), and the norms (n,) of what they leave out."""
        parts = self.parts.take(outputs.flatten(1))
        parts[:, 0] -= self.mean
        each = zip(parts.unbind(1), self.vectors.split(self.ranks), strict=True)
        c = torch.cat([part @ vectors.T for part, vectors in each], dim=1)
        return c, (parts.square().sum((1, 2)) - c.square().sum(1)).clamp(min=0.0).sqrt()

    def signs(self, image: int) -> Tensor:
        """(rank,): of the coefficients of an image."""
        return torch.cat([CHARACTERS[i, image].expand(rank) for i, rank in enumerate(self.ranks)])


def principal_components(source: Source, rows: np.ndarray, rank: int, seed: int) -> Basis:
    """The largest principal components of the parts of outputs, of which all images are samples.

    Each output counts relative to its distance from the mean, so that the rarest shapes do not take the whole basis.
    """
    few = np.sort(np.random.default_rng(seed).choice(rows, min(len(rows), BASIS_SHAPES), replace=False))
    parts = Parts(source.settings.map, source.settings.output_shape)
    taken, wholes = [], []
    for block in _blocks(few):
        y, whole = _with_whole(source, block, source.shapes(block))
        taken.append(parts.take(y.flatten(1)))
        wholes.append((whole.flatten(1).norm(dim=1), _slope(whole)))
    Y = torch.cat(taken)
    norms, slopes = (torch.cat([w[i] for w in wholes]) for i in (0, 1))
    mean = Y[:, 0].mean(dim=0)
    Y[:, 0] -= mean
    distance = Y.square().sum((1, 2)).sqrt()
    Y /= torch.clamp(distance, min=LEAST_DISTANCE * float(distance.median()))[:, None, None]
    most = min(rank, *Y[:, 0].shape)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        found = [torch.svd_lowrank(part, q=min(most + 32, *part.shape), niter=3)[1:] for part in Y.unbind(1)]
    sizes = torch.cat([S[:most] for S, _ in found])
    least = float(sizes.sort(descending=True).values[min(rank, len(sizes)) - 1])
    negligible = 1e-5 * float(sizes.max())  # points that a mirror leaves where they are have no odd part
    ranks = tuple(int((S[:most] >= max(least, negligible)).sum()) for S, _ in found)
    vectors = torch.cat([V[:, :r].T for (_, V), r in zip(found, ranks, strict=True)]).contiguous()
    floor = TARGETS[source.settings.map].floor
    return Basis(parts, mean, vectors, ranks, (floor * float(norms.median()), floor * float(slopes.median())))


def basis_data(source: Source, rows: np.ndarray, images: int, basis: Basis) -> BasisData:
    """The data of some shapes in a basis."""
    columns: list[list[tuple[Tensor, ...]]] = [[] for _ in range(images)]
    for block in _blocks(rows):
        X = source.shapes(block)
        y, whole = _with_whole(source, block, X)
        c, missed = basis.coefficients(y)
        norms, slopes = whole.flatten(1).norm(dim=1), _slope(whole)
        for image in range(images):
            inputs = inputs_of(source.settings, SYMMETRIES[image].points(X))
            columns[image].append((inputs, c * basis.signs(image), missed, norms, slopes))
    inputs, outputs, missed, norms, slopes = _joined(columns)
    return BasisData(inputs, outputs, missed, norms.clamp(min=basis.floors[0]), slopes.clamp(min=basis.floors[1]))


def _with_whole(source: Source, rows: np.ndarray, X: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs to be learned, and the labels whole, that errors are relative to."""
    y = source.outputs(rows, X)
    return y, (y if source.base_points is None else source.outputs(rows, X, absolute=True))


def _joined(columns: list[list[tuple[Tensor, ...]]]) -> list[Tensor]:
    """Image after image."""
    parts = [part for image in columns for part in image]
    return [torch.cat(column) for column in zip(*parts, strict=True)]


def _slope(values: Tensor) -> Tensor:
    """Norm (n,) of the derivative along the nodes of the output."""
    return derivative(values.double()).flatten(1).norm(dim=1).float()


def _blocks(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[i : i + BLOCK] for i in range(0, len(rows), BLOCK)]
