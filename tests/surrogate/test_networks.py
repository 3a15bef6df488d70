"""Maps as modules: shapes of their outputs, one module for all modes as many, batch norms folded away, the basis of the perceptron."""

from dataclasses import replace

import pytest
import torch
from surrogate_cases import OPERATORS, N, drawn, mild, settings_for, smooth_field

from surrogate.data import Source, basis_data, principal_components
from surrogate.features import frame
from surrogate.ivnet import BatchNorm
from surrogate.merge import folded, merged
from surrogate.networks import IVNetMap, MLPMap, Settings, make_network
from surrogate.symmetric import CHARACTERS, Parts
from surrogate.targets import SYMMETRIES, TARGETS, apply_kernel


def curves(count=3):
    return torch.from_numpy(mild(count))


def relative(got, want):
    assert got.shape == want.shape
    return float((got - want).detach().abs().max() / want.detach().abs().max())


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
@pytest.mark.parametrize("name", TARGETS)
def test_outputs_are_of_the_shape_that_the_settings_say(name, arch):
    settings = settings_for(name, arch, modes=(0, 5))
    y = drawn(settings)(curves())
    assert y.shape == (3, 2 if arch == "ivnet" and TARGETS[name].operator else 1, *settings.output_shape)
    assert y.dtype == torch.float32
    assert float(y.detach().std()) > 0


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
def test_settings_make_themselves_anew(arch):
    settings = settings_for("advection", arch, modes=(0, 5))
    assert Settings.from_dict(settings.as_dict()) == settings
    with pytest.raises(TypeError):
        Settings.from_dict({**settings.as_dict(), "depth": 3})


@pytest.mark.parametrize("norm", ["none", "batch"])
@pytest.mark.parametrize("name", ["advection", "flow_tension", "near"])
def test_merged_networks_answer_as_each_alone(name, norm):
    parts = [drawn(settings_for(name, "ivnet", (k,), norm=norm), seed=k) for k in (0, 3, 4)]
    parts += [drawn(settings_for(name, "ivnet", (7, 9), norm=norm), seed=9)]
    whole = merged([folded(part) for part in parts])
    assert whole.settings.modes == (0, 3, 4, 7, 9)
    X = curves()
    y = whole(X)
    own = torch.cat([part(X) for part in parts], dim=1)
    assert relative(y, own) < 1e-5  # float32, in whatever order a processor adds
    assert min(relative(own[:, [k]], own[:, [k - 1]]) for k in range(1, 5)) > 0.1


def test_folded_batch_norms_answer_the_same():
    network = drawn(settings_for("advection", "ivnet", (2, 3), norm="batch"), seed=4)
    norms = [module for module in network.modules() if isinstance(module, BatchNorm)]
    assert len(norms) == 2 * 4
    plain = folded(network)
    assert not any(isinstance(module, torch.nn.BatchNorm1d) for module in plain.modules())
    X = curves()
    assert relative(plain(X), network(X)) < 1e-5
    with torch.no_grad():
        norms[0].running_mean.add_(1.0)
    assert relative(plain(X), network(X)) > 1e-3


def test_a_network_without_batch_norms_is_folded_already():
    network = drawn(settings_for("relax", "ivnet"))
    assert folded(network) is network


@pytest.mark.parametrize("name", ["relax", "advection"])
def test_a_perceptron_of_full_rank_gives_the_targets_back(pairs, name):
    """With coefficients of the data in the place of its core's."""
    source = Source(pairs, settings_for(name))
    rows = source.rows("train", None)
    basis = principal_components(source, rows, 1000, 0)
    data = basis_data(source, rows, 1, basis)
    network = make_network(replace(source.settings, ranks=basis.ranks))
    assert isinstance(network, MLPMap)
    network.basis.copy_(basis.vectors)
    network.output_mean.copy_(basis.mean)
    network.output_scale.copy_(0.5 + torch.rand(len(basis.vectors)))
    network.normalized = lambda values: data.outputs / network.output_scale
    X = source.shapes(rows)
    assert relative(network(X), source.outputs(rows, X)) < 1e-4


@pytest.mark.parametrize("name", ["relax", "self_tension", "near"])
def test_the_parts_of_outputs(name):
    """They are whole together, orthogonal, and change by a sign alone under a symmetry, each part in its own way."""
    settings = settings_for(name)
    shape, size = settings.output_shape, int(torch.tensor(settings.output_shape).prod())
    parts = Parts(name, shape)
    Y = torch.randn(3, size, generator=torch.Generator().manual_seed(0))
    y = parts.take(Y)
    assert relative(parts.put(y), Y) < 1e-6
    assert relative(y.square().sum((1, 2)), Y.square().sum(1)) < 1e-6
    alone = [parts.put(y * torch.eye(4)[i][:, None]) for i in range(4)]
    for i in range(4):
        assert all(abs(float((alone[i] * alone[j]).sum())) < 1e-6 * size for j in range(i))
        signs = []
        for symmetry in SYMMETRIES:
            image = symmetry.kernel if TARGETS[name].operator else symmetry.parts
            moved = image(alone[i].reshape(3, *shape)).reshape(3, size)
            signs.append(1 if relative(moved, alone[i]) < 1e-6 else -1 if relative(-moved, alone[i]) < 1e-6 else 0)
        assert signs == CHARACTERS[i].tolist()
    assert len({tuple(row) for row in CHARACTERS.tolist()}) == 4


@pytest.mark.parametrize("rolloff", [None, 5.0])
@pytest.mark.parametrize("name", OPERATORS)
def test_operators_by_their_rows_act_as_the_whole_kernel(name, rolloff):
    network = drawn(replace(settings_for(name), rolloff=rolloff))
    X = curves()
    u, F = torch.from_numpy(smooth_field(len(X), seed=3)), frame(X)
    u += torch.randn(u.shape, generator=torch.Generator().manual_seed(0), dtype=u.dtype)  # all modes, of no symmetry
    expected = apply_kernel(network(X)[:, 0], u, F, rolloff)
    operators = network.operators(X)
    assert operators.shape[:3] == (len(X), 4, 2 * (N // 4 + 1))  # little more than a quarter of the sources
    assert relative(network.apply_to(operators, u, F), expected) < 1e-5
    moved = network.to(torch.float64)  # what was made of the basis is made anew
    assert relative(moved.apply_to(moved.operators(X), u, F), expected) < 1e-5


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
def test_inputs_are_scaled_and_outputs_kept_to_the_range_that_targets_had(arch):
    network = drawn(settings_for("self_tension", arch))
    X, seen = curves(), []
    large = torch.full((3, 8) if arch == "mlp" else (1, 3, N, 1), 50.0)
    network.core.forward = lambda x: seen.append(x) or large
    y = network(X)
    assert torch.equal(seen[0], torch.asinh((network.features(X) - network.input_mean) / network.input_scale))
    limit = network.highest * network.output_scale
    limit = network.outputs(limit[None])[0] if arch == "mlp" else limit.flatten() + network.output_mean.flatten()
    assert relative(y[:, 0, 0], limit.expand(3, N)) < 1e-6


def test_settings_that_cannot_be_are_refused():
    for settings, error in (
        (settings_for("relax", "ivnet", width=1), ValueError),
        (settings_for("relax", "mlp", width=0), ValueError),
        (settings_for("relax", "mlp", depth=2), TypeError),
    ):
        with pytest.raises(error):
            make_network(settings)
    assert isinstance(make_network(settings_for("relax", "ivnet")), IVNetMap)
