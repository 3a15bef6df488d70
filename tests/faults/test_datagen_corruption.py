"""Data sets that were damaged, or made wrongly: verify names the file, in one line for each problem, and exits with 3."""

import json
import random
import shutil
import sys

import h5py
import numpy as np
import pytest
from datagen_fakes import CHUNKS, CONFIG, RUNS, SHAPES, TASKS, cli, contents, run, write_config
from scene_helpers import the_error

from datagen.manifest import read_manifest, write_manifest
from datagen.shards import join_shards, write_shard
from datagen.verify import verify

pytestmark = pytest.mark.usefixtures("fakes")


def problems(data, *options):
    """What verify says, by its command line; also that it ends as it should."""
    result = cli("verify", data, "--quiet", *options)
    lines = [line.removeprefix("FAILED  ") for line in result.stdout.splitlines()]
    assert result.exit_code == (3 if lines else 0), result.output
    if lines:
        assert result.stderr == f"error: {len(lines)} problem(s) in {data}\n"
    return lines


def the_problem(data, *options):
    [line] = problems(data, *options)
    return line


def rewrite(path, manifest_path, change):
    """The shard made as if its task had given other arrays: change(arrays) in place, and the manifest knows nothing else."""
    with h5py.File(path) as file:
        arrays = {name: file[name][()] for name in read_manifest(manifest_path).columns}
    change(arrays)
    shard, columns = write_shard(path, arrays)
    manifest = read_manifest(manifest_path)
    write_manifest(manifest_path, manifest.having([shard, *(s for s in manifest.shards if s.file != shard.file)], columns))
    if path.parent.name == "labels":
        run("label", path.parents[2] / "tiny.toml", "-o", path.parents[1], "--quiet")  # joins them again


def test_a_sound_data_set_has_no_problems_in_any_stage_of_its_making(tmp_path, config, whole):
    data = tmp_path / "data"
    for stage in ("harvest", "select", "label"):
        run(stage, config, "-o", data, "--quiet")
        assert problems(data) == []
    found = verify(whole).found
    assert found[0] == f"{whole / 'harvest'}: {TASKS} of {TASKS} shards, {TASKS * RUNS * SHAPES} shapes"
    assert "33 train, 33 validation, 30 test" in found[1]
    assert "of 32 runs" in found[1]
    assert contents(data) == contents(whole)


def test_two_hundred_damaged_files_are_all_found(tmp_path):
    """Flipped bits, cut ends and lost files, of random shards at random places, one at a time."""
    whole, pick = tmp_path / "data", random.Random(1)
    few = CONFIG.replace("runs = 20", "runs = 8").replace("runs = 12", "runs = 4").replace("chunk = 10", "chunk = 20")
    run("make", write_config(tmp_path, few), "-o", whole, "--quiet")
    paths = [*sorted(whole.glob("*/0*.h5")), whole / "shapes.h5", whole / "pairs.h5"]
    assert len(paths) == 3 + 2 + 2
    for k in range(200):
        path = pick.choice(paths)
        content = path.read_bytes()
        if k % 4 == 0:
            path.write_bytes(content[: pick.randrange(len(content))])
        elif k % 40 == 1:
            path.unlink()
        else:
            spoilt = bytearray(content)
            spoilt[pick.randrange(len(content))] ^= 1 << pick.randrange(8)
            path.write_bytes(spoilt)
        found = verify(whole).problems
        assert len(found) == 1, (k, found)
        assert found[0].startswith(f"{path} "), (k, found)
        path.write_bytes(content)
    assert verify(whole).problems == []


def test_a_joined_file_that_joins_something_else_is_named(whole):
    path, manifest = whole / "pairs.h5", read_manifest(whole / "labels" / "manifest.json")
    for shards in (manifest.shards[:-1], [manifest.shards[1], manifest.shards[0], *manifest.shards[2:]]):
        other = manifest.model_copy(update={"shards": shards})
        shard = join_shards(path, whole / "labels", other)
        joined = read_manifest(whole / "pairs.json")
        write_manifest(whole / "pairs.json", joined.having([shard], joined.columns))
        lines = problems(whole)
        assert len(lines) == len(manifest.columns)
        assert all(line.startswith(f"{path}: ") and "does not join all shards in their order" in line for line in lines)
    (whole / "pairs.json").unlink()
    assert the_problem(whole) == f"{path}: it has not been made from all parts of the labels: run `python -m datagen label`"


def test_missing_unexpected_and_unlisted_files_are_named(whole):
    harvest = whole / "harvest"
    (harvest / "000099.h5").write_bytes(b"")
    (harvest / ".000001.h5.7.tmp").write_bytes(b"")
    manifest = read_manifest(harvest / "manifest.json")
    write_manifest(harvest / "manifest.json", manifest.having(manifest.shards[:-1], manifest.columns))
    shutil.rmtree(whole / "labels")
    lines = problems(whole)
    assert f"{harvest}: 1 of {TASKS} shards are not there yet: 000007.h5" in lines
    assert f"{harvest / '000007.h5'} is in no manifest" in lines
    assert f"{harvest / '000099.h5'} is unexpected: no task makes it" in lines
    assert f"{harvest / '.000001.h5.7.tmp'} is unexpected: no task makes it" in lines
    assert f"{whole / 'pairs.h5'} joins shards that are not there: run `python -m datagen label`" in lines
    assert len(lines) == 5


