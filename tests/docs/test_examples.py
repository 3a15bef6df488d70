"""Examples of the pages at the top of the documentation, and of the README, run with small settings."""

import pytest
from doc_examples import ROOT, blocks_of, check_command, commands_of, not_run, runnable, sessions_of, working_in
from website.hooks import MEASURED

WRITTEN = [path for path in sorted((ROOT / "docs").glob("*.md")) if path.stem not in MEASURED]  # measured pages name commands of hours
PAGES = [ROOT / "README.md", *WRITTEN]
NOT_RUN = {("docs/ladder.md", "minutes"): 1, ("docs/formats.md", "a data set"): 1, ("README.md", "a data set"): 1}


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    return sessions_of(PAGES, tmp_path_factory)


@pytest.mark.parametrize("block", runnable(PAGES))
def test_example(sessions, block):
    with working_in(sessions[block.page].folder):
        sessions[block.page].run_to(block)


def test_what_is_not_run_is_known():
    assert not_run(PAGES) == NOT_RUN


@pytest.mark.parametrize("name", [name for name in MEASURED if (ROOT / "docs" / f"{name}.md").exists()])
def test_commands_of_measured_pages_are_there(name):
    for block in blocks_of(ROOT / "docs" / f"{name}.md"):
        for command in commands_of(block.text) if block.kind in ("", "sh") and "python" in block.text else ():
            check_command(command.split("#")[0].split())
