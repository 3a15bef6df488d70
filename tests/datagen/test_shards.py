"""Shards and manifests: bytes that depend on the arrays alone, files that are joined without copies, missing data that is never zeros."""

import hashlib
import json
import shutil

import h5py
import numpy as np
import pytest

from datagen.ledger import Ledger
from datagen.manifest import WHOLE, Column, Manifest, Part, check_same, read_manifest, read_manifests, write_manifest
from datagen.shards import dataset_names, join_shards, open_joined, read_shard, shard_name, write_shard

SETTINGS = {"seed": 1, "harvest": [{"flow": "shear", "runs": 4}, {"flow": "relaxation", "runs": 2}], "select": {"most": None}}
ROWS = (3, 0, 2, 4)  # of the shards below


def arrays(task, rows=3):
    """float64, float32 in a group, complex64 and integers, none of them zero."""
    random = np.random.default_rng(task)
    X = random.uniform(1, 2, (rows, 2, 5))
    return {"X": X, "map/10": X[:, 0].astype("f4"), "c": (X[:, 0] + 1j * X[:, 1]).astype("c8"), "run": 10 * task + 1 + np.arange(rows)}


def empty(tasks=len(ROWS), **changes):
    return Manifest(**{"stage": "harvest", "settings": SETTINGS, "input": None, "tasks": tasks, **changes})


def fill(folder, tasks=None, part=WHOLE, wanted=None):
    """Makes what is missing of these tasks; the ledger."""
    ledger = Ledger(folder, wanted or empty(), part)
    for task in ledger.todo if tasks is None else sorted(set(tasks) & set(ledger.todo)):
        ledger.acknowledge([write_shard(folder / shard_name(task), arrays(task, ROWS[task]))])
    return ledger


@pytest.fixture
def joined(tmp_path):
    """A data folder with four shards and the file that joins them."""
    manifest = fill(tmp_path / "data" / "labels").everything()
    assert manifest.complete
    join_shards(tmp_path / "data" / "pairs.h5", tmp_path / "data" / "labels", manifest)
    return tmp_path / "data" / "pairs.h5"


def test_a_shard_gives_back_its_arrays_and_its_entry_is_that_of_its_bytes(tmp_path):
    shard, columns = write_shard(tmp_path / "000007.h5", arrays(7))
    content = (tmp_path / "000007.h5").read_bytes()
    assert (shard.file, shard.rows, shard.bytes) == ("000007.h5", 3, len(content))
    assert shard.sha256 == hashlib.sha256(content).hexdigest()
    assert columns["X"] == Column(shape=[2, 5], dtype="<f8")
    assert columns["c"] == Column(shape=[5], dtype="<c8")
    assert columns["run"] == Column(shape=[], dtype="<i8")
    read = read_shard(tmp_path / "000007.h5", shard)
    assert list(read) == ["X", "c", "map/10", "run"]
    for name, values in arrays(7).items():
        assert read[name].dtype == values.dtype
        assert np.array_equal(read[name], values)


def test_equal_arrays_give_equal_bytes_in_any_order_and_at_any_time(tmp_path):
    a = arrays(1)
    write_shard(tmp_path / "a.h5", a)
    write_shard(tmp_path / "b.h5", dict(reversed(a.items())))
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    a["X"][0, 0, 0] = np.nextafter(a["X"][0, 0, 0], 2)
    write_shard(tmp_path / "b.h5", a)
    assert (tmp_path / "a.h5").read_bytes() != (tmp_path / "b.h5").read_bytes()


def test_no_file_keeps_the_time_of_its_making(tmp_path, joined):
    write_shard(tmp_path / "a.h5", arrays(1))
    for path in (tmp_path / "a.h5", joined):
        with h5py.File(path) as file:
            assert [h5py.h5g.get_objinfo(file[name].id).mtime for name in dataset_names(file)] == [0] * 4


def test_arrays_of_different_lengths_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one number of rows, got \[3, 4\]"):
        write_shard(tmp_path / "a.h5", {"X": np.zeros((3, 2)), "run": np.zeros(4)})
    assert not list(tmp_path.iterdir())


