"""The pages are built without a warning, and every public name has its place in them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import r3jax

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    settings = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        words, cwd=ROOT, env=settings, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_public_name_is_described(site):
    """The overview links to an anchor of each name, and the anchor is there."""
    overview = (site / "api" / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="\.\./?(?:api/)?([\w/]*)#(r3jax[\w.]*)"', overview)
    links += re.findall(r'href="([\w/]*)#(r3jax[\w.]*)"', overview)
    described = {anchor.rpartition(".")[2] for _, anchor in links}
    assert set(r3jax.__all__) <= described
    for page, anchor in links:
        text = (site / "api" / page.strip("/") / "index.html").read_text(encoding="utf-8")
        assert f'id="{anchor}"' in text


def test_pages_ask_nothing_of_the_net(site):
    """They can be read from a folder: no fonts, scripts or styles from elsewhere."""
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="https?://', text), page


def test_no_module_of_the_reference_is_left_out_by_mistake(site):
    """A page that describes nothing would be built without a warning as well."""
    for source in (ROOT / "docs" / "api").glob("*.md"):
        modules = re.findall(r"^::: (\S+)", source.read_text(encoding="utf-8"), re.MULTILINE)
        page = site / "api" / ("" if source.stem == "index" else source.stem) / "index.html"
        text = page.read_text(encoding="utf-8")
        for module in modules:
            assert text.count(f'id="{module}.') >= 1, f"{module} has nothing in it"
