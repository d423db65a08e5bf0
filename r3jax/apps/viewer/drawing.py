"""Turns numbers into colors, lines and pictures: the map of a run, and the view of any camera.

Pure functions. A map, a grid, a camera and a pose give a `CameraPreview`, with a picture of each of
its quantities.

A map of a house has a million voxels; a browser can draw a tenth of that. Voxels are merged in
pairs along each axis, repeatedly, until few enough are left: surfaces stay closed and only become
coarser. R depends on a voxel and a camera. To color a map, R and its terms are averaged over
positions that see the voxel: either positions spread over known free space, or that of the dragged
camera.

Shape symbols: h w size of the depth buffer; H W size of a picture; B directions of the panorama;
n points, Gaussians or blocks; s segments; C candidates; N rows of the map; m occupied ones;
P positions.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from matplotlib.colors import to_rgb
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from r3jax.apps.viewer.story import Moment, Offer
from r3jax.errors import InputError
from r3jax.exploration.coverage import probe_poses
from r3jax.exploration.taken_views import StepRow
from r3jax.geometry.cameras import Camera
from r3jax.geometry.selection import for_selected
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.geometry.voxels import INDEX_LIMIT, unpack
from r3jax.kernels.constants import SH0
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.seen import visible_rows
from r3jax.mapping.state import MapState
from r3jax.plots import style
from r3jax.runs.reader import Run
from r3jax.runs.replay import Reason
from r3jax.runs.rows import paths_to
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.explain import CAUSES
from r3jax.scoring.panorama import panorama
from r3jax.scoring.renderability import term_images
from r3jax.scoring.terms import score_voxels
from r3jax.scoring.utility import view_utility
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene
from r3jax.visibility.views import panorama_view

POINT_BUDGET = 200_000
"""Maximum number of recorded points that are drawn."""

SPLAT_BUDGET = 300_000
"""Maximum number of Gaussians for a browser."""


UNSEEN = (150, 155, 163)
"""Color of surfaces that no position sees, and of pixels that show no known surface."""

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
    """Everything that a preview needs beside the pose."""

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
    """Background with which the splats were trained."""


@dataclass(frozen=True)
class QuickPreview:
    """How well one view could be rendered, and why; computed in milliseconds."""

    means: dict[str, float]
    """Per term its mean over the view's pixels, in [0, 1]; pixels that show no voxel count 0."""

    seen: float
    """Share of the pixels that show a voxel."""

    images: dict[str, np.ndarray]
    """Image of each term, [h, w]; NaN where a pixel shows no voxel."""

    @property
    def renderability(self) -> float:
        """The mean of R over the view: `r3jax.renderability`."""
        return self.means["renderability"]


@dataclass(frozen=True)
class CameraPreview:
    """Everything about one view, and the best direction from its position."""

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


NUM_PROBES = 24
"""Number of positions over which a map's colors are averaged: enough to see every room of a large
house."""


class SurfaceTerms(eqx.Module):
    """The terms of every row of a map, each a mean over the positions that see it."""

    value: Float[Array, " N"]
    """R; 0 where no position sees the voxel."""

    bias: Float[Array, " N"]
    """b, the term of the angle; 0 where no position sees the voxel."""

    noise: Float[Array, " N"]
    """eps, the term of the color's consistency; 0 where no position sees the voxel."""

    resolution: Float[Array, " N"]
    """gamma, the term of the resolution; 0 where no position sees the voxel."""

    sightings: Float[Array, " N"]
    """Number of positions that see the voxel."""


def probe_positions(grid: OccupancyGrid, num: int = NUM_PROBES) -> np.ndarray:
    """Returns positions in known free space [m], evenly spread, [P, 3] float32, P <= num.

    They are those of the probe views that measure a run's mean renderability.
    """
    return np.asarray(probe_poses(grid, num)[:, :3, 3], dtype=np.float32)


def surface_terms(
    state: MapState,
    camera: Camera,
    positions: np.ndarray,
    config: ScoringConfig,
    *,
    pad_to: int = 1,
) -> SurfaceTerms:
    """Computes the terms of every voxel, averaged over the positions that see it.

    Args:
        state: the map.
        camera: its focal length sets the target resolution.
        positions: camera centers [P, 3] [m]; every direction round them counts.
        config: range and settings of the closed forms.
        pad_to: pads to this number of positions, so that a growing set compiles once.
    """
    given = np.asarray(positions, dtype=np.float32).reshape(-1, 3)
    missing = max(pad_to, 1) - len(given)
    padded = np.concatenate([given, np.zeros((max(missing, 0), 3), np.float32)])
    is_real = np.arange(len(padded)) < len(given)
    return _surface_terms(state, camera, jnp.asarray(padded), jnp.asarray(is_real), config)


