"""Reads a scene of the Replica-SLAM renderings (NICE-SLAM, Zhu et al. 2022).

    results/frame000000.jpg    8-bit RGB
    results/depth000000.png    uint16, `scale` steps a meter (6553.5), 0 = no measurement
    traj.txt                   a camera-to-world matrix per line, 16 numbers row by row, OpenCV axes
    cam_params.json            {"camera": {w, h, fx, fy, cx, cy, scale}}; here or one folder above

The world is Replica's own: meters, z up; unless the first pose is the identity, as in sequences
that others write in this layout.
"""

from pathlib import Path
from typing import Any

from r3jax.formats.depth import DepthUnit
from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import PosedImages, pair_images
from r3jax.formats.poses import read_poses, up_of_poses
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, parse_json

_MAX_JSON = 1 << 20
"""A camera takes some hundred bytes."""

_FIELDS = {"w": int, "h": int, "fx": float, "fy": float, "cx": float, "cy": float, "scale": float}


def is_replica_slam(path: Path) -> bool:
    """Returns True if the folder looks like a scene of Replica-SLAM."""
    return (path / "traj.txt").exists() and (path / "results").is_dir()


def read_replica_slam(path: Path | str) -> PosedImages:
    """Opens a scene and checks everything but the pixels.

    Args:
        path: the folder of the scene.

    Raises:
        FormatError: files that are missing, numbers of images and poses that differ, a camera
            that makes no sense, poses that are not finite or not rigid.
    """
    path = Path(path)
    found, measured = (_numbered(path / "results", start) for start in ("frame", "depth"))
    poses = read_poses(path / "traj.txt")
    images, depths = pair_images(path, found, measured, len(poses))
    lens, unit = _camera(path)
    return PosedImages(
        path=path,
        image_paths=images,
        lenses=(lens,) * len(images),
        poses=poses,
        depth_paths=depths,
        depth_unit=unit,
        up=up_of_poses(poses),
    )


def _numbered(folder: Path, start: str) -> dict[str, Path]:
    """Finds the images whose names start like this, by the rest of their names."""
    if not folder.is_dir():
        raise FormatError(folder, "the folder is missing")
    kinds = (".png", ".jpg", ".jpeg")
    found = [p for p in folder.glob(f"{start}*") if p.suffix.lower() in kinds]
    if not found:
        raise FormatError(folder, f"the folder contains no image {start}*.jpg or {start}*.png")
    return {image.stem.removeprefix(start): image for image in found}


def _camera(path: Path) -> tuple[Lens, DepthUnit]:
    """Reads the camera of all images, and the unit of their depth."""
    places = (path / "cam_params.json", path.resolve().parent / "cam_params.json")
    source = next((place for place in places if place.exists()), places[0])
    with naming(source):
        content: Any = parse_json(read_bytes(source, _MAX_JSON))
        check_fields("cam_params", content, {"camera": dict[str, Any]})
        camera: dict[str, Any] = content["camera"]
        check_fields("camera", camera, _FIELDS)
        if not 1e-3 < camera["scale"] < 1e9:
            raise ForeignFileError(f"invalid scale {camera['scale']:g}")
        # Pixel centers lie at whole numbers there.
        center = (camera["cx"] + 0.5, camera["cy"] + 0.5)
        params = (float(camera["fx"]), float(camera["fy"]), *center)
        lens = Lens("PINHOLE", camera["w"], camera["h"], params)
        return lens, DepthUnit(1.0 / camera["scale"])
