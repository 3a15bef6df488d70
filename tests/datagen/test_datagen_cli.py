"""python -m datagen: what its commands leave, that a second one makes what is missing, and that a failure is a line and an exit code."""

import json
import re
import sys

import h5py
import numpy as np
import pytest
from datagen_fakes import CHUNKS, RUNS, SHAPES, TASKS, cli, contents, run
from scene_helpers import error_line, the_error

from datagen.__main__ import parse_modes
from datagen.shards import dataset_names, open_joined

N = TASKS * RUNS * SHAPES

pytestmark = pytest.mark.usefixtures("fakes")


def stamps(folder):
    """What changes when a file is made anew."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.rglob("0*.h5")}


def test_make_leaves_all_files_and_they_agree(config, whole):
    names = [f"harvest/{k:06d}.h5" for k in range(TASKS)] + [f"labels/{k:06d}.h5" for k in range(CHUNKS)]
    others = ["coverage.json", "harvest/manifest.json", "labels/manifest.json", "pairs.h5", "pairs.json", "shapes.h5", "shapes.json"]
    assert sorted(contents(whole)) == sorted(names + others)
    with h5py.File(whole / "shapes.h5") as shapes, open_joined(whole / "pairs.h5") as pairs:
        assert np.array_equal(pairs["shape"][()], np.arange(N))
        for name in ("run", "split"):
            assert np.array_equal(pairs[name][()], shapes[name][()])
        assert (pairs["split"].dtype, pairs["run"].dtype, pairs["shape"].dtype) == (np.int8, np.int64, np.int64)
        assert dataset_names(pairs) == sorted(["X_std", "relax", *(f"advection/{k}" for k in range(5)), "run", "shape", "split"])
    result = run("verify", whole)
    assert "FAILED" not in result.output
    assert f"{N} pairs" in result.stdout


def test_the_stages_one_by_one_leave_the_same_and_say_what_they_did(tmp_path, config, whole):
    data = tmp_path / "data"
    said = [run(stage, config, "-o", data).output for stage in ("harvest", "select", "label")]
    assert contents(data) == contents(whole)
    assert f"{TASKS}/{TASKS} tasks" in said[0]
    assert re.search(r"[\d.e+]+ shapes/s", said[0])
    assert f"harvest: {TASKS} of {TASKS} shards, {N} shapes in {data / 'harvest'}" in said[0]
    assert f"coverage of {N} shapes" in said[1]
    assert re.search(r"[\d.e+]+ pairs/s", said[2])
    assert f"{N} pairs joined in {data / 'pairs.h5'}" in said[2]


def test_quiet_prints_nothing_and_the_folder_is_named_after_the_data_set(tmp_path, config, whole, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("make", config, "--quiet").output == ""
    assert contents(tmp_path / "data" / "tiny") == contents(whole)


def test_a_second_run_makes_nothing(config, whole):
    before, made = contents(whole), stamps(whole)
    result = run("make", config, "-o", whole)
    assert f"{whole / 'shapes.h5'} is there, {N} shapes" in result.output
    assert (contents(whole), stamps(whole)) == (before, made)


def test_what_is_gone_or_of_another_size_is_told_and_made_again(config, whole):
    before, made = contents(whole), stamps(whole / "harvest")
    (whole / "harvest" / "000002.h5").unlink()
    (whole / "labels" / "000004.h5").write_bytes(b"cut")
    (whole / "shapes.h5").write_bytes(b"cut")
    (whole / "pairs.h5").unlink()
    notices = run("make", config, "-o", whole, "--quiet").stderr.splitlines()
    assert len(notices) == 3
    assert notices[0] == f"{whole / 'harvest' / '000002.h5'} is missing: made again"
    assert all(re.search("has 3 bytes, was written with .* made again", line) for line in notices[1:])
    assert contents(whole) == before
    assert {name for name, stamp in stamps(whole / "harvest").items() if stamp != made[name]} == {"000002.h5"}


def test_labels_of_other_settings_stand_beside_the_first_ones(config, whole):
    before = contents(whole)
    assert "label.dt was" in the_error(cli("label", config, "-o", whole, "--set", "label.dt=1e-4"), 2)
    run("label", config, "-o", whole, "--name", "slow", "--set", "label.dt=1e-4", "--maps", "relax")
    assert {name: content for name, content in contents(whole).items() if "slow" not in name} == before
    with open_joined(whole / "pairs-slow.h5") as pairs:
        assert dataset_names(pairs) == ["X_std", "relax", "run", "shape", "split"]
        assert pairs["shape"].shape == (N,)
    assert "FAILED" not in run("verify", whole).output
    (whole / "labels-slow" / "000001.h5").write_bytes(b"cut")
    result = cli("verify", whole, "--quiet")
    assert result.exit_code == 3
    assert f"{whole / 'labels-slow' / '000001.h5'} has 3 bytes" in result.stdout
    assert "letters, digits" in the_error(cli("label", config, "-o", whole, "--name", "a/b"), 2)


def test_name_and_device_do_not_count_all_else_does(tmp_path, config, whole):
    run("make", config, "-o", whole, "--set", "name=other", "--device", "torch")
    run("label", config, "-o", whole, "--modes", "0-4", "--maps", "near,relax,self_tension,flow_tension,advection")
    for change in ("seed=4", "shapes.points=64", "simulation.tolerance=1e-4", "select.distance=0.1", "label.dt=1e-4", "label.chunk=11"):
        message = the_error(cli("make", config, "-o", whole, "--set", change), 2)
        key, _, value = change.partition("=")
        assert re.search(rf"{re.escape(key)} was \S+, is {float(value):g}".replace("0.0001", r"(1e-04|0\.0001)"), message), message
        assert "--force" in message


def test_force_starts_anew(tmp_path, config, whole):
    before = contents(whole)
    changed = ("--set", "seed=4", "--set", "label.chunk=50", "-o", whole)
    the_error(cli("make", config, *changed), 2)
    assert contents(whole) == before
    run("make", config, *changed, "--force", "--quiet")
    assert sorted(contents(whole / "labels")) == ["000000.h5", "000001.h5", "manifest.json"]
    run("make", config, *changed[:4], "-o", tmp_path / "fresh", "--quiet")
    assert contents(whole) == contents(tmp_path / "fresh")


def test_a_stage_made_anew_is_told_from_the_one_that_its_followers_were_made_of(config, whole):
    change = ("--set", "seed=4", "-o", whole)
    run("harvest", config, *change, "--force")
    assert "seed was 4, is 3" in the_error(cli("select", config, "-o", whole), 2)
    assert "seed was 3, is 4" in the_error(cli("select", config, *change), 2)
    run("select", config, *change, "--force")
    assert "seed was 3, is 4" in the_error(cli("label", config, *change), 2)
    table = json.loads((whole / "labels" / "manifest.json").read_text())
    table["settings"]["seed"] = 4
    (whole / "labels" / "manifest.json").write_text(json.dumps(table))
    assert "from another input" in the_error(cli("label", config, *change), 2)


def test_maps_and_modes_are_those_asked_for(tmp_path, config, whole):
    run("label", config, "-o", whole, "--maps", "advection, relax", "--modes", "3,0-1", "--force", "--quiet")
    with open_joined(whole / "pairs.h5") as pairs:
        expected = ["X_std", "advection/0", "advection/1", "advection/3", "relax", "run", "shape", "split"]
        assert dataset_names(pairs) == expected
    assert parse_modes(" 2, 4-6,0") == [2, 4, 5, 6, 0]


def test_parts_leave_what_one_run_leaves(tmp_path, config, whole):
    data = tmp_path / "data"
    assert f"harvest, part 2 of 3: done; 3 of {TASKS} shards" in run("harvest", config, "-o", data, "--part", "2/3").stdout
    assert f"6 of {TASKS} shards" in run("harvest", config, "-o", data, "--part", "1/3").stdout
    assert f"has 6 of {TASKS} shards: run `python -m datagen harvest` again" in the_error(cli("select", config, "-o", data), 2)
    assert "all parts are done" in run("harvest", config, "-o", data, "--part", "3/3").stdout
    run("select", config, "-o", data, "--quiet")  # parts need not be joined for that
    for k in (2, 1):
        run("label", config, "-o", data, "--part", f"{k}/2", "--quiet")
    assert not (data / "pairs.h5").exists()
    assert f"{data / 'pairs.h5'}: it has not been made from all parts of the labels" in cli("verify", data).output
    made = stamps(data)
    run("harvest", config, "-o", data, "--quiet")
    run("label", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)
    assert stamps(data) == made


FAILURES = {
    "no config": (["make", "{tmp}/none.toml"], "does not exist"),
    "part beyond": (["harvest", "{config}", "--part", "4/3"], "--part 4/3: expected K/P"),
    "no part": (["label", "{config}", "--part", "two"], "--part two: expected K/P"),
    "part and force": (["harvest", "{config}", "--part", "1/3", "--force"], "give one of them"),
    "modes": (["label", "{config}", "--modes", "1;2"], "--modes 1;2: expected numbers and ranges"),
    "range backwards": (["label", "{config}", "--modes", "4-2"], "--modes 4-2"),
    "mode beyond": (["make", "{config}", "--modes", "0-5"], "from 0 to 4"),
    "mode twice": (["make", "{config}", "--modes", "1,0-2"], "different numbers"),
    "unknown map": (["make", "{config}", "--maps", "relax,advect"], "label.maps.1 = 'advect'"),
    "no map": (["make", "{config}", "--maps", ""], "label.maps.0 = ''"),
    "device": (["harvest", "{config}", "--device", "gpu"], "simulation.device = 'gpu'"),
    "set": (["harvest", "{config}", "--set", "label.chunks=1"], "did you mean chunk?"),
    "select too early": (["select", "{config}"], "run `python -m datagen harvest` first"),
    "label too early": (["label", "{config}"], "run `python -m datagen select` first"),
    "verify nothing": (["verify", "{tmp}/none"], "holds no data set"),
    "verify a config": (["verify", "{config}"], "holds no data set"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_what_is_wrong_is_one_line_and_nothing_is_written(tmp_path, config, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, fragment = FAILURES[case]
    names = {"tmp": tmp_path, "config": config}
    before = contents(tmp_path)
    message = the_error(cli(*(a.format(**names) for a in arguments)), 2)
    assert fragment in message
    assert contents(tmp_path) == before


def test_inputs_that_are_not_as_they_were_written_are_named(config, whole):
    for name, stage in (("harvest/000003.h5", "select"), ("shapes.h5", "label")):
        content = bytearray((whole / name).read_bytes())
        content[len(content) // 2] ^= 16
        (whole / name).write_bytes(content)
        message = the_error(cli(stage, config, "-o", whole, "--force"), 2)
        assert f"{whole / name} is not as it was written" in message
        content[len(content) // 2] ^= 16
        (whole / name).write_bytes(content)


def test_failed_tasks_are_told_in_a_line_each_and_tried_again_by_the_next_run(tmp_path, config, whole, monkeypatch):
    data = tmp_path / "data"
    monkeypatch.setenv("FAKE_WRONG", "5:odd,2:exit,6:once")
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    result = cli("make", config, "-o", data, "--quiet")
    assert "2 of 8 tasks failed twice and were set aside; run again" in error_line(result.stderr, result.exit_code, 3)
    lines = result.stderr.splitlines()
    assert len(lines) == 3
    assert lines[0].startswith(f"failed: {data / 'harvest' / '000002.h5'}: SystemExit: 7 (")
    assert lines[1].startswith(f"failed: {data / 'harvest' / '000005.h5'}: Odd: odd 5 (")
    assert sorted(line.split()[0] for line in (tmp_path / "log").read_text().splitlines()) == sorted("0122345566" + "7")
    assert not (data / "shapes.h5").exists()
    monkeypatch.delenv("FAKE_WRONG")
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)


@pytest.mark.parametrize(("stage", "wrong", "done"), [("harvest", "3:stop", "3 of 8"), ("label", "label:swallow", "0 of 10")])
def test_a_signal_ends_with_exit_code_4_and_the_next_run_goes_on(tmp_path, config, whole, monkeypatch, stage, wrong, done):
    data = tmp_path / "data"
    monkeypatch.setenv("FAKE_WRONG", wrong)
    message = the_error(cli("make", config, "-o", data, "--quiet"), 4)
    assert f"stopped with {done} shards; run the same command again to go on" in message
    monkeypatch.delenv("FAKE_WRONG")
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)


def test_a_signal_while_shapes_are_selected_leaves_none(tmp_path, config, whole, monkeypatch):
    from datagen_fakes import WRONG

    data = tmp_path / "data"
    run("harvest", config, "-o", data, "--quiet")
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["datagen.select"], "select", lambda config, parts: WRONG["stop"](0))
        assert "stopped by a signal; run the same command again" in the_error(cli("select", config, "-o", data, "--quiet"), 4)
    assert sorted(path.name for path in data.iterdir()) == ["harvest"]
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)


@pytest.mark.parametrize("stage", ["harvest", "label"])
def test_a_disk_error_ends_with_exit_code_5(tmp_path, config, monkeypatch, stage):
    monkeypatch.setenv("FAKE_WRONG", "4:disk" if stage == "harvest" else "label:disk")
    message = the_error(cli("make", config, "-o", tmp_path / "data", "--quiet"), 5)
    assert "No space left on device" in message


@pytest.mark.parametrize("command", [[], ["harvest"], ["select"], ["label"], ["make"], ["verify"]])
def test_help_is_there(command):
    result = cli(*command, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.output


def test_more_modes_than_nodes_hold_are_refused_at_once(tmp_path, config):
    for key, points in (("shapes.points", 32), ("label.operator_points", 16)):
        message = the_error(cli("harvest", config, "-o", tmp_path, "--set", f"{key}={points}", "--set", "shapes.modes=40"), 2)
        assert "40 modes: take twice as many nodes" in message
    assert "CUDA device" in the_error(cli("harvest", config, "-o", tmp_path / "no", "--device", "cuda:77"), 2)


def test_labels_of_other_shapes_are_told_and_not_read(config, whole):
    run("harvest", config, "-o", whole, "--force", "--set", "seed=9")
    result = run("select", config, "-o", whole, "--force", "--set", "seed=9")
    assert f"{whole / 'labels'} holds labels of other shapes now" in result.stderr
    with pytest.raises(ValueError, match="is of other shapes than"), open_joined(whole / "pairs.h5"):
        pass
    assert "was not made from" in cli("verify", whole, "--quiet").stdout


def test_ranges_have_the_smaller_number_first(tmp_path, config):
    text = config.read_text()
    assert "[[harvest]]" in text
    for low, high in ((10, 1), (0, 1)):
        config.write_text(text.replace("[[harvest]]", f"[[harvest]]\ncapillary = [{low}.0, {high}.0]", 1))
        message = the_error(cli("harvest", config, "-o", tmp_path), 2)
        assert f"harvest.0.capillary = [{low}, {high}]: expected positive numbers, the smaller one first" in message
