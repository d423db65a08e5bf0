"""The notebooks as pages, with the pictures that they were saved with."""

import base64
from pathlib import Path

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds a page for each notebook, and its pictures."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        paragraphs: list[str] = []
        for number, cell in enumerate(nbformat.read(path, as_version=4).cells):
            if cell.cell_type == "markdown":
                paragraphs.append(cell.source)
                continue
            paragraphs.append(f"```python\n{cell.source}\n```")
            for place, output in enumerate(cell.outputs):
                name = f"{path.stem}/{number}_{place}.png"
                picture = output.get("data", {}).get("image/png")
                if picture:
                    content = base64.b64decode(picture)
                    files.append(File.generated(config, f"notebooks/{name}", content=content))
                    paragraphs.append(f"![Result of the code above]({name})")
                elif output.get("name") == "stdout":
                    paragraphs.append(f"```text\n{output.text.rstrip()}\n```")
        where = f"*This page is [`notebooks/{path.name}`]({path.name}): run it, change it.*"
        paragraphs.insert(1, where)
        files.append(File.generated(config, f"notebooks/{path.name}", abs_src_path=str(path)))
        text = "\n\n".join(paragraphs)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
    return files
