"""The README: short, its links lead somewhere, and its Python runs when pasted."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_it_is_short_and_says_what_people_look_for():
    assert len(README.splitlines()) <= 120
    for word in (
        "make demo",
        "make test",
        "pip install",
        "phone",
        "ROS",
        "SLAM",
        "r3jax audit",
        "r3jax benchmark",
    ):
        assert word in README


def test_links_and_pictures_are_there():
    for name in ("README.md", "CONTRIBUTING.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        links = re.findall(r"\]\((?!https?://)([^)#]+)", text)
        links += re.findall(r"`((?:docs|tests|r3jax|experiments)/[\w/.-]+)`", text)
        missing = [link for link in links if not (ROOT / link).exists()]
        assert not missing, f"{name}: {missing}"


def test_the_film_is_small():
    assert (ROOT / "docs" / "images" / "film.webp").stat().st_size < 3_000_000


@pytest.mark.full
def test_its_python_runs_when_pasted(capsys):
    blocks = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 1
    assert len([line for line in blocks[0].splitlines() if line.strip()]) <= 12
    exec(compile(blocks[0], "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    said = re.compile(r"next view at \[.*\], renderability so far \d\.\d\d")
    assert all(said.fullmatch(line) for line in lines)
