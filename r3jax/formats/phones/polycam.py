"""Reads raw data of Polycam, a folder or a zip archive.

    keyframes/images/<us>.jpg        8-bit RGB
    keyframes/cameras/<us>.json      fx, fy, cx, cy, width, height, t_00 .. t_23: a 3x4
                                     camera-to-world matrix, OpenGL axes, ARKit's world (y up) [m]
    keyframes/depth/<us>.png         uint16, millimeters, smaller than the image
    keyframes/confidence/<us>.png    255 is the best

After the app's own bundle adjustment there are corrected_images/ and corrected_cameras/ as well,
which are taken then; long sessions have none. Polycam itself calls depth beyond 5 m a guess.
(https://github.com/PolyCam/polyform)
"""

from pathlib import Path

import numpy as np

from r3jax.formats.errors import FormatError, naming
from r3jax.formats.lenses import Lens
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.formats.phones.archives import (
    Archive,
    Shot,
    complete_shots,
    confident_depth,
    find_archive,
    is_there,
    posed_images,
)
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.poses import UP_Y, mend_pose
from r3jax.validation.json_text import check_fields

_BEST = 255
_FARTHEST = 5.0
"""Depth beyond it is no measurement [m]."""

_MATRIX = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_FIELDS = dict.fromkeys(("fx", "fy", "cx", "cy", *_MATRIX), float) | {"width": int, "height": int}

_NO_DEPTH = (
    "this looks like a Polycam export without keyframes/depth: scan in LiDAR or Room mode with "
    "Developer mode on and export raw data, or let COLMAP find the poses: ns-process-data images "
    "--data {}/keyframes/images --output-dir OUT"
)


def is_polycam(path: Path) -> bool:
    """Returns True if the folder or archive looks like raw data of Polycam."""
    return is_there(path, "keyframes")


def read_polycam(path: Path | str) -> PosedImages:
    """Opens raw data and checks everything but the pixels.

    Args:
        path: the folder that holds keyframes/, or a zip archive of it.

    Raises:
        FormatError: no cameras, no depth images; a camera that makes no sense; a pose that is not
            finite or not rigid.
    """
    path = Path(path)
    archive = find_archive(path, "keyframes")
    if archive is None:
        raise FormatError(path, "there is no folder keyframes in it")
    corrected = archive.names("keyframes/corrected_cameras", ".json")
    kind = "corrected_" if corrected else ""
    names = corrected or archive.names("keyframes/cameras", ".json")
    if not names:
        raise FormatError(
            path,
            "this looks like a Polycam export without keyframes/cameras: export raw data with "
            "Developer mode on",
        )
    shots, remark = complete_shots(
        archive, [_shot(archive, kind, name) for name in names], len(names), _NO_DEPTH.format(path)
    )
    return posed_images(
        archive, shots, depth=lambda shot: _depth(archive, shot), up=UP_Y, remark=remark
    )


def _shot(archive: Archive, kind: str, name: str) -> Shot:
    """Reads one frame; the names of its folders begin with `kind`."""
    source = f"keyframes/{kind}cameras/{name}.json"
    camera = archive.json(source)
    with naming(archive.where(source)):
        check_fields("camera", camera, _FIELDS)
        params = tuple(float(camera[field]) for field in ("fx", "fy", "cx", "cy"))
        lens = Lens("PINHOLE", camera["width"], camera["height"], params)
    pose = np.eye(4)
    pose[:3] = np.reshape([camera[field] for field in _MATRIX], (3, 4))
    return Shot(
        image=f"keyframes/{kind}images/{name}.jpg",
        depth=f"keyframes/depth/{name}.png",
        confidence=f"keyframes/confidence/{name}.png",
        lens=lens,
        pose=mend_pose(archive.where(source), "the pose", pose @ OPENGL_FROM_OPENCV),
    )


def _depth(archive: Archive, shot: Shot) -> np.ndarray:
    depth = confident_depth(archive, shot, _BEST)
    return np.where(depth <= _FARTHEST, depth, np.float32(0.0))
