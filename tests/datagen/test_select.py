"""Selection: the same as brute force, whatever the parts; runs stay together in the splits."""

import itertools

import numpy as np
import pytest
from drawn_shapes import groups_of_shapes

from biem.curves.curve import bending_energy
from datagen import select as module
from datagen.config import Dataset
from datagen.hausdorff import descriptors, distance, polygons
from datagen.select import check_fractions, select, split_of_runs, thin
from datagen.shapes import decode, encode

MODES = 32
RUNS, EACH = 10, 12
COLUMNS = {"run": np.int64, "family": np.int64, "time": np.float64, "capillary": np.float64}


def dataset(seed=0, **options):
    return Dataset(name="test", seed=seed, shapes={"modes": MODES}, harvest=[{"flow": "shear", "runs": 100}], select=options)


def harvested(X, run, family=None, time=None):
    """A part with one shape after another; family 0, times 0, 1, ... where they are not given."""
    n = len(X)
    run = np.broadcast_to(run, n).astype(np.int64)
    family = np.broadcast_to(0 if family is None else family, n).astype(np.int64)
    time = np.arange(n, dtype=float) if time is None else time
    return {"X": X, "run": run, "family": family, "time": time, "capillary": 0.5 + run}


def cut(part, at):
    return [{name: values[a:b] for name, values in part.items()} for a, b in itertools.pairwise([0, *at, len(part["run"])])]


