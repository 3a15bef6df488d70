"""The sample of shapes in the repository: shapes of one length and area, split by run, whose labels satisfy what the maps must."""

from pathlib import Path

import numpy as np
import pytest

from biem.curves.crossing import self_crossings
from biem.curves.curve import bending_energy, centroid, d_ds, dot, length, reduced_area, speed, tangent
from biem.curves.fourier import resample
from biem.curves.pose import standardize
from datagen.config import Label
from datagen.label import label_shapes
from datagen.shapes import decode, read_shapes

SAMPLE = Path(__file__).parents[2] / "datagen" / "sample.h5"


@pytest.fixture(scope="module")
def sample():
    return read_shapes(SAMPLE)


@pytest.fixture(scope="module")
def shapes(sample):
    return decode(sample["coefficients"], 128)


def test_shapes_are_vesicles_in_the_standard_pose(shapes):
    assert shapes.shape == (500, 2, 128)
    assert np.abs(length(shapes) - 1).max() < 1e-6
    assert np.abs(reduced_area(shapes) - 0.65).max() < 2e-3
    assert np.median(np.abs(reduced_area(shapes) - 0.65)) < 1e-7
    assert np.abs(centroid(shapes)).max() < 1e-6
    assert self_crossings(shapes) == []
    assert np.abs(standardize(shapes)[0] - shapes).max() < 1e-5


def test_all_families_and_splits_are_there_and_no_run_is_in_two(sample):
    assert len(np.unique(sample["family"])) >= 12
    shares = np.bincount(sample["split"], minlength=3) / 500
    assert np.abs(shares - [0.8, 0.1, 0.1]).max() < 0.04
    pairs = np.unique(np.stack([sample["run"], sample["split"]]), axis=1)
    assert len(np.unique(pairs[0])) == pairs.shape[1]
    assert 42.85 < sample["bending_energy"].min() < 44
    assert sample["bending_energy"].max() > 150


def test_labels_of_the_sample_are_inextensible_and_relax(shapes, sample):
    """P (1 - M) e = 0 at the network's nodes, as far as these resolve it, and no shape gains bending energy."""
    calm = np.argsort(sample["bending_energy"])[10:16]
    X = shapes[calm]
    made = label_shapes(X, Label(points=64, maps=["relax", "advection"], modes=[0, 2]))
    X_std = made["X_std"].astype(float)
    for k in (0, 2):
        for part in (0, 1):
            for direction in (0, 1):
                u = made[f"advection/{k}"][:, part, direction].astype(float)
                stretching = dot(tangent(X_std), d_ds(u, speed(X_std)))
                assert np.abs(stretching).max() < 2e-3 * max(1.0, np.abs(d_ds(u, speed(X_std))).max())
    before, after = (bending_energy(resample(f, 128)) for f in (X_std, X_std + made["relax"]))
    assert (after < before).all()
