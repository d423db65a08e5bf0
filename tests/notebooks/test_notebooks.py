"""The notebooks run from top to bottom, leave nothing behind, and are saved with small pictures."""

import os
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_there_are_five():
    assert [path.name[:2] for path in NOTEBOOKS] == ["1_", "2_", "3_", "4_", "5_"]


@each
def test_notebook_runs(path, tmp_path, monkeypatch):
    """In a process of its own, at a small size; every notebook shows pictures."""
    work = tmp_path / "work"
    work.mkdir()
    settings = {
        "R3JAX_NOTEBOOK_SMALL": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "TMPDIR": str(tmp_path),
        "IPYTHONDIR": str(tmp_path / "ipython"),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(work)}}
    )
    client.execute()
    assert list(work.iterdir()) == [], "the notebook leaves files where it is opened"
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 3
    complaints = [output.text for output in outputs if output.get("name") == "stderr"]
    assert not any("Warning" in text for text in complaints), complaints


@each
def test_notebook_is_saved_with_its_pictures(path):
    """`make notebooks` ran it as it stands: the site shows what it saved."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 3
    assert not any(output.output_type == "error" for output in outputs)
    assert path.stat().st_size < 400_000, "pictures swell the history"
    assert notebook.cells[0].source.startswith(f"# {path.name[0]} ")
    assert max(len(cell.source.splitlines()) for cell in code) <= 30, "a cell fits on a screen"
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
