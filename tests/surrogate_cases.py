"""Small pairs, networks and files of weights for the tests of surrogate, and networks that know the exact maps."""

import json
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
import torch
from helpers import nodes, rotate
from safetensors import safe_open
from safetensors.torch import save_file

from biem.curves.curve import normal
from biem.curves.fourier import resample
from biem.curves.pose import standardize
from biem.membrane.maps import LAYERS, ExactMaps
from datagen import shapes as shapes_module
from datagen.config import Label
from datagen.label import label_modes, label_shapes
from datagen.shapes import decode, read_shapes
from surrogate.distribution import Distribution
from surrogate.features import CHANNELS
from surrogate.networks import Settings, make_network
from surrogate.targets import TARGETS, apply_kernel, apply_modes
from surrogate.weights import Card

N, K = 32, 17
OF_SPLIT = (32, 8, 8)  # shapes
SAMPLE = Path(shapes_module.__file__).parent / "sample.h5"
EVERY = tuple(range(K))
OPERATORS = ("advection", "flow_tension", "near")
IVNET = {"blocks": 2, "width": 6, "levels": 2, "growth": 1.5}
MLP = {"blocks": 1, "width": 24}
RANKS = (3, 2, 2, 1)


def sample(counts=OF_SPLIT, points=128):
    """X (n, 2, points), split and run (n,) of so many shapes of each split of the sample, shuffled."""
    shapes = read_shapes(SAMPLE)
    rows = np.concatenate([np.flatnonzero(shapes["split"] == split)[:count] for split, count in enumerate(counts)])
    rows = np.random.default_rng(5).permutation(rows)
    return decode(shapes["coefficients"][rows], points), shapes["split"][rows], shapes["run"][rows]


def write_pairs(path, arrays, label=None, reduced_area=0.65):
    """A file of pairs, of the layout that labelling makes, and its manifest."""
    label = label or Label()
    settings = {"label": {**label.model_dump(mode="json"), "modes": list(label_modes(label))}, "shapes": {"reduced_area": reduced_area}}
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    path.with_suffix(".json").write_text(json.dumps({"version": 1, "stage": "join", "settings": settings}))
    return path


def arrays_of(path):
    """All datasets of a file of pairs."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def labelled(X, split, run, label=None):
    """The arrays of a file of pairs."""
    return {**label_shapes(X, label or Label()), "split": split, "run": run, "shape": np.arange(len(X))}


def mild(count=3, points=N):
    """Shapes (count, 2, points) of the sample with the least bending energy, which few nodes resolve; made exactly of length 1."""
    shapes = read_shapes(SAMPLE)
    rows = np.argsort(shapes["bending_energy"])[: 20 * count : 20]
    X = standardize(decode(shapes["coefficients"][rows], 128))[0]
    return np.ascontiguousarray(standardize(resample(X, points))[0])


def placed(X, angle=0.0, center=(0.0, 0.0), scale=1.0, nodes=0):
    """X turned, scaled, moved, and with another first node."""
    return np.ascontiguousarray(np.roll(scale * rotate(X, angle) + np.asarray(center)[:, None], nodes, axis=-1))


def smooth_field(M, most=6, seed=0, points=N):
    """Vectors (M, 2, points) of random modes up to `most`."""
    c = np.random.default_rng(seed).normal(size=(2, M, 2, most + 1))
    phase = np.arange(most + 1)[:, None] * nodes(points)
    return c[0] @ np.cos(phase) + c[1] @ np.sin(phase)


# --- labels by exact maps, one input at a time, and what networks are to make of them, without surrogate's own ways


def apply_exact(name, maps, X, u):
    """Layers, parts and nodes (M, S, C, N) of an operator's answer."""
    if name == "advection":
        return maps.advect(X, u)[:, None]
    return maps.flow_tension(X, u)[:, None, None] if name == "flow_tension" else maps.near_layers(X, u)


