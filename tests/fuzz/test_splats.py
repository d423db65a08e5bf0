"""Splat PLY files, damaged.

All 2,000 cases: `pytest -m slow tests/fuzz/test_splats.py`.
"""

import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest

from r3jax.splatting.errors import SceneFileError
from r3jax.splatting.ply import read_scene, write_scene
from r3jax.splatting.scene import GaussianScene
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files, pick_up, unsealed
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    rng = np.random.default_rng(0)
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "scene.ply"
        written = []
        for harmonics in (1, 4):
            scene = GaussianScene(
                draw(5, 3), draw(5, 4), draw(5, 3), draw(5), draw(5, harmonics, 3)
            )
            write_scene(path, scene)
            written.append(unsealed(pick_up(path.parent)))
    return [*written, {"scene.ply": _as_text(written[0]["scene.ply"])}]


def _as_text(data: bytes) -> bytes:
    """The same scene as a text PLY, with an element before the Gaussians."""
    head, _, body = data.partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(5, -1)
    head = head.replace(b"binary_little_endian", b"ascii")
    camera = b"element camera 1\nproperty float fov\nelement vertex"
    rows = "\n".join(" ".join(f"{x:.6g}" for x in row) for row in table)
    return head.replace(b"element vertex", camera) + b"end_header\n60\n" + rows.encode() + b"\n"


def read(folder: Path) -> None:
    scene = read_scene(folder / "scene.ply")
    for leaf in jax.tree.leaves(scene):
        assert np.isfinite(leaf).all()
    assert np.asarray(scene.is_alive).any()


READER = Reader(seeds, read, (SceneFileError,))


def test_damaged_splats_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_splats(harness):
    """`pytest -m slow tests/fuzz/test_splats.py`."""
    harness.check(__name__, CASES_SLOW)
