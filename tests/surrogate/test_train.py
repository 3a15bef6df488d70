"""Trainings: they learn, go on bitwise from where they stopped, keep modes apart, and stop where nothing good can come."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from surrogate_cases import arrays_of, write_pairs

from biem.errors import NumericalFailure
from datagen.config import Label
from surrogate import learner
from surrogate import train as module
from surrogate.config import load_training
from surrogate.pairs import open_pairs
from surrogate.targets import TARGETS
from surrogate.train import Job, read_log, settings_of, train
from surrogate.weights import read_checkpoint, read_weights, save_weights

IVNET = ["network.arch=ivnet", "network.blocks=1", "network.width=8"]
MLP = ["network.arch=mlp", "network.blocks=1", "network.width=32", "network.rank=24"]
RESIDUAL = [*MLP, "network.target=residual"]
SMALL = ["training.batch=16", "training.every=5", "training.samples=320", "training.lr=1e-2"]


def config_of(*overrides):
    return load_training(None, [*SMALL, *overrides])


def trained(config, job, pairs, **options):
    return train(config, job, pairs, progress=False, **options)


def state(folder):
    """The checkpoint and the log, without what the clock says."""
    found = read_checkpoint(folder / "checkpoint.pt")
    found.pop("seconds")
    return found, [{key: value for key, value in line.items() if key != "seconds"} for line in read_log(folder)]


def same(a, b):
    """All tensors and plain values."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


@pytest.mark.parametrize(
    ("name", "modes", "arch", "bound"),
    [
        ("advection", (2,), IVNET, 0.45),
        ("self_tension", (), IVNET, 0.15),
        ("advection", (), MLP, 0.08),
        ("relax", (), MLP, 0.25),
        ("flow_tension", (), RESIDUAL, 0.006),
    ],
)
def test_a_few_steps_learn_a_few_shapes(tmp_path, pairs, name, modes, arch, bound):
    config = config_of(*arch, "training.samples=2400", "training.every=75", "training.augment=false", "training.ema=0.9")
    path = trained(config, Job(name, modes, tmp_path), pairs)
    lines = read_log(tmp_path / Job(name, modes, tmp_path).name)
    assert [line["step"] for line in lines] == [75, 150]
    assert lines[-1]["loss"] < bound
    assert lines[-1]["samples"] == 2400
    network, card = read_weights(path)
    assert (card.network.map, card.network.modes, card.samples, card.shapes) == (name, modes, 2400, 32)
    assert card.data == pairs.digest
    assert (card.target, card.base_points) == (("residual", 48) if arch is RESIDUAL else ("full", None))
    assert (card.dt, card.relaxation) == ((1e-5, "implicit") if name == "relax" else (None, None))
    assert list(card.errors) == ([str(k) for k in modes] or ["all"])
    assert (path.parent / "curve.png").read_bytes().startswith(b"\x89PNG")
    check_errors_of_the_card(network, card, pairs)
    check_halves(tmp_path / "half.safetensors", network, card, pairs)


def check_errors_of_the_card(network, card, pairs):
    """They are those of the file's network on the test shapes, but for the range that it keeps to."""
    from surrogate.data import Source

    source = Source(pairs, card.network, card.base_points)
    rows = source.rows("test", None)
    X = source.shapes(rows)
    network.lowest.fill_(-float("inf"))
    network.highest.fill_(float("inf"))
    labels = source.outputs(rows, X, absolute=True).flatten(2).norm(dim=2)[:, 0].double().numpy()
    errors = (network(X) - source.outputs(rows, X)).flatten(2).norm(dim=2)[:, 0].double().numpy() / labels
    (found,) = card.errors.values()
    if card.network.map != "relax":  # where small labels count as larger ones
        assert np.isclose(found["median"], np.median(errors), rtol=1e-3)
        assert np.isclose(found["mean"], errors.mean(), rtol=1e-3)
        assert np.isclose(found["p95"], np.quantile(errors, 0.95), rtol=1e-3)
    assert found["median"] < found["p95"]


