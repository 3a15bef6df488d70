"""Errors against labels, velocities of neighbours, steps in a row and cost; what is read again and what is measured anew."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import shapely
import torch
from surrogate_cases import Exactly, arrays_of, card_of, drawn, labelled, mild, sample, settings_for, write_pairs

from biem.curves.curve import area, length
from biem.curves.fourier import resample
from biem.membrane.maps import ExactMaps
from datagen.config import Label
from datagen.shapes import encode
from surrogate.evaluation import Options, evaluate
from surrogate.evaluation import run as module
from surrogate.evaluation.cost import ORDER, costs
from surrogate.evaluation.errors import map_errors, test_rows
from surrogate.evaluation.parts import Parts, resolved_shapes
from surrogate.evaluation.relaxation import DIVERGED, errors_of_steps, march, reference
from surrogate.evaluation.rungs import Rung, SteppedMaps, exact_rungs, learned_rungs, operators, stats
from surrogate.evaluation.tables import trade
from surrogate.evaluation.velocities import neighbours, velocity_errors
from surrogate.learned import LearnedMaps, Loaded
from surrogate.library import Need
from surrogate.pairs import open_pairs
from surrogate.weights import save_weights

test_rows.__test__ = False  # not a test, by its name


def nothing(*_):
    pass


def of_exact(name, arch, points=64, base=None):
    """A rung of a network that knows the maps built at `points` nodes."""
    settings = settings_for(name, arch)
    network = Exactly(settings, points, dt=1e-5, base=base)
    card = card_of(settings, target="full" if base is None else "residual")
    part = Loaded(network, card, None if base is None else ExactMaps(points=base))
    return Rung(arch, LearnedMaps({name: (part,)}), frozenset({name}), {name: "exactly"})


@pytest.mark.parametrize(("arch", "base"), [("ivnet", None), ("mlp", None), ("mlp", 48)])
@pytest.mark.parametrize("name", ["advection", "flow_tension"])
def test_operators_of_every_form_are_compared_mode_by_mode(name, arch, base):
    X = torch.from_numpy(mild(2))
    found = operators(of_exact(name, arch, base=base), name, X)
    wanted = operators(exact_rungs((32, 64))[1], name, X)
    assert found.shape == wanted.shape
    assert float((found - wanted).abs().max()) < 1e-4 * float(wanted.abs().max())


def test_exact_near_layers_are_compared_like_those_of_networks():
    X = torch.from_numpy(mild(1))
    found = operators(of_exact("near", "ivnet"), "near", X)
    wanted = operators(exact_rungs((32,))[0], "near", X)
    assert found.shape == wanted.shape == (1, 17, 2, 2, 5, 2, 32)
    assert float((found - wanted).abs().max()) < 1e-6


def test_maps_that_made_the_labels_have_no_errors_and_scaled_ones_have_the_scale(pairs):
    rows = test_rows(pairs, None, 0)
    assert list(rows) == list(np.flatnonzero(pairs.split == 2))

    class Scaled(ExactMaps):
        """Answers too large by a tenth."""

        def self_tension(self, X):
            return 1.1 * super().self_tension(X)

    rungs = [Rung("right", ExactMaps(), frozenset({"self_tension"}), {}), Rung("wrong", Scaled(), frozenset({"self_tension"}), {})]
    done = []
    X, arrays = mild(8), arrays_of(pairs.path)
    arrays["X_std"][rows], arrays["self_tension"][rows] = X, ExactMaps().self_tension(X.astype(np.float32).astype(np.float64))
    own = write_pairs(pairs.path.with_name("own.h5"), arrays)
    found = map_errors(open_pairs(own), "self_tension", rungs, rows, done.append)
    assert found["right"]["all"]["max"] < 1e-6
    assert found["wrong"]["all"]["median"] == pytest.approx(0.1, rel=1e-4)
    assert sum(done) == found["right"]["all"]["n"] == 8


def test_the_operator_as_a_whole_is_the_frobenius_norm_over_nodal_velocities(pairs):
    rows = test_rows(pairs, 2, 0)
    rung = exact_rungs((48,))[0]
    found = map_errors(pairs, "advection", [rung], rows, nothing)["exact 48"]
    X = pairs.read("X_std", rows).astype(np.float64)
    T = np.stack([pairs.read(f"advection/{k}", rows) for k in range(17)], axis=1)  # (n, K, part, in, out, N)
    phase = np.arange(17)[:, None] * 2 * np.pi * np.arange(32) / 32
    weight = np.where((np.arange(17) % 16) == 0, 1, 2)[:, None] / 32
    basis = np.stack([weight * np.cos(phase), weight * np.sin(phase)], axis=1)
    labels = np.einsum("kpi,nkpdcj->ndicj", basis, T)  # the response to a velocity that is 1 at node i
    errors = np.zeros_like(labels)
    for d in range(2):
        for i in range(32):
            u = np.zeros_like(X)
            u[:, d, i] = 1.0
            errors[:, d, i] = rung.maps.advect(X, u) - labels[:, d, i]
    size = lambda v: np.sqrt((v**2).sum(axis=(1, 2, 3, 4)))
    assert found["operator"]["mean"] == pytest.approx(float((size(errors) / size(labels)).mean()), rel=1e-3)
    assert found["all"]["n"] == 2 * 17
    assert found["modes"]["3"]["n"] == 2


def test_a_mode_that_is_zero_is_left_out(pairs):
    found = map_errors(pairs, "flow_tension", exact_rungs((64,)), test_rows(pairs, 3, 0), nothing)["exact 64"]
    assert list(found["modes"]) == [str(k) for k in range(1, 17)]
    assert found["all"]["n"] == 3 * 16
    assert found["operator"]["max"] < 0.2


def test_neighbours_stand_at_the_gap():
    X = mild(4, points=128)
    other = neighbours(X, 1 / 32, np.random.default_rng(0))
    rings = lambda shapes: shapely.polygons(resample(shapes, 1024).transpose(0, 2, 1))
    assert np.abs(shapely.distance(rings(X), rings(other)) - 1 / 32).max() < 1e-3
    assert np.abs(length(other) - length(np.roll(X, 1, axis=0))).max() < 1e-12


def test_more_nodes_are_better_for_velocities_as_they_occur():
    found = velocity_errors(mild(6, points=128), exact_rungs((32, 64)), 32, 0)
    assert list(found) == ["shear", "poiseuille", "neighbour"]
    for flow, slots in found.items():
        better, small = (
            (0.5, 3e-2) if flow == "neighbour" else (0.2, 2e-3)
        )  # what 32 nodes hold of a velocity is the limit beside a neighbour
        for errors in slots.values():
            assert errors["exact 64"]["median"] < better * errors["exact 32"]["median"]
            assert errors["exact 64"]["median"] < small


def test_extrapolated_references_are_of_second_order():
    X = mild(2, points=64)
    fine, _ = reference(X, 1e-4, 2, 32, 32, nothing)
    errors = [np.abs(reference(X, 1e-4, 2, n, 32, nothing)[0] - fine)[-1].max() for n in (4, 8)]
    assert errors[0] / errors[1] > 3.0
    best, change = reference(X, 1e-4, 2, 8, 32, nothing)
    assert (np.abs(best - fine).max(axis=(2, 3)) <= change + 1e-15).all()


def test_steps_keep_area_and_length():
    X = mild(3)
    states = march(ExactMaps(), X, 1e-5, 3, 1, 32, nothing)
    assert np.abs(area(states[-1]) / area(X) - 1).max() < 1e-9
    assert np.abs(length(states[-1]) / length(X) - 1).max() < 1e-9


def test_steps_that_fail_are_counted_and_end_there():
    class Wild(ExactMaps):
        """The second of the vesicles that are given is lost."""

        def relax(self, X, dt):
            Y = super().relax(X, dt)
            if len(X) == 3:
                Y[1] = np.nan
            return Y

    X = mild(3)
    states = march(Wild(), X, 1e-5, 2, 1, 32, nothing)
    assert np.isnan(states[1:, 1]).all()
    wanted = march(ExactMaps(), X, 1e-5, 2, 1, 32, nothing)
    found = errors_of_steps(states, wanted)
    assert (found["diverged"], found["vesicles"]) == (1, 3)
    assert found["max"] == [0.0, None, None]
    assert found["median"][2] < 1e-12
    wanted[1, 0] += 2 * DIVERGED  # one that comes back counts as lost
    assert errors_of_steps(states, wanted)["diverged"] == 2


def test_extrapolated_steps_beat_the_steps_they_are_made_of():
    X = mild(3)
    wanted = SteppedMaps(steps=64).relax(X, 1e-5)
    one, two = (np.abs(SteppedMaps(steps=n).relax(X, 1e-5) - wanted).max() for n in (1, 2))
    both = np.abs(SteppedMaps(steps=2, extrapolated=True).relax(X, 1e-5) - wanted).max()
    assert both < 0.5 * two < 0.4 * one


def test_cost_counts_what_there_is():
    whole = exact_rungs((32,))[0]
    part = frozenset({"self_tension", "relax"})
    makers = {
        "exact": (whole.maps, whole.slots, 1e-5),
        "other": (ExactMaps(points=48), whole.slots - {"near"}, 1e-5),
        "part": (ExactMaps(), part, 1e-5),
    }
    ticks = []
    found = costs(makers, ["exact", "other"], mild(4), 2, lambda: ticks.append(1))
    assert len(ticks) == 9
    assert found["exact"]["step"] == pytest.approx(sum(found["exact"][name] for name in ORDER[:5]))
    assert found["other"]["near"] == found["exact"]["near"] > 0
    assert found["part"]["self_tension"] > 0
    assert found["part"]["step"] is found["part"]["near"] is None


def test_infinite_errors_are_told_and_not_written_as_numbers():
    found = stats(np.array([1.0, 2.0, 3.0, np.nan]))
    assert found["max"] is found["mean"] is None
    assert found["median"] == 3.0
    json.dumps(found, allow_nan=False)


def test_resolved_shapes_are_those_of_the_data_set(tmp_path):
    X, _, _ = sample((4, 0, 0))
    with h5py.File(tmp_path / "shapes.h5", "w") as file:
        file["coefficients"] = encode(X, 32)
    with h5py.File(tmp_path / "nodes.h5", "w") as file:
        file["X"] = X
    for name in ("shapes.h5", "nodes.h5"):
        assert np.abs(resolved_shapes(tmp_path / name, np.array([2, 0]), 128) - X[[2, 0]]).max() < 1e-7
    with pytest.raises(ValueError, match="64 nodes"):
        resolved_shapes(tmp_path / "shapes.h5", np.array([0]), 32)


# --- the whole


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Of small data, and weights of some maps of two kinds."""
    folder = tmp_path_factory.mktemp("evaluate")
    X, split, run = sample((2, 2, 6))
    label = Label(maps=["self_tension", "advection", "flow_tension"])
    data = write_pairs(folder / "pairs.h5", labelled(X, split, run, label), label)
    flows = []
    for dt in (1e-5, 1e-4):
        flow = Label(maps=["relax"], dt=dt, relaxation="converged", substeps=2)
        flows.append(write_pairs(folder / f"pairs-flow{dt:g}.h5", labelled(X, split, run, flow), flow))
    other = Label(maps=["self_tension"])
    suspension = write_pairs(folder / "suspension.h5", labelled(X, split, run, other), other)
    write_pairs(folder / "suspension-flow1e-4.h5", labelled(X, split, run, flow), flow)
    with h5py.File(folder / "shapes.h5", "w") as file:
        file["coefficients"] = encode(X, 32)
    for name, arch in (("relax", "mlp"), ("self_tension", "mlp"), ("advection", "ivnet")):
        settings = settings_for(name, arch)
        save_weights(folder / "weights" / arch / f"{name}.safetensors", drawn(settings), card_of(settings))
    few = {"velocity_shapes": 2, "relaxation_shapes": 2, "steps": 2, "substeps": 2, "counts": (2,), "rounds": 1, "points": (32, 48)}
    made = {"data": data, "out": folder / "out", "flows": tuple(flows), "shapes": folder / "shapes.h5", "taylor_green": suspension}
    return Options(**made, weights=folder / "weights", quiet=True, **few)


