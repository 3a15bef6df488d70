"""Which weights are found for what is needed, what is refused and in what words; and the maps that a scene asks for."""

import shutil

import numpy as np
import pytest
import torch
from surrogate_cases import EVERY, card_of, drawn, mild, settings_for

from biem.backend import counting
from biem.curves.pose import standardize
from biem.curves.shapes import equilibrium
from biem.membrane.maps import SLOTS, ExactMaps, MapsRequest, Monitored
from surrogate import library
from surrogate.library import Need, find, load_maps, need_of
from surrogate.provider import SlotMaps, make_maps
from surrogate.weights import save_weights


def put(path, name, arch="mlp", modes=None, points=32, **changes):
    settings = settings_for(name, arch, modes, points)
    save_weights(path, drawn(settings), card_of(settings, **changes))
    return path


@pytest.fixture(scope="session")
def shelf(tmp_path_factory):
    """Weights of all kinds and maps; relax of "mlp" for two time steps."""
    folder = tmp_path_factory.mktemp("weights")
    for name in SLOTS:
        put(folder / "mlp" / f"{name}.safetensors", name)
        put(folder / "ivnet" / f"{name}.safetensors", name, "ivnet")
        if name != "near":
            put(folder / "hybrid" / f"{name}.safetensors", name, target="residual")
    put(folder / "mlp" / "relax-1e-4.safetensors", "relax", dt=1e-4)
    return folder


@pytest.fixture
def own_shelf(shelf, tmp_path):
    """One that a test may change."""
    return shutil.copytree(shelf, tmp_path / "weights")


