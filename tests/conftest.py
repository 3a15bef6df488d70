"""Options and fixtures of several test files."""

import shutil
import subprocess
import sys
from pathlib import Path

import datagen_fakes
import pytest

# Files that take longest, handed out first (`--no-loadscope-reorder`), so that none of them is still running alone at the end.
SLOW = (
    *("run/test_mpi", "docs/test_site", "surrogate/test_training_processes", "scripts/test_requires", "packaging/test_package"),
    *("docs/test_examples", "scripts/test_extremes", "run/test_periodic_runs", "faults/test_kill", "scripts/test_compare"),
    *("surrogate/test_train", "run/test_adaptive", "datagen/test_datagen_ranks", "faults/test_datagen_corruption"),
    *("parity/test_dense_suspension", "physics/test_known_values", "scene/test_scene_files", "run/test_doctor", "run/test_split_runs"),
)


def pytest_collection_modifyitems(items):
    """The slow files first, otherwise as they were found."""
    folder = Path(__file__).parent
    places = {folder / f"{name}.py": place for place, name in enumerate(SLOW)}
    items.sort(key=lambda item: places.get(item.path, len(places)))


def pytest_addoption(parser):
    parser.addoption("--moments", type=int, default=4, help="random moments at which runs that make data are killed; 50 in full")


def pytest_generate_tests(metafunc):
    if "moment" in metafunc.fixturenames:
        metafunc.parametrize("moment", range(metafunc.config.getoption("moments")))


@pytest.fixture
def config(tmp_path):
    """The file of a data set for the fakes."""
    return datagen_fakes.write_config(tmp_path)


@pytest.fixture
def whole(tmp_path, config, fakes):
    """The folder of such a data set, finished."""
    datagen_fakes.run("make", config, "-o", tmp_path / "whole", "--quiet")
    return tmp_path / "whole"


@pytest.fixture
def fakes(monkeypatch):
    """Stages that compute next to nothing in place of those of datagen."""
    for name, module in datagen_fakes.modules().items():
        monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def kilobytes():
    """Size of the small disk; a file of tests may have its own."""
    return 128


@pytest.fixture
def small_disk(tmp_path, kilobytes):
    """A disk that is soon full."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no right to mount a small disk")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)
