"""Examples of the cookbook, but for those on machines (test_cookbook_machines.py), and of the pages on the method, with small settings."""

import pytest
from doc_examples import ROOT, not_run, runnable, sessions_of, working_in

MACHINES = ("gpu", "several-processes", "slurm")
PAGES = [path for folder in ("cookbook", "method") for path in sorted((ROOT / "docs" / folder).glob("*.md")) if path.stem not in MACHINES]


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    return sessions_of(PAGES, tmp_path_factory)


@pytest.mark.parametrize("block", runnable(PAGES))
def test_example(sessions, block):
    with working_in(sessions[block.page].folder):
        sessions[block.page].run_to(block)


def test_what_is_not_run_is_known():
    assert not_run(PAGES) == {("docs/cookbook/reduced-area.md", "minutes"): 1}
