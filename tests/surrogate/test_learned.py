"""Learned maps behind the seam, with networks that know the exact maps: every rule of pose and scale, limits, steps of relaxation."""

from functools import cache

import numpy as np
import pytest
import torch
from surrogate_cases import IVNET, MLP, Exactly, N, card_of, drawn, mild, placed, settings_for, smooth_field

from biem.backend import counting, to_numpy
from biem.curves.curve import length
from biem.curves.pose import standardize
from biem.errors import NumericalFailure
from biem.membrane.maps import SLOTS, ExactMaps
from surrogate import learned
from surrogate.damping import damped, least_damping
from surrogate.learned import LearnedMaps, Loaded, composition, keeping_length

DT = 1e-5
KAPPA_B, MU, LENGTH = 0.7, 2.3, 2.5
ROUNDING = 1e-9
CASES = [(slot, arch) for slot in SLOTS for arch in ("ivnet", "mlp")]


def loaded(slot, arch="mlp", points=64, base=None, dt=DT, relaxation="implicit", units=(1.0, 1.0), network=None, damped_from=None):
    """One that knows the maps built at `points` nodes; base: nodes of exact maps that it corrects."""
    settings = settings_for(slot, arch)
    changes = {"dt": dt, "relaxation": relaxation, "damped_from": damped_from} if slot == "relax" else {}
    card = card_of(settings, target="full" if base is None else "residual", **changes)
    network = network or Exactly(settings, points, dt, base)
    return Loaded(network, card, None if base is None else ExactMaps(*units, points=base))


def answer(maps, slot, X, u, dt=DT):
    return {
        "relax": lambda: maps.relax(X, dt),
        "self_tension": lambda: maps.self_tension(X),
        "advection": lambda: maps.advect(X, u),
        "flow_tension": lambda: maps.flow_tension(X, u),
        "near": lambda: maps.near_layers(X, u),
    }[slot]()


def low(X):
    """Without the Nyquist mode, which has no standard pose."""
    X_hat = np.fft.rfft(X)
    X_hat[..., -1] = 0
    return np.fft.irfft(X_hat)


@cache
def world():
    """Curves (3, 2, N) anywhere, each turned in its own way, and velocities."""
    X = mild(3)
    places = [(0.4, (1.0, -2.0), 5), (-2.1, (-7.0, 0.3), 16), (2.9, (0.2, 11.0), 31)]
    return np.stack([placed(x, angle, center, LENGTH, shift) for x, (angle, center, shift) in zip(X, places, strict=True)]), smooth_field(3)


@pytest.mark.parametrize(("slot", "arch"), CASES)
def test_of_curves_anywhere_and_in_any_units_they_are_the_exact_maps(slot, arch):
    """Turned, moved, 2.5 long, with other first nodes, and mu and kappa_b that are not 1: each answer to rounding."""
    X, u = world()
    if slot == "near":  # they take time
        X, u = X[:1], u[:1]
    dt = DT * MU * LENGTH**3 / KAPPA_B
    maps = LearnedMaps({slot: (loaded(slot, arch),)}, KAPPA_B, MU)
    exact = ExactMaps(KAPPA_B, MU, 64)
    got, want = answer(maps, slot, X, u, dt), answer(exact, slot, X, u, dt)
    scale = np.abs(want).max()
    if slot == "advection":
        assert np.abs(got - want).max() < 1e-4 * scale
        want = keeping_length(X, want)  # by what the nodes do not resolve
    if slot == "relax":
        got, want = low(got) - low(X), low(want) - low(X)
        scale = np.abs(want).max()
    assert scale > 1e-4
    assert np.abs(got - want).max() < (1e-6 if slot == "near" else ROUNDING) * scale  # near layers are to a tolerance
    assert np.abs(want - answer(ExactMaps(1.0, 1.0, 64), slot, X, u, dt)).max() > 0.1 * scale or slot == "advection"


