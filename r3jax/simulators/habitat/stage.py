"""Between our world and Habitat-Sim's: stages, axes, poses, field of view. Needs no Habitat-Sim.

Ours is z-up with OpenCV camera axes. Habitat's is y-up with OpenGL camera axes (x right, y up,
z backward). Between the two lies the mesh file, whose
axes are its maker's. `habitat_from_world` always means the rotation [3, 3] from our world to
Habitat's: neither moves the origin nor scales.

Measured on 0.3.3: a bare GLB is taken as z-up and turned, and a stage config
(`<name>.stage_config.json`) says by `up` and `front` which axes its GLB has. A PLY is never turned,
whatever its stage config says: of all 24 rotations the identity alone agreed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular, read_bytes
from r3jax.validation.json_text import check_type, parse_json

_CONFIG = ".stage_config.json"
_PLY = ".ply"
_MAX_CONFIG = 1 << 20
"""HabitatStage configs have a few hundred bytes."""

_UNMOVED: dict[str, Any] = {"scale": [1, 1, 1], "origin": [0, 0, 0], "units_to_meters": 1}
"""What else could move or scale the mesh, and the only values that are understood."""


@dataclass(frozen=True)
class HabitatStage:
    """A scene for Habitat."""

    file: Path
    """What Habitat is told to load."""

    mesh: Path
    """What it then shows; the same file, but for a stage config."""

    habitat_from_file: np.ndarray
    """Rotation [3, 3] from the mesh file's axes to Habitat's world."""

    @property
    def is_ply(self) -> bool:
        """True if the mesh is a PLY."""
        return self.mesh.suffix.lower() == _PLY


def read_stage(path: str | Path) -> HabitatStage:
    """Finds out what Habitat will show.

    Args:
        path: a `.glb`, a `.ply`, or a `.stage_config.json`.

    Raises:
        ValueError: another kind of file, one that is missing, or a stage config that does not say
            which mesh it shows and how it is turned.
    """
    path = Path(path).absolute()
    try:
        if path.name.lower().endswith(_CONFIG):
            return _read_config(path)
        turn = {".glb": BARE_GLB, _PLY: np.eye(3)}.get(path.suffix.lower())
        if turn is None:
            raise ForeignFileError(f"Habitat scenes are .glb, .ply or {_CONFIG} files")
        check_regular(path)
    except FileNotFoundError:
        raise InputError(f"no such file for Habitat: {path}") from None
    except (ForeignFileError, OSError) as error:
        raise InputError(f"{path}: {error!s:.500}") from error
    return HabitatStage(path, path, turn)


def _read_config(path: Path) -> HabitatStage:
    """Reads a stage config's mesh and axes."""
    config = parse_json(read_bytes(path, _MAX_CONFIG))
    check_type("the stage config", config, dict[str, Any])
    if "render_asset" not in config:
        raise ForeignFileError("it names no render_asset, so there is nothing to see")
    check_type("render_asset", config["render_asset"], str)
    for name, value in _UNMOVED.items():
        if config.get(name, value) != value:
            raise ForeignFileError(
                f"{name} {config[name]!s:.60} is not supported, only {value}: apply it to the mesh"
            )
    mesh = (path.parent / config["render_asset"]).absolute()
    try:
        check_regular(mesh)
    except FileNotFoundError:
        raise ForeignFileError(f"its render_asset {mesh} is missing") from None
    except ForeignFileError as error:
        raise ForeignFileError(f"its render_asset {mesh}: {error}") from None
    return HabitatStage(path, mesh, np.eye(3) if mesh.suffix.lower() == _PLY else _axes_of(config))


def _axes_of(config: dict[str, Any]) -> np.ndarray:
    """Computes the rotation [3, 3] for the `up` and `front` of a stage config."""
    lacking = [name for name in ("up", "front") if name not in config]
    if lacking:
        raise ForeignFileError(
            f"it does not say {' and '.join(lacking)}; give the mesh's own axes, for z up "
            '"up": [0, 0, 1], "front": [0, 1, 0], for y up "up": [0, 1, 0], "front": [0, 0, -1]'
        )
    for name in ("up", "front"):
        check_type(name, config[name], list[float])
    try:
        return habitat_from_axes(config["up"], config["front"])
    except ValueError as error:
        raise ForeignFileError(str(error)) from None


_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Between the camera's axes; its own inverse."""

_MAX_OFF_CENTER = 1e-3
"""How far the principal point may lie from the image's center [px]."""

_MAX_STRETCH = 1e-5
"""How much the focal lengths may differ, relative to their size."""


def habitat_from_axes(up: Sequence[float | int], front: Sequence[float | int]) -> np.ndarray:
    """Computes the rotation [3, 3] from a mesh file to Habitat's world.

    Args:
        up: direction in the file that becomes Habitat's up, +y; a stage config's `up`.
        front: direction in the file that becomes Habitat's front, -z; its `front`.

    Raises:
        ValueError: the directions are not axes of unit length at right angles.
    """
    y, z = np.asarray(up, np.float64), -np.asarray(front, np.float64)
    if y.shape != (3,) or z.shape != (3,):
        raise InputError(f"up and front are 3 numbers each, got {y.size} and {z.size}")
    with np.errstate(all="ignore"):  # numbers of any size may stand in a file
        rotation = np.stack([np.cross(y, z), y, z])
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= 1e-6:
        raise InputError(
            f"up {list(up)} and front {list(front)} must have unit length and be at right angles"
        )
    return rotation


BARE_GLB = habitat_from_axes((0, 0, 1), (0, 1, 0))
"""What Habitat does with a GLB that no stage config describes: (x, y, z) -> (x, z, -y)."""


def agent_from_pose(
    T_world_camera: np.ndarray, habitat_from_world: np.ndarray
) -> tuple[np.ndarray, Rotation]:
    """Computes the state of an agent whose camera sits in its origin.

    Args:
        T_world_camera: pose of the camera in our world, [4, 4].
        habitat_from_world: rotation [3, 3].

    Returns:
        Position in Habitat's world [3] [m], and rotation: exact where the pose is rigid up to
        rounding only.

    Raises:
        ValueError: the pose is not finite or not rigid.
    """
    problem = rigid_error(T_world_camera)
    if problem is not None:
        raise InputError(problem)
    T = np.asarray(T_world_camera, np.float64)
    rotation = habitat_from_world @ T[:3, :3] @ _OPENGL_FROM_OPENCV
    return habitat_from_world @ T[:3, 3], Rotation.from_matrix(rotation)


def horizontal_fov_deg(camera: Camera) -> float:
    """Computes the horizontal field of view [deg] by which Habitat knows a camera.

    Raises:
        ValueError: Habitat cannot show this camera's image: its pixels are not square, or the
            principal point is not the image's center.
    """
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    if abs(fx - fy) > _MAX_STRETCH * fx:
        raise InputError(
            f"Habitat's cameras have square pixels, but fx is {fx:.6g} and fy {fy:.6g} px: give "
            "a camera with fx = fy (Camera.from_fov), or use the ray caster (mesh:<file>)"
        )
    center = 0.5 * camera.width, 0.5 * camera.height
    if max(abs(cx - center[0]), abs(cy - center[1])) > _MAX_OFF_CENTER:
        raise InputError(
            f"Habitat's cameras look through the image's center {center}, but the principal point "
            f"is ({cx:.6g}, {cy:.6g}) px: give a centered camera (Camera.from_fov), or use the "
            "ray caster (mesh:<file>)"
        )
    return math.degrees(2.0 * math.atan(0.5 * camera.width / fx))
