"""Runs the notebooks from top to bottom, and saves them with their pictures.

    python -m docs.figures.notebooks            # or `make notebooks`

Pictures get 256 colors, so that a notebook stays small enough for the repository.
"""

import base64
import io
import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"


def main() -> None:
    """Runs each in a folder of its own."""
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            resources = {"metadata": {"path": folder}}
            NotebookClient(notebook, timeout=1800, resources=resources).execute()
        save(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1024:.0f} KB")


def save(notebook: nbformat.NotebookNode, path: Path) -> None:
    """Writes a notebook that was run: what it shows and prints, without what changes each time."""
    notebook.metadata = {key: notebook.metadata[key] for key in ("kernelspec", "language_info")}
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.metadata = {}
            cell.outputs = [_small(o) for o in cell.outputs if o.get("name") != "stderr"]
    nbformat.write(notebook, path)


def _small(output: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Returns an output with its picture in 256 colors, rare ones among them.

    Those of a color scale.
    """
    picture = output.get("data", {}).get("image/png")
    if picture:
        image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
        packed = io.BytesIO()
        image.quantize(256, Image.Quantize.MAXCOVERAGE).save(packed, "PNG", optimize=True)
        output.data["image/png"] = base64.b64encode(packed.getvalue()).decode()
    return output


if __name__ == "__main__":
    main()
