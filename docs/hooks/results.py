"""Tables and figures of experiments/results in the pages that speak of them.

A page names what it wants by a comment, and gets it in its place:

    <!-- results: beyond/small/beyond.md -->

Everything beside it (figures, CSV) is copied and linked. A result that no page names is a warning,
which fails a strict build: nothing that was measured goes unreported.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"
_MARK = re.compile(r"^<!-- results: (\S+) -->$", re.MULTILINE)
_named: set[str] = set()


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds figures and tables of numbers to the site."""
    for path in sorted(RESULTS.rglob("*")):
        if path.suffix in {".png", ".csv", ".json", ".tex"}:
            uri = f"results/files/{path.relative_to(RESULTS).as_posix()}"
            files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, *, page: Page, **kwargs: object) -> str:
    """Puts the results in the places that name them."""
    if not page.file.src_uri.startswith("results/"):
        return markdown
    return _MARK.sub(lambda found: _included(found[1]), markdown)


def _included(name: str) -> str:
    path = RESULTS / name
    _named.add(name)
    folder = f"files/{Path(name).parent.as_posix()}"
    text = path.read_text(encoding="utf-8").strip()
    text = re.sub(r"\]\((?!https?://)([^)/]+\.\w+)\)", rf"]({folder}/\1)", text)
    text = re.sub(r"^#+ (.*)$", r"**\1**", text, flags=re.MULTILINE)
    rows = [p.name for p in sorted(path.parent.iterdir()) if p.suffix in {".csv", ".json"}]
    links = ", ".join(f"[{row}]({folder}/{row})" for row in rows)
    return f"{text}\n\nNumbers behind it: {links}\n" if links else f"{text}\n"


def on_env(env: object, **kwargs: object) -> None:
    """All pages are read by now: complains about results that none of them names."""
    there = {path.relative_to(RESULTS).as_posix() for path in RESULTS.rglob("*.md")}
    for name in sorted(there - _named):
        message = "experiments/results/%s is in no page: name it in one of docs/results"
        get_plugin_logger("results").warning(message, name)
