"""Pages of results: tables and figures of experiments/results, and the details beside them.

A page names what it wants by a comment, alone on its line or behind a link:

    <!-- results: beyond/small/beyond.md -->

Everything beside it (figures, CSV) is copied and linked. `experiments/results/NAME/README.md`, the
details of a page, becomes `results/details/NAME.md`. A table that no page names is a warning, which
fails a strict build: nothing that was measured goes unreported.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"
_MARK = re.compile(r"^(?:\[[^\]]*\]\([^)]*\) )?<!-- results: (\S+) -->$", re.MULTILINE)
_DETAILS = re.compile(r"\]\((?:\.\./)+experiments/results/(\w+)/README\.md")
_named: set[str] = set()


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds figures, tables of numbers and pages of details to the site."""
    for path in sorted(RESULTS.rglob("*")):
        if path.suffix in {".png", ".csv", ".json", ".tex"}:
            uri = f"results/files/{path.relative_to(RESULTS).as_posix()}"
            files.append(File.generated(config, uri, abs_src_path=str(path)))
    for path in sorted(RESULTS.glob("*/README.md")):
        uri = f"results/details/{path.parent.name}.md"
        files.append(File.generated(config, uri, content=_for_the_site(path.read_text("utf-8"))))
    return files


def _for_the_site(text: str) -> str:
    """Turns the links of a README in the repository into those of the site."""
    text = _MARK.sub(r"<!-- results: \1 -->", text)
    text = text.replace("](../../../docs/", "](../../")
    text = re.sub(r"\]\(\.\./(\w+)/README\.md", r"](\1.md", text)
    return re.sub(r"\]\(\.\./((?:\w|-)+/[^)]*\.(?:png|csv|json))\)", r"](../files/\1)", text)


def on_page_markdown(markdown: str, *, page: Page, **kwargs: object) -> str:
    """Puts the results in the places that name them, and leads to the details on the site."""
    folder = posixpath.dirname(page.file.src_uri)
    details = posixpath.relpath("results/details", folder or ".")
    markdown = _DETAILS.sub(rf"]({details}/\1.md", markdown)
    if not page.file.src_uri.startswith("results/"):
        return markdown
    files = posixpath.relpath("results/files", folder)
    return _MARK.sub(lambda found: _included(found[1], files), markdown)


def _included(name: str, files: str) -> str:
    path = RESULTS / name
    _named.add(name)
    folder = f"{files}/{Path(name).parent.as_posix()}"
    text = path.read_text(encoding="utf-8").strip()
    text = re.sub(r"\]\((?!https?://)([^)/]+\.\w+)\)", rf"]({folder}/\1)", text)
    text = re.sub(r"^#+ (.*)$", r"**\1**", text, flags=re.MULTILINE)
    rows = [p.name for p in sorted(path.parent.iterdir()) if p.suffix in {".csv", ".json"}]
    links = ", ".join(f"[{row}]({folder}/{row})" for row in rows)
    return f"{text}\n\nNumbers behind it: {links}\n" if links else f"{text}\n"


def on_env(env: object, **kwargs: object) -> None:
    """All pages are read by now: complains about results that none of them names."""
    tables = {p.relative_to(RESULTS).as_posix() for p in RESULTS.rglob("*.md")}
    for name in sorted(t for t in tables - _named if not t.endswith("/README.md")):
        message = "experiments/results/%s is in no page: name it in one of docs/results"
        get_plugin_logger("results").warning(message, name)