def mode_labels(name, X, points):
    """T (M, K, 2 [re, im], 2 [d], S, C, N) float64."""
    maps = ExactMaps(points=points)
    rows = []
    for k in range(X.shape[-1] // 2 + 1):
        for part, f in enumerate((np.cos(k * nodes(X.shape[-1])), np.sin(k * nodes(X.shape[-1])))):
            for d in (0, 1):
                u = np.zeros_like(X)
                if part == 0 or k not in (0, X.shape[-1] // 2):
                    u[:, d] = f
                rows.append(apply_exact(name, maps, X, u))
    T = np.stack(rows, axis=1)
    return T.reshape(len(X), -1, 2, 2, *T.shape[2:])


def frames_of(X):
    """(M, 2 [normal, tangent], 2, N)."""
    n = normal(X)
    return np.stack([n, np.stack([-n[:, 1], n[:, 0]], axis=1)], axis=1)


def in_frame(v, X):
    """Vectors (M, ..., 2, N) by normal and tangential part; scalars (M, ..., 1, N) as they are."""
    return v if v.shape[-2] == 1 else np.einsum("mcdj,m...dj->m...cj", frames_of(X), v)


def demodulated_labels(name, X, points):
    """D (M, K, 2, 2, S, C, N)."""
    T = in_frame(mode_labels(name, X, points), X)
    carrier = np.exp(-1j * np.arange(T.shape[1])[:, None] * nodes(X.shape[-1]))[:, None, None, None]
    D = (T[:, :, 0] + 1j * T[:, :, 1]) * carrier
    return np.stack([D.real, D.imag], axis=2)


def kernel_labels(name, X, points):
    """A (M, 2 [a], N [i], S, C, N), one node and direction at a time."""
    maps, F = ExactMaps(points=points), frames_of(X)
    rows = []
    for a in (0, 1):
        for i in range(X.shape[-1]):
            u = np.zeros_like(X)
            u[:, :, i] = F[:, a, :, i]
            rows.append(apply_exact(name, maps, X, u))
    A = np.stack(rows, axis=1)
    return in_frame(A.reshape(len(X), 2, -1, *A.shape[2:]), X)


def exact_outputs(settings, X, points, dt):
    """What a network of the settings is to answer for X in the standard pose, (M, G, *output_shape) float64."""
    name, maps = settings.map, ExactMaps(points=points)
    if name == "relax":
        return in_frame(maps.relax(X, dt) - X, X)[:, None]
    if name == "self_tension":
        return maps.self_tension(X)[:, None, None]
    return demodulated_labels(name, X, points) if settings.arch == "ivnet" else kernel_labels(name, X, points)[:, None]


class Exactly(torch.nn.Module):
    """A network that knows the maps: those built at `points` nodes, less those at `base` nodes. It keeps the curves that it was given."""

    def __init__(self, settings, points=64, dt=0.0, base=None):
        super().__init__()
        self.settings, self.points, self.dt, self.base = settings, points, dt, base
        self.distribution = Distribution(settings.points)
        self.seen = []

    def forward(self, X):
        self.seen.append(X)
        values = exact_outputs(self.settings, X.numpy(), self.points, self.dt)
        if self.base is not None:
            values = values - exact_outputs(self.settings, X.numpy(), self.base, self.dt)
        return torch.from_numpy(values)

    def operators(self, X):
        return self(X)

    def apply_to(self, A, u, frames):
        return apply_modes(A, u) if self.settings.arch == "ivnet" else apply_kernel(A[:, 0], u, frames)


# --- networks and cards


def settings_for(name, arch="mlp", modes=None, points=N, channels=CHANNELS, **network):
    """Of a small network. modes: default all where there are some."""
    each = EVERY if modes is None else modes
    own = {**(IVNET if arch == "ivnet" else MLP), **network}
    of_operator = arch == "ivnet" and TARGETS[name].operator
    return Settings(name, arch, points, tuple(channels), each if of_operator else (), own, () if arch == "ivnet" else RANKS)


def drawn(settings, seed=0):
    """A network of random weights, statistics and basis, none of them zero, for inference."""
    torch.manual_seed(seed)
    network = make_network(settings)
    with torch.no_grad():
        for parameter in network.core.parameters():
            parameter.copy_(0.3 * torch.randn_like(parameter))
        for name, value in network.named_buffers():
            if name.endswith(("_mean", "basis", "running_mean")):
                value.copy_(0.3 * torch.randn_like(value))
            elif name.endswith(("_scale", "running_var")):
                value.copy_(0.5 + torch.rand_like(value))
            elif name.endswith(("lowest", "highest")):
                value.copy_((1 if name == "highest" else -1) * (2.0 + torch.rand_like(value)))
    return network.eval().requires_grad_(False)


def card_of(settings, **changes):
    """A model card."""
    target = changes.pop("target", "full")
    return Card(
        **{
            "settings": asdict(settings),
            "target": target,
            "base_points": 48 if target == "residual" else None,
            "reduced_area": 0.65,
            "dt": 1e-5 if settings.map == "relax" else None,
            "relaxation": "converged" if settings.map == "relax" else None,
            "layers": list(LAYERS) if settings.map == "near" else None,
            "operator_points": 128,
            "data": "0" * 64,
            "shapes": 32,
            "samples": 1000,
            "seconds": 1.0,
            "seed": 0,
            "commit": "0000000",
            "errors": {str(k): {"median": 0.1, "mean": 0.2, "p95": 0.3} for k in settings.modes or ("all",)},
        }
        | changes
    )


def rewritten(path, change):
    """The file with other tensors or another card: change(tensors, card) in place."""
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        card = json.loads(file.metadata()["card"])
    change(tensors, card)
    save_file(tensors, path, metadata={"card": json.dumps(card)})
