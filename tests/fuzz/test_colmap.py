"""COLMAP models, text and binary, with damaged tables, counts, names and numbers.

All 2,000 cases: `pytest -m slow tests/fuzz/test_colmap.py`.
"""

import tempfile
from pathlib import Path

import numpy as np
import pytest

from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.colmap.text import write_text
from r3jax.formats.errors import FormatError
from r3jax.geometry.cameras import rigid_error
from tests.formats.colmap_models import random_model
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.numbers import INT_WORDS
from tests.fuzz.tree import Files, Link, pick_up
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    found: list[Files] = []
    for write, seed in ((write_binary, 0), (write_text, 0), (write_binary, 5), (write_text, 7)):
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder), random_model(seed))
            found.append({f"sparse/0/{name}": data for name, data in pick_up(Path(folder)).items()})
    return found


def read(folder: Path) -> None:
    images = read_colmap(folder)
    assert len(images) > 0
    assert len(images.lenses) == len(images) == len(images.poses) == len(images.depth_paths)
    for pose, lens, path in zip(images.poses, images.lenses, images.image_paths, strict=True):
        assert rigid_error(pose) is None
        assert np.isfinite(lens.params).all()
        assert lens.camera.width > 0
        assert ".." not in path.relative_to(folder).parts
    points = images.points
    assert points is not None
    assert np.isfinite(points.xyz).all()
    assert points.rgb.shape == points.xyz.shape
    assert ((points.seen_image >= 0) & (points.seen_image < len(images))).all()
    assert ((points.seen_point >= 0) & (points.seen_point < len(points))).all()
    for index in range(len(images)):
        try:
            images.frame(index)
        except FormatError:
            continue  # distorted, or there is no depth
        raise AssertionError("a COLMAP model has no depth")


READER = Reader(seeds, read, (FormatError,))


def crafted() -> list[Files]:
    """Every count and every other word of a binary as a hostile number, and names that lead out."""
    binary, text = seeds()[:2]
    found: list[Files] = []
    for name, data in binary.items():
        assert isinstance(data, bytes)
        for word in (*(word.to_bytes(8, "little") for word in INT_WORDS), b"\xff" * 8):
            for at in (0, *range(8, min(len(data), 120), 4)):
                found.append({**binary, name: data[:at] + word + data[at + 8 :]})
    name = "sparse/0/images.txt"
    lines = text[name]
    assert isinstance(lines, bytes)
    for hostile in (b"../../x", b"/etc/passwd", b"..\\x", b".", b"a/../../outside/secret", b"\0"):
        found.append({**text, name: lines.replace(b"a.png", hostile)})
    found.append({**binary, "images": Link("/")})
    return found


CRAFTED = Reader(crafted, read, (FormatError,))


def test_damaged_models_are_refused_or_read(harness):
    harness.check(__name__, CASES)


def test_hostile_counts_and_names(harness):
    harness.check_crafted(f"{__name__}:CRAFTED")


@pytest.mark.slow
def test_many_damaged_models(harness):
    """`pytest -m slow tests/fuzz/test_colmap.py`."""
    harness.check(__name__, CASES_SLOW)
