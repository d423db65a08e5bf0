"""The images that every model of a scene is evaluated by: rendered once, kept beside the results.

They are rendered at the resolution of the exploration and made smaller as the training images
are, without noise and without limit of range. The exploration never sees them: `run_cell` reads
them afterwards.
"""

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.apps.benchmark.cells import Cell, Conditions
from r3jax.errors import InputError
from r3jax.files import make_folder, write_atomic
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.splatting.views import Views
from r3jax.validation.arrays import read_npz
from r3jax.validation.errors import ForeignFileError

FOLDER = "test_views"
"""Folder of a benchmark's test views: poses and images."""

_KINDS = {"hash": "U", "rgb": "u"} | dict.fromkeys(
    ("poses", "depth", "T_world_camera", "cameras"), "f"
)


@dataclass(frozen=True)
class ReferenceImages:
    """Test views of a scene."""

    hash: str
    """Hash of the set of poses."""

    poses: np.ndarray
    """`T_world_camera`, [v, 4, 4] float32."""

    views: Views
    """Their images as a model is compared with them."""


def reference_path(root: Path, scene_hash: str, set_hash: str, conditions: Conditions) -> Path:
    """Returns the path of the images; everything that changes them changes the path."""
    sizes = conditions.resolution, conditions.fov, conditions.train_resolution
    return path_of_images(root, scene_hash, set_hash, sizes)


def path_of_images(
    root: Path, scene_hash: str, set_hash: str, sizes: tuple[int, float, int]
) -> Path:
    """Returns the path by resolution [px], field of view [deg] and resolution in training [px]."""
    what = [scene_hash, set_hash, *sizes]
    key = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:16]
    return Path(root) / FOLDER / f"{key}.npz"


def save_reference_images(path: Path, reference: ReferenceImages) -> None:
    """Writes the images: whole, or not at all.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    views, data = reference.views, io.BytesIO()
    cameras = [np.asarray(x) for x in jax.tree.leaves(views.cameras)]
    np.savez_compressed(
        data,
        hash=np.array(reference.hash),
        poses=reference.poses,
        rgb=np.asarray(views.rgb),
        depth=np.asarray(views.depth),
        T_world_camera=np.asarray(views.T_world_camera),
        cameras=np.stack(cameras),
    )
    make_folder(path.parent)
    write_atomic(path, data.getvalue())


def read_reference_images(path: Path) -> ReferenceImages:
    """Reads the images that `save_reference_images` wrote.

    Raises:
        FileNotFoundError: the images are not there.
        ValueError: the file is damaged; the message names it.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: the test views are gone; start the benchmark again")
    try:
        stored = read_npz(path, _KINDS)
        _check(stored)
    except ForeignFileError as error:
        raise InputError(
            f"{path} does not hold test views ({error}): delete it and start the benchmark again"
        ) from None
    height, width = stored["rgb"].shape[1:3]
    # The leaves of a camera are its four numbers, in the order of its fields.
    like = jax.tree.structure(Camera(width, height, 1.0, 1.0, 0.0, 0.0))
    views = Views(
        rgb=jnp.asarray(stored["rgb"]),
        depth=jnp.asarray(stored["depth"]),
        T_world_camera=jnp.asarray(stored["T_world_camera"]),
        cameras=jax.tree.unflatten(like, [jnp.asarray(x) for x in stored["cameras"]]),
    )
    return ReferenceImages(str(stored["hash"]), stored["poses"], views)


def _check(stored: dict[str, np.ndarray]) -> None:
    """Refuses arrays that do not belong together, and numbers that render to nothing.

    Raises:
        ForeignFileError: says which.
    """
    rgb = stored["rgb"]
    v = len(rgb) if rgb.ndim == 4 else 0
    expected = {
        "hash": (),
        "poses": (v, 4, 4),
        "rgb": (v, *rgb.shape[1:3], 3),
        "depth": (v, *rgb.shape[1:3]),
        "T_world_camera": (v, 4, 4),
        "cameras": (4, v),
    }
    for name, shape in expected.items():
        if stored[name].shape != shape or not stored[name].size:
            raise ForeignFileError(f"{name} has the shape {stored[name].shape}, expected {shape}")
    if rgb.dtype != np.uint8:
        raise ForeignFileError(f"rgb is {rgb.dtype}, expected uint8")
    if not (stored["depth"] >= 0.0).all():  # infinite where there is nothing
        raise ForeignFileError("depth is negative or NaN")
    if not (np.isfinite(stored["cameras"]).all() and (stored["cameras"][:2] > 0.0).all()):
        raise ForeignFileError("a camera has no focal length, or numbers that are not finite")
    for name in ("poses", "T_world_camera"):
        problems = [(i, rigid_error(pose)) for i, pose in enumerate(stored[name])]
        wrong = next(((i, problem) for i, problem in problems if problem), None)
        if wrong is not None:
            raise ForeignFileError(f"{name}, view {wrong[0]}: {wrong[1]}")


def load_reference_images(root: Path, cell: Cell) -> ReferenceImages:
    """Reads the test views of a cell, as they were rendered when the benchmark was planned.

    Raises:
        FileNotFoundError: they are not there.
    """
    path = reference_path(root, cell.scene_hash, cell.test_views_hash, cell.conditions)
    return read_reference_images(path)
