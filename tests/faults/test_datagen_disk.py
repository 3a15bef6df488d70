"""Data folders that cannot be written, or outgrow the disk: one line, exit code 5, and what was there is intact."""

import resource
import shutil

import pytest
from datagen_fakes import MPIRUN, TASKS, cli, contents, ranks_run, run, start
from scene_helpers import error_line, the_error

from datagen.manifest import read_manifests

pytestmark = pytest.mark.usefixtures("fakes")


@pytest.mark.parametrize("output", ["tiny.toml", "tiny.toml/deeper", "/proc/none", "harvest_is_a_file"])
def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, config, output):
    (tmp_path / "harvest_is_a_file").mkdir()
    (tmp_path / "harvest_is_a_file" / "harvest").write_text("mine")
    before = contents(tmp_path)
    message = the_error(cli("make", config, "-o", tmp_path / output, "--quiet"), 2, 5)
    assert str(tmp_path / output).removesuffix("/deeper") in message
    assert contents(tmp_path) == before


def test_a_folder_in_the_place_of_a_file_is_one_line(tmp_path, config):
    data = tmp_path / "data"
    (data / "harvest" / "manifest.json.d").mkdir(parents=True)
    (data / "harvest" / "000004.h5").mkdir()
    message = the_error(cli("make", config, "-o", data, "--quiet"), 5)
    assert "000004.h5" in message


def limit_files(size, log):
    """No file of this process may outgrow `size` bytes; what it prints goes to the log."""
    import os

    descriptor = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


@pytest.mark.parametrize("size", [1000, 4000, 5000])
def test_files_that_may_not_grow_end_the_run_and_the_next_one_goes_on(tmp_path, config, whole, size):
    """No room for a manifest, for a shard, for a manifest that has grown."""
    data, log = tmp_path / "data", tmp_path / "log"
    process = start(["make", config, "-o", data, "--quiet"], limit_files, (size, str(log)))
    process.join(60)
    assert "could not be written" in error_line(log.read_text(), process.exitcode, 5)
    assert not [path for path in data.rglob("*.tmp")]
    run("make", config, "-o", data, "--quiet")
    assert contents(data) == contents(whole)


@pytest.fixture
def kilobytes():
    return 64


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_full_disk_ends_all_ranks_and_what_was_acknowledged_is_kept(tmp_path, config, whole, small_disk, ranks):
    if ranks > 1 and not MPIRUN.exists():
        pytest.skip("no mpirun beside the interpreter")
    data = small_disk / "data"
    exit_code, _, printed = ranks_run(ranks, "make", config, "-o", data, "--quiet")
    assert "No space left on device" in error_line(printed, exit_code, 5)
    assert len(printed.splitlines()) == 1
    kept = read_manifests(data / "harvest").shards
    assert 0 < len(kept) < TASKS
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(data, elsewhere)
    made = {shard.file: (elsewhere / "harvest" / shard.file).stat().st_mtime_ns for shard in kept}
    run("make", config, "-o", elsewhere, "--quiet")
    assert contents(elsewhere) == contents(whole)
    assert {name: (elsewhere / "harvest" / name).stat().st_mtime_ns for name in made} == made


def test_a_full_disk_leaves_a_finished_data_set_as_it_is(config, whole, small_disk):
    data = small_disk / "data"
    run("harvest", config, "-o", whole, "--quiet")
    (data / "harvest").mkdir(parents=True)
    for name in ("manifest.json", "000000.h5", "000001.h5"):
        shutil.copy(whole / "harvest" / name, data / "harvest" / name)
    before = contents(data)
    (small_disk / "rest").write_bytes(bytes(shutil.disk_usage(small_disk).free))
    the_error(cli("harvest", config, "-o", data, "--quiet"), 5)
    (small_disk / "rest").unlink()
    assert contents(data) == before