def check_halves(path, network, card, pairs):
    """Half precision changes a trained network by less than a thousandth."""
    save_weights(path, network, card, half=True)
    X = torch.from_numpy(pairs.read("X_std", np.arange(8)).astype(np.float64))
    y = network(X)
    assert float((read_weights(path)[0](X) - y).norm()) < 1e-3 * float(y.norm())


@pytest.mark.parametrize(
    ("modes", "arch"), [((2, 5), IVNET), ((2, 5), [*IVNET, "network.norm=batch"]), ((), MLP), ((), [*RESIDUAL, "training.shapes=20"])]
)
def test_a_resumed_training_is_bitwise_the_one_made_at_once(tmp_path, pairs, modes, arch):
    config = config_of(*arch)
    once, twice = (Job("flow_tension", modes, tmp_path / name) for name in ("once", "twice"))
    whole = trained(config, once, pairs)
    for steps in (5, 10):
        partly = trained(config, twice, pairs, stop_after=steps)
        assert partly.name == "checkpoint.pt"
    assert state(partly.parent)[0]["step"] == 15
    torch.manual_seed(11)  # of no matter
    done = trained(config, twice, pairs)
    a, b = state(whole.parent), state(done.parent)
    assert same(a[0], b[0])
    assert a[1] == b[1]
    assert len(a[1]) == 4
    own, other = (read_weights(path)[0].state_dict() for path in (whole, done))
    assert same(dict(own), dict(other))


def test_what_a_killed_training_left_in_the_log_beyond_its_checkpoint_is_taken_out(tmp_path, pairs):
    config, job = config_of(*MLP), Job("self_tension", (), tmp_path)
    folder = trained(config, job, pairs, stop_after=10).parent
    lines = (folder / "log.jsonl").read_text()
    (folder / "log.jsonl").write_text(lines + lines.splitlines()[-1].replace('"step": 10', '"step": 15') + "\n")
    trained(config, job, pairs)
    assert [line["step"] for line in read_log(folder)] == [5, 10, 15, 20]


def test_a_log_without_a_checkpoint_is_begun_anew(tmp_path, pairs):
    config, job = config_of(*MLP), Job("self_tension", (), tmp_path)
    folder = trained(config, job, pairs, stop_after=10).parent
    (folder / "checkpoint.pt").unlink()
    trained(config, job, pairs)
    assert [line["step"] for line in read_log(folder)] == [5, 10, 15, 20]


def test_a_finished_training_is_left_as_it_is(tmp_path, pairs, monkeypatch):
    config, job = config_of(*MLP), Job("self_tension", (), tmp_path)
    path = trained(config, job, pairs)
    before = path.read_bytes()
    monkeypatch.setattr(module, "make_learner", None)
    assert trained(config, job, pairs) == path
    assert path.read_bytes() == before


@pytest.mark.parametrize("norm", ["none", "batch"])
def test_modes_trained_together_are_those_trained_alone(tmp_path, pairs, norm):
    config = config_of(*IVNET, f"network.norm={norm}", "training.clip=0.05")
    together = trained(config, Job("advection", (2, 5, 16), tmp_path), pairs)
    whole, card = read_weights(together)
    assert list(card.errors) == ["2", "5", "16"]
    for g, mode in enumerate((2, 5, 16)):
        alone, own = read_weights(trained(config, Job("advection", (mode,), tmp_path), pairs))
        for (name, p), q in zip(alone.state_dict().items(), whole.state_dict().values(), strict=True):
            if name.startswith("distribution") or p.ndim == 0:
                assert torch.equal(p, q)
            else:
                assert torch.allclose(p, q[g * len(p) : (g + 1) * len(p)], rtol=1e-4, atol=1e-5), name
        assert card.errors[str(mode)] == pytest.approx(own.errors[str(mode)], rel=1e-3)


def test_the_same_seed_gives_the_same_weights_and_another_does_not(tmp_path, pairs):
    files = [
        trained(config_of(*MLP, f"training.seed={seed}"), Job("relax", (), tmp_path / name), pairs)
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
    ]
    a, b, c = (read_weights(path)[0].core.state_dict() for path in files)
    assert same(dict(a), dict(b))
    assert not same(dict(a), dict(c))


