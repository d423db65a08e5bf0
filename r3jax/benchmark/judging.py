"""The images that every model of a scene is judged by: rendered once, kept beside the results.

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

from r3jax.benchmark.cells import Cell
from r3jax.benchmark.conditions import Conditions
from r3jax.files import write_atomic
from r3jax.geometry.cameras import Camera
from r3jax.splatting.views import Views

FOLDER = "test_views"
"""Of a benchmark: poses and images."""


@dataclass(frozen=True)
class JudgingViews:
    """Test views of a scene."""

    hash: str
    """Of the set of poses."""

    poses: np.ndarray
    """`T_world_camera`, [v, 4, 4] float32."""

    views: Views
    """Their images as a model is compared with them."""


def judging_path(root: Path, scene_hash: str, set_hash: str, conditions: Conditions) -> Path:
    """Where the images lie; another file for everything that changes them."""
    names = ("resolution", "fov", "train_resolution")
    what = [scene_hash, set_hash, *(getattr(conditions, name) for name in names)]
    key = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:16]
    return Path(root) / FOLDER / f"{key}.npz"


def save_judging_views(path: Path, judging: JudgingViews) -> None:
    """Writes the images: whole, or not at all.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    views, data = judging.views, io.BytesIO()
    cameras = [np.asarray(x) for x in jax.tree.leaves(views.cameras)]
    np.savez_compressed(
        data,
        hash=np.array(judging.hash),
        poses=judging.poses,
        rgb=np.asarray(views.rgb),
        depth=np.asarray(views.depth),
        T_world_camera=np.asarray(views.T_world_camera),
        cameras=np.stack(cameras),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, data.getvalue())


def read_judging_views(path: Path) -> JudgingViews:
    """Inverse of `save_judging_views`.

    Raises:
        FileNotFoundError: the images are not there.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: the test views are gone; start the benchmark again")
    with np.load(path) as data:
        stored = {name: data[name] for name in data.files}
    height, width = stored["rgb"].shape[1:3]
    # The leaves of a camera are its four numbers, in the order of its fields.
    like = jax.tree.structure(Camera(width, height, 1.0, 1.0, 0.0, 0.0))
    views = Views(
        rgb=jnp.asarray(stored["rgb"]),
        depth=jnp.asarray(stored["depth"]),
        T_world_camera=jnp.asarray(stored["T_world_camera"]),
        cameras=jax.tree.unflatten(like, [jnp.asarray(x) for x in stored["cameras"]]),
    )
    return JudgingViews(str(stored["hash"]), stored["poses"], views)


def load_judging_views(root: Path, cell: Cell) -> JudgingViews:
    """The test views of a cell, as they were rendered when the benchmark was planned.

    Raises:
        FileNotFoundError: they are not there.
    """
    path = judging_path(root, cell.scene_hash, cell.test_views_hash, cell.conditions)
    return read_judging_views(path)
