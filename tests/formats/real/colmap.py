"""COLMAP, and what gaussian-splatting and people make of its folders."""

import struct

import numpy as np

from tests.formats.real.layouts import NUM, POSES, Files, Layout, picture

SIZE = (64, 48)
RADIAL = (70.0, 70.0, 32.0, 24.0)
NAMES = ("DSC_5283.JPG", "DSC_5284.JPG", "DSC_5290.JPG")
"""As a camera numbers them, with gaps and a suffix in capitals."""

IDS = (9, 2, 5)
"""COLMAP numbers images in the order of its database, not of their names."""

NUM_POINTS = 40
_POINTS = np.random.default_rng(3).normal(0.0, 2.0, (NUM_POINTS, 3))


def _extrinsics(pose: np.ndarray) -> list[float]:
    from r3jax.formats.poses import quaternion_of

    inverse = np.linalg.inv(pose)
    return [*quaternion_of(inverse[:3, :3]), *inverse[:3, 3]]


def text_model(names: tuple[str, ...] = NAMES) -> Files:
    """cameras.txt, images.txt, points3D.txt with COLMAP's headings and 17 digits."""
    images = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        f"# Number of images: {NUM}, mean observations per image: 200.66666666666666",
    ]
    for i in range(NUM):
        numbers = " ".join(f"{value:.17g}" for value in _extrinsics(POSES[i]))
        images.append(f"{IDS[i]} {numbers} 1 {names[i]}")
        images.append("7.5 8.25 -1 " + " ".join(f"{k}.5 {k}.25 {k}" for k in range(NUM_POINTS)))
    points = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
        f"# Number of points: {NUM_POINTS}, mean track length: 2.3515625",
    ]
    for k, xyz in enumerate(_POINTS):
        track = " ".join(f"{number} {k + 1}" for number in IDS)
        points.append(f"{k} {' '.join(f'{v:.17g}' for v in xyz)} 49 78 86 1.11864 {track}")
    cameras = [
        "# Camera list with one line of data per camera:",
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        "# Number of cameras: 1",
        "1 SIMPLE_RADIAL 64 48 70 32 24 -0.013",
    ]
    tables = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {name: ("\n".join(lines) + "\n").encode() for name, lines in tables.items()}


def binary_model() -> Files:
    """The same in binary, with the rigs and frames that COLMAP adds since 3.12."""
    cameras = struct.pack("<QIiQQ4d", 1, 1, 2, 64, 48, 70.0, 32.0, 24.0, -0.013)
    images = struct.pack("<Q", NUM)
    for i in range(NUM):
        images += struct.pack("<I7dI", IDS[i], *_extrinsics(POSES[i]), 1)
        images += NAMES[i].encode() + b"\0" + struct.pack("<Q", NUM_POINTS + 1)
        images += struct.pack("<2dq", 7.5, 8.25, -1)
        images += b"".join(struct.pack("<2dq", k, k, k) for k in range(NUM_POINTS))
    points = struct.pack("<Q", NUM_POINTS)
    for k, xyz in enumerate(_POINTS):
        points += struct.pack("<Q3d3BdQ", k, *xyz, 49, 78, 86, 1.1, NUM)
        points += b"".join(struct.pack("<II", number, k + 1) for number in IDS)
    rigs = struct.pack("<QII", 1, 1, 1) + struct.pack("<iI", 0, 1)
    return {
        "cameras.bin": cameras, "images.bin": images, "points3D.bin": points,
        "rigs.bin": rigs, "frames.bin": struct.pack("<Q", 0), "project.ini": b"log_to_stderr=0\n",
    }  # fmt: skip


def within(folder: str, files: Files) -> Files:
    """The files in a folder."""
    return {f"{folder}/{name}": data for name, data in files.items()}


def photos(folder: str, names: tuple[str, ...] = NAMES) -> Files:
    """The pictures by their names."""
    return {f"{folder}/{name}": picture(i, SIZE) for i, name in enumerate(names)}


def _workspace() -> Files:
    beside = {"database.db": b"SQLite format 3\0", "images/.DS_Store": b"\0Bud1"}
    return within("sparse/0", binary_model()) | photos("images") | beside


def _gaussian_splatting() -> Files:
    run = within("distorted/sparse/0", {"project.ini": b""}) | {"distorted/database.db": b""}
    stereo = {"stereo/patch-match.cfg": b"__auto__, 20\n", "run-colmap-geometric.sh": b""}
    return within("sparse/0", binary_model()) | photos("images") | run | stereo


def _torn() -> Files:
    whole = within("sparse/0", binary_model())
    torn = {f"sparse/1/{n}": binary_model()[n] for n in ("cameras.bin", "points3D.bin")}
    return whole | torn | photos("images")


def _failed() -> Files:
    """A calibration that ran away, as of photos without overlap."""
    lens = struct.pack("<QIiQQ4d", 1, 1, 2, 64, 48, 70.0, 32.0, 24.0, -15.46)
    return _workspace() | {"sparse/0/cameras.bin": lens}


def _instant_ngp() -> Files:
    """colmap2nerf.py's folders, without its transforms.json."""
    return within("colmap_text", text_model(_JPEGS)) | photos("images", _JPEGS)


_JPEGS = ("1.jpeg", "2.jpeg", "3.jpeg")

_COMMON = {
    "size": SIZE, "intrinsics": RADIAL, "model": "SIMPLE_RADIAL",
    "has_depth": False, "has_points": True,
}  # fmt: skip

LAYOUTS = (
    Layout("colmap workspace, binary, with rigs and frames", _workspace, **_COMMON),
    Layout("colmap, the model's folder given", _workspace, given="sparse/0", **_COMMON),
    Layout("gaussian-splatting's convert.py", _gaussian_splatting, **_COMMON),
    Layout("colmap, sparse/1 without its images", _torn, remark=("sparse/1",), **_COMMON),
    Layout(
        "colmap, text", lambda: text_model(_JPEGS) | photos("images", _JPEGS), poses_off=1e-9,
        **_COMMON,
    ),
    Layout("colmap, a lens that ran away", _failed, remark=("Camera 1 ", "plausible"), **_COMMON),
    Layout("colmap_text of instant-ngp", _instant_ngp, **_COMMON),
)  # fmt: skip
