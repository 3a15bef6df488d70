"""Training arrays: images in their places, norms, principal components, residuals, and what of a data set is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from surrogate_cases import EVERY, K, N, settings_for

from surrogate.base import exact_labels
from surrogate.data import LEAST_DISTANCE, LEAST_NORM, Source, basis_data, mode_data, principal_components
from surrogate.features import derivative, features, frame
from surrogate.networks import make_network
from surrogate.targets import SYMMETRIES, apply_kernel, apply_modes, to_frame

MAPS = ("relax", "self_tension", "advection", "flow_tension", "near")
SINGLE = 3e-6


def source_of(pairs, name, arch="ivnet", modes=(0, 3), base=None):
    return Source(pairs, settings_for(name, arch, modes), base)


def close(got, want, tolerance=SINGLE):
    assert got.shape == want.shape
    assert float((got - want).abs().max()) <= tolerance * float(want.abs().max())


def with_basis(source, basis):
    """The network that forms outputs from coefficients."""
    network = make_network(replace(source.settings, ranks=basis.ranks))
    network.basis.copy_(basis.vectors)
    network.output_mean.copy_(basis.mean)
    return network


@pytest.mark.parametrize("name", MAPS)
def test_data_are_the_shapes_then_their_images_one_after_another(pairs, name):
    source = source_of(pairs, name)
    rows = source.rows("val", None)
    data, _ = mode_data(source, rows, 4)
    X = source.shapes(rows)
    y = source.outputs(rows, X)
    n, G = len(rows), y.shape[1]
    assert len(data) == 4 * n
    assert data.outputs.shape == (G, 4 * n, int(np.prod(source.settings.output_shape[:-1])), N)
    for image, symmetry in enumerate(SYMMETRIES):
        these = slice(image * n, (image + 1) * n)
        expected = features(symmetry.points(X), source.settings.channels).float().transpose(1, 2)
        assert torch.equal(data.inputs[these], expected)
        for g in range(G):
            of_image = source.image(y, image)[:, g]
            close(data.outputs[g, these].reshape(of_image.shape), of_image, 0.0)


@pytest.mark.parametrize("name", MAPS)
def test_norms_are_those_of_the_outputs_of_every_image(pairs, name):
    source = source_of(pairs, name)
    data, (least, least_slope) = mode_data(source, source.rows("train", None), 4)
    norms = data.outputs.flatten(2).norm(dim=2)
    slopes = derivative(data.outputs.double()).flatten(2).norm(dim=2).float()
    close(data.norms, torch.maximum(norms, least))
    close(data.slopes, torch.maximum(slopes, least_slope))
    if name == "relax":
        close(least, 0.1 * norms.median(dim=1, keepdim=True).values)
    else:
        assert 0.0 < float(least.max()) <= LEAST_NORM


def test_least_norms_of_the_training_data_hold_for_others(pairs):
    source = source_of(pairs, "relax")
    high = torch.full((1, 1), 1e3)
    data, floors = mode_data(source, source.rows("val", None), 1, (high, 2 * high))
    assert floors == (high, 2 * high)
    assert bool((data.norms == 1e3).all())
    assert bool((data.slopes == 2e3).all())


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
@pytest.mark.parametrize("name", ["advection", "flow_tension", "near"])
def test_outputs_applied_to_a_velocity_are_the_labels_summed_over_its_modes(pairs, name, arch):
    source = source_of(pairs, name, arch, EVERY)
    rows = source.rows("test", None)
    X = source.shapes(rows)
    u = torch.randn((len(rows), 2, N), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    c = np.fft.rfft(u.numpy()) / N * np.where(np.arange(K) % (K - 1), 2, 1)
    expected = 0.0
    for k in range(K):
        T = pairs.read(f"{name}/{k}", rows).astype(np.float64)
        T = T if name == "near" else T[:, None]  # (n, S, re/im, d, [out,] N)
        pair = np.stack([c[:, :, k].real, -c[:, :, k].imag], axis=1)
        expected = expected + np.einsum("nrd,nsrd...->ns...", pair, T)
    expected = torch.from_numpy(expected if expected.ndim == 4 else expected[:, :, None])
    if expected.shape[2] == 2:
        expected = to_frame(expected, frame(X))
    y = source.outputs(rows, X)
    got = apply_modes(y, u) if arch == "ivnet" else apply_kernel(y[:, 0], u, frame(X))
    close(got.double(), expected, 2e-5)


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
@pytest.mark.parametrize("name", ["relax", "self_tension", "advection", "flow_tension"])
def test_a_residual_and_its_base_are_the_label(pairs, name, arch):
    source = source_of(pairs, name, arch, EVERY, base=48)
    whole = source_of(pairs, name, arch, EVERY)
    rows = source.rows("val", None)
    X = source.shapes(rows)
    residual, full = source.outputs(rows, X), whole.outputs(rows, X)
    assert torch.equal(source.outputs(rows, X, absolute=True), full)
    assert float(residual.norm()) < 0.2 * float(full.norm())
    base = torch.from_numpy(exact_labels(X.numpy(), name, 48, 1e-5))
    F = frame(X)
    if name == "relax":
        base = to_frame(base, F)[:, None]
    elif name == "self_tension":
        base = base[:, None, None]
    else:  # by its action
        u = torch.from_numpy(np.cos(2 * np.pi * 5 * np.arange(N) / N)).expand(len(rows), 2, N)
        applied = apply_modes if arch == "ivnet" else lambda y, u: apply_kernel(y[:, 0], u, F)
        residual, full = applied(residual, u), applied(full, u)
        values = base[:, 5, 0].sum(1)  # cos, both directions
        base = to_frame(values[:, None], F) if name == "advection" else values[:, None, None]
    close(residual.double() + base, full.double(), 1e-5)


def test_residuals_of_some_modes_are_those_of_all(pairs):
    rows = source_of(pairs, "advection").rows("val", None)
    some, every = (source_of(pairs, "advection", modes=modes, base=48) for modes in ((2, 5), EVERY))
    X = some.shapes(rows)
    close(some.outputs(rows, X), every.outputs(rows, X)[:, [2, 5]], 1e-6)


def test_errors_of_residuals_are_relative_to_the_labels(pairs):
    residual, whole = source_of(pairs, "advection", base=48), source_of(pairs, "advection")
    rows = residual.rows("val", None)
    assert torch.equal(mode_data(residual, rows, 1)[0].norms, mode_data(whole, rows, 1)[0].norms)


@pytest.mark.parametrize("name", ["relax", "advection"])
def test_coefficients_and_what_they_miss_are_the_whole_output(pairs, name):
    source = source_of(pairs, name, "mlp")
    rows = source.rows("train", None)
    basis = principal_components(source, rows, 12, 0)
    data = basis_data(source, rows, 4, basis)
    assert sum(basis.ranks) == len(basis.vectors) == data.outputs.shape[1] == 12
    network = with_basis(source, basis)
    mean = network.outputs(torch.zeros(1, 12))
    y = source.outputs(rows, source.shapes(rows))
    for image in range(4):
        whole = source.image(y, image).flatten(1)
        these = slice(image * len(rows), (image + 1) * len(rows))
        c, missed = data.outputs[these], data.missed[these]
        close(torch.hypot(c.norm(dim=1), missed), (whole - mean).norm(dim=1), 1e-5)
        close(missed, (whole - network.outputs(c)).norm(dim=1), 1e-3)
        close(data.norms[these], y.flatten(1).norm(dim=1).clamp(min=basis.floors[0]))
        close(data.slopes[these], derivative(y.double()).flatten(1).norm(dim=1).float().clamp(min=basis.floors[1]))
    assert 0.0 < float(data.missed.norm() / data.outputs.norm()) < 0.8


def test_a_basis_has_the_largest_components_of_all_images(pairs):
    """No other basis of as many vectors misses less of the outputs, each taken as it counts."""
    source = source_of(pairs, "relax", "mlp")
    rows = source.rows("train", None)
    basis = principal_components(source, rows, 12, 0)
    mean = with_basis(source, basis).outputs(torch.zeros(1, 12))
    y = source.outputs(rows, source.shapes(rows))
    Y = torch.cat([source.image(y, image).flatten(1) for image in range(4)]) - mean
    distance = Y.norm(dim=1, keepdim=True)
    weight = 1.0 / distance.clamp(min=LEAST_DISTANCE * float(distance.median()))
    values = torch.linalg.svdvals((Y * weight).double())
    least = float(values[12:].square().sum().sqrt())
    missed = float((basis_data(source, rows, 4, basis).missed * weight[:, 0]).norm())
    assert 0.999 * least < missed < 1.02 * least


def test_a_basis_of_all_shapes_misses_nothing(pairs):
    source = source_of(pairs, "advection", "mlp")
    rows = source.rows("train", None)
    basis = principal_components(source, rows, 1000, 0)
    data = basis_data(source, rows, 4, basis)
    assert len(basis.vectors) < 4 * len(rows)  # the even part's mean is taken out
    y = source.outputs(rows, source.shapes(rows))
    network = with_basis(source, basis)
    for image in range(4):
        expected = source.image(y, image).flatten(1)
        close(network.outputs(data.outputs[image * len(rows) : (image + 1) * len(rows)]), expected, 1e-4)
    assert float(data.missed.max()) < 2e-3 * float(data.norms.max())


def test_a_basis_is_the_same_for_the_same_seed_and_leaves_the_random_numbers_alone(pairs):
    source = source_of(pairs, "relax", "mlp")
    rows = source.rows("train", None)
    torch.manual_seed(7)
    first = principal_components(source, rows, 8, 3)
    after = torch.randn(3)
    torch.manual_seed(7)
    assert torch.equal(torch.randn(3), after)
    assert torch.equal(principal_components(source, rows, 8, 3).vectors, first.vectors)
    assert not torch.equal(principal_components(source, rows, 8, 4).vectors, first.vectors)


def test_so_many_shapes_of_a_split_by_chance(pairs):
    source = source_of(pairs, "relax")
    every = source.rows("train", None)
    some = source.rows("train", 20, seed=1)
    assert len(every) == 32
    assert len(set(some)) == 20
    assert set(some) <= set(every)
    assert list(some) == sorted(some)
    assert list(source.rows("train", 20, seed=1)) == list(some)
    assert list(source.rows("train", 20, seed=2)) != list(some)
    assert not set(source.rows("test", None)) & set(every)