def test_the_report_has_every_part_and_says_what_is_missing(options):
    report = evaluate(options)
    results = report.results
    assert results["rungs"] == ["ivnet", "mlp", "exact 32", "exact 48"]
    assert {name: list(maps) for name, maps in results["errors"].items()} == {
        "test": ["relax 1e-05", "relax 0.0001", "self_tension", "advection", "flow_tension"],
        "taylor_green": ["relax 0.0001", "self_tension"],
    }
    assert set(results["errors"]["test"]["advection"]) == {"ivnet", "exact 32", "exact 48"}
    assert set(results["velocities"]["neighbour"]["flow_tension"]) == {"exact 32", "exact 48"}
    assert {"mlp", "exact 48, 16 steps", "reference"} < set(results["relaxation"]["1e-05"])
    assert {"mlp, 10 steps of 1e-05", "exact 48, 10 steps of 1e-05"} < set(results["relaxation"]["0.0001"])
    assert results["cost"]["2"]["exact 32, float32"]["step with near"] > 0
    assert results["cost"]["2"]["mlp"]["step"] is None
    assert any(note.startswith("mlp has no advection") for note in results["notes"])
    assert any(note.startswith("hybrid has no relax") for note in results["notes"])
    assert json.loads((options.out / "evaluate.json").read_text()) == results
    assert report.text in (options.out / "evaluate.md").read_text()
    assert all(path.is_file() for path in report.files)
    assert {"errors_test.png", "errors_test_advection.png", "velocities.png", "relaxation_1e-05.png", "cost.png"} <= {
        p.name for p in report.files
    }
    rows = trade(results)
    assert {row[2] for row in rows if row[0].startswith("relax 1e-05")} >= {"mlp", "exact 48, extrapolated"}
    once, composed = (next(row[4] for row in rows if row[0] == f"relax {dt}") for dt in ("1e-05", "0.0001"))
    assert composed["mlp"] == 10 * once["mlp"]
    assert composed["exact 48"] == once["exact 48"]