@pytest.mark.parametrize("name", ["harvest/manifest.json", "labels/manifest.json", "shapes.json"])
def test_manifests_that_are_none_are_named(whole, name):
    (whole / name).write_text((whole / name).read_text()[:-40])
    assert f"{whole / name} is no manifest" in the_problem(whole)
    (whole / name).unlink()
    assert str(whole / name.split("/")[0].replace(".json", ".h5")) in problems(whole)[0]


def test_values_that_are_not_finite_are_counted(whole):
    def spoil(arrays):
        arrays["time"][[2, 5]] = np.nan, np.inf

    rewrite(whole / "harvest" / "000003.h5", whole / "harvest" / "manifest.json", spoil)
    lines = problems(whole)
    assert lines[0] == f"{whole / 'harvest' / '000003.h5'}: 2 values of time are not finite"
    assert lines[1] == f"{whole / 'shapes.json'} was not made from {whole / 'harvest'} as it is now: make it anew with --force"
    assert len(lines) == 2


def test_a_file_that_is_not_as_its_manifest_says_it_is_named(whole):
    path = whole / "labels" / "manifest.json"
    manifest = read_manifest(path)
    columns = {**manifest.columns, "relax": manifest.columns["relax"].model_copy(update={"dtype": "<f8"})}
    write_manifest(path, manifest.having(manifest.shards, columns))
    lines = problems(whole)
    assert len(lines) == CHUNKS + 1
    assert lines[0] == f"{whole / 'labels' / '000000.h5'}: relax is <f4 (10, 2, 8), the manifest says <f8 (10, 2, 8)"
    assert "relax does not join all shards" in lines[-1]
    del columns["relax"]
    write_manifest(path, manifest.having(manifest.shards, columns))
    assert "datasets that only it, or only its manifest, has: relax" in problems(whole)[0]


def test_runs_in_two_splits_are_named(whole):
    def spoil(arrays):
        arrays["split"][0] = 1  # run 0 is in train

    rewrite(whole / "shapes.h5", whole / "shapes.json", spoil)
    lines = problems(whole)
    assert lines[0] == f"{whole / 'shapes.h5'}: run 0 is in more than one split: train, validation"
    assert f"{whole / 'labels' / '000000.h5'}: split differs from that of the shapes" in lines


def test_labels_of_other_shapes_are_named(whole):
    def swap(arrays):
        arrays["shape"][[0, 1]] = arrays["shape"][[1, 0]]

    rewrite(whole / "labels" / "000004.h5", whole / "labels" / "manifest.json", swap)
    lines = problems(whole)
    assert f"{whole / 'labels' / '000004.h5'}: its rows are not the shapes 40 to 49" in lines
    assert any(line.startswith(f"{whole / 'pairs.h5'}: its rows are not the shapes in their order") for line in lines)


@pytest.mark.parametrize(("relative", "found"), [(2e-6, True), (0.5e-6, False), (np.nan, True)])
def test_a_wrong_label_is_found_when_computed_again(whole, relative, found):
    """Rounding to float32 is no error, a value off by more than 1e-6 of the largest one of its row is."""

    def spoil(arrays):
        row = arrays["relax"][7]
        arrays["relax"][7] = np.where(np.abs(row) == np.abs(row).max(), row * (1 + relative), row) if relative == relative else -row

    rewrite(whole / "labels" / "000002.h5", whole / "labels" / "manifest.json", spoil)
    lines = problems(whole, "--fraction", "1")
    assert len(lines) == found
    if found:
        assert lines[0].startswith(f"{whole / 'labels' / '000002.h5'}: relax of shape 27 is off by ")


def test_the_share_of_labels_that_is_computed_again_is_the_one_asked_for(whole, monkeypatch):
    computed = []
    module = sys.modules["datagen.label"]
    original = module.label_shapes
    monkeypatch.setattr(module, "label_shapes", lambda X, label: computed.append(X) or original(X, label))
    counts = []
    for options in ({}, {"fraction": 0.25}, {"fraction": 0.25, "seed": 1}, {"fraction": 1.0}, {"fraction": 0.0}):
        computed.clear()
        assert verify(whole, **options).problems == []
        counts.append(sum(map(len, computed)))
    assert counts == [1, 24, 24, 96, 1]


def test_what_is_found_wrong_in_one_file_hides_nothing_in_another(whole):
    for name in ("harvest/000001.h5", "labels/000003.h5", "labels/000009.h5", "shapes.h5"):
        (whole / name).write_bytes(b"x")
    (whole / "pairs.h5").unlink()
    lines = problems(whole)
    assert [line.split()[0] for line in lines[:4]] == [
        str(whole / name) for name in ("harvest/000001.h5", "shapes.h5", "labels/000003.h5", "labels/000009.h5")
    ]
    assert lines[4] == f"{whole / 'pairs.h5'} is missing"


def test_settings_that_differ_between_stages_are_named(whole):
    table = json.loads((whole / "shapes.json").read_text())
    table["settings"]["seed"] = 99
    (whole / "shapes.json").write_text(json.dumps(table))
    lines = problems(whole)
    assert lines == [
        f"{whole / 'shapes.json'}: seed are not the settings of {whole / 'harvest'}",
        f"{whole / 'labels'}: seed are not the settings of {whole / 'shapes.h5'}",
    ]


def test_what_is_damaged_is_refused_by_the_stages_too(config, whole):
    (whole / "labels" / "manifest.json").write_text("{}")
    assert "is no manifest" in the_error(cli("label", config, "-o", whole), 2)
