"""Tiny sequences in the layouts of Replica-SLAM, TUM, 7-Scenes and LLFF, in memory."""

import io
import json

import numpy as np
from PIL import Image

from r3jax.formats.poses import quaternion_of
from tests.formats.colmap_models import random_pose

WIDTH, HEIGHT, NUM = 10, 8, 3


def encoded(image: np.ndarray, kind: str = "png") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format=kind)
    return buffer.getvalue()


def poses(num: int = NUM) -> np.ndarray:
    found = np.stack([random_pose(i) for i in range(num)])
    found[:, :3, 3] /= 10.0
    return found


def pixels(i: int, width: int = WIDTH, height: int = HEIGHT) -> tuple[np.ndarray, np.ndarray]:
    """Colors and depth steps; the first steps are 0 and 65535."""
    rng = np.random.default_rng(i)
    rgb = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    steps = rng.integers(1, 20_000, (height, width)).astype(np.uint16)
    steps[0, :2] = 0, 65535
    return rgb, steps


def replica_slam() -> dict[str, bytes]:
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 8.0, "fy": 8.0, "cx": 4.5, "cy": 3.5, "scale": 6553.5}
    files = {"cam_params.json": json.dumps({"camera": camera}).encode(), "traj.txt": b""}
    for i, pose in enumerate(poses()):
        rgb, steps = pixels(i)
        files[f"results/frame{i:06d}.jpg"] = encoded(rgb, "jpeg")
        files[f"results/depth{i:06d}.png"] = encoded(steps)
        files["traj.txt"] += " ".join(f"{x:.18e}" for x in pose.ravel()).encode() + b"\n"
    return files


def tum() -> dict[str, bytes]:
    """Depth comes 8 ms after color, poses every 5 ms; the last image has no depth near it."""
    files = {
        "rgb.txt": b"# color images\n# timestamp filename\n",
        "depth.txt": b"# depth maps\n",
        "groundtruth.txt": b"# timestamp tx ty tz qx qy qz qw\n",
        "K.txt": b"8 0 4.5\n0 8 3.5\n0 0 1\n",
    }
    for i in range(NUM + 1):
        time = 100.0 + 0.1 * i
        rgb, steps = pixels(i)
        name = f"rgb/{time:.6f}.png"
        files[name] = encoded(rgb)
        files["rgb.txt"] += f"{time:.6f} {name}\n".encode()
        if i < NUM:
            name = f"depth/{time + 0.008:.6f}.png"
            files[name] = encoded(steps)
            files["depth.txt"] += f"{time + 0.008:.6f} {name}\n".encode()
    for k in range(80):
        time = 99.999 + 0.005 * k
        pose = poses(NUM + 1)[min(NUM, max(0, round((time - 100.0) / 0.1)))]
        w, x, y, z = quaternion_of(pose[:3, :3])
        numbers = [time, *pose[:3, 3], x, y, z, w]
        files["groundtruth.txt"] += " ".join(f"{v:.9f}" for v in numbers).encode() + b"\n"
    return files


def seven_scenes() -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    for i, pose in enumerate(poses(2)):
        rgb, steps = pixels(i)
        # Blocks of one value: real sizes, small files.
        files[f"frame-{i:06d}.color.png"] = encoded(np.kron(rgb, np.ones((60, 64, 1), np.uint8)))
        files[f"frame-{i:06d}.depth.png"] = encoded(np.kron(steps, np.ones((60, 64), np.uint16)))
        lines = ["\t".join(f"{x:.7e}" for x in row) for row in pose]
        files[f"frame-{i:06d}.pose.txt"] = "\n".join(lines).encode()
    return files


def llff() -> dict[str, bytes]:
    """Axes down, right, backward; the size of the images that COLMAP had; copies of half of it."""
    rows = [
        [*np.column_stack([T[:3, 1], T[:3, 0], -T[:3, 2], T[:3, 3], [HEIGHT, WIDTH, 8.0]]).ravel(),
         0.5, 4.0]
        for T in poses()
    ]  # fmt: skip
    stored = io.BytesIO()
    np.save(stored, np.array(rows))
    files = {"poses_bounds.npy": stored.getvalue()}
    for i in range(NUM):
        files[f"images/IMG_{9699 + i}.JPG"] = encoded(pixels(i)[0], "jpeg")
        files[f"images_2/IMG_{9699 + i}.png"] = encoded(pixels(i)[0][::2, ::2])
    return files
