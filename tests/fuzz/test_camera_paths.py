"""Camera paths with damaged fields, matrices and sizes.

All 2,000 cases: `pytest -m slow tests/fuzz/test_camera_paths.py`.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from r3jax.apps.audit.camera_paths import is_camera_path, read_camera_path
from r3jax.formats.errors import FormatError
from r3jax.geometry.cameras import rigid_error
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 100
"""In the normal suite."""


def seeds() -> list[Files]:
    matrix = np.eye(4)
    matrix[:3, 3] = 1.0, 2.0, 3.0
    camera = {"camera_to_world": matrix.ravel().tolist(), "fov": 60.0, "aspect": 1.5}
    content = {
        "camera_type": "perspective", "render_width": 96, "render_height": 64, "fps": 24,
        "seconds": 4.0, "camera_path": [camera, camera], "keyframes": [],
    }  # fmt: skip
    return [{"path.json": json.dumps(content).encode()}]


def read(folder: Path) -> None:
    is_camera_path(folder / "path.json")  # never raises
    path = read_camera_path(folder / "path.json")
    assert len(path.poses) == len(path.lenses) > 0
    for pose, lens in zip(path.poses, path.lenses, strict=True):
        assert rigid_error(pose) is None
        assert np.isfinite(lens.params).all()
        assert lens.is_pinhole


READER = Reader(seeds, read, (FormatError,))


def test_damaged_camera_paths_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_camera_paths(harness):
    """`pytest -m slow tests/fuzz/test_camera_paths.py`."""
    harness.check(__name__, CASES_SLOW)
