"""Coverage: numbers that add up and agree with brute force, files that are the same every time, a picture that shows something."""

import json

import numpy as np
import pytest
from drawn_shapes import groups_of_shapes
from PIL import Image

from biem.curves.curve import bending_energy, curvature
from datagen import coverage
from datagen.config import SPLITS
from datagen.coverage import report, summary
from datagen.hausdorff import distance, polygons
from datagen.shapes import decode, encode


def kept(X, family, run, split):
    """What shapes.h5 holds of it."""
    of_shape = lambda values, dtype: np.broadcast_to(values, len(X)).astype(dtype)
    return {
        "coefficients": encode(X, 32),
        "run": of_shape(run, np.int64),
        "family": of_shape(family, np.int64),
        "time": np.arange(len(X), dtype=np.float64),
        "capillary": np.ones(len(X)),
        "split": of_shape(split, np.int8),
        "bending_energy": bending_energy(X).astype(np.float32),
    }


@pytest.fixture(scope="module")
def shapes():
    """60 shapes of 20 runs and of families 0, 2; family 2 has none for validation."""
    run = np.arange(60) // 3
    family = np.where(run < 12, 0, 2)
    split = np.where(run < 8, 0, np.where(run < 12, 1, np.where(run < 16, 2, 0)))
    return kept(groups_of_shapes(groups=5, each=12, spread=0.05, seed=8), family, run, split)


@pytest.fixture(scope="module")
def reported(shapes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("coverage")
    return report(shapes, folder, 0), folder


def test_numbers_add_up(reported):
    stats, folder = reported
    assert stats == json.loads((folder / "coverage.json").read_text())
    assert stats["shapes"] == 60
    assert stats["families"] == {
        "0": {"train": 24, "validation": 12, "test": 0},
        "2": {"train": 12, "validation": 0, "test": 12},
    }
    assert stats["runs"] == {"train": 12, "validation": 4, "test": 4}
    for name in ("bending_energy", "largest_curvature", "nearest_distance"):
        counts, edges = np.array(stats[name]["counts"]), np.array(stats[name]["edges"])
        assert counts.sum(axis=1).tolist() == [36, 24]
        assert (np.diff(edges) > 0).all()
        assert edges[0] == stats[name]["quantiles"]["0"]
        assert edges[-1] == stats[name]["quantiles"]["1"]
        assert min(counts.sum(axis=0)[[0, -1]]) >= 1


def test_numbers_are_those_of_brute_force(shapes, reported):
    stats, _ = reported
    P = polygons(shapes["coefficients"])
    nearest = [min(distance(P[i], P[j]) for j in range(60) if j != i) for i in range(60)]
    largest = np.abs(curvature(decode(shapes["coefficients"], 8192))).max(axis=1)
    for name, values in (("bending_energy", shapes["bending_energy"]), ("largest_curvature", largest), ("nearest_distance", nearest)):
        assert stats[name]["shapes"] == 60
        for q, value in stats[name]["quantiles"].items():
            assert value == pytest.approx(np.quantile(values, float(q)), rel=2e-3)  # the largest curvature is that at the nodes
    counts, _ = np.histogram(shapes["bending_energy"].astype(float), stats["bending_energy"]["edges"])
    assert np.array(stats["bending_energy"]["counts"]).sum(axis=0).tolist() == counts.tolist()


def test_files_are_the_same_every_time(shapes, reported, tmp_path):
    report(shapes, tmp_path / "new", 0)
    for folder in (tmp_path / "new", reported[1]):
        assert {file.name for file in folder.iterdir()} == {"coverage.json", "coverage.png"}
    for name in ("coverage.json", "coverage.png"):
        assert (tmp_path / "new" / name).read_bytes() == (reported[1] / name).read_bytes()


def test_sample_is_drawn_by_the_seed(shapes, reported, tmp_path, monkeypatch):
    """A few shapes for their neighbours, which are sought among all; another seed draws others."""
    everyone = reported[0]["nearest_distance"]["quantiles"]
    monkeypatch.setattr(coverage, "SAMPLE", 10)
    one, other = (report(shapes, tmp_path, seed) for seed in (0, 1))
    assert one["nearest_distance"]["shapes"] == 10 == np.sum(one["nearest_distance"]["counts"])
    assert one["nearest_distance"]["quantiles"] != other["nearest_distance"]["quantiles"]
    assert one["bending_energy"] == other["bending_energy"]
    for sampled in (one, other):
        assert everyone["0"] <= sampled["nearest_distance"]["quantiles"]["0"]
        assert sampled["nearest_distance"]["quantiles"]["1"] <= everyone["1"]


def test_picture_shows_every_family(reported):
    with Image.open(reported[1] / "coverage.png") as image:
        assert image.format == "PNG"
        shown = np.asarray(image.convert("RGB"), dtype=int)
    assert 800 < min(shown.shape[:2]) <= max(shown.shape[:2]) < 2000
    below = shown[2 * len(shown) // 5 :]
    for color in ([31, 119, 180], [255, 127, 14]):  # C0 and C1: the histograms above, the shapes below
        assert (shown == color).all(axis=-1).mean() > 0.01
        assert (below == color).all(axis=-1).mean() > 0.01
    assert not (shown == [44, 160, 44]).all(axis=-1).any()  # C2
    assert (below[-len(below) // 4 :] < 200).any()  # the hardest ones


def test_summary(shapes, tmp_path):
    stats = report(shapes, tmp_path, 0, ["relaxation", "extensional", "shear"])
    lines = summary(stats)
    assert lines[0] == "train 36 shapes of 12 runs, validation 12 shapes of 4 runs, test 12 shapes of 4 runs"
    assert lines[1] == "shapes of family 0 relaxation: 36, 2 shear: 24"
    energy = shapes["bending_energy"].astype(float)
    assert lines[2] == f"bending energy: {energy.min():.3g} to {energy.max():.3g}, half of them below {np.median(energy):.3g}"
    assert len(lines) == 5
    assert all("\n" not in line and len(line) < 140 for line in lines)


def test_one_shape_and_copies(tmp_path):
    """One shape has no neighbour; copies have neighbours at distance 0."""
    X = groups_of_shapes(groups=1, each=1, spread=0.0)
    stats = report(kept(X, 0, 0, SPLITS.index("test")), tmp_path, 0)
    assert stats["nearest_distance"]["shapes"] == 0 == np.sum(stats["nearest_distance"]["counts"])
    assert stats["families"] == {"0": {"train": 0, "validation": 0, "test": 1}}
    assert len(summary(stats)) == 4
    stats = report(kept(np.repeat(X, 5, axis=0), 0, np.arange(5), 0), tmp_path, 0)
    assert set(stats["nearest_distance"]["quantiles"].values()) == {0.0}
    assert np.sum(stats["nearest_distance"]["counts"]) == 5
    assert np.sum(stats["bending_energy"]["counts"]) == 5


def test_no_shapes(shapes, tmp_path):
    with pytest.raises(ValueError, match="there are no shapes"):
        report({name: values[:0] for name, values in shapes.items()}, tmp_path, 0)
    assert not any(tmp_path.iterdir())
