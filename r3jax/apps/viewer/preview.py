"""What a camera at any pose would get: the numbers and pictures beside the camera that is dragged.

Pure: a map, a grid, a camera and a pose go in, a `CameraPreview` comes out, and pictures of what
each of its pixels shows.

Shape symbols: h w size of the depth buffer; H W size of a picture; B directions of the panorama.
"""

import functools
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from PIL import Image, ImageDraw

from r3jax.apps.viewer.color_maps import UTILITY_MAP, paint, spread, to_bytes
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
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


@dataclass(frozen=True)
class Context:
    """What a look needs beside the pose."""

    map_state: MapState
    grid: OccupancyGrid

    camera: Camera
    """Camera of the run, at full size: its focal length sets the target resolution."""

    config: ScoringConfig = field(default_factory=ScoringConfig)

    picture_camera: Camera | None = None
    """Camera of the rendered splats: the same view with fewer pixels; None: `camera`."""

    model: GaussianScene | None = None
    """The trained splats, if there are any."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Behind the splats: what they were trained with."""


@dataclass(frozen=True)
class QuickPreview:
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
class CameraPreview:
    """Everything about one view, and where it would be better to look from the same place."""

    T_world_camera: np.ndarray
    """The pose, [4, 4]."""

    glance: QuickPreview

    exploration: float
    """U_G: visible unexplored cells."""

    rendering: float
    """U_R: sum of 1 - R over the visible voxels."""

    direction_scores: np.ndarray
    """Utility of a view along each direction of the panorama, [B]."""

    best_direction: np.ndarray
    """Direction of largest utility, unit length, [3]."""

    T_suggested: np.ndarray
    """The pose at the same position that looks along it, [4, 4]."""

    splats: np.ndarray | None
    """The trained splats from here, RGB in [0, 1], [H, W, 3]."""

    truth: np.ndarray | None = None
    """The true picture, RGB in [0, 1], [H, W, 3], where it was requested."""


def quick_preview_from(around: Context, T_world_camera: np.ndarray) -> QuickPreview:
    """Computes R and its terms in the view at one pose [4, 4]."""
    pose = jnp.asarray(T_world_camera, dtype=jnp.float32)
    shown = term_images(around.map_state, around.camera, pose, around.config)
    is_hit = np.asarray(shown.row) < around.map_state.capacity
    found = (shown.value, shown.bias, shown.noise, shown.resolution)
    images = {name: np.asarray(image) for name, image in zip(TERMS, found, strict=True)}
    return QuickPreview(
        means={name: float(image.mean()) for name, image in images.items()},
        seen=float(is_hit.mean()),
        images={name: np.where(is_hit, image, np.nan) for name, image in images.items()},
    )


def preview_from(
    around: Context, T_world_camera: np.ndarray, glance: QuickPreview | None = None
) -> CameraPreview:
    """Computes everything about the view at one pose.

    Args:
        around: map, grid, camera and what else is known.
        T_world_camera: [4, 4].
        glance: of the same pose, if it is at hand.
    """
    pose = jnp.asarray(T_world_camera, dtype=jnp.float32)
    state, grid, camera = around.map_state, around.grid, around.camera
    utility = view_utility(state, grid, camera, pose, around.config)
    round_about = panorama(state, grid, camera, pose[:3, 3], around.config)
    return CameraPreview(
        T_world_camera=np.asarray(T_world_camera),
        glance=glance or quick_preview_from(around, T_world_camera),
        exploration=float(utility.exploration),
        rendering=float(utility.rendering),
        direction_scores=np.asarray(round_about.direction_scores),
        best_direction=np.asarray(round_about.best_direction),
        T_suggested=np.asarray(round_about.T_world_camera),
        splats=_splats(around, pose),
    )


def _splats(around: Context, pose: Float[Array, "4 4"]) -> np.ndarray | None:
    if around.model is None:
        return None
    camera = around.picture_camera or around.camera
    background = jnp.asarray(around.background, dtype=jnp.float32)
    return np.asarray(render(around.model, camera, pose, background).rgb).clip(0.0, 1.0)


_INK, _PAPER = (31, 41, 55), (255, 255, 255)


@functools.cache
def _bin_of_pixel(width: int, num_bins: int) -> np.ndarray:
    """Finds the nearest direction of the lattice per panorama pixel, [width / 2, width]."""
    height = width // 2
    elevation = 0.5 * np.pi - (np.arange(height) + 0.5) * np.pi / height
    azimuth = np.pi - (np.arange(width) + 0.5) * 2.0 * np.pi / width
    level = np.cos(elevation)[:, None]
    rays = np.stack(
        [
            level * np.cos(azimuth),
            level * np.sin(azimuth),
            np.broadcast_to(np.sin(elevation)[:, None], (height, width)),
        ],
        axis=-1,
    )
    return np.argmax(rays.reshape(-1, 3) @ fibonacci_lattice(num_bins).T, axis=1).reshape(
        height, width
    )


def panorama_pixel(direction: np.ndarray, width: int) -> tuple[float, float]:
    """Projects a direction into a panorama of that width: column and row [px]."""
    x, y, z = direction / np.linalg.norm(direction)
    column = (np.pi - np.arctan2(y, x)) / (2.0 * np.pi) * width
    row = (0.5 * np.pi - np.arcsin(np.clip(z, -1.0, 1.0))) / np.pi * (width // 2)
    return float(column), float(row)


def panorama_image(look: CameraPreview, width: int = 360) -> np.ndarray:
    """Draws the utility of looking in each direction, from the position of the preview.

    The middle column looks along +x, azimuth grows to the left, up is up. Yellow is best;
    the ring marks the suggested direction, the cross where the camera looks.

    Returns:
        [width / 2, width, 3] uint8.
    """
    scores = spread(look.direction_scores)
    picture = paint(scores[_bin_of_pixel(width, len(scores))], UTILITY_MAP)
    image = Image.fromarray(np.ascontiguousarray(picture))
    pen = ImageDraw.Draw(image)
    u, v = panorama_pixel(look.T_world_camera[:3, 2], width)
    for color, thick in ((_INK, 5), (_PAPER, 2)):
        pen.line([(u - 7, v), (u + 7, v)], fill=color, width=thick)
        pen.line([(u, v - 7), (u, v + 7)], fill=color, width=thick)
    u, v = panorama_pixel(look.best_direction, width)
    for color, radius, thick in ((_INK, 10, 5), ((239, 68, 68), 9, 3)):
        pen.ellipse([u - radius, v - radius, u + radius, v + radius], outline=color, width=thick)
    return np.asarray(image)


def quick_preview_image(glance: QuickPreview, term: str) -> np.ndarray:
    """Draws R or a term, pixel by pixel, [h, w, 3] uint8."""
    return paint(glance.images[term])


def preview_pictures(
    look: CameraPreview, term: str = "renderability"
) -> list[tuple[str, np.ndarray]]:
    """Draws the view as R (or a term), as the splats show it, and as it is, as far as known.

    Returns:
        Names and pictures, [H, W, 3] uint8 each.
    """
    pictures = [(term, quick_preview_image(look.glance, term))]
    if look.splats is not None:
        pictures.append(("splats", to_bytes(look.splats)))
    if look.truth is not None:
        pictures.append(("true image", to_bytes(look.truth)))
    if look.splats is not None and look.truth is not None:
        error = np.abs(look.splats - look.truth).mean(axis=-1)
        pictures.append(("error of the splats", paint(1.0 - (4.0 * error).clip(0.0, 1.0))))
    return pictures
