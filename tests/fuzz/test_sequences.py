"""Replica-SLAM, TUM and 7-Scenes with damaged lists, poses, cameras and images.

All 2,000 cases of each: `pytest -m slow tests/fuzz/test_sequences.py`.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from r3jax.formats.errors import FormatError
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.sequences.replica_slam import read_replica_slam
from r3jax.formats.sequences.seven_scenes import read_seven_scenes
from r3jax.formats.sequences.tum import read_tum
from r3jax.geometry.cameras import rigid_error
from tests.formats import sequences
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 80
"""Of each, in the normal suite."""


def checked(read: Callable[[Path], PosedImages]) -> Callable[[Path], None]:
    """A reader whose values must make sense."""

    def check(folder: Path) -> None:
        images = read(folder)
        assert len(images) > 0
        for pose in images.poses:
            assert rigid_error(pose) is None
        for path in (*images.image_paths, *images.depth_paths):
            assert path is not None
            assert ".." not in path.relative_to(folder).parts
        for frame in images.frames():
            assert frame.rgb.shape == (*frame.depth.shape, 3)
            assert np.isfinite(frame.depth).all()
            assert (np.asarray(frame.depth) >= 0.0).all()

    return check


REPLICA_SLAM = Reader(
    lambda: [sequences.replica_slam()], checked(read_replica_slam), (FormatError,)
)
TUM = Reader(lambda: [sequences.tum()], checked(read_tum), (FormatError,))
SEVEN_SCENES = Reader(
    lambda: [sequences.seven_scenes()], checked(read_seven_scenes), (FormatError,)
)
NAMES = ("REPLICA_SLAM", "TUM", "SEVEN_SCENES")


@pytest.mark.parametrize("name", NAMES)
def test_damaged_sequences_are_refused_or_read(harness, name):
    harness.check(f"{__name__}:{name}", CASES)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_sequences(harness, name):
    """`pytest -m slow tests/fuzz/test_sequences.py`."""
    harness.check(f"{__name__}:{name}", CASES_SLOW)
