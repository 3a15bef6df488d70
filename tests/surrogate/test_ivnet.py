"""IVNet: circular to rounding, its groups strangers to each other, its settings checked; and the perceptron."""

import pytest
import torch
from torch.nn.functional import conv1d, conv_transpose1d, pad, silu

from surrogate.ivnet import BatchNorm, Convolution, Interpolation, IVNet, Restriction, VBlock
from surrogate.mlp import MLP

SIZES = {"blocks": 2, "width": 8, "levels": 2, "growth": 1.5}


def noisy(module, seed=0, size=0.3):
    """Its weights drawn anew, none of them zero."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator))
    return module.double()


def drawn(*shape, seed=1):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rolled(h, by):
    return torch.roll(h, by, dims=2)


@pytest.mark.parametrize("norm", ["none", "batch"])
@pytest.mark.parametrize("levels", [1, 2, 3])
def test_a_shift_by_two_to_the_levels_nodes_shifts_the_output(levels, norm):
    net = noisy(IVNet(3, 4, groups=2, **{**SIZES, "levels": levels}, norm=norm)).eval()
    x = drawn(2, 5, 32, 3)
    y = net(x)
    assert y.shape == (2, 5, 32, 4)
    step = 2**levels
    scale = y.abs().max()
    for by in (step, 3 * step, -step):
        assert (net(rolled(x, by)) - rolled(y, by)).abs().max() < 1e-14 * 32 * scale
    assert (net(rolled(x, step // 2)) - rolled(y, step // 2)).abs().max() > 1e-3 * scale


@pytest.mark.parametrize(("module", "into", "out"), [(Restriction, 1, 2), (Interpolation, 2, 1), (Convolution, 1, 1)])
def test_each_part_is_circular_alone(module, into, out):
    """One goes from 2 n to n nodes and one from n to 2 n: a shift by `into` nodes becomes one by `out`."""
    arguments = (4, 6, 2) if module is Convolution else (4, 6, 2, True)
    part = noisy(module(*arguments))
    h = drawn(2, 3, 16, 4)
    y = part(h)
    ratio = {Restriction: (8, 2, 1), Interpolation: (32, 1, 2), Convolution: (16, 1, 1)}[module]
    assert y.shape == (2, 3, ratio[0], 6)
    for times in (1, 3):
        assert (part(rolled(h, times * ratio[1])) - rolled(y, times * ratio[2])).abs().max() < 1e-14


def test_a_convolution_is_torchs_with_circular_padding():
    part = noisy(Convolution(4, 6, 2))
    h = drawn(2, 3, 16, 4)
    for g in range(2):
        weight = part.all.weight[g].reshape(5, 4, 6).permute(2, 1, 0)  # (out, into, kernel)
        padded = pad(h[g].transpose(1, 2), (2, 2), mode="circular")
        expected = conv1d(padded, weight, part.all.bias[g, 0])
        assert (part(h)[g].transpose(1, 2) - expected).abs().max() < 1e-13


def test_a_restriction_is_two_strided_convolutions_of_dilation_1_and_2():
    part = noisy(Restriction(4, 6, 1, True))
    h = drawn(1, 3, 16, 4)
    expected = []
    for piece, dilation in ((part.narrow, 1), (part.wide, 2)):
        weight = piece.weight[0].reshape(5, 4, 3).permute(2, 1, 0)
        padded = pad(h[0].transpose(1, 2), (2 * dilation, 2 * dilation), mode="circular")
        expected.append(conv1d(padded, weight, piece.bias[0, 0], stride=2, dilation=dilation))
    assert (part(h)[0].transpose(1, 2) - torch.cat(expected, dim=1)).abs().max() < 1e-13


def test_an_interpolation_is_a_strided_transposed_convolution():
    """Fine nodes 2 j and 2 j + 1 see the coarse nodes j - 1, j, j + 1: a kernel of six."""
    part = noisy(Interpolation(4, 6, 1, False))
    h = drawn(1, 3, 16, 4)
    kernel = part.fine.weight[0].reshape(3, 4, 2, 6)  # (neighbour, into, which of two, out)
    weight = torch.zeros(4, 6, 6, dtype=torch.float64)
    for neighbour in range(3):
        for which in range(2):
            weight[:, :, 2 * (2 - neighbour) + which] = kernel[neighbour, :, which]
    three = torch.cat([h[0]] * 3, dim=1).transpose(1, 2)
    whole = conv_transpose1d(three, weight, stride=2)
    expected = whole[:, :, 32 + 2 : 64 + 2].transpose(1, 2)
    assert (part(h)[0] - expected).abs().max() < 1e-13


@pytest.mark.parametrize("norm", ["none", "batch"])
def test_groups_are_the_networks_alone(norm):
    together = noisy(IVNet(3, 4, groups=3, **SIZES, norm=norm))
    x = drawn(3, 6, 16, 3)
    y = together(x)
    for g in range(3):
        alone = IVNet(3, 4, groups=1, **SIZES, norm=norm).double()
        with torch.no_grad():
            for p, q in zip(alone.parameters(), together.parameters(), strict=True):
                size = p.shape[0]
                p.copy_(q[g * size : (g + 1) * size])
        assert (alone(x[g : g + 1])[0] - y[g]).abs().max() < 1e-12 * y.abs().max()


@pytest.mark.parametrize("norm", ["none", "batch"])
def test_no_group_sees_another(norm):
    net = noisy(IVNet(3, 4, groups=3, **SIZES, norm=norm))
    x = drawn(3, 4, 16, 3).requires_grad_()
    net(x)[1].square().sum().backward()
    parts = [x.grad, *(p.grad for p in net.parameters())]
    for gradient in parts:
        of_group = gradient.reshape(3, -1)
        assert bool((of_group[[0, 2]] == 0).all())
    assert float(x.grad[1].abs().max()) > 0
    assert all(float(g.reshape(3, -1)[1].abs().max()) > 0 for g in parts if norm == "none")


def test_a_v_begins_as_nothing():
    x = drawn(1, 2, 16, 8).float()
    assert bool((VBlock(8, 2, 1.5, 1, "silu", "none")(x) == 0).all())


def test_a_batch_norm_is_over_batch_and_nodes():
    h = 3.0 + 2.0 * drawn(2, 50, 16, 4).float()
    y = BatchNorm(8)(h)
    assert y.mean(dim=(1, 2)).abs().max() < 1e-5
    assert (y.std(dim=(1, 2)) - 1).abs().max() < 1e-2


@pytest.mark.parametrize(
    "wrong",
    [
        {"blocks": 0},
        {"width": 1},
        {"levels": 0},
        {"growth": 0.0},
        {"growth": -1.0},
        {"activation": "tanh"},
        {"norm": "layer"},
        {"groups": 0},
        {"into": 0},
        {"out": 0},
    ],
)
def test_settings_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=r"IVNet of .* numbers must be positive"):
        IVNet(**{"into": 3, "out": 4, **SIZES, **wrong})


@pytest.mark.parametrize("wrong", [{"width": 0}, {"blocks": 0}, {"into": 0}, {"out": 0}])
def test_perceptrons_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match="all must be at least 1"):
        MLP(**{"into": 3, "out": 4, "width": 8, "blocks": 1, **wrong})


def test_a_perceptron_begins_without_its_residual_blocks():
    net = MLP(5, 4, width=8, blocks=3)
    x = torch.randn(6, 5)
    layers = list(net.layers)
    assert torch.equal(net(x), layers[-1](silu(layers[0](x))))
