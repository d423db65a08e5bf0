"""Numbers as colors, lines and pictures: what is drawn of a run, and what any camera would get.

Pure: a map, a grid, a camera and a pose go in, a `CameraPreview` comes out, and pictures of what
each of its pixels shows.

Shape symbols: h w size of the depth buffer; H W size of a picture; B directions of the panorama;
n points or Gaussians; s segments; C candidates.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Array, Float
from matplotlib.colors import to_rgb
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from r3jax.exploration.taken_views import StepRow
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.kernels.constants import SH0
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.runs.reader import Run
from r3jax.runs.rows import paths_to
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import panorama
from r3jax.scoring.renderability import term_images
from r3jax.scoring.utility import view_utility
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene

POINT_BUDGET = 200_000
"""Recorded points that are drawn at most."""

SPLAT_BUDGET = 300_000
"""Gaussians that a browser gets at most."""


UNSEEN = (150, 155, 163)
"""Color of what no position sees, and of pixels that show nothing known."""

SCORES = style.SCORE_MAP
"""Colors of R and its terms, 0 to 1: red is bad."""

ORDER = style.PATH_MAP
"""Colors of the order of acquisition."""

UTILITY_MAP = "viridis"
"""Colors of the utility of a candidate or a direction, from the least to the largest."""


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


def to_bytes(rgb: np.ndarray) -> np.ndarray:
    """Converts colors [..., 3] in [0, 1] to uint8."""
    return np.rint(np.asarray(rgb, dtype=np.float64).clip(0.0, 1.0) * 255.0).astype(np.uint8)


CAUSE_COLORS = tuple(to_bytes(np.asarray(to_rgb(color))) for color in style.CAUSE_COLORS)
"""Colors of the causes of a utility, [3] uint8 each, in the order of `scoring.explain.CAUSES`."""


@functools.cache
def _table(name: str) -> np.ndarray:
    """Returns the 256 colors of a colormap, [256, 3] uint8."""
    colors = matplotlib.colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
    table = np.rint(colors * 255.0).astype(np.uint8)
    table.flags.writeable = False
    return table


def paint(values: np.ndarray, name: str = SCORES) -> np.ndarray:
    """Colors numbers in [0, 1]; NaN becomes `UNSEEN`.

    Args:
        values: [...]; what lies outside [0, 1] gets the color of the nearer end.
        name: of a colormap of matplotlib.

    Returns:
        [..., 3] uint8.
    """
    is_number = ~np.isnan(values)
    index = np.rint(np.where(is_number, values, 0.0).clip(0.0, 1.0) * 255.0).astype(np.intp)
    return np.where(is_number[..., None], _table(name)[index], np.asarray(UNSEEN, np.uint8))


def linear_light(encoded: np.ndarray) -> np.ndarray:
    """Converts sRGB-encoded colors to linear light, both [..., 3] in [0, 1]."""
    low = encoded / 12.92
    return np.where(encoded <= 0.04045, low, ((encoded + 0.055) / 1.055) ** 2.4)


def css_color(color: np.ndarray | tuple[int, int, int]) -> str:
    """Writes a color of three bytes in the form of CSS, such as `#0f766e`."""
    return "#" + "".join(f"{int(part):02x}" for part in color)


def spread(values: np.ndarray) -> np.ndarray:
    """Shifts and scales numbers to [0, 1].

    If all are equal, they become 0.5. Numbers that are not finite become NaN.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    if not finite.any():
        return np.full(values.shape, np.nan)
    low, high = values[finite].min(), values[finite].max()
    scaled = np.where(finite, values - low, 0.0) / (high - low) if high > low else 0.5
    return np.where(finite, scaled, np.nan)


def path_segments(rows: Sequence[StepRow], num_views: int) -> tuple[np.ndarray, np.ndarray]:
    """Computes the path that the camera flew, segment by segment.

    Args:
        rows: of the trace from the first one on, as many as are to be drawn.
        num_views: of the whole run, over which the colors run.

    Returns:
        Ends [s, 2, 3] float32 [m], and their colors by order [s, 2, 3] uint8.
    """
    ends, order = [np.zeros((0, 2, 3))], [np.zeros(0)]
    for row, path in zip(rows, paths_to(rows), strict=True):
        if path is None:
            continue
        ends.append(np.stack([path[:-1], path[1:]], axis=1))
        order.append(np.full(len(path) - 1, row.step / max(num_views - 1, 1)))
    colors = paint(np.concatenate(order), ORDER)
    return np.concatenate(ends).astype(np.float32), np.repeat(colors[:, None], 2, axis=1)


