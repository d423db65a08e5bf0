"""Recordings with damaged images, depth images, poses and intrinsics.

All 2,000 cases: `pytest -m slow tests/fuzz/test_recordings.py`.
"""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from r3jax.formats.errors import FormatError
from r3jax.formats.recordings import read_recording
from r3jax.geometry.cameras import rigid_error
from tests.conftest import SHARED
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    rng = np.random.default_rng(0)
    files = {"K.txt": b"8 0 4.5\n0 8 3.5\n0 0 1\n", "poses.txt": b""}
    for i in range(2):
        rgb = rng.integers(0, 256, (8, 10, 3), dtype=np.uint8)
        depth = rng.integers(0, 5000, (8, 10)).astype(np.uint16)
        files[f"images/{i:03d}.png"] = encoded(rgb, "png")
        files[f"depth/{i:03d}.png"] = encoded(depth, "png")
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = 0.1 * i, 1.5, 0.25
        files["poses.txt"] += " ".join(f"{x:.6f}" for x in pose.reshape(-1)).encode() + b"\n"
    photos = {name: data for name, data in files.items() if not name.startswith("images/")}
    for i in range(2):
        photos[f"images/{i:03d}.jpg"] = encoded(np.full((8, 10, 3), 90 * i, np.uint8), "jpeg")
    return [files, photos, *_real_one()]


def encoded(image: np.ndarray, kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format=kind)
    return buffer.getvalue()


def _real_one() -> list[Files]:
    """The first frame of a real recording, where there is one."""
    path = SHARED / "recordings" / "hololens_lounge"
    if not path.is_dir():
        return []
    lines = (path / "poses.txt").read_bytes().splitlines(keepends=True)
    pose = next(line for line in lines if line.strip() and not line.startswith(b"#"))
    files = {"K.txt": (path / "K.txt").read_bytes(), "poses.txt": pose}
    for name in ("images", "depth"):
        image = min((path / name).iterdir())
        files[f"{name}/{image.name}"] = image.read_bytes()
    return [files]


def read(folder: Path) -> None:
    recording = read_recording(folder)
    assert len(recording) > 0
    for pose in recording.poses:
        assert rigid_error(pose.astype(np.float32)) is None
    for frame in recording.frames():
        shape = (recording.camera.height, recording.camera.width)
        assert frame.rgb.shape == (*shape, 3)
        assert frame.depth.shape == shape
        assert np.isfinite(frame.rgb).all()
        assert np.isfinite(frame.depth).all()
        assert (np.asarray(frame.depth) >= 0.0).all()
        assert rigid_error(np.asarray(frame.T_world_camera)) is None


READER = Reader(seeds, read, (FormatError,))


def test_damaged_recordings_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_recordings(harness):
    """`pytest -m slow tests/fuzz/test_recordings.py`."""
    harness.check(__name__, CASES_SLOW)