def the_error(folder, kind="mlp", error=ValueError, **options):
    with pytest.raises(error) as caught:
        load_maps(kind, folder, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_each_kind_takes_its_own(shelf):
    for kind in library.KINDS:
        maps = load_maps(kind, shelf)
        assert list(maps.loaded) == [slot for slot in SLOTS if not (kind == "hybrid" and slot == "near")]
        for slot, parts in maps.loaded.items():
            assert all(part.card.network.map == slot for part in parts)
            assert all(part.network.settings.arch == ("ivnet" if kind == "ivnet" else "mlp") for part in parts)
            assert all((part.base is not None) == (kind == "hybrid") for part in parts)


def test_a_base_is_of_the_cards_nodes_and_the_scenes_units(shelf):
    exact = ExactMaps(2.0, 3.0, 96, "float32")
    maps = load_maps("hybrid", shelf, kappa_b=2.0, mu=3.0, exact=exact)
    base = maps.loaded["advection"][0].base
    assert (base.points, base.kappa_b, base.mu, base.precision) == (48, 2.0, 3.0, "float32")
    assert (maps.kappa_b, maps.mu, maps.exact) == (2.0, 3.0, exact)
    assert load_maps("mlp", shelf, kappa_b=2.0, mu=3.0, slots=["relax"]).exact == ExactMaps(2.0, 3.0)


def test_corrected_maps_of_one_shape_are_built_once(shelf):
    maps, X, u = load_maps("hybrid", shelf), mild(2), np.ones((2, 2, 32))
    with counting() as counts:
        maps.self_tension(X)
        maps.flow_tension(X, u)
        maps.advect(X, u)
    assert counts["tension_matrix"] == len(X)


def test_relaxations_come_with_the_longest_step_first(shelf):
    assert [part.card.dt for part in load_maps("mlp", shelf).loaded["relax"]] == [1e-4, 1e-5]


def test_only_the_slots_asked_for_are_read(shelf, monkeypatch):
    read = []
    monkeypatch.setattr(library, "read_weights", lambda path, own=library.read_weights: read.append(path.stem) or own(path))
    assert list(load_maps("mlp", shelf, slots=["self_tension", "advection"]).loaded) == ["self_tension", "advection"]
    assert read == ["self_tension", "advection"]


def test_what_hybrid_has_no_network_for_is_exact(shelf):
    X, f = mild(2), np.ones((2, 2, 32))
    assert np.array_equal(load_maps("hybrid", shelf).near_layers(X, f), ExactMaps().near_layers(X, f))


def test_another_reduced_area(shelf):
    message = the_error(shelf, need=Need(32, 0.8))
    assert "they are for reduced area 0.65, the scene has 0.8" in message
    assert "relax" in message
    load_maps("mlp", shelf, need=Need(32, 0.654), slots=["relax"])
    assert "reduced area" in the_error(shelf, need=Need(32, 0.656))


def test_another_number_of_nodes(shelf):
    assert "they are for 32 nodes, the scene has vesicles.points = 64" in the_error(shelf, need=Need(64, 0.65))


@pytest.mark.parametrize("dt", [1e-5, 1e-4, 1.1e-4, 3e-5, 1.004e-5, 2.5e-4])
def test_time_steps_that_networks_know_or_compose(shelf, dt):
    load_maps("mlp", shelf, need=Need(32, 0.65, (dt,)), slots=["relax"])


@pytest.mark.parametrize("dt", [0.5e-5, 1.5e-5, 1.03e-5])
def test_other_time_steps_are_refused(shelf, dt):
    message = the_error(shelf, need=Need(32, 0.65, (1e-5, dt)), slots=["relax"])
    assert "dt kappa_b/(mu L^3) = 0.0001, 1e-05" in message
    assert f"the scene asks for {dt:.6g}" in message
    assert "a sum of them" in message


def test_implicit_steps_are_not_composed(tmp_path):
    put(tmp_path / "a.safetensors", "relax", relaxation="implicit")
    load_maps("mlp", tmp_path, need=Need(32, 0.65, (1e-5,)), slots=["relax"])
    assert "one of them" in the_error(tmp_path, need=Need(32, 0.65, (2e-5,)), slots=["relax"])


def test_other_maps_need_no_time_step(shelf):
    load_maps("mlp", shelf, need=Need(32, 0.65, (7e-5 / 2,)), slots=["advection"])


def test_modes_that_are_missing(tmp_path):
    put(tmp_path / "a.safetensors", "advection", "ivnet", modes=EVERY[:-1])
    message = the_error(tmp_path, "ivnet", slots=["advection"])
    assert "all of 0 to 16 are needed: merge them" in message


@pytest.mark.parametrize("slot", ["advection", "relax"])
def test_two_that_fit(own_shelf, slot):
    shutil.copy(own_shelf / "mlp" / f"{slot}.safetensors", own_shelf / "again.safetensors")
    message = the_error(own_shelf, slots=[slot])
    assert f"several weights of {slot} (mlp) that fit" in message
    assert "again.safetensors" in message
    put(own_shelf / "again.safetensors", slot, reduced_area=0.9)  # now only one
    load_maps("mlp", own_shelf, slots=[slot])


def test_nothing_there(tmp_path, shelf):
    assert "has no weights (*.safetensors)" in the_error(tmp_path, error=FileNotFoundError)
    assert "does not exist" in the_error(tmp_path / "none", error=FileNotFoundError)
    assert "no weights of near for solver.maps = 'mlp'" in the_error(shelf / "hybrid", slots=["near"])
    assert "no maps of kind 'cnn': expected one of ivnet, mlp, hybrid" in the_error(shelf, "cnn")


def test_a_bad_file_among_good_ones_is_named(own_shelf):
    (own_shelf / "bad.safetensors").write_bytes(b"no weights")
    assert "bad.safetensors is no whole safetensors file" in the_error(own_shelf)


def test_a_file_that_has_changed_is_read_anew(tmp_path):
    path = put(tmp_path / "a.safetensors", "relax")
    assert find(tmp_path)[0][1].dt == 1e-5
    put(path, "relax", dt=1e-4)
    assert find(path)[0][1].dt == 1e-4


def test_one_file_alone_will_do(shelf):
    load_maps("mlp", shelf / "mlp" / "advection.safetensors", slots=["advection"])


# --- what vesicles need


def test_needs_are_in_the_units_of_the_membranes():
    need = need_of(2.0 * mild(3), kappa_b=3.0, mu=0.5, dts=(1e-4, 5e-5))
    assert need.points == 32
    assert abs(need.reduced_area - 0.65) < 2e-3
    assert np.allclose(need.dts, [1e-4 * 3 / (0.5 * 8), 5e-5 * 3 / (0.5 * 8)], rtol=1e-12)


def test_vesicles_of_several_reduced_areas():
    X = np.stack([equilibrium(32, 0.65), equilibrium(32, 0.8)])
    with pytest.raises(ValueError, match=r"reduced areas from 0\.6.* to 0\.8.*solver.maps = \"exact\""):
        need_of(X)


def test_vesicles_of_several_lengths_are_not_relaxed_together():
    X = np.stack([mild(1)[0], 1.1 * mild(1)[0]])
    with pytest.raises(ValueError, match=r"lengths from 1 to 1\.1.*solver.maps.relax = \"exact\""):
        need_of(X, dts=(1e-5,))
    assert need_of(X).dts == ()
    assert len(need_of(np.stack([mild(1)[0], 1.003 * mild(1)[0]]), dts=(1e-5,)).dts) == 1


# --- what a scene asks for


def request_for(kinds, weights, X=None, needed=SLOTS, **changes):
    return MapsRequest(
        **{
            "kinds": {**dict.fromkeys(SLOTS, "exact"), **kinds},
            "needed": frozenset(needed),
            "weights": weights,
            "kappa_b": 1.0,
            "mu": 1.0,
            "X": mild(3) if X is None else X,
            "dt": 1e-5,
            "dts": (1e-5,),
            "adaptive": False,
            "operator_points": None,
            "dtype": "float64",
            "device": "cpu",
            "out_of_distribution": "flag",
        }
        | changes
    )


def answers(maps, X):
    u = np.cos(np.arange(X.size)).reshape(X.shape)
    return {
        "relax": maps.relax(X, 1e-5),
        "self_tension": maps.self_tension(X),
        "advection": maps.advect(X, u),
        "flow_tension": maps.flow_tension(X, u),
        "near": maps.near_layers(X, u),
    }


def test_kinds_are_mixed_by_slot(shelf):
    kinds = {"relax": "hybrid", "self_tension": "ivnet", "advection": "mlp", "near": "ivnet"}
    X = mild(3)
    got = answers(make_maps(request_for(kinds, shelf)), X)
    exact = answers(ExactMaps(), X)
    of_kind = {kind: answers(load_maps(kind, shelf), X) for kind in library.KINDS}
    for slot in SLOTS:
        if slot not in kinds:
            assert np.array_equal(got[slot], exact[slot])
            continue
        for kind, values in of_kind.items():
            assert np.array_equal(got[slot], values[slot]) == (kind == kinds[slot])
        assert not np.array_equal(got[slot], exact[slot])


def test_only_what_a_scene_needs_is_read(shelf, monkeypatch):
    read = []
    monkeypatch.setattr(library, "read_weights", lambda path, own=library.read_weights: read.append(path.stem) or own(path))
    kinds = dict.fromkeys(SLOTS, "mlp")
    X = mild(2)
    make_maps(request_for(kinds, shelf, X, needed=("advection",)))
    assert read == ["advection"]
    read.clear()
    make_maps(request_for({**kinds, "advection": "exact"}, shelf, X, needed=("advection", "self_tension")))
    assert read == ["self_tension"]


def test_units_and_limits_of_the_scene_are_passed_on(shelf):
    request = request_for(
        {"advection": "mlp"}, shelf, kappa_b=2.0, mu=3.0, operator_points=48, dtype="float32", out_of_distribution="exact"
    )
    maps = make_maps(request)
    learned = maps.slots["advection"]
    assert (learned.kappa_b, learned.mu, learned.limits) == (2.0, 3.0, "exact")
    assert learned.exact == maps.slots["relax"] == ExactMaps(2.0, 3.0, 48, "float32")


def test_time_steps_are_checked_where_relaxation_is_learned(shelf):
    with pytest.raises(ValueError, match=r"the scene asks for 3\.5e-06"):
        make_maps(request_for({"relax": "mlp"}, shelf, dts=(1e-5, 3.5e-6)))
    with pytest.raises(ValueError, match=r"time\.adaptive needs solver\.maps\.relax"):
        make_maps(request_for({"relax": "mlp"}, shelf, adaptive=True))
    make_maps(request_for({"advection": "mlp"}, shelf, dts=(1e-5, 3.5e-6), adaptive=True))
    make_maps(request_for({"advection": "mlp", "relax": "mlp"}, shelf, dts=(3.5e-6,), needed=("advection",)))


def test_vesicles_of_several_lengths_with_exact_relaxation(shelf):
    """As the message about them says."""
    X = np.stack([mild(1)[0], 1.1 * mild(1)[0]])
    with pytest.raises(ValueError, match=r"solver\.maps\.relax"):
        make_maps(request_for({"relax": "mlp", "advection": "mlp"}, shelf, X))
    assert make_maps(request_for({"advection": "mlp"}, shelf, X)).advect(X, X).shape == X.shape


def test_diagnostics_are_the_largest_over_the_makers(shelf):
    maps = make_maps(request_for({"relax": "ivnet", "advection": "mlp", "near": "mlp"}, shelf, out_of_distribution="exact"))
    assert isinstance(maps, SlotMaps)
    assert isinstance(maps, Monitored)
    X = mild(3)
    assert maps.diagnostics(X) == {"out_of_distribution": 0.0, "by_exact_maps": 0.0}  # networks that were not measured know no limit
    X_std = standardize(X)[0]
    for slot, count in (("relax", 1), ("advection", 3)):
        distribution = maps.slots[slot].loaded[slot][0].network.distribution
        distances = np.sort(distribution(torch.from_numpy(X_std)).numpy())
        distribution.limit.fill_(float(distances[-count] - 1e-9))
    with counting() as counts:
        maps.advect(X + 0.0, X)
    assert counts["by_exact_maps"] == 3
    assert maps.diagnostics(X + 0.0) == {"out_of_distribution": 3.0, "by_exact_maps": 3.0}
