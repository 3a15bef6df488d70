"""Examples of the cookbook on processes, Slurm and GPUs: with stand-ins for Slurm, and checked alone where there is no GPU."""

import pytest
from doc_examples import ROOT, not_run, runnable, sessions_of, working_in

PAGES = [ROOT / "docs" / "cookbook" / f"{name}.md" for name in ("gpu", "several-processes", "slurm")]
CUDA = "needs a CUDA device"


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    return sessions_of(PAGES, tmp_path_factory)


@pytest.mark.parametrize("block", runnable(PAGES))
def test_example(sessions, block):
    with working_in(sessions[block.page].folder):
        sessions[block.page].run_to(block)
    if block.told.get("not run") == CUDA:
        pytest.skip("there is no CUDA device here: options and files are checked, nothing is run")


def test_what_is_not_run_is_known():
    assert not_run(PAGES) == {("docs/cookbook/gpu.md", CUDA): 1}