def test_a_shard_that_is_not_as_it_was_written_is_not_read(tmp_path):
    shard, _ = write_shard(tmp_path / "a.h5", arrays(1))
    content = bytearray((tmp_path / "a.h5").read_bytes())
    content[-1] ^= 1
    (tmp_path / "a.h5").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.h5 is not as it was written"):
        read_shard(tmp_path / "a.h5", shard)
    (tmp_path / "a.h5").unlink()
    with pytest.raises(ValueError, match=r"a\.h5 is missing"):
        read_shard(tmp_path / "a.h5", shard)


# The joined file


def test_joined_shards_read_as_one_from_anywhere(tmp_path, joined, monkeypatch):
    shutil.move(tmp_path / "data", tmp_path / "moved")
    monkeypatch.chdir("/")
    with open_joined(tmp_path / "moved" / "pairs.h5") as file:
        assert dataset_names(file) == ["X", "c", "map/10", "run"]
        for name in dataset_names(file):
            values = np.concatenate([arrays(task, n)[name] for task, n in enumerate(ROWS)])
            assert file[name].dtype == values.dtype
            assert np.array_equal(file[name][()], values)
            assert np.array_equal(file[name][2:5], values[2:5])  # across an empty shard


def test_a_missing_shard_is_nan_and_refused_never_zeros(joined):
    (joined.parent / "labels" / "000002.h5").unlink()
    with h5py.File(joined) as file:  # past the guard
        for name in ("X", "map/10", "c"):
            assert np.isnan(file[name][3:5]).all(), name
            assert np.isfinite(file[name][5:]).all(), name
    with pytest.raises(ValueError, match=r"labels/000002\.h5 is missing"), open_joined(joined):
        pass


@pytest.mark.parametrize("size", [0, 100, -1])
def test_a_shard_of_another_size_is_refused(joined, size):
    path = joined.parent / "labels" / "000003.h5"
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ValueError, match=r"labels/000003\.h5 has \d+ bytes, was written with"), open_joined(joined):
        pass


def test_what_does_not_belong_together_is_not_opened_as_joined(tmp_path, joined):
    def refused(path, match):
        with pytest.raises(ValueError, match=match), open_joined(path):
            pass

    refused(tmp_path / "none.h5", r"none\.h5 cannot be read")
    refused(joined.parent / "labels" / "000000.h5", "joins no shards")
    manifest = joined.parent / "labels" / "manifest.json"
    text = manifest.read_text()
    manifest.write_text(text.replace('"tasks": 4', '"tasks": 5'))
    refused(joined, "does not join what is in")
    manifest.unlink()
    refused(joined, "has no manifest")


# Manifests


def test_a_manifest_reads_back_and_its_bytes_do_not_depend_on_the_order(tmp_path):
    made = [write_shard(tmp_path / shard_name(task), arrays(task)) for task in range(4)]
    columns = made[0][1]
    a = empty().having((shard for shard, _ in made), columns)
    b = empty().having((shard for shard, _ in reversed(made)), dict(reversed(columns.items())))
    for name, manifest in (("a", a), ("b", b)):
        write_manifest(tmp_path / f"{name}.json", manifest)
        assert read_manifest(tmp_path / f"{name}.json") == a
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert a.complete
    assert a.rows == 12
    other = a.having([a.shards[0].model_copy(update={"sha256": "0"}), *a.shards[1:]], columns)
    assert other.digest != a.digest == b.digest


@pytest.mark.parametrize("spoil", ["", "{", '{"version": 1}', "[]", "\xff", '{"seed": NaN}', None])
def test_what_is_no_manifest_is_refused_in_one_line(tmp_path, spoil):
    path = tmp_path / "manifest.json"
    if spoil is None:
        fill(tmp_path)
        table = json.loads(path.read_text())
        table["shards"].append(table["shards"][0])
        spoil = json.dumps(table)
    path.write_text(spoil, encoding="latin-1")
    with pytest.raises(ValueError, match=r"manifest\.json is no manifest") as caught:
        read_manifests(tmp_path)
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="does not exist"):
        read_manifest(tmp_path / "none.json")


