"""transforms.json files with damaged fields, matrices, names, images and depth images.

All 2,000 cases: `pytest -m slow tests/fuzz/test_nerfstudio.py`.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import read_transforms
from r3jax.geometry.cameras import rigid_error
from tests.fuzz import containers
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.json_trees import HOSTILE_NAMES
from tests.fuzz.test_recordings import encoded
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""

POSE = [[1.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def seeds() -> list[Files]:
    rng = np.random.default_rng(0)
    files: dict[str, bytes] = {}
    frames = []
    for i in range(2):
        files[f"images/{i}.png"] = encoded(rng.integers(0, 256, (8, 10, 3), dtype=np.uint8), "png")
        files[f"depth/{i}.png"] = encoded(rng.integers(0, 5000, (4, 5)).astype(np.uint16), "png")
        frames.append({"file_path": f"images/{i}.png", "depth_file_path": f"depth/{i}.png"})
        frames[-1]["transform_matrix"] = POSE
    ours = {"w": 10, "h": 8, "fl_x": 12.5, "fl_y": 12.25, "cx": 5.0, "cy": 4.0}
    ours |= {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    ours |= {"depth_unit_scale_factor": 0.0002, "depth_beyond_range_value": 65535}
    blender = {"camera_angle_x": 0.7, "applied_transform": POSE[:3], "applied_scale": 0.5}
    bare = [{**frame, "file_path": frame["file_path"].removesuffix(".png")} for frame in frames]
    return [
        {**files, "transforms.json": json.dumps({**ours, "frames": frames}).encode()},
        {**files, "transforms.json": json.dumps({**blender, "frames": bare}).encode()},
    ]


def read(folder: Path) -> None:
    images = read_transforms(folder)
    assert len(images) > 0
    for i, pose in enumerate(images.poses):
        assert rigid_error(pose) is None
        assert np.isfinite(images.lenses[i].params).all()
        assert ".." not in images.image_paths[i].relative_to(folder).parts
    for frame in images.frames():
        assert frame.rgb.shape == (*frame.depth.shape, 3)
        assert not np.isnan(frame.depth).any()
        assert (np.asarray(frame.depth) >= 0.0).all()


READER = Reader(seeds, read, (FormatError,))


def crafted() -> list[Files]:
    """Names that lead elsewhere, and a picture that unpacks to far more than it takes."""
    seed = seeds()[0]
    text = seed["transforms.json"]
    assert isinstance(text, bytes)
    content = json.loads(text)
    found: list[Files] = []
    for field in ("file_path", "depth_file_path"):
        for name in HOSTILE_NAMES:
            frames = [{**content["frames"][0], field: name}]
            changed = json.dumps({**content, "frames": frames}).encode()
            found.append({**seed, "transforms.json": changed})
    for name in ("images/0.png", "depth/0.png"):
        found.append({**seed, name: containers.png_bomb()})
        huge = json.dumps({**content, "w": 65536, "h": 65536}).encode()
        found.append({**seed, name: containers.png_bomb(), "transforms.json": huge})
    return found


CRAFTED = Reader(crafted, read, (FormatError,))


def test_damaged_files_are_refused_or_read(harness):
    harness.check(__name__, CASES)


def test_hostile_names_and_pictures(harness):
    harness.check_crafted(f"{__name__}:CRAFTED")


@pytest.mark.slow
def test_many_damaged_files(harness):
    """`pytest -m slow tests/fuzz/test_nerfstudio.py`."""
    harness.check(__name__, CASES_SLOW)