def test_a_relaxation_is_named_by_its_step():
    from pathlib import Path

    assert Job("relax", (), Path(), "1e-05").name == "relax-1e-05"
    assert Job("advection", (3,), Path()).name == "advection-03"
    assert Job("near", (0, 1, 16), Path()).name == "near-00-16"


# --- what ends a training


def test_data_that_are_not_finite_stop_it_by_name_and_leave_the_checkpoint(tmp_path, pairs, monkeypatch):
    config, job = config_of(*IVNET), Job("advection", (2,), tmp_path)
    path = trained(config, job, pairs, stop_after=5)
    before = path.read_bytes()
    train_rows = np.flatnonzero(pairs.split == 0)
    bad = train_rows[7]

    def spoilt(source, rows, images, floors=None, own=learner.mode_data):
        data, floors = own(source, rows, images, floors)
        if len(rows) == 32:
            data.outputs[0, 2 * 32 + 7, 0, 0] = float("nan")  # its third image
        return data, floors

    monkeypatch.setattr(learner, "mode_data", spoilt)
    monkeypatch.setattr(learner.ModeLearner, "_fill", filled_without_statistics(learner.ModeLearner._fill))
    with pytest.raises(NumericalFailure) as caught:
        trained(config, job, pairs)
    message = str(caught.value)
    assert "advection-02: the loss is not finite at step" in message
    assert f"row {bad} (run {pairs.run[bad]}, symmetry 2)" in message
    assert f"The last good checkpoint is {path}" in message
    found = read_checkpoint(path)
    assert found["step"] % 5 == 0
    assert all(bool(torch.isfinite(value).all()) for value in found["core"].values())
    assert found["step"] > 5 or path.read_bytes() == before


def filled_without_statistics(own):
    """One bad value spoils one shape, not the scales of all."""

    def fill(self, kept):
        own(self, kept)
        for name in ("output_mean", "output_scale", "lowest", "highest"):
            value = getattr(self.network, name)
            value.copy_(torch.nan_to_num(value, nan=1.0))

    return fill


@pytest.mark.parametrize("arch", [IVNET, MLP])
def test_weights_that_run_away_stop_it(tmp_path, pairs, arch):
    config, job = config_of(*arch, "training.lr=1e36"), Job("self_tension", (), tmp_path)
    with pytest.raises(NumericalFailure, match=r"self_tension: .* not finite at step .* lower training.lr"):
        trained(config, job, pairs)
    assert not (tmp_path / "self_tension" / "weights.safetensors").exists()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("training.lr=0.5", "training.training.lr = 0.5 (there 0.01)"),
        ("network.width=12", "training.network.width = 12 (there 32)"),
        ("training.seed=7", "training.training.seed = 7 (there 0)"),
    ],
)
def test_a_folder_of_another_training(tmp_path, pairs, change, named):
    job = Job("self_tension", (), tmp_path)
    trained(config_of(*MLP), job, pairs, stop_after=5)
    with pytest.raises(ValueError, match="is of another training") as caught:
        trained(config_of(*MLP, change), job, pairs)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_of_other_data(tmp_path, pairs, pairs_path):
    job = Job("self_tension", (), tmp_path)
    trained(config_of(*MLP), job, pairs, stop_after=5)
    other = open_pairs(write_pairs(tmp_path / "other.h5", arrays_of(pairs_path), Label(dt=2e-5)))
    with pytest.raises(ValueError, match=f"data = '{other.digest}'"):
        trained(config_of(*MLP), job, other)


def test_a_checkpoint_cut_short(tmp_path, pairs):
    config, job = config_of(*MLP), Job("self_tension", (), tmp_path)
    path = trained(config, job, pairs, stop_after=5)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match="is not a whole checkpoint"):
        trained(config, job, pairs)


# --- data that will not do


