"""transforms.json of nerfstudio, instant-ngp, NeRF's own data sets, and scripts of people."""

from typing import Any

import numpy as np

from tests.formats.real.layouts import (
    NUM,
    OPENGL,
    POSES,
    Files,
    Layout,
    cloud,
    depth_png,
    picture,
    pixels,
    text,
)
from tests.formats.sequences import encoded

SIZE = (64, 48)
LENS = (70.0, 71.0, 31.0, 25.0)
_FIELDS = {"fl_x": 70.0, "fl_y": 71.0, "cx": 31.0, "cy": 25.0}


def _frames(name: str, **fields: Any) -> list[dict[str, Any]]:
    """In no order, as colmap2nerf.py leaves them."""
    rows = [(POSES[i] @ OPENGL).tolist() for i in range(NUM)]
    frame = lambda i: {"file_path": name.format(i), "sharpness": 31.75 + i, **fields}
    return [{**frame(i), "transform_matrix": rows[i]} for i in range(NUM)]


def _pictures(name: str) -> Files:
    return {name.format(i): picture(i, SIZE) for i in range(NUM)}


def _instant_ngp() -> Files:
    """colmap2nerf.py: sizes with a decimal point, both angles of view, zeros of other lenses."""
    content = {
        "camera_angle_x": 0.857, "camera_angle_y": 0.652, **_FIELDS, "w": 64.0, "h": 48.0,
        "k1": 0, "k2": 0, "k3": 0, "k4": 0, "p1": 0, "p2": 0, "is_fisheye": False,
        "aabb_scale": 16, "frames": _frames("./images/{:04d}.jpg"),
    }  # fmt: skip
    return {"transforms.json": text(content), **_pictures("images/{:04d}.jpg")}


def _nerfstudio() -> Files:
    """ns-process-data: a transform of three rows with negative zeros, a cloud beside."""
    content = {
        "w": 64, "h": 48, **_FIELDS, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply",
        "applied_transform": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [-0.0, -1.0, -0.0, -0.0]],
        "frames": _frames("images/frame_{:05d}.png", colmap_im_id=1),
    }  # fmt: skip
    files = {f"images/frame_{i:05d}.png": picture(i, SIZE, "png") for i in range(NUM)}
    copies = {f"images_2/frame_{i:05d}.png": picture(i, (32, 24), "png") for i in range(NUM)}
    return {"transforms.json": text(content), "sparse_pc.ply": cloud(), **files, **copies}


def _with_depth() -> Files:
    """A camera without a distortion key, depth in millimeters without a unit."""
    frames = _frames("images/frame_{:05d}.jpg")
    for i, frame in enumerate(frames):
        frame["depth_file_path"] = f"depth/frame_{i:05d}.png"
    depth = {f"depth/frame_{i:05d}.png": depth_png(i, (32, 24)) for i in range(NUM)}
    content = {"w": 64, "h": 48, **_FIELDS, "camera_model": "OPENCV", "frames": frames}
    return {"transforms.json": text(content), **_pictures("images/frame_{:05d}.jpg"), **depth}


def _matrices() -> Files:
    """A script that keeps OpenCV's K in every frame."""
    K = [[70.0, 0.0, 31.0], [0.0, 71.0, 25.0], [0.0, 0.0, 1.0]]
    content = {"w": 64, "h": 48, "aabb_scale": 1, "frames": _frames("images/{:03d}.jpg", K=K)}
    return {"transforms.json": text(content), **_pictures("images/{:03d}.jpg")}


def _synthetic() -> Files:
    """NeRF's data sets: split, names without a suffix, transparent pictures, no size."""
    frames = _frames("./train/r_{}", rotation=0.012566370614359171)
    files: Files = {"transforms_train.json": text({"camera_angle_x": 0.6911112, "frames": frames})}
    for split in ("val", "test"):
        other = text({"camera_angle_x": 0.6911112, "frames": frames[:1]})
        files[f"transforms_{split}.json"] = other
    for i in range(NUM):
        alpha = np.full((48, 64, 1), 255, np.uint8)
        files[f"train/r_{i}.png"] = encoded(np.concatenate([pixels(i, *SIZE), alpha], axis=-1))
    return files


_COMMON = {"size": SIZE, "intrinsics": LENS, "poses_off": 1e-12}
_FOCAL = 32.0 / float(np.tan(0.5 * 0.6911112))

LAYOUTS = (
    Layout("instant-ngp's colmap2nerf", _instant_ngp, has_depth=False, **_COMMON),
    Layout("nerfstudio's ns-process-data", _nerfstudio, has_depth=False, **_COMMON),
    Layout("nerfstudio, the file given", _nerfstudio, given="transforms.json", has_depth=False,
           **_COMMON),
    Layout("nerfstudio with depth of half the size", _with_depth, **_COMMON),
    Layout("a matrix K in every frame", _matrices, has_depth=False, **_COMMON),
    Layout("NeRF synthetic", _synthetic, size=SIZE, intrinsics=(_FOCAL, _FOCAL, 32.0, 24.0),
           has_depth=False, remark=("transforms_test.json", "transforms_val.json")),
)  # fmt: skip
