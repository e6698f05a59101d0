"""Every notebook runs from a clean start, as a reader would run it, and is committed without outputs."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
pytest.importorskip("ipykernel", reason="ipykernel is not installed")
jupyter_client = pytest.importorskip("jupyter_client")
jupyter_core = pytest.importorskip("jupyter_core")

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def test_issue_notebooks_are_all_there():
    assert [path.name[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_committed_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert not cell.outputs and cell.execution_count is None, f"clear the outputs of {path.name}"
    assert notebook.cells[0].source.startswith("# "), "it begins with its title"


@pytest.fixture(scope="module")
def kernel(tmp_path_factory):
    """A Python in which notebooks run one after another: its start takes most of their time."""
    manager = jupyter_client.AsyncKernelManager()
    yield manager
    if manager.has_kernel:
        jupyter_core.utils.run_sync(manager.shutdown_kernel)(now=True)


def run_notebook(path: Path, folder: Path, kernel, monkeypatch) -> None:
    """Runs a notebook with short trainings of few shapes, in a folder beside which it writes."""
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("IPYTHONDIR", str(folder / "ipython"))
    folder.mkdir()
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        for setting, less in {"trainer.max_epochs=8": 2, "data.shapes=12": 6}.items():
            cell.source = cell.source.replace(setting, f"{setting.partition('=')[0]}={less}")
    notebook.cells.insert(0, nbformat.v4.new_code_cell(f"%reset -f\n%cd {folder}"))
    client = nbclient.NotebookClient(notebook, kernel, timeout=280)
    client.execute()
    client.kc.stop_channels()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs), "it shows something"
    assert not [output for output in outputs if output.get("name") == "stderr"], "and warns of nothing"


@pytest.mark.parametrize("path", NOTEBOOKS[:-1], ids=lambda path: path.stem)
def test_a_notebook_runs(path, kernel, tmp_path, monkeypatch):
    run_notebook(path, tmp_path / "notebooks", kernel, monkeypatch)
