"""A recording of an empty room: a few photos along two walls, and terms that take seconds."""

from pathlib import Path

import numpy as np
from PIL import Image

from r3jax.apps.benchmark.photos.protocol import PhotoTerms
from r3jax.geometry.cameras import look_at
from tests.exploration.toys import BoxRoom

NUM = 18
TERMS = PhotoTerms(
    choose=3, first=3, nearest=3, every=10, iterations=15, gaussians=300, capacity=600,
    voxel_size=0.1,
)  # fmt: skip


def poses() -> np.ndarray:
    """Cameras on a line through the room, turned more and more, [NUM, 4, 4], z up."""
    t = np.linspace(0.0, 1.0, NUM)
    eyes = np.stack([0.8 + 2.0 * t, 0.8 + 0.9 * t * t, np.full(NUM, 1.2)], axis=1)
    aims = np.stack([1.0 + 3.0 * t, 3.0 - 2.0 * t, np.full(NUM, 1.1)], axis=1)
    return np.stack(
        [np.asarray(look_at(e, a), np.float64) for e, a in zip(eyes, aims, strict=True)]
    )


def write_recording(path: Path) -> Path:
    """Writes the photos as a recording of a world with z up."""
    world = BoxRoom()
    camera = world.camera
    (path / "images").mkdir(parents=True)
    (path / "depth").mkdir()
    for i, pose in enumerate(poses()):
        frame = world.render(pose)
        rgb = np.rint(np.asarray(frame.rgb) * 255.0).astype(np.uint8)
        steps = np.rint(np.asarray(frame.depth) * 1000.0).astype(np.uint16)
        Image.fromarray(rgb).save(path / "images" / f"{i:03d}.png")
        Image.fromarray(steps).save(path / "depth" / f"{i:03d}.png")
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    # Recordings have pixel centers at whole numbers.
    K = [[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]]
    np.savetxt(path / "K.txt", K)
    np.savetxt(path / "poses.txt", poses().reshape(NUM, 16))
    return path
