"""Networks of near layers are read when a gap first needs them, and not before; what is wrong with their files is said before the run."""

import numpy as np
import pytest
import torch
from scene_helpers import scene_of
from surrogate_cases import card_of, drawn, mild, rewritten, settings_for

from biem.backend import counting
from biem.membrane.maps import SLOTS
from biem.run.simulate import simulate
from surrogate import learned
from surrogate.learned import Deferred
from surrogate.library import load_maps
from surrogate.weights import read_distribution, read_weights, save_weights

FORCES = np.cos(np.arange(2 * 2 * 32.0)).reshape(2, 2, 32)
LOADED = "near_networks_loaded"
MLP = {"kind": "vesnet", "maps": "mlp", "near_field": "layers"}
DT = 1e-5  # that the shipped networks relax by


@pytest.fixture
def shelf(tmp_path):
    """Networks of all maps, with statistics that are not those of a network that was never trained."""
    for seed, name in enumerate(SLOTS):
        settings = settings_for(name)
        network = drawn(settings, seed)
        network.distribution.measure(torch.from_numpy(mild(24)))
        save_weights(tmp_path / f"{name}.safetensors", network, card_of(settings))
    return tmp_path


def test_a_near_network_is_read_once_at_the_first_call(shelf, monkeypatch):
    read = []
    monkeypatch.setattr(learned, "read_weights", lambda path: read.append(path.stem) or read_weights(path))
    maps, X = load_maps("mlp", shelf), mild(2)
    with counting() as counts:
        maps.relax(X, 1e-5)
        maps.advect(X, FORCES)
        maps.diagnostics(X)
        assert (read, counts[LOADED]) == ([], 0)
        first = maps.near_layers(X, FORCES)
        maps.near_layers(X, 2.0 * FORCES)
    assert (read, counts[LOADED]) == (["near"], 1)
    network, _ = read_weights(shelf / "near.safetensors")
    at_once = learned.LearnedMaps({"near": (learned.Loaded(network, maps.loaded["near"][0].card),)})
    assert np.array_equal(first, at_once.near_layers(X, FORCES))


@pytest.mark.parametrize("limits", ["flag", "exact"])
def test_shapes_are_watched_by_the_statistics_alone(shelf, limits):
    """Near layers the only map by a network: vesicles outside its distribution are told without it."""
    rewritten(shelf / "near.safetensors", lambda t, card: t["distribution.limit"].fill_(1e-3))
    maps, X = load_maps("mlp", shelf, slots=["near"], limits=limits), mild(2)
    with counting() as counts:
        assert maps.diagnostics(X) == {"out_of_distribution": 2.0, "by_exact_maps": 2.0 * (limits == "exact")}
    assert counts[LOADED] == 0
    own, alone = read_weights(shelf / "near.safetensors")[0].distribution, read_distribution(shelf / "near.safetensors")
    assert torch.equal(own(torch.from_numpy(X)), alone(torch.from_numpy(X)))


BAD = {
    "a tensor that is missing": (lambda t, card: t.pop("output_mean"), "has no tensor output_mean"),
    "one too many": (lambda t, card: t.update(more=torch.ones(2)), "has a tensor more"),
    "another shape": (lambda t, card: t.update(output_mean=torch.ones(3)), r"output_mean has shape \(3,\)"),
    "other nodes": (lambda t, card: card["settings"].update(points=64), "they are for 64 nodes"),
    "another reduced area": (lambda t, card: card.update(reduced_area=0.9), "they are for reduced area 0.9"),
    "no network": (lambda t, card: card["settings"]["network"].update(heads=3), "does not describe a network"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_said_before_the_first_step(shelf, case):
    change, words = BAD[case]
    rewritten(shelf / "near.safetensors", change)
    with pytest.raises(ValueError, match=words) as caught:
        load_maps("mlp", shelf)
    assert "\n" not in str(caught.value)


def test_a_file_cut_short_is_said_before_the_first_step(shelf):
    path = shelf / "near.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"near\.safetensors is no whole safetensors file"):
        load_maps("mlp", shelf)


def other_weights(path):
    settings = settings_for("near")
    save_weights(path, drawn(settings), card_of(settings, seed=5))


SPOILT = {
    "not finite": (lambda path: rewritten(path, lambda t, card: t["output_mean"].fill_(float("nan"))), "not finite"),
    "another file": (other_weights, "is not the file that the run began with"),
    "gone": (lambda path: path.unlink(), "does not exist"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_what_only_reading_tells_is_an_error_of_the_file(shelf, case):
    """Not of the step: an adaptive run would halve its steps in vain."""
    maps = load_maps("mlp", shelf)
    spoil, words = SPOILT[case]
    spoil(shelf / "near.safetensors")
    for _ in range(2):
        with pytest.raises(OSError, match=words):
            maps.near_layers(mild(2), FORCES)


def test_only_near_waits(shelf):
    found = load_maps("mlp", shelf).loaded
    assert [slot for slot in found if isinstance(found[slot][0], Deferred)] == ["near"]


@pytest.mark.parametrize(("apart", "times"), [(1.0, 0), (0.155, 1)])
def test_in_a_run_a_close_pair_alone_needs_the_near_network(apart, times):
    vesicles = {"points": 32, "reduced_area": 0.65, "centers": [[-apart / 2, 0.0], [apart / 2, 0.0]], "angles": [1.57, 1.57]}
    done = simulate(scene_of(vesicles=vesicles, solver=MLP, time={"dt": DT, "horizon": 2 * DT}))
    assert done.counts["relax_network"] > 0
    assert (done.counts["near_network"] > 0) == bool(times)
    assert done.counts[LOADED] == times