@jax.jit
def _surface_terms(
    state: MapState,
    camera: Camera,
    positions: Float[Array, "P 3"],
    is_real: Bool[Array, " P"],
    config: ScoringConfig,
) -> SurfaceTerms:
    def add(i: Int[Array, ""], totals: Float[Array, "5 N"]) -> Float[Array, "5 N"]:
        return jax.lax.cond(
            is_real[i],
            lambda: _add_sightings(state, camera, positions[i], config, totals),
            lambda: totals,
        )

    start = jnp.zeros((5, state.capacity), dtype=jnp.float32)
    totals = jax.lax.fori_loop(0, positions.shape[0], add, start)
    mean = totals[:4] / jnp.maximum(totals[4:], 1.0)
    return SurfaceTerms(mean[0], mean[1], mean[2], mean[3], totals[4])


def _add_sightings(
    voxels: MapState,
    camera: Camera,
    position: Float[Array, " 3"],
    config: ScoringConfig,
    totals: Float[Array, "5 N"],
) -> Float[Array, "5 N"]:
    """Adds the terms of the voxels that one position sees, and one sighting each."""
    visible = visible_rows(voxels, panorama_view(position, config), config)
    num = totals.shape[1]

    def add(
        index: Int[Array, " K"], valid: Bool[Array, " K"], totals: Float[Array, "5 N"]
    ) -> Float[Array, "5 N"]:
        part = score_voxels(voxels.take(index, valid), position, camera.focal, config.score)
        rows = [part.value, part.bias, part.noise, part.resolution, jnp.ones_like(part.value)]
        target = jnp.where(valid, index, num)  # out of range on purpose: dropped
        return totals.at[:, target].add(jnp.stack(rows), mode="drop")

    return for_selected(visible, add, totals)


BUDGET = 300_000
"""Maximum number of blocks for a browser."""

QUANTITIES = (*TERMS, "color")
"""Quantities to color blocks by: R, its terms, and the mean observed color."""


CAUSE = "cause"
"""Colors blocks by the cause of a view; not one of `QUANTITIES`, as it depends on the view."""


