"""The pages are built without a warning, open from a folder, and describe every public name."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from playwright import sync_api

import r3jax

pytestmark = pytest.mark.full

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
PYTHON_BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


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
    links = re.findall(r'href="([\w-]+\.html)#(r3jax[\w.]*)"', overview)
    described = {anchor.rpartition(".")[2] for _, anchor in links}
    assert set(r3jax.__all__) <= described
    for page, anchor in links:
        assert f'id="{anchor}"' in (site / "api" / page).read_text(encoding="utf-8")


def test_pages_ask_nothing_of_the_net(site):
    """They can be read from a folder: no fonts, scripts or styles from elsewhere."""
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="https?://', text), page


def test_no_module_of_the_reference_is_left_out_by_mistake(site):
    """A page that describes nothing would be built without a warning as well."""
    for source in (DOCS / "api").glob("*.md"):
        modules = re.findall(r"^::: (\S+)", source.read_text(encoding="utf-8"), re.MULTILINE)
        text = (site / "api" / f"{source.stem}.html").read_text(encoding="utf-8")
        for module in modules:
            assert text.count(f'id="{module}.') >= 1, f"{module} has nothing in it"


def test_made_pages_have_what_they_are_made_of(site):
    """Notebooks have their pictures, equations are MathML, every command has a section."""
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        text = (site / "notebooks" / f"{notebook.stem}.html").read_text(encoding="utf-8")
        pictures = re.findall(rf'src="({notebook.stem}/\w+\.png)"', text)
        assert len(pictures) >= 3
        assert all((site / "notebooks" / picture).is_file() for picture in pictures)
    method = (site / "explanation" / "method.html").read_text(encoding="utf-8")
    assert method.count("<math") >= 20
    assert "arithmatex" not in method
    commands = (site / "api" / "commands.html").read_text(encoding="utf-8")
    for name in ("explore", "train", "evaluate", "benchmark", "audit", "view"):
        assert f'id="r3jax-{name}"' in commands


def test_pages_are_searched_from_a_folder(site):
    """Chromium opens the site as files, and its search finds the page of a word."""
    if not Path(CHROMIUM).exists():
        pytest.skip("the search is tested in Chromium, which is not installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto((site / "index.html").as_uri())
        page.locator('input[name="query"]').click()
        page.locator('input[name="query"]').press_sequentially("loop closure", delay=20)
        found = page.locator(".md-search-result__link").first
        found.wait_for(timeout=20_000)
        hits = page.locator(".md-search-result__link").evaluate_all("all => all.map(a => a.href)")
        browser.close()
    assert any("howto/slam.html" in address for address in hits), hits


def test_examples_of_the_reference_run_one_after_the_other():
    names = {}
    for code in PYTHON_BLOCK.findall((DOCS / "api" / "index.md").read_text(encoding="utf-8")):
        exec(compile(code, "docs/api/index.md", "exec"), names)
    assert names["image"].rgb.shape == (64, 64, 3)


def test_promises_name_tests_that_are_there():
    """Each row of the table ends with its tests: paths, or files beside the path before them."""
    text = (DOCS / "explanation" / "promises.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 30
    for row in rows:
        folder = None
        for name in re.findall(r"`([\w/*]*(?:test_[\w*]+\.py|/))`", row.split(" | ")[-1]):
            path = ROOT / name if name.startswith("tests/") else folder / name
            assert list(ROOT.glob(str(path.relative_to(ROOT)))), f"{name} in: {row}"
            folder = path.parent