@pytest.fixture(scope="module")
def cloud():
    """10 runs of 12 shapes, of four groups, so that shapes of several runs lie close together; two families."""
    X = groups_of_shapes(groups=4, each=RUNS * EACH // 4, spread=0.06, seed=3)
    run = np.random.default_rng(1).permutation(np.repeat(np.arange(RUNS), EACH))
    order = np.argsort(run, kind="stable")
    part = harvested(X[order], run[order], run[order] % 2)
    P = polygons(encode(part["X"], MODES))
    d = np.zeros((len(P), len(P)))
    for i, j in itertools.combinations(range(len(P)), 2):
        d[i, j] = d[j, i] = distance(P[i], P[j])
    return part, d


def greedy(d, threshold, order):
    kept = []
    for i in order:
        if not any(d[i, j] < threshold[i] for j in kept):
            kept.append(i)
    return np.sort(kept)


@pytest.mark.parametrize("options", [{"distance": 4e-3}, {"distance": 8e-3}, {"distance": 8e-3, "hard_distance": 3e-3}, {"distance": 0.2}])
@pytest.mark.parametrize("chunk", [1024, 17])
def test_selection_is_that_of_brute_force(cloud, options, chunk, monkeypatch):
    """Over all pairs, in the same random order, whether shapes come to lie in one chunk or not."""
    part, d = cloud
    monkeypatch.setattr(module, "CHUNK", chunk)
    config = dataset(**options, hard_above=0.7, fractions=(1, 0, 0))
    energy = bending_energy(decode(encode(part["X"], MODES), 256))
    hard = energy > np.quantile(energy, 0.7)
    threshold = np.where(hard, options.get("hard_distance", options["distance"]), options["distance"])
    expected = greedy(d, threshold, np.random.default_rng([0, 0]).permutation(len(d)))
    selected = select(config, [part])
    assert (selected["time"] == part["time"][expected]).all()
    assert (d[:, expected].min(axis=1) <= threshold).all()
    if options == {"distance": 8e-3}:
        assert 20 < len(expected) < 100
        assert d[np.ix_(expected, expected)][np.triu_indices(len(expected), 1)].min() >= 8e-3
    if options == {"distance": 0.2}:
        assert len(expected) == 1


def test_what_is_handed_on(cloud):
    part, _ = cloud
    selected = select(dataset(distance=4e-3), [part])
    rows = selected["time"].astype(int)  # times are the rows
    assert (np.diff(rows) > 0).all()
    for name, dtype in COLUMNS.items():
        assert selected[name].dtype == dtype
        assert (selected[name] == part[name][rows]).all()
    assert selected["coefficients"].dtype == np.complex64
    assert selected["coefficients"].shape == (len(rows), 2 * MODES)
    assert np.abs(decode(selected["coefficients"], 128) - part["X"][rows]).max() < 1e-7
    assert selected["bending_energy"].dtype == np.float32
    assert selected["bending_energy"] == pytest.approx(bending_energy(part["X"][rows]), rel=1e-4)
    assert selected["split"].dtype == np.int8
    assert set(selected) == {"coefficients", "split", "bending_energy", *COLUMNS}


def test_parts_make_no_difference(cloud):
    """Bytes are the same however the shapes are cut and in whatever order the parts come; another seed gives another selection."""
    part, _ = cloud
    one = select(dataset(distance=4e-3), [part])
    runs = np.flatnonzero(np.diff(part["run"])) + 1
    for parts in (cut(part, [1, 77, 77, 110]), cut(part, runs)[::-1], cut(part, range(1, len(part["run"])))):
        other = select(dataset(distance=4e-3), iter(parts))
        assert all(one[name].tobytes() == other[name].tobytes() and one[name].dtype == other[name].dtype for name in one)
    other = select(dataset(seed=1, distance=4e-3), [part])
    assert set(other["time"]) != set(one["time"])


def test_order_is_by_run_then_time():
    X = groups_of_shapes(groups=6, each=1, spread=0.0)
    part = harvested(X, [4, 2, 4, 2, 4, 2], time=np.array([1.0, 3.0, 0.0, 3.0, 1.0, 2.0]))
    selected = select(dataset(distance=0.0, fractions=(1, 0, 0)), cut(part, [3]))
    expected = [5, 1, 3, 2, 0, 4]  # of equal run and time, the one that came first
    assert selected["run"].tolist() == [2, 2, 2, 4, 4, 4]
    assert (selected["coefficients"] == encode(X[expected], MODES)).all()


def test_copies_leave_one():
    X = np.repeat(groups_of_shapes(groups=2, each=1, spread=0.0), [3000, 1], axis=0)
    part = harvested(X, np.arange(3001) // 100)
    selected = select(dataset(distance=1e-9, fractions=(1, 0, 0)), [part])
    assert len(selected["run"]) == 2
    assert len(select(dataset(distance=0.0), [part])["run"]) == 3001
    with pytest.raises(ValueError, match=r"^1 run has shapes that are kept, for select.fractions = \(0.8, 0.1, 0.1\): .*harvest more runs"):
        select(dataset(distance=1e-9), [{name: values[:3000] for name, values in part.items()}])


def test_hard_shapes_are_kept_at_their_own_distance(cloud):
    """Their share rises; with hard_distance 0 all of them are kept."""
    part, d = cloud
    energy = bending_energy(part["X"])
    hard_above = np.quantile(energy, 0.8)

    def share(**options):
        return (select(dataset(distance=1e-2, hard_above=0.8, **options), [part])["bending_energy"] > hard_above).mean()

    same, denser, all_of_them = share(), share(hard_distance=6e-3), share(hard_distance=0.0)
    assert share(hard_distance=1e-2) == same
    assert same < 0.6 * denser < 0.6 * all_of_them
    kept = select(dataset(distance=1e-2, hard_above=0.8, hard_distance=0.0), [part])
    assert (kept["bending_energy"] > hard_above).sum() == (energy > hard_above).sum() == len(d) // 5


def test_most_is_drawn_from_the_kept_shapes(cloud):
    part, _ = cloud
    kept = select(dataset(distance=4e-3), [part])
    fewer = select(dataset(distance=4e-3, most=50), [part])
    assert len(fewer["run"]) == 50 < len(kept["run"])
    assert set(fewer["time"]) < set(kept["time"])
    assert select(dataset(distance=4e-3, most=1000), [part])["time"].tolist() == kept["time"].tolist()
    at = np.searchsorted(kept["time"], fewer["time"]) / len(kept["time"])
    assert at.mean() == pytest.approx(0.5, abs=0.15)  # from all runs alike


def test_runs_stay_together_and_families_are_shared_out(cloud):
    part, _ = cloud
    selected = select(dataset(distance=4e-3, fractions=(0.5, 0.25, 0.25)), [part])
    split = {run: set(selected["split"][selected["run"] == run]) for run in np.unique(selected["run"])}
    assert all(len(s) == 1 for s in split.values())
    of = np.array([next(iter(split[run])) for run in range(RUNS)])
    assert np.bincount(of).tolist() == [5, 3, 2]
    assert all(np.bincount(of[family::2], minlength=3).min() >= 1 for family in (0, 1))
    assert set(selected["split"].tolist()) == {0, 1, 2}


def test_runs_without_kept_shapes_do_not_count():
    """Of 20 runs, 17 are copies of one: 4 remain to be shared out."""
    X = groups_of_shapes(groups=4, each=1, spread=0.0)[np.minimum(np.arange(20), 3)]
    selected = select(dataset(distance=1e-6, fractions=(0.5, 0.25, 0.25)), [harvested(X, np.arange(20))])
    assert len(np.unique(selected["run"])) == 4
    assert np.bincount(selected["split"]).tolist() == [2, 1, 1]


@pytest.mark.parametrize(
    ("runs", "fractions", "expected"),
    [
        (100, (0.8, 0.1, 0.1), [80, 10, 10]),
        (3, (0.8, 0.1, 0.1), [1, 1, 1]),
        (7, (0.8, 0.1, 0.1), [5, 1, 1]),
        (15, (0.8, 0.1, 0.1), [12, 2, 1]),
        (100, (0.29, 0.71, 0.0), [29, 71, 0]),
        (1, (0.0, 0.0, 1.0), [0, 0, 1]),
        (2, (0.99, 0.0, 0.01), [1, 0, 1]),
    ],
)
def test_numbers_of_runs(runs, fractions, expected):
    split = split_of_runs(np.arange(runs), np.zeros(runs, int), fractions, np.random.default_rng(0))
    assert np.bincount(split, minlength=3).tolist() == expected


def test_split_is_random_by_its_seed_and_even_in_each_family():
    """Five families of 40, 3, 1, 20, 36 runs; those too small for all splits are in fewer."""
    family = np.repeat(np.arange(5), [40, 3, 1, 20, 36])
    run = np.arange(100)
    one, same, other = (split_of_runs(run, family, (0.8, 0.1, 0.1), np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert (one == same).all()
    assert (one != other).sum() > 10
    for split in (one, other):
        assert np.bincount(split).tolist() == [80, 10, 10]
        for f, n in enumerate((40, 3, 1, 20, 36)):
            assert np.abs(np.bincount(split[family == f], minlength=3) - n * np.array([0.8, 0.1, 0.1])).max() <= 2
    shuffled = np.random.default_rng(2).permutation(100)
    assert (split_of_runs(run[shuffled], family[shuffled], (0.8, 0.1, 0.1), np.random.default_rng(0)) == one[shuffled]).all()


@pytest.mark.parametrize("fractions", [(0.8, 0.1, 0.2), (1.1, -0.1, 0.0), (0.8, 0.1, 0.1 + 1e-8)])
def test_fractions_are_checked_before_anything_else(fractions):
    with pytest.raises(ValueError, match=r"select.fractions = .*expected numbers of at least 0 that sum to 1"):
        select(dataset(fractions=fractions), iter([]))


def test_fractions_within_rounding():
    check_fractions((0.7, 0.2, 0.1))
    check_fractions((1 / 3, 1 / 3, 1 / 3 + 1e-10))


def test_bad_shapes_are_named(cloud):
    part, _ = cloud
    parts = cut(part, [40, 90])
    X = parts[1]["X"].copy()
    X[7, 1, 3] = np.nan
    with pytest.raises(ValueError, match=rf"^run {parts[1]['run'][7]}, row 7 of part 1: .*not finite.*harvest this part again$"):
        select(dataset(), [parts[0], {**parts[1], "X": X}, parts[2]])
    nothing = {name: values[:0] for name, values in part.items()}
    with pytest.raises(ValueError, match=r"^2 parts without a single shape: .*runs go on for longer"):
        select(dataset(), [nothing, nothing])
    assert select(dataset(distance=4e-3), [nothing, part])["run"].size > 3  # a task whose runs all ended
    with pytest.raises(ValueError, match=r"^run 3 has shapes of several families"):
        split_of_runs(np.array([1, 3, 3, 4]), np.array([0, 0, 1, 1]), (1, 0, 0), np.random.default_rng(0))


def test_order_decides_which_copies_are_kept():
    """The first of each group in the order that is given, not the first in the file."""
    X = groups_of_shapes(groups=3, each=1, spread=0.0)
    c = encode(X[[0, 1, 2, 0, 1, 2]], MODES)
    D = descriptors(polygons(c))
    for order, kept in (([0, 1, 2, 3, 4, 5], [0, 1, 2]), ([5, 4, 0, 1, 2, 3], [0, 4, 5])):
        assert thin(c, D, np.full(6, 1e-4), np.array(order)).tolist() == kept
