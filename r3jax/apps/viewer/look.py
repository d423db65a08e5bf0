"""What a camera at any pose would get: the numbers and pictures beside the camera that is dragged.

Pure: a map, a grid, a camera and a pose go in, a `Look` comes out.

Shape symbols: h w size of the depth buffer; H W size of a picture; B directions of the panorama.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import panorama
from r3jax.scoring.renderability import term_images
from r3jax.scoring.utility import view_utility
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene

TERMS = ("renderability", "bias", "noise", "resolution")
"""R and its factors, in the order in which they are shown."""

Photographer = Callable[[np.ndarray], np.ndarray | None]
"""The true picture at a pose `T_world_camera` [4, 4], RGB in [0, 1], [H, W, 3]; None: there is
none."""


@dataclass(frozen=True)
class Surroundings:
    """What a look needs beside the pose."""

    map_state: MapState
    grid: OccupancyGrid

    camera: Camera
    """Of the run, at full size: its focal length sets the resolution that is asked for."""

    config: ScoringConfig = field(default_factory=ScoringConfig)

    picture_camera: Camera | None = None
    """Of the rendered splats: the same view with fewer pixels; None: `camera`."""

    model: GaussianScene | None = None
    """The trained splats, if there are any."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Behind the splats: what they were trained with."""

    photographer: Photographer | None = None
    """Takes the true picture, where the scene can be opened."""


@dataclass(frozen=True)
class Glance:
    """How well one view could be rendered, and why: what takes milliseconds."""

    means: dict[str, float]
    """Per term its mean over the view's pixels, in [0, 1]; pixels that show no voxel count 0."""

    seen: float
    """Share of the pixels that show a voxel."""

    images: dict[str, np.ndarray]
    """Per term what each pixel shows, [h, w]; NaN where it shows no voxel."""

    @property
    def renderability(self) -> float:
        """The mean of R over the view: `r3jax.renderability`."""
        return self.means["renderability"]


@dataclass(frozen=True)
class Look:
    """Everything about one view, and where it would be better to look from the same place."""

    T_world_camera: np.ndarray
    """The pose, [4, 4]."""

    glance: Glance

    exploration: float
    """U_G: visible unexplored cells."""

    rendering: float
    """U_R: sum of 1 - R over the visible voxels."""

    direction_scores: np.ndarray
    """What a view along each direction of the panorama would be worth, [B]."""

    best_direction: np.ndarray
    """The direction worth most, unit length, [3]."""

    T_suggested: np.ndarray
    """The pose at the same position that looks along it, [4, 4]."""

    splats: np.ndarray | None
    """The trained splats from here, RGB in [0, 1], [H, W, 3]."""

    truth: np.ndarray | None
    """The true picture, RGB in [0, 1], [H, W, 3]."""


def glance_from(around: Surroundings, T_world_camera: np.ndarray) -> Glance:
    """R and its terms in the view at one pose [4, 4]."""
    pose = jnp.asarray(T_world_camera, dtype=jnp.float32)
    shown = term_images(around.map_state, around.camera, pose, around.config)
    is_hit = np.asarray(shown.row) < around.map_state.capacity
    found = (shown.value, shown.bias, shown.noise, shown.resolution)
    images = {name: np.asarray(image) for name, image in zip(TERMS, found, strict=True)}
    return Glance(
        means={name: float(image.mean()) for name, image in images.items()},
        seen=float(is_hit.mean()),
        images={name: np.where(is_hit, image, np.nan) for name, image in images.items()},
    )


def look_from(
    around: Surroundings, T_world_camera: np.ndarray, glance: Glance | None = None
) -> Look:
    """Everything about the view at one pose.

    Args:
        around: map, grid, camera and what else is known.
        T_world_camera: [4, 4].
        glance: of the same pose, if it is at hand.

    Raises:
        ValueError: the true picture is asked for, and the pose is not rigid.
    """
    pose = jnp.asarray(T_world_camera, dtype=jnp.float32)
    state, grid, camera = around.map_state, around.grid, around.camera
    utility = view_utility(state, grid, camera, pose, around.config)
    round_about = panorama(state, grid, camera, pose[:3, 3], around.config)
    return Look(
        T_world_camera=np.asarray(T_world_camera),
        glance=glance or glance_from(around, T_world_camera),
        exploration=float(utility.exploration),
        rendering=float(utility.rendering),
        direction_scores=np.asarray(round_about.direction_scores),
        best_direction=np.asarray(round_about.best_direction),
        T_suggested=np.asarray(round_about.T_world_camera),
        splats=_splats(around, pose),
        truth=None if around.photographer is None else around.photographer(T_world_camera),
    )


def _splats(around: Surroundings, pose: Float[Array, "4 4"]) -> np.ndarray | None:
    if around.model is None:
        return None
    camera = around.picture_camera or around.camera
    background = jnp.asarray(around.background, dtype=jnp.float32)
    return np.asarray(render(around.model, camera, pose, background).rgb).clip(0.0, 1.0)
