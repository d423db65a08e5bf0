"""Recordings of phones: Record3D's export as one was shared, Stray Scanner's as its source writes
it."""

import numpy as np

from tests.formats.phones import exr, video
from tests.formats.real.layouts import (
    NUM,
    OPENGL,
    POSES,
    Files,
    Layout,
    depth_png,
    meters,
    picture,
    pixels,
    quaternion,
    text,
)
from tests.formats.sequences import encoded

RECORD3D = (48, 64)
"""Held upright: higher than wide."""

_DEPTH = (12, 16)


def _record3d() -> Files:
    """One K with its columns one after the other, an initPose, more poses than pictures."""
    poses = [
        [*quaternion(T @ OPENGL), *T[:3, 3].tolist()] for T in (*POSES, *POSES[:1], *POSES[:1])
    ]
    metadata = {
        "dh": 16, "frameTimestamps": [0, *np.arange(1, 5) * 0.016668042], "dw": 12, "fps": 60,
        "poses": poses, "K": [70.5, 0, 0, 0, 71.5, 0, 25.0, 30.0, 1],
        "initPose": [0, 0, 0, 1, 0, 0, 0], "h": 64, "w": 48, "cameraType": 1,
    }  # fmt: skip
    files: Files = {"EXR_RGBD/metadata.json": text(metadata), "EXR_RGBD/sound.m4a": b""}
    for i in range(NUM):
        files[f"EXR_RGBD/rgb/{i}.jpg"] = picture(i, RECORD3D)
        files[f"EXR_RGBD/depth/{i}.exr"] = exr({"R": meters(i, *_DEPTH)})
    return files


STRAY = (192, 144)


def _stray(header: str, tail: str) -> Files:
    """Blanks after the commas, numbers with zeros before them, 1/60 s apart."""
    rows = [header]
    files: Files = {"imu.csv": b"timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n"}
    for i in range(NUM):
        numbers = [*POSES[i][:3, 3], *quaternion(POSES[i])]
        line = ", ".join(f"{value:.9g}" for value in numbers)
        rows.append(f"{6791.528 + i / 60}, {i:06d}, {line}{tail}")
        files[f"depth/{i:06d}.png"] = depth_png(i, (16, 12))
        files[f"confidence/{i:06d}.png"] = encoded(np.full((12, 16), 2, np.uint8))
    files["odometry.csv"] = ("\n".join(rows) + "\n").encode()
    files["camera_matrix.csv"] = b"150.5, 0.0, 96.0\n0.0, 150.5, 72.0\n0.0, 0.0, 1.0\n"
    return files | {"rgb.mp4": video([pixels(i, *STRAY) for i in range(NUM)])}


_HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"
_NEWER = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
_COMMON = {"size": STRAY, "intrinsics": (150.5, 150.5, 96.0, 72.0), "up": (0.0, 1.0, 0.0)}

LAYOUTS = (
    Layout("Record3D EXR + JPG", _record3d, given="EXR_RGBD", size=RECORD3D,
           intrinsics=(70.5, 71.5, 25.0, 30.0), up=(0.0, 1.0, 0.0), remark=("2 of 5",)),
    Layout("Stray Scanner", lambda: _stray(_HEADER, ""), **_COMMON),
    Layout("Stray Scanner of 2026, centers of distortion left empty",
           lambda: _stray(_HEADER + _NEWER, ", 150.5, 150.5, 96.0, 72.0, , "), **_COMMON),
)  # fmt: skip
