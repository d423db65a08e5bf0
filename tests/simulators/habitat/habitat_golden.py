"""Frames and states that a real Habitat-Sim 0.3.3 gave, in our terms."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from r3jax.geometry.cameras import Camera

HOUSE = Path(__file__).parents[3] / "experiments/scenes/aws_small_house/aws_small_house.glb"


class Golden(NamedTuple):
    """A scene as Habitat saw it."""

    frames: dict[str, np.ndarray]
    """`rgb`, `depth`, states and matrices of every pose."""

    mesh: Path
    """The file that it showed."""

    up: str | None
    """The file's vertical axis, None: as its kind says."""

    world_from_file: np.ndarray
    """Rotation [3, 3] of our `mesh:` scenes, written down by hand."""

    @property
    def camera(self) -> Camera:
        K = self.frames["K"]
        return Camera(256, 256, *(float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))

    @property
    def poses(self) -> np.ndarray:
        """`T_world_camera` [n, 4, 4] in the world of our `mesh:` scene."""
        turn = np.eye(4)
        turn[:3, :3] = self.world_from_file
        return turn @ self.frames["c2w_opencv_glb"]

    @property
    def habitat_from_world(self) -> np.ndarray:
        return self.frames["habitat_from_glb"][:3, :3] @ self.world_from_file.T


def load_house(shared) -> Golden:
    return Golden(
        dict(np.load(shared("golden", "habitat_small_house.npz"))),
        HOUSE,
        None,
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    )


def load_simple_room(shared) -> Golden:
    return Golden(
        dict(np.load(shared("golden", "habitat_simple_room.npz"))),
        shared("golden", "habitat_simple_room.glb"),
        "z",
        np.eye(3),
    )