def frustum_corners(camera: Camera, T_world_camera: np.ndarray, depth: float) -> np.ndarray:
    """Returns the image's corners at a distance ahead of the camera, in order, [4, 3] [m]."""
    columns = np.array([0.0, camera.width, camera.width, 0.0])
    rows = np.array([0.0, 0.0, camera.height, camera.height])
    x = (columns - float(camera.cx)) / float(camera.fx)
    y = (rows - float(camera.cy)) / float(camera.fy)
    corners = depth * np.stack([x, y, np.ones(4)], axis=1)
    return corners @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def frustum_segments(camera: Camera, T_world_camera: np.ndarray, depth: float) -> np.ndarray:
    """Returns a camera's pyramid, its edges and a tick on its upper side, [9, 2, 3] float32 [m]."""
    corners = frustum_corners(camera, T_world_camera, depth)
    apex = np.repeat(T_world_camera[None, :3, 3], 4, axis=0)
    sides = np.stack([apex, corners], axis=1)
    rim = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    middle = corners[:2].mean(axis=0)
    tick = np.stack([middle, middle + 0.4 * (corners[0] - corners[3])])[None]
    return np.concatenate([sides, rim, tick]).astype(np.float32)


def recorded_points(run: Run, budget: int = POINT_BUDGET) -> tuple[np.ndarray, np.ndarray]:
    """Measured points of all frames in their recorded colors, the same number of each frame.

    Args:
        run: the run.
        budget: points at most.

    Returns:
        Points [n, 3] float32 [m] and colors [n, 3] uint8.

    Raises:
        RunError: a frame is missing, broken, or not the one that was recorded.
    """
    points, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
    share = max(1, budget // max(len(run.rows), 1))
    camera = run.camera
    for row in run.rows:
        frame = run.frame(row.step)
        depth, rgb = np.asarray(frame.depth), np.asarray(frame.rgb)
        v, u = np.nonzero((depth > 0.0) & np.isfinite(depth))
        # Drawn for each view: a fixed pattern would show as lines.
        chosen = np.random.default_rng(row.step).permutation(len(v))[:share]
        v, u = v[chosen], u[chosen]
        z = depth[v, u]
        x = (u + 0.5 - float(camera.cx)) / float(camera.fx) * z
        y = (v + 0.5 - float(camera.cy)) / float(camera.fy) * z
        world = np.stack([x, y, z], axis=1) @ row.pose[:3, :3].T + row.pose[:3, 3]
        points.append(world.astype(np.float32))
        colors.append(np.rint(rgb[v, u] * 255.0).astype(np.uint8))
    return np.concatenate(points)[:budget], np.concatenate(colors)[:budget]


def splat_arrays(
    scene: GaussianScene, budget: int = SPLAT_BUDGET
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gaussians as a browser draws them: without view-dependent color, the largest ones first.

    Args:
        scene: the splats.
        budget: Gaussians at most.

    Returns:
        Centers [n, 3] [m], covariances [n, 3, 3] [m^2], colors [n, 3] and opacities [n, 1] in
        [0, 1], float32 all.
    """
    alive = np.flatnonzero(np.asarray(scene.is_alive))
    logits = np.asarray(scene.opacity_logits, dtype=np.float64)[alive]
    opacity = 1.0 / (1.0 + np.exp(-logits))
    scales = np.exp(np.asarray(scene.log_scales, dtype=np.float64)[alive])
    if len(alive) > budget:
        # What covers most: opacity times the area of the two longer axes.
        area = scales.prod(axis=1) / scales.min(axis=1)
        best = np.sort(np.argsort(-opacity * area, kind="stable")[:budget])
        alive, opacity, scales = alive[best], opacity[best], scales[best]
    axes = _matrices(np.asarray(scene.quats, dtype=np.float64)[alive]) * scales[:, None, :]
    rgb = np.asarray(scene.sh, dtype=np.float64)[alive, 0] * SH0 + 0.5
    arrays = (
        np.asarray(scene.means)[alive],
        axes @ axes.transpose(0, 2, 1),
        rgb.clip(0.0, 1.0),
        opacity[:, None],
    )
    centers, covariances, colors, opacities = (x.astype(np.float32) for x in arrays)
    return centers, covariances, colors, opacities


def _matrices(wxyz: np.ndarray) -> np.ndarray:
    """Converts quaternions [..., 4] of any length but 0 to rotation matrices [..., 3, 3]."""
    return Rotation.from_quat(wxyz, scalar_first=True).as_matrix()


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """Converts a rotation matrix [3, 3] to the unit quaternion wxyz, w >= 0."""
    w, x, y, z = Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True).tolist()
    return w, x, y, z


def pose_of(wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Returns `T_world_camera` [4, 4] float64 of a quaternion wxyz and a position [m]."""
    pose = np.eye(4)
    pose[:3, :3] = _matrices(wxyz)
    pose[:3, 3] = position
    return pose