def the_error(tmp_path, pairs, name, modes=(), arch=MLP, *overrides):
    with pytest.raises(ValueError) as caught:
        trained(config_of(*arch, *overrides), Job(name, modes, tmp_path / "runs"), pairs)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_maps_and_modes_without_labels(tmp_path, pairs_path):
    path = write_pairs(tmp_path / "few.h5", arrays_of(pairs_path), Label(maps=["relax", "advection"], modes=[0, 3]))
    few = open_pairs(path)
    assert "not of near" in the_error(tmp_path, few, "near")
    assert "has modes 0, 3 of advection, not 4" in the_error(tmp_path, few, "advection", (3, 4), IVNET)
    assert "has modes 0, 3 of advection, not 1-2, 4-16" in the_error(tmp_path, few, "advection")
    assert trained(config_of(*IVNET), Job("advection", (3,), tmp_path), few).exists()


def test_labels_that_are_not_finite(tmp_path, pairs_path):
    path = tmp_path / "nan.h5"
    shutil.copy(pairs_path, path)
    shutil.copy(pairs_path.with_suffix(".json"), path.with_suffix(".json"))
    row = int(np.flatnonzero(open_pairs(path).split == 0)[4])
    with h5py.File(path, "r+") as file:
        file["advection/5"][row, 1, 1, 1, 30] = np.nan
    assert f"nan.h5: advection/5 of row {row} (and 0 more) is not finite" in the_error(tmp_path, open_pairs(path), "advection")


@pytest.mark.parametrize(("split", "name"), [(0, "train"), (1, "val"), (2, "test")])
def test_a_split_without_shapes(tmp_path, pairs_path, split, name):
    arrays = arrays_of(pairs_path)
    arrays["split"] = np.where(arrays["split"] == split, (split + 1) % 3, arrays["split"]).astype(np.int8)
    pairs = open_pairs(write_pairs(tmp_path / "pairs.h5", arrays))
    assert f"pairs.h5 has no shapes of the {name} split" in the_error(tmp_path, pairs, "self_tension")


def test_settings_that_do_not_fit(tmp_path, pairs):
    assert "network.levels = 6: 32 nodes cannot be halved so often" in the_error(tmp_path, pairs, "relax", (), IVNET, "network.levels=6")
    assert "is not for near" in the_error(tmp_path, pairs, "near", (), RESIDUAL)


def test_overrides_for_one_map_hold_for_it_alone():
    config = config_of(*MLP, "map.near.rank=7", "map.near.lr=0.5")
    assert (config.of("near").network.rank, config.of("near").training.lr) == (7, 0.5)
    assert config.of("relax").network.rank == 24
    assert not config.of("near").map
    for wrong, message in (
        ("map.near.colour=3", "map.near.colour is not known"),
        ("map.gravity.rank=3", "gravity"),
        ("network.width=0", "network.width"),
        ("training.samples=0", "training.samples"),
        ('network.channels=["z"]', "network.channels"),
        ("map.near.rank=0", "rank"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            config_of(wrong)
        assert "\n" not in str(caught.value)


def test_what_a_run_was_stands_beside_it(tmp_path, pairs):
    config, job = config_of(*IVNET), Job("advection", (2,), tmp_path)
    folder = trained(config, job, pairs, stop_after=5).parent
    found = json.loads((folder / "run.json").read_text())
    assert found["map"] == "advection"
    assert found["modes"] == [2]
    assert found["data"] == pairs.digest
    assert found["training"]["network"]["width"] == 8


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "configs" / "train").glob("*.toml")), ids=lambda path: path.stem)
def test_the_training_files_are_valid(path):
    config = load_training(path)
    assert {config.of(name).network.arch for name in TARGETS} == {config.network.arch}


def test_a_rolloff_is_of_what_acts_on_velocities():
    config = config_of(*MLP, "network.rolloff=4")
    found = {name: settings_of(config, Job(name, (), Path("runs")), 32).rolloff for name in TARGETS}
    assert found == {"relax": None, "self_tension": None, "advection": 4.0, "flow_tension": 4.0, "near": None}
    with pytest.raises(ValueError, match="rolloff = 4"):
        settings_of(config_of(*IVNET, "network.rolloff=4"), Job("near", (0,), Path("runs")), 32)
