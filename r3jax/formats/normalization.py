"""Undoes how nerfstudio turns, centers and scales the coordinates that it trains in.

    dataparser_transforms.json    {"transform": 3x4, "scale": s}: x_trained = s * (transform @ x)

`ns-train` writes it into its output folder; x are the coordinates before `applied_transform` and
`applied_scale` of the transforms.json (https://docs.nerf.studio/quickstart/data_conventions.html).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from r3jax.formats.errors import naming
from r3jax.formats.poses import mend_pose
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.fields import check_fields
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import parse_json

NAME = "dataparser_transforms.json"

_MAX_BYTES = 1 << 20
"""It takes a few hundred bytes."""


class Normalization(NamedTuple):
    """From original coordinates to those of a training."""

    T: np.ndarray
    """Rigid, [4, 4]."""

    scale: float
    """Applied after it."""

    def undone(self, poses: np.ndarray, T_capture_original: np.ndarray | None) -> np.ndarray:
        """Poses in a capture's own coordinates, [n, 4, 4].

        Args:
            poses: camera to the training's coordinates, [n, 4, 4].
            T_capture_original: takes original points to the capture's coordinates, a similarity
                [4, 4]; None: they are the same.
        """
        original = poses.copy()
        original[:, :3, 3] /= self.scale
        original = np.linalg.inv(self.T) @ original
        if T_capture_original is None:
            return original
        found = T_capture_original @ original
        found[:, :3, :3] /= np.cbrt(np.linalg.det(T_capture_original[:3, :3]))
        return found


def read_normalization(path: Path) -> Normalization:
    """Reads a dataparser_transforms.json.

    Raises:
        FormatError: missing or damaged, a transform that is not rigid, or a scale that is none.
    """
    with naming(path):
        content = parse_json(read_bytes(path, _MAX_BYTES))
        check_fields("dataparser", content, {"transform": list[list[float]], "scale": float})
        rows, scale = content["transform"], float(content["scale"])
        if [len(row) for row in rows] not in ([4] * 3, [4] * 4):
            raise ForeignFileError("`transform` must be a 3x4 or a 4x4 matrix")
        if not 1e-9 < scale < 1e9:
            raise ForeignFileError(f"the scale {scale:g} makes no sense")
    matrix = np.eye(4)
    matrix[: len(rows)] = rows
    return Normalization(mend_pose(path, "the transform", matrix), scale)
