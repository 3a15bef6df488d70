"""The notebook of results: it runs from its first cell to its last on a trajectory, and is stored without what it printed."""

import nbformat
import pytest
from doc_examples import ROOT
from limits import LIMIT
from nbclient import NotebookClient
from scene_helpers import cli

PATH = ROOT / "notebooks" / "results.ipynb"


@pytest.fixture(scope="module")
def notebook():
    return nbformat.read(PATH, as_version=4)


def test_it_is_valid_and_holds_no_output(notebook):
    nbformat.validate(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.outputs == []
            assert cell.execution_count is None
    assert notebook.cells[0].source.startswith("# ")
    assert PATH.stat().st_size < 20_000


def test_it_runs(notebook, tmp_path):
    assert cli("new", "shear_pair", "-o", tmp_path / "shear_pair.toml").exit_code == 0
    scene = [tmp_path / "shear_pair.toml", "--accuracy", "fast", "--set", "time.horizon=0.5 t_gamma", "--set", "time.save_every=1"]
    assert cli("run", *scene, "-o", tmp_path / "out" / "shear_pair.h5", "--quiet").exit_code == 0
    executed = nbformat.from_dict(notebook)
    NotebookClient(executed, timeout=LIMIT, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in executed.cells if cell.cell_type == "code" for output in cell.outputs]
    printed = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert "frames of 2 vesicles with 32 nodes, to 0.5 t_gamma" in printed
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 4
    assert all(len(picture) > 10_000 for picture in pictures)
