"""What networks learn: both forms of an operator against exact maps, and the symmetries against exact maps of the images."""

from functools import cache

import numpy as np
import pytest
import torch
from surrogate_cases import (
    OPERATORS,
    Exactly,
    K,
    N,
    apply_exact,
    demodulated_labels,
    in_frame,
    kernel_labels,
    mild,
    mode_labels,
    sample,
    settings_for,
    smooth_field,
)

from biem.curves.fourier import resample
from biem.membrane.maps import ExactMaps
from biem.membrane.resultants import Resultants
from datagen.config import Label
from datagen.label import label_shapes
from surrogate.features import frame
from surrogate.targets import (
    SYMMETRIES,
    TARGETS,
    apply_kernel,
    apply_modes,
    demodulated,
    from_frame,
    kernel_of_modes,
    modes_of_kernel,
    to_frame,
)

SINGLE = 2e-6  # of the float32 of targets, relative to the largest
NOT_THE_IDENTITY = SYMMETRIES[1:]


@cache
def case(name):
    """X (n, 2, N), its labels T as float64 tensors, and the frames."""
    X = mild(1 if name == "near" else 3)
    return torch.from_numpy(X), torch.from_numpy(mode_labels(name, X, 64)), frame(torch.from_numpy(X))


def tensor(a):
    return torch.from_numpy(np.ascontiguousarray(a))


def close(got, want, tolerance=SINGLE, scale=None):
    """scale: what the tolerance is relative to, where it is not the largest value."""
    assert got.shape == want.shape
    assert float((got.double() - want.double()).abs().max()) < tolerance * float(want.abs().max() if scale is None else scale)


def all_modes(T, F):
    return torch.stack([demodulated(T[:, k], k, F) for k in range(K)], dim=1)


def test_a_vector_in_its_frame_and_back():
    X = mild(2)
    F = frame(tensor(X))
    for shape in ((2, 2, N), (2, 5, 2, N), (2, 2, 3, 5, 2, N)):
        v = torch.randn(shape, dtype=torch.float64)
        assert np.abs(to_frame(v, F).numpy() - in_frame(v.numpy(), X)).max() < 1e-13
        assert (from_frame(to_frame(v, F), F) - v).abs().max() < 1e-13


@pytest.mark.parametrize("name", OPERATORS)
def test_modes_are_the_labels_demodulated_in_the_frame(name):
    X, T, F = case(name)
    close(all_modes(T, F), tensor(demodulated_labels(name, X.numpy(), 64)))


@pytest.mark.parametrize("name", OPERATORS)
def test_the_kernel_is_the_answer_to_one_node_at_a_time(name):
    X, T, F = case(name)
    close(kernel_of_modes(T, F), tensor(kernel_labels(name, X.numpy(), 64)))


@pytest.mark.parametrize("rolloff", [None, 3.0])
@pytest.mark.parametrize("name", OPERATORS)
def test_one_form_gives_the_other(name, rolloff):
    _, T, F = case(name)
    A = kernel_of_modes(T, F, rolloff)
    scale = A.abs().sum(2).max() * (1.0 if rolloff is None else 1.0 + (N / 2 / rolloff) ** 2)  # sums over the nodes
    close(modes_of_kernel(A, F, rolloff), all_modes(T, F), scale=scale)


def test_a_rolloff_takes_from_kernels_what_is_rough():
    _, T, F = case("advection")
    smooth, rough = (modes_of_kernel(kernel_of_modes(T, F, 3.0), F)[:, k].norm() / all_modes(T, F)[:, k].norm() for k in (1, 12))
    assert abs(smooth / 0.9 - 1.0) < 1e-4
    assert abs(rough * 17.0 - 1.0) < 1e-4


@pytest.mark.parametrize("name", OPERATORS)
def test_both_forms_applied_to_a_velocity_are_the_exact_map(name):
    """Of any velocity, the highest mode included."""
    X, T, F = case(name)
    u = np.random.default_rng(0).normal(size=X.shape)
    expected = tensor(in_frame(apply_exact(name, ExactMaps(points=64), X.numpy(), u), X.numpy()))
    close(apply_modes(all_modes(T, F), tensor(u)), expected, 5 * SINGLE)
    for rolloff in (None, 4.0):
        close(apply_kernel(kernel_of_modes(T, F, rolloff), tensor(u), F, rolloff), expected, 30 * SINGLE if rolloff else 5 * SINGLE)