def test_only_what_has_changed_is_measured_again(options, monkeypatch):
    monkeypatch.setattr(module, "draw", lambda *_: [])
    first = evaluate(options)
    measured = []
    inner = module.map_errors
    monkeypatch.setattr(
        module,
        "map_errors",
        lambda of, name, rungs, *rest: measured.append((name, {r.name for r in rungs})) or inner(of, name, rungs, *rest),
    )
    for name in ("velocity_errors", "reference", "march", "costs"):
        monkeypatch.setattr(module, name, lambda *a, name=name, **k: pytest.fail(f"{name} again"))
    assert evaluate(options).results == first.results
    assert measured == []
    path = options.weights / "mlp" / "self_tension.safetensors"
    before = path.read_bytes()
    settings = settings_for("self_tension", "mlp")
    save_weights(path, drawn(settings, seed=7), card_of(settings))
    evaluate(replace(options, only=("errors",)))
    path.write_bytes(before)
    assert measured == [("self_tension", {"mlp"})] * 2  # of both sets of shapes


def test_results_of_another_version_or_half_written_are_not_read(tmp_path):
    parts = Parts(tmp_path, 1)
    assert parts.of("a part", {"n": 1}, lambda: {"value": 1}) == {"value": 1}
    assert parts.get("a part", {"n": 1}) == {"value": 1}
    assert parts.get("a part", {"n": 2}) is None
    assert Parts(tmp_path, 2).get("a part", {"n": 1}) is None
    (tmp_path / "a-part.json").write_text('{"digest')
    assert parts.get("a part", {"n": 1}) is None


@pytest.mark.parametrize(
    ("wrong", "text"), [({"only": ("speed",)}, "'speed'"), ({"kinds": ("cnn",)}, "'cnn'"), ({"substeps": 3}, "substeps = 3")]
)
def test_wrong_options_get_one_line(options, wrong, text):
    with pytest.raises(ValueError, match=text) as caught:
        evaluate(replace(options, **wrong))
    assert "\n" not in str(caught.value)


def test_a_folder_without_any_weights_is_refused(options, tmp_path):
    with pytest.raises(FileNotFoundError, match="no weights"):
        evaluate(replace(options, weights=tmp_path))


def test_kinds_without_weights_are_left_out_with_lines(tmp_path):
    rungs, notes = learned_rungs(("mlp", "hybrid"), tmp_path, Need(32, 0.65))
    assert rungs == []
    assert len(notes) == 9
    assert all("\n" not in note for note in notes)