@pytest.mark.parametrize("slot", SLOTS)
def test_of_a_parameter_shifted_by_a_part_of_a_node_they_are_nearly_the_exact_maps(slot):
    """Which are themselves not those of the shifted curve but for what the nodes do not resolve."""
    M = 1 if slot == "near" else 3
    X, u = mild(M), smooth_field(M)
    shift = np.exp(1j * 0.37 * 2 * np.pi / N * np.arange(N // 2 + 1))
    X, u = (np.fft.irfft(shift * np.fft.rfft(a)) for a in (X, u))
    dt = DT * MU / KAPPA_B
    got = answer(LearnedMaps({slot: (loaded(slot),)}, KAPPA_B, MU), slot, X, u, dt)
    want = answer(ExactMaps(KAPPA_B, MU, 64), slot, X, u, dt)
    if slot == "relax":
        got, want = low(got) - low(X), low(want) - low(X)
    assert np.abs(got - want).max() < 2e-2 * np.abs(want).max()
    assert np.linalg.norm(got - want) < 1e-2 * np.linalg.norm(want)


@pytest.mark.parametrize(("slot", "arch"), [case for case in CASES if case[0] != "near"])
def test_a_residual_and_its_base_are_the_exact_maps(slot, arch):
    X, u = world()
    dt = DT * MU * LENGTH**3 / KAPPA_B
    maps = LearnedMaps({slot: (loaded(slot, arch, base=32, units=(KAPPA_B, MU)),)}, KAPPA_B, MU)
    got, want = answer(maps, slot, X, u, dt), answer(ExactMaps(KAPPA_B, MU, 64), slot, X, u, dt)
    coarse = answer(ExactMaps(KAPPA_B, MU, 32), slot, X, u, dt)
    if slot == "relax":
        got, want, coarse = got - X, want - X, coarse - X
    scale = np.abs(want).max()
    assert np.abs(got - want).max() < ROUNDING * scale
    assert np.abs(coarse - want).max() > 1e4 * ROUNDING * scale


@pytest.mark.parametrize("relaxation", ["implicit", "converged"])
def test_high_modes_of_a_full_network_relax_as_on_a_circle(relaxation):
    X, _ = world()
    X_next = LearnedMaps({"relax": (loaded("relax", relaxation=relaxation, damped_from=11),)}, KAPPA_B, MU).relax(
        X, DT * MU * LENGTH**3 / KAPPA_B
    )
    rate = DT * (2 * np.pi * np.arange(N // 2 + 1)) ** 3 / 4
    factor = np.exp(-rate) if relaxation == "converged" else 1 / (1 + rate)
    got, X_hat = np.fft.rfft(X_next)[..., 11:16], np.fft.rfft(X)[..., 11:16]
    assert np.abs(got - factor[11:16] * X_hat).max() < 1e-10 * np.abs(X_hat).max() + 1e-14
    assert factor[11] < 0.6


def test_damping_leaves_low_modes_alone():
    generator = torch.Generator().manual_seed(0)
    for n, first in ((32, 11), (64, 22)):
        X, Z = (torch.randn((2, 2, n), generator=generator, dtype=torch.float64) for _ in range(2))
        for converged in (True, False):
            relaxation = "converged" if converged else "implicit"
            card = card_of(settings_for("relax"), dt=1e-4, relaxation=relaxation, damped_from=first)
            out = torch.fft.rfft(damped(Z, X, card))
            assert (out - torch.fft.rfft(Z))[..., :first].abs().max() < 1e-13
            rate = 0.25e-4 * (2 * np.pi * torch.arange(first, n // 2 + 1, dtype=torch.float64)) ** 3
            change = torch.exp(-rate) - 1 if converged else -rate / (1 + rate)
            assert (out[..., first:] - change * torch.fft.rfft(X)[..., first:]).abs().max() < 1e-12


@pytest.mark.parametrize(("stable_from", "choice"), [(99, 15), (14, 13), (0, 11)])
def test_as_much_damping_as_stability_takes_and_no_more(stable_from, choice):
    """A relaxation that makes its undamped modes from `stable_from` on grow a little, step by step."""

    def relax(damped_from):
        def step(X, dt):
            z = np.fft.rfft(X)
            high = slice(min(stable_from, 16), min(damped_from, 16))
            z[..., high] = 1.5 * z[..., high] + 1e-4
            return np.fft.irfft(z, n=X.shape[-1])

        return step

    assert least_damping(relax, mild(3), 1e-5) == choice


# --- steps


@pytest.mark.parametrize(
    ("dt", "known", "times", "rest"),
    [
        (1.0, [1.0], [1], 0.0),
        (3.0, [1.0], [3], 0.0),
        (0.5, [1.0], [0], 0.5),
        (1.5, [1.0], [1], 0.5),
        (0.993, [1.0], [1], 0.0),
        (0.98, [1.0], [0], 0.98),
        (1.007, [1.0], [1], 0.0),
        (2.2, [1.0, 0.1], [2, 2], 0.0),
        (2.2, [0.1, 1.0], [2, 2], 0.0),
        (2.25, [1.0, 0.1], [2, 2], 0.05),
        (9.99, [1.0], [10], 0.0),
        (0.3, [], [], 0.3),
    ],
)
def test_a_step_is_composed_of_known_ones_the_longest_first(dt, known, times, rest):
    found, left = composition(dt, known)
    assert found == times
    assert left == pytest.approx(rest, abs=1e-12)


def test_long_relaxations_are_composed_and_their_rest_is_exact_and_counted():
    X, _ = world()
    unit = DT * MU * LENGTH**3 / KAPPA_B
    parts = tuple(loaded("relax", dt=dt, relaxation="converged", base=32, units=(KAPPA_B, MU)) for dt in (4 * DT, DT))
    maps = LearnedMaps({"relax": parts}, KAPPA_B, MU, ExactMaps(KAPPA_B, MU, 64))
    exact = ExactMaps(KAPPA_B, MU, 64)
    with counting() as counts:
        got = maps.relax(X, 9.5 * unit)
    want = X
    for steps in (4, 4, 1, 0.5):
        want = exact.relax(want, steps * unit)
    assert counts["relaxation_rest_by_exact_maps"] == 3
    assert [len(part.network.seen) for part in parts] == [2, 1]
    assert np.abs(got - want).max() < 1e-4 * np.abs(want - X).max()  # later curves are not at whole nodes of the standard pose
    with counting() as counts:
        maps.relax(X, 8 * unit)
    assert "relaxation_rest_by_exact_maps" not in counts


def test_a_time_step_is_that_of_the_membranes_length():
    """Twice as long, it is eight times as long a step."""
    part = loaded("relax")
    maps = LearnedMaps({"relax": (part,)}, 2.0, 0.5)
    with counting() as counts:
        maps.relax(2.0 * mild(2), DT * 8 * 0.5 / 2.0)
    assert "relaxation_rest_by_exact_maps" not in counts
    with counting() as counts:
        maps.relax(mild(2), 0.4 * DT * 0.5 / 2.0)
    assert counts["relaxation_rest_by_exact_maps"] == 2


# --- what a network is given, and how often


def test_networks_are_given_the_standard_pose_once_for_one_curve():
    X, u = world()
    part = loaded("advection")
    maps = LearnedMaps({"advection": (part,)})
    first = maps.advect(X, u)
    maps.advect(X, 2 * u)
    assert len(part.network.seen) == 1
    assert np.abs(part.network.seen[0].numpy() - mild(3)).max() < 1e-12
    assert np.array_equal(maps.advect(X + 0.0, u), first)
    assert len(part.network.seen) == 2


def test_curves_that_take_turns_are_standardized_once(monkeypatch):
    """As those of a step do: all vesicles, those with near pairs, those that are being moved."""
    X, u = world()
    curves, poses = [X + k for k in range(4)], []
    monkeypatch.setattr(learned, "standardize", lambda X: poses.append(X) or standardize(X))
    maps = LearnedMaps({slot: (loaded(slot),) for slot in ("advection", "flow_tension")})
    for _ in range(3):
        for Y in curves:
            maps.advect(Y, u)
            maps.flow_tension(Y, u)
    assert len(poses) == 4


def network_maps(kinds=None, limits="flag", base=None, seed=1):
    """Maps by networks of random weights; base: of all but near."""
    found = {}
    for slot in SLOTS:
        arch = (kinds or {}).get(slot, "mlp")
        network = drawn(settings_for(slot, arch, **(IVNET if arch == "ivnet" else MLP)), seed)
        found[slot] = (loaded(slot, arch, base=None if slot == "near" else base, network=network),)
    return LearnedMaps(found, limits=limits, exact=ExactMaps(points=32))


@pytest.mark.parametrize("kind", ["ivnet", "mlp", "hybrid"])
def test_rigid_motions_are_followed_whatever_the_networks_say(kind):
    """However fast: a vesicle far from the origin of a flow moves much faster than it deforms."""
    X, _ = world()
    maps = network_maps(dict.fromkeys(SLOTS, "ivnet" if kind == "ivnet" else "mlp"), base=48 if kind == "hybrid" else None)
    r = X - X.mean(axis=-1, keepdims=True)
    u = 1e3 * np.array([1.0, -2.0])[:, None] + 30.0 * np.stack([-r[:, 1], r[:, 0]], axis=1)
    assert np.abs(maps.advect(X, u) - u).max() < 1e-9 * np.abs(u).max()
    few = smooth_field(3)
    shifted = maps.flow_tension(X, few + u)
    assert np.abs(shifted - maps.flow_tension(X, few)).max() < 1e-5 * np.abs(shifted).max()


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
def test_lengths_stay_whatever_the_networks_say(arch):
    X, u = world()
    v = network_maps(dict.fromkeys(SLOTS, arch)).advect(X, u)
    before, after = (length(X + step * v) for step in (-1e-6, 1e-6))
    assert np.abs(after - before).max() < 1e-5 * 2e-6 * np.abs(v).max()


@pytest.mark.parametrize("kind", ["ivnet", "mlp", "hybrid"])
def test_numpy_and_torch_arrays_give_the_same(kind):
    X, u = mild(3), smooth_field(3)
    maps = network_maps(dict.fromkeys(SLOTS, "ivnet" if kind == "ivnet" else "mlp"), base=32 if kind == "hybrid" else None)
    for slot in SLOTS:
        a = answer(maps, slot, X, u)
        b = answer(maps, slot, torch.from_numpy(X), torch.from_numpy(u))
        assert isinstance(a, np.ndarray)
        assert isinstance(b, torch.Tensor)
        assert a.dtype == np.float64
        assert b.dtype == torch.float64
        assert np.abs(a - to_numpy(b)).max() < 1e-5 * np.abs(a).max()


@pytest.mark.parametrize("arch", ["ivnet", "mlp"])
def test_any_number_of_vesicles_gives_the_same(arch):
    """More than a chunk, less, and one."""
    one, velocity = mild(3), smooth_field(3)
    X, u = (np.concatenate([a] * 100) for a in (one, velocity))
    maps = network_maps(dict.fromkeys(SLOTS, arch))
    for slot in ("relax", "self_tension", "advection", "flow_tension") + (("near",) if arch == "mlp" else ()):
        few = answer(maps, slot, one, velocity)
        for m in (300, 1):
            many = answer(maps, slot, X[:m], u[:m])
            assert many.shape == (m, *few.shape[1:])
            assert np.abs(many - np.concatenate([few] * 100)[:m]).max() < 1e-5 * np.abs(few).max()


def test_vesicles_do_not_see_each_other():
    X, u = mild(3), smooth_field(3)
    maps = network_maps()
    Y = X.copy()
    Y[1] = mild(6)[4]
    for slot in SLOTS:
        a, b = answer(maps, slot, X, u), answer(maps, slot, Y, u)
        assert np.abs(a - b)[[0, 2]].max() < 1e-6 * np.abs(a).max()
        assert np.abs(a - b)[1].max() > 1e-4 * np.abs(a).max()


# --- limits


def limited_maps(limits, outside=1):
    """Maps by which the so many strangest of three curves are outside."""
    maps = network_maps(limits=limits)
    distribution = maps.loaded["relax"][0].network.distribution
    distribution.measure(torch.from_numpy(mild(25)))
    distances = distribution(torch.from_numpy(mild(3)))
    distribution.limit.copy_(torch.sort(distances).values[2 - outside : 4 - outside].mean())
    return maps, np.flatnonzero((distances > distribution.limit).numpy())


@pytest.mark.parametrize("arrays", [np.asarray, torch.from_numpy])
@pytest.mark.parametrize("slot", SLOTS)
def test_vesicles_outside_are_answered_by_exact_maps_where_asked_for(slot, arrays):
    flag, which = limited_maps("flag")
    exactly, _ = limited_maps("exact")
    assert len(which) == 1
    X, u = (arrays(a) for a in world())
    with counting() as counts:
        by_networks = to_numpy(answer(flag, slot, X, u, DT * LENGTH**3))
    assert "by_exact_maps" not in counts
    with counting() as counts:
        got = to_numpy(answer(exactly, slot, X, u, DT * LENGTH**3))
    assert counts["by_exact_maps"] == 1
    want = to_numpy(answer(ExactMaps(points=32), slot, X, u, DT * LENGTH**3))
    inside = np.setdiff1d(np.arange(3), which)
    assert np.abs(got[inside] - by_networks[inside]).max() == 0
    assert np.abs(got[which] - want[which]).max() < 1e-12 * np.abs(want).max()
    assert np.abs(want - by_networks)[which].max() > 1e-6 * np.abs(want).max()


def test_refused_vesicles_are_named():
    maps, which = limited_maps("refuse", outside=2)
    X, u = world()
    for slot in SLOTS:
        with pytest.raises(NumericalFailure, match=rf"vesicle {which[0]} \(and 1 more\) is unlike the shapes"):
            answer(maps, slot, X + 0.0, u, DT * LENGTH**3)
    inside = np.setdiff1d(np.arange(3), which)
    assert maps.advect(X[inside], u[inside]).shape == (1, 2, N)


@pytest.mark.parametrize(("limits", "by_exact_maps"), [("flag", 0.0), ("exact", 2.0)])
def test_diagnostics_count_vesicles_outside_wherever_they_are(limits, by_exact_maps):
    maps, _ = limited_maps(limits, outside=2)
    X, _ = world()
    assert maps.diagnostics(mild(3)) == maps.diagnostics(X) == {"out_of_distribution": 2.0, "by_exact_maps": by_exact_maps}


def test_a_map_that_is_not_loaded_is_none():
    maps = LearnedMaps({"relax": (loaded("relax"),)})
    with pytest.raises(KeyError):
        maps.self_tension(mild(1))


def test_the_layers_of_a_constant_force_know_the_length():
    """S of a constant density is not that of length 1 by a factor alone: the logarithm adds its constant."""
    X = LENGTH * mild(1)
    f = np.stack([np.ones((1, N)), np.zeros((1, N))], axis=1)
    maps = LearnedMaps({"near": (loaded("near"),)}, mu=MU)
    got = maps.near_layers(X, f)
    of_one = LearnedMaps({"near": (loaded("near"),)}).near_layers(mild(1), f)
    constant = -float(length(X)[0]) * np.log(LENGTH) / (4 * np.pi * MU)
    expected = of_one * LENGTH / MU + constant * np.array([1.0, 0.0])[:, None]
    assert np.abs(got - expected).max() < 1e-12
    assert abs(constant) > 0.05