@dataclass(frozen=True)
class Blocks:
    """The occupied voxels of a map, merged."""

    centers: np.ndarray
    """Mean center of the voxels in each block [m], [n, 3] float32."""

    edge: float
    """Edge of a block [m]."""

    rows: np.ndarray
    """The occupied rows of the map, [m]."""

    block_of: np.ndarray
    """The block of each of them, [m]."""

    @property
    def num_voxels(self) -> int:
        """Number of voxels in the blocks."""
        return len(self.rows)

    def mean(self, values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Computes the weighted mean over the voxels of each block.

        Args:
            values: of every row of the map, [N].
            weights: of every row, [N]; None: all alike.

        Returns:
            [n] float64; NaN where the weights of a block sum to 0.
        """
        weight = np.ones(len(self.rows)) if weights is None else np.asarray(weights)[self.rows]
        num = len(self.centers)
        totals = np.bincount(self.block_of, weight, num)
        sums = np.bincount(self.block_of, weight * np.asarray(values)[self.rows], num)
        return np.where(totals > 0.0, sums / np.where(totals > 0.0, totals, 1.0), np.nan)


def blocks_of(map_state: MapState, budget: int = BUDGET) -> Blocks:
    """Groups the voxels of a map into at most `budget` blocks, as fine as that allows.

    Raises:
        ValueError: a budget without a block.
    """
    if budget < 1:
        raise InputError(f"budget must be at least 1 block, got {budget}")
    rows = np.flatnonzero(np.asarray(map_state.present))
    # All rows, used or not: another number of them would make JAX recompile.
    index = np.asarray(jnp.stack(unpack(map_state.key[0], map_state.key[1])))[:, rows]
    size = float(map_state.voxel_size)
    points = (index.astype(np.float64) + 0.5) * size
    # Counted from the lowest index there is: halving -1 and 0 would never make them one.
    counted = index.astype(np.int64) + INDEX_LIMIT
    halvings, block_of, num = 0, np.arange(len(rows)), len(rows)
    while num > budget:
        halvings += 1
        merged, block_of = np.unique(_packed(counted >> halvings), return_inverse=True)
        num = len(merged)
    count = np.maximum(np.bincount(block_of, minlength=num), 1)
    centers = np.stack([np.bincount(block_of, axis, num) / count for axis in points], axis=1)
    return Blocks(centers.astype(np.float32), size * 2.0**halvings, rows, block_of)


def _packed(index: np.ndarray) -> np.ndarray:
    """Packs each index [3, m], from 0 on, into one number."""
    x, y, z = index
    return (x << 42) | (y << 21) | z


def block_values(blocks: Blocks, terms: SurfaceTerms, quantity: str) -> np.ndarray:
    """Computes R or a term per block, [n] in [0, 1]; NaN where no position sees any of its voxels.

    Raises:
        KeyError: there is no such term.
    """
    of_term = (terms.value, terms.bias, terms.noise, terms.resolution)
    rows: dict[str, Array] = dict(zip(TERMS, of_term, strict=True))
    is_seen = (np.asarray(terms.sightings) > 0.0).astype(np.float64)
    return blocks.mean(np.asarray(rows[quantity]), is_seen)


def block_causes(blocks: Blocks, capacity: int, reason: Reason) -> np.ndarray:
    """Finds the cause with the largest share in the deficit of each block for a view, [n] int.

    Args:
        blocks: of the map that the view was chosen on.
        capacity: rows of that map, N.
        reason: of the view.

    Returns:
        An index into `scoring.explain.CAUSES`; 0, which no voxel has, where the view was to see
        none of the block, or none with a deficit.
    """
    deficit = np.zeros((len(CAUSES) - 1, capacity))
    deficit[:, reason.rows] = reason.shares
    means = np.stack([blocks.mean(of_cause) for of_cause in deficit])
    return np.where(means.max(axis=0, initial=0.0) > 0.0, 1 + np.argmax(means, axis=0), 0)


_SHADE = 0.5
"""How far the grays of unseen blocks follow the lightness of the map's own colors."""


def cause_colors(causes: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Returns the color per block, [n, 3] uint8, of the causes from `block_causes` [n].

    Args:
        causes: per block; where none took anything, it is gray.
        own: the map's own colors [n, 3] uint8: as light as they are, grays show walls and doors.
    """
    light = own.mean(axis=1, keepdims=True) if len(own) else np.zeros((0, 1))
    grays = np.rint((1.0 - _SHADE) * np.asarray(UNSEEN) + _SHADE * light).astype(np.uint8)
    table = np.stack([np.asarray(UNSEEN, np.uint8), *CAUSE_COLORS[1:]])
    return np.where((causes == 0)[:, None], grays, table[causes])


def block_colors(
    blocks: Blocks, map_state: MapState, terms: SurfaceTerms | None, quantity: str
) -> np.ndarray:
    """Computes the color per block, [n, 3] uint8.

    Args:
        blocks: of the map.
        map_state: the map.
        terms: of the map; not needed for `color`.
        quantity: one of `QUANTITIES`.
    """
    if quantity == "color" or terms is None:
        channels = [blocks.mean(channel) for channel in np.asarray(map_state.mean)]
        stacked = np.stack(channels, axis=1) if channels else np.zeros((0, 3))
        return np.rint(stacked.clip(0.0, 1.0) * 255.0).astype(np.uint8)
    return paint(block_values(blocks, terms, quantity))


@dataclass(frozen=True)
class Known:
    """The map after a view, ready to be drawn."""

    moment: Moment
    blocks: Blocks

    terms: SurfaceTerms | None
    """Terms from probes in known free space; None if only colors are drawn."""


def known_at(
    moment: Moment, camera: Camera, config: ScoringConfig, budget: int, *, with_terms: bool = True
) -> Known:
    """Groups a moment's map into blocks, and scores its voxels from known free space.

    Args:
        moment: the moment.
        camera: of the run.
        config: of the scores.
        budget: blocks at most.
        with_terms: False leaves the terms out, which take most of the time.
    """
    state = moment.map_state
    terms = None
    if with_terms:
        positions = probe_positions(moment.grid)
        terms = surface_terms(state, camera, positions, config, pad_to=NUM_PROBES)
    return Known(moment, blocks_of(state, budget), terms)


def offer_segments(camera: Camera, offer: Offer) -> tuple[np.ndarray, np.ndarray]:
    """Draws candidates as frusta, the chosen one larger; yellow is best, gray is out of reach.

    Returns:
        Ends [s, 2, 3] float32 [m] and colors [s, 2, 3] uint8.
    """
    is_reachable = np.isfinite(offer.utilities["path"])
    scores = spread(np.where(is_reachable, offer.utilities["total"], np.nan))
    parts = [
        frustum_segments(camera, np.asarray(pose), 0.2 if number == offer.chosen else 0.1)
        for number, pose in enumerate(offer.poses)
    ]
    if not parts:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    colors = np.repeat(paint(scores, UTILITY_MAP), len(parts[0]), axis=0)
    return np.concatenate(parts), np.repeat(colors[:, None], 2, axis=1)