CHANGES = {
    "value": ({"seed": 2}, "seed was 1, is 2"),
    "nested": ({"select": {"most": 5}}, r"select\.most was null, is 5"),
    "in a list": ({"harvest": [SETTINGS["harvest"][0], {"flow": "shear", "runs": 2}]}, r'harvest\.1\.flow was "relaxation", is "shear"'),
    "gone": ({"harvest": SETTINGS["harvest"][:1]}, r"harvest\.1\.flow was \"relaxation\", is absent; harvest\.1\.runs was 2, is absent"),
    "more": ({"select": {"most": None, "distance": 0.1}}, r"select\.distance was absent, is 0\.1"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_other_settings_are_refused_by_name_old_and_new(tmp_path, case):
    change, expected = CHANGES[case]
    fill(tmp_path)
    state = lambda: {path.name: (path.stat().st_ino, path.stat().st_size, path.stat().st_mtime_ns) for path in tmp_path.iterdir()}
    before = state()
    wanted = empty(settings={**SETTINGS, **change})
    with pytest.raises(ValueError, match=expected) as caught:
        Ledger(tmp_path, wanted)
    assert "with other settings" in str(caught.value)
    assert "another folder (-o), or start anew with `python -m datagen harvest --force`" in str(caught.value)
    assert state() == before
    assert len(Ledger(tmp_path, wanted, force=True).todo) == len(ROWS)
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]


def test_another_input_and_another_number_of_tasks_are_refused():
    check_same("x", empty(input="a"), empty(input="a"))
    with pytest.raises(ValueError, match="from another input"):
        check_same("x", empty(input="a"), empty(input="b"))
    with pytest.raises(ValueError, match="tasks was 4, is 5"):
        check_same("x", empty(), empty(tasks=5))
    with pytest.raises(ValueError, match="and 2 more"):
        check_same("x", empty(settings={}), empty(settings=dict.fromkeys("abcdef", 1)))


# The ledger


def test_only_what_is_missing_is_made_and_only_leftovers_go(tmp_path):
    fill(tmp_path, [0, 1, 2])
    kept = {name: (tmp_path / name).stat() for name in ("000000.h5",)}
    (tmp_path / "000001.h5").unlink()
    (tmp_path / "000002.h5").write_bytes(b"short")
    write_shard(tmp_path / "000003.h5", arrays(3))  # made, not acknowledged
    for leftover in (".000001.h5.123.tmp", ".manifest.json.123.tmp", ".manifest.2-of-3.json.9.tmp"):
        (tmp_path / leftover).write_bytes(b"half")
    (tmp_path / "notes.txt").write_text("mine")
    ledger = Ledger(tmp_path, empty())
    assert ledger.todo == [1, 2, 3]
    assert len(ledger.notices) == 2
    assert ledger.notices[0].endswith("000001.h5 is missing: made again")
    assert "000002.h5 has 5 bytes, was written with" in ledger.notices[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000.h5", "manifest.json", "notes.txt"]
    assert {name: (tmp_path / name).stat() for name in kept} == kept
    assert [shard.file for shard in read_manifest(tmp_path / "manifest.json").shards] == ["000000.h5"]


def test_parts_share_a_folder_and_leave_what_one_run_leaves(tmp_path):
    folder, whole = tmp_path / "parts", tmp_path / "whole"
    fill(whole)
    first, second = Part.parse("1/2"), Part.parse("2/2")
    fill(folder, part=first)
    fill(folder, [1], part=second)
    (folder / "000003.h5").write_bytes(b"of the second part, being made")
    (folder / ".000003.h5.5.tmp").touch()
    (folder / ".manifest.2-of-2.json.5.tmp").touch()
    again = Ledger(folder, empty(), first)
    assert (again.todo, again.notices) == ([], [])
    assert sorted(path.name for path in folder.iterdir() if "3" in path.name or "tmp" in path.name) == [
        ".000003.h5.5.tmp",
        ".manifest.2-of-2.json.5.tmp",
        "000003.h5",
    ]
    assert [shard.file for shard in read_manifests(folder).shards] == ["000000.h5", "000001.h5", "000002.h5"]
    fill(folder, part=second)
    assert not (folder / "manifest.json").exists()
    assert read_manifests(folder).complete
    inodes = {path.name: path.stat().st_ino for path in folder.glob("0*.h5")}
    ledger = fill(folder)
    assert ledger.todo == []
    assert {path.name: path.stat().st_ino for path in folder.glob("0*.h5")} == inodes
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {path.name: path.read_bytes() for path in whole.iterdir()}


def test_other_numbers_of_parts_go_on_with_each_others_shards(tmp_path):
    fill(tmp_path, [0, 3])
    fill(tmp_path, part=Part.parse("2/3"))
    assert Ledger(tmp_path, empty(), Part.parse("1/1")).todo == [2]
    assert Ledger(tmp_path, empty(), Part.parse("2/2")).todo == []
    assert Ledger(tmp_path, empty(), Part.parse("4/4")).todo == []
    assert Ledger(tmp_path, empty(), Part.parse("9/9")).todo == []


def test_a_shard_of_two_contents_is_made_again(tmp_path):
    fill(tmp_path)
    manifest = read_manifest(tmp_path / "manifest.json")
    one = manifest.shards[1].model_copy(update={"sha256": "another"})
    write_manifest(tmp_path / "manifest.1-of-2.json", manifest.having([one], manifest.columns))
    assert [shard.file for shard in read_manifests(tmp_path).shards] == ["000000.h5", "000002.h5", "000003.h5"]
    ledger = fill(tmp_path)
    assert ledger.notices == [f"{tmp_path / '000001.h5'} is in two manifests with different contents: made again"]
    assert ledger.everything() == manifest


def test_parts_of_different_settings_are_not_united(tmp_path):
    fill(tmp_path, part=Part.parse("1/2"))
    with pytest.raises(ValueError, match="seed was 1, is 5"):
        Ledger(tmp_path, empty(settings={**SETTINGS, "seed": 5}), Part.parse("2/2"))
    write_manifest(tmp_path / "manifest.2-of-2.json", empty(settings={**SETTINGS, "seed": 5}))
    with pytest.raises(ValueError, match="seed was 5, is 1"):
        read_manifests(tmp_path)


def test_shards_with_other_columns_are_refused(tmp_path):
    ledger = fill(tmp_path, [0])
    other = {**arrays(1), "X": arrays(1)["X"].astype("f4")}
    with pytest.raises(ValueError, match=r"000001\.h5: X is <f4 \(n, 2, 5\), in the other shards <f8 \(n, 2, 5\)"):
        ledger.acknowledge([write_shard(tmp_path / "000001.h5", other)])
    del other["X"]
    with pytest.raises(ValueError, match=r"000001\.h5: X is absent"):
        ledger.acknowledge([write_shard(tmp_path / "000001.h5", other)])
    assert len(read_manifests(tmp_path).shards) == 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "a/b", "1/0", "-1/3", "1/2/3", ""])
def test_parts_that_there_are_not_are_refused(text):
    with pytest.raises(ValueError, match=r"--part .*: expected K/P with K from 1 to P"):
        Part.parse(text)


def test_every_task_is_of_one_part():
    parts = [Part.parse(f"{k}/3") for k in (1, 2, 3)]
    assert [[k for k in range(8) if part.has(k)] for part in parts] == [[0, 3, 6], [1, 4, 7], [2, 5]]


def test_force_is_not_for_a_part(tmp_path):
    with pytest.raises(ValueError, match="--force starts the whole folder anew"):
        Ledger(tmp_path / "x", empty(), Part.parse("1/2"), force=True)
    assert not (tmp_path / "x").exists()
