"""Files of pairs: what they are of, and each way in which one may not do is one line."""

import json
import shutil

import h5py
import numpy as np
import pytest
from surrogate_cases import EVERY, arrays_of, write_pairs

from datagen.config import Label
from datagen.manifest import Manifest
from datagen.shards import join_shards, write_shard
from surrogate.pairs import open_pairs


@pytest.fixture
def own_pairs(pairs_path, tmp_path):
    """Ones that a test may change."""
    for path in (pairs_path, pairs_path.with_suffix(".json")):
        shutil.copy(path, tmp_path / path.name)
    return tmp_path / pairs_path.name


@pytest.fixture
def joined(pairs_path, tmp_path):
    """The same as virtual datasets over three shards, as labelling leaves them."""
    arrays, made, columns = arrays_of(pairs_path), [], {}
    (tmp_path / "labels").mkdir()
    for k in range(3):
        shard, columns = write_shard(tmp_path / "labels" / f"{k:06d}.h5", {name: a[16 * k : 16 * (k + 1)] for name, a in arrays.items()})
        made.append(shard)
    manifest = Manifest(stage="label", settings={}, input="", tasks=3, columns=columns, shards=made)
    join_shards(tmp_path / "pairs.h5", tmp_path / "labels", manifest)
    shutil.copy(pairs_path.with_suffix(".json"), tmp_path / "pairs.json")
    return tmp_path / "pairs.h5"


def the_error(path, kind=ValueError):
    with pytest.raises(kind) as caught:
        open_pairs(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_pairs_are_of(pairs):
    label = Label()
    assert (pairs.points, pairs.operator_points, pairs.dt, pairs.relaxation) == (32, 128, label.dt, "implicit")
    assert pairs.reduced_area == 0.65
    assert pairs.modes == EVERY
    assert np.bincount(pairs.split).tolist() == [32, 8, 8]
    assert len(pairs.digest) == 64


def test_joined_shards_read_as_one_file(joined, pairs):
    found = open_pairs(joined)
    rows = np.array([3, 17, 18, 40])
    for whole in (False, True):
        for name in ("X_std", "advection/3"):
            assert np.array_equal(found.read(name, rows, whole), pairs.read(name, rows))


def test_a_shard_that_is_missing(joined):
    (joined.parent / "labels" / "000001.h5").unlink()
    assert "labels/000001.h5 is missing: make it again" in the_error(joined)


def test_files_that_are_not_there(tmp_path, own_pairs):
    assert "does not exist" in the_error(tmp_path / "none.h5", FileNotFoundError)
    own_pairs.with_suffix(".json").unlink()
    assert "pairs.json is missing" in the_error(own_pairs)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"settings": {"label": {}}}', '{"settings": null}'])
def test_manifests_that_say_nothing(own_pairs, text):
    own_pairs.with_suffix(".json").write_text(text)
    assert "pairs.json does not say what the pairs are of" in the_error(own_pairs)


def test_files_that_are_none(own_pairs):
    content = own_pairs.read_bytes()
    own_pairs.write_bytes(content[:1000])
    assert "cannot be read as HDF5" in the_error(own_pairs)
    own_pairs.unlink()
    with h5py.File(own_pairs, "w") as file:
        file["X"] = np.zeros(3)
    assert "is not a file of pairs" in the_error(own_pairs)


def test_a_manifest_of_other_pairs(own_pairs):
    path = own_pairs.with_suffix(".json")
    settings = json.loads(path.read_text())
    settings["settings"]["label"]["points"] = 64
    path.write_text(json.dumps(settings))
    assert "has shapes of 32 nodes, " in the_error(own_pairs)


def test_maps_and_modes_that_are_missing(pairs_path, tmp_path):
    label = Label(maps=["relax", "advection"], modes=[0, 1, 2, 3, 7, 9, 10])
    path = write_pairs(tmp_path / "few.h5", arrays_of(pairs_path), label)
    pairs = open_pairs(path)
    pairs.check("relax")
    pairs.check("advection", (0, 7))
    with pytest.raises(ValueError, match=r"few\.h5 has labels of relax, advection, not of near: label them with `--maps near`"):
        pairs.check("near")
    with pytest.raises(ValueError, match="has modes 0-3, 7, 9-10 of advection, not 4-6, 8"):
        pairs.check("advection", (3, 4, 5, 6, 8))


def test_labels_that_are_not_finite(own_pairs):
    with h5py.File(own_pairs, "r+") as file:
        file["advection/3"][[5, 9], 0, 1, 0, 4] = np.nan
    pairs = open_pairs(own_pairs)
    for whole in (False, True):
        with pytest.raises(ValueError, match=r"pairs\.h5: advection/3 of row 5 \(and 1 more\) is not finite: verify the data set"):
            pairs.read("advection/3", np.arange(48), whole)
    assert pairs.read("advection/3", np.array([6, 7, 8])).shape == (3, 2, 2, 2, 32)