@pytest.mark.parametrize("name", ["advection", "flow_tension"])
def test_labels_of_resolved_shapes_applied_to_a_velocity_are_the_maps_of_the_resolved_shape(name, pairs):
    rows = np.arange(6)
    fine = sample()[0][rows]
    X = tensor(pairs.read("X_std", rows)).double()
    T = torch.stack([tensor(pairs.read(f"{name}/{k}", rows)).double() for k in range(K)], dim=1)
    T = T[:, :, :, :, None] if name == "advection" else T[:, :, :, :, None, None]
    u = smooth_field(6, points=128)
    exact = Resultants(fine)
    expected = resample(exact.project(u)[:, None] if name == "advection" else exact.flow_tension(u)[:, None, None], N)
    F = frame(X)
    got = apply_modes(all_modes(T, F), tensor(u[:, :, ::4].copy()))
    if name == "advection":
        got = from_frame(got, F.float())
    close(got, tensor(expected), 5 * SINGLE)


@cache
def labels_of_image(index):
    """Labels of the images of three shapes of 128 nodes, and the frames of their N nodes."""
    labels = label_shapes(SYMMETRIES[index].points(tensor(mild(3, 128))).numpy(), Label(maps=list(OPERATORS)))
    return labels, frame(tensor(labels["X_std"]).double())


def label_of_mode(labels, name, k):
    """(n, 2 [re, im], 2 [d], S, C, N)."""
    T = tensor(labels[f"{name}/{k}"]).double()
    if name == "near":
        return T.movedim(1, 3)
    return T[:, :, :, None] if name == "advection" else T[:, :, :, None, None]


@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("index", range(4))
def test_operators_of_an_image_are_images(name, index):
    (labels, F), (of_image, F_image), symmetry = labels_of_image(0), labels_of_image(index), SYMMETRIES[index]
    T = [torch.stack([label_of_mode(those, name, k) for k in range(K)], dim=1) for those in (labels, of_image)]
    for k in range(K):
        D, D_image = demodulated(T[0][:, k], k, F), demodulated(T[1][:, k], k, F_image)
        close(symmetry.modes(D), D_image, scale=T[0].abs().max())
    close(symmetry.kernel(kernel_of_modes(T[0], F)), kernel_of_modes(T[1], F_image), 10 * SINGLE)


@pytest.mark.parametrize("name", ["relax", "self_tension"])
@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_fields_of_an_image_are_images(name, symmetry):
    X = torch.from_numpy(mild(3))
    network = Exactly(settings_for(name), points=64, dt=1e-5)
    close(symmetry.parts(network(X)), network(symmetry.points(X)), 1e-10)


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_the_image_of_an_image_is_the_first(symmetry):
    generator = torch.Generator().manual_seed(0)
    X, D, A = (torch.randn(shape, generator=generator) for shape in ((3, 2, N), (3, 2, 2, 5, 2, N), (3, 2, N, 5, 2, N)))
    for image, values in ((symmetry.points, X), (symmetry.parts, X), (symmetry.modes, D), (symmetry.kernel, A)):
        assert torch.equal(image(image(values)), values)


@pytest.mark.parametrize("symmetry", NOT_THE_IDENTITY)
def test_images_are_other_shapes_in_the_standard_pose_of_their_nodes(symmetry):
    """Counterclockwise, their first node where the fundamental mode is real and positive."""
    X = torch.from_numpy(mild(3))
    image = symmetry.points(X)
    assert float((image - X).abs().max()) > 1e-3
    c = torch.fft.fft(image[:, 0] + 1j * image[:, 1])[:, 1] / N
    assert float(c.real.min()) > 0.1
    assert float(c.imag.abs().max()) < 1e-12


def test_targets_say_how_outputs_are_shaped():
    for name, target in TARGETS.items():
        ivnet, mlp = settings_for(name, "ivnet").output_shape, settings_for(name, "mlp").output_shape
        tail = (target.layers, target.parts, N) if target.operator else (target.parts, N)
        assert ivnet == ((2, 2, *tail) if target.operator else tail)
        assert mlp == ((2, N, *tail) if target.operator else tail)
