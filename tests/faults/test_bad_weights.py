"""Files of weights: whole through a round trip, and each way in which one may be bad is one line that names the file."""

import pytest
import torch
from safetensors.torch import save_file
from surrogate_cases import card_of, drawn, mild, rewritten, settings_for

from surrogate.weights import checkpoint_bytes, read_card, read_checkpoint, read_weights, save_weights

CASES = [("advection", "ivnet"), ("advection", "mlp"), ("near", "mlp"), ("relax", "ivnet"), ("self_tension", "mlp")]


def saved(path, name="relax", arch="ivnet", half=False, **changes):
    settings = settings_for(name, arch, modes=(0, 2))
    network = drawn(settings)
    save_weights(path, network, card_of(settings, **changes), half)
    return network


def the_error(path, read=read_weights, kind=ValueError):
    with pytest.raises(kind) as caught:
        read(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize(("name", "arch"), CASES)
def test_round_trip(tmp_path, name, arch):
    network = saved(tmp_path / "a" / "w.safetensors", name, arch)
    found, card = read_weights(tmp_path / "a" / "w.safetensors")
    assert card.model_dump_json() == card_of(network.settings).model_dump_json()
    assert card.network == network.settings
    assert read_card(tmp_path / "a" / "w.safetensors") == card
    assert found.settings == network.settings
    own, other = network.state_dict(), found.state_dict()
    assert own.keys() == other.keys()
    assert all(torch.equal(own[key], other[key]) and own[key].dtype == other[key].dtype for key in own)
    X = torch.from_numpy(mild(2))
    assert torch.equal(found(X), network(X))
    assert not found.training
    assert not any(p.requires_grad for p in found.parameters())


@pytest.mark.parametrize(("name", "arch"), CASES)
def test_half_precision_changes_answers_little_and_statistics_not_at_all(tmp_path, name, arch):
    network = saved(tmp_path / "w.safetensors", name, arch)
    saved(tmp_path / "half.safetensors", name, arch, half=True)
    found, _ = read_weights(tmp_path / "half.safetensors")
    X = torch.from_numpy(mild(3))
    got, want = found(X), network(X)
    assert 0 < float((got - want).norm()) < 1e-2 * float(want.norm())
    for key, value in network.state_dict().items():
        assert torch.equal(found.state_dict()[key], value) == (not key.startswith(("core.", "basis"))), key
    assert found.core.state_dict()[next(iter(found.core.state_dict()))].dtype == torch.float32
    assert (tmp_path / "half.safetensors").stat().st_size < (tmp_path / "w.safetensors").stat().st_size


def test_weights_that_half_precision_cannot_hold_stay_whole(tmp_path):
    settings = settings_for("relax", "mlp")
    network = drawn(settings)
    with torch.no_grad():
        network.basis[0, 0] = 1e6
    save_weights(tmp_path / "w.safetensors", network, card_of(settings), half=True)
    assert torch.equal(read_weights(tmp_path / "w.safetensors")[0].basis, network.basis)


def test_a_file_cut_short(tmp_path):
    path = tmp_path / "w.safetensors"
    saved(path)
    content = path.read_bytes()
    for length in (0, 5, 100, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert "is no whole safetensors file" in the_error(path)
        assert "is no whole safetensors file" in the_error(path, read_card)


class Trap:
    """Sets a mark where it is unpickled."""

    def __reduce__(self):
        return (exec, ("import builtins; builtins.sprung = True",))


def test_a_pickle_is_refused_and_not_opened(tmp_path):
    import builtins

    for path in (tmp_path / "w.pt", tmp_path / "w.safetensors"):
        torch.save({"weights": torch.ones(3), "trap": Trap()}, path)
        assert "pickle" in the_error(path)
        assert "pickle" in the_error(path, read_card)
    path = tmp_path / "checkpoint.pt"
    torch.save({"step": 3, "trap": Trap()}, path)
    assert "not a whole checkpoint" in the_error(path, read_checkpoint)
    assert not hasattr(builtins, "sprung")


def test_a_file_that_is_not_there(tmp_path):
    assert "does not exist" in the_error(tmp_path / "w.safetensors", kind=FileNotFoundError)


def test_no_card(tmp_path):
    path = tmp_path / "w.safetensors"
    save_file({"a": torch.ones(3)}, path)
    assert "has no model card" in the_error(path)
    save_file({"a": torch.ones(3)}, path, metadata={"format": "pt"})
    assert "has no model card" in the_error(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", '{"version": 1}'])
def test_a_card_that_is_none(tmp_path, text):
    path = tmp_path / "w.safetensors"
    save_file({"a": torch.ones(3)}, path, metadata={"card": text})
    assert "model card" in the_error(path)


CARDS = {
    "version": (lambda t, card: card.update(version=2), "version 2"),
    "layers": (lambda t, card: card.update(layers=[-1.0, 0.0, 1.0]), "layers at [-1.0, 0.0, 1.0]"),
    "missing key": (lambda t, card: card.pop("reduced_area"), "reduced_area"),
    "unknown key": (lambda t, card: card.update(colour="red"), "colour"),
    "no number": (lambda t, card: card.update(dt="soon"), "dt"),
    "settings": (lambda t, card: card["settings"].update(depth=3), "depth"),
    "settings missing": (lambda t, card: card["settings"].pop("points"), "points"),
    "map": (lambda t, card: card["settings"].update(map="gravity"), "network"),
    "network": (lambda t, card: card["settings"]["network"].update(heads=3), "network"),
    "size": (lambda t, card: card["settings"]["network"].update(width=0), "network"),
}


def shorter(tensors, card):
    tensors["input_mean"] = tensors["input_mean"][..., :-1].contiguous()


def spoilt(name, value):
    def change(tensors, card):
        tensors[name].view(-1)[0] = value

    return change


TENSORS = {
    "missing": (lambda t, card: t.pop("core.read.all.weight"), "has no tensor core.read.all.weight"),
    "too many": (lambda t, card: t.update({"core.more": torch.ones(2)}), "has a tensor core.more"),
    "shape": (shorter, "input_mean has shape (1, 1, 1, 9), its card expects (1, 1, 1, 10)"),
    "another width": (lambda t, card: card["settings"]["network"].update(width=8), "its card expects"),
    "another depth": (lambda t, card: card["settings"]["network"].update(blocks=3), "has no tensor core.blocks.2"),
    "nan": (spoilt("core.read.all.weight", float("nan")), "core.read.all.weight has values that are not finite"),
    "infinite": (spoilt("output_scale", float("inf")), "output_scale has values that are not finite"),
    "nan in a range": (spoilt("lowest", float("nan")), "lowest has values that are not"),
    "nan in the limit": (spoilt("distribution.limit", float("nan")), "distribution.limit has values that are not"),
}


@pytest.mark.parametrize(("change", "named"), [*CARDS.values(), *TENSORS.values()], ids=[*CARDS, *TENSORS])
def test_a_card_of_something_else_and_tensors_that_are_not_the_cards(tmp_path, change, named):
    path = tmp_path / "w.safetensors"
    saved(path)
    rewritten(path, change)
    assert named in the_error(path)


def test_no_limits_are_none(tmp_path):
    """A network that was not measured has none; its file is sound."""
    path = tmp_path / "w.safetensors"
    saved(path)
    rewritten(path, lambda t, card: (t["lowest"].fill_(-float("inf")), t["highest"].fill_(float("inf"))))
    assert float(read_weights(path)[0].highest.max()) == float("inf")


def test_a_checkpoint_goes_round_and_one_cut_short_is_refused(tmp_path):
    path = tmp_path / "checkpoint.pt"
    content = checkpoint_bytes({"step": 3, "core": {"a": torch.arange(4.0)}, "average": {}})
    path.write_bytes(content)
    found = read_checkpoint(path)
    assert found["step"] == 3
    assert torch.equal(found["core"]["a"], torch.arange(4.0))
    for length in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert "is not a whole checkpoint" in the_error(path, read_checkpoint)
