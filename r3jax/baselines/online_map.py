"""A Gaussian map that grows with every key frame, and the policies that train it while they plan.

After a frame: Gaussians are born where the map renders it wrongly, some steps of Adam follow over
this and earlier frames, and faint ones are pruned now and then. All randomness follows from the key
of the run and the number of key frames, so that the same frames make the same map.

Births and rows that are added or dropped are worked out on the host. Settings are one set per
rival. Training happens in `observe`, on the clock.

Shape symbols: n rows of the scene; F key frames; h w their size; m marks per Gaussian.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt32

from r3jax.baselines.confidence import pixel_normals
from r3jax.baselines.information import on_cpu, pixel_tallies, with_room
from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.kernels.constants import DILATION, FRUSTUM_MARGIN, NEAR_PLANE, SH0
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import GreedyPolicy, PlannerState
from r3jax.splatting.backend import RasterConfig, find_backend
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene, empty_scene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.optimizer import Moments, adam_update, empty_moments
from r3jax.splatting.views import fitted_size, load_views


@dataclass(frozen=True)
class MapSettings:
    """How Gaussians are born, trained and pruned; the defaults are those of Active-GS."""

    flat: bool = True
    """Discs along the measured surface; False: balls."""

    image_width: int = 128
    """Longer side of the images that the map is trained on [px]; never larger than recorded."""

    spacing: float = 0.02
    """One new Gaussian at most per voxel of this edge and key frame [m]."""

    size: float = 0.01
    """Standard deviation of a new Gaussian [m]."""

    max_size: float = 0.05
    """Larger ones are cut down to this [m]."""

    birth_color: float = 0.25
    """Squared color error, mean of the channels, above which a pixel gets a new Gaussian."""

    birth_opacity: float = 0.5
    """Rendered opacity below which it does."""

    birth_depth: float = 0.05
    """It does where the measured surface is nearer than the rendered one by this share."""

    steps: int = 10
    """Steps of Adam per key frame; Adam restarts at each."""

    recent: int = 3
    """Latest key frames in every batch."""

    older: int = 5
    """Earlier ones in it, drawn at random."""

    by_error: bool = True
    """Draws them in proportion to the last error of each; False: all alike."""

    color_weight: float = 1.0
    """Weight of the mean absolute error of colors."""

    depth_weight: float = 0.8
    """Weight of that of depths [1/m]."""

    isotropy: float = 0.0
    """Weight of the mean difference between a Gaussian's sizes and their mean [1/m], beside the sum
    of the losses of a batch."""

    rate_means: float = 5e-4
    """Learning rate of the centers [m]."""

    rate_quats: float = 5e-4
    """Learning rate of the rotations."""

    rate_opacities: float = 0.01
    """Learning rate of the opacity logits."""

    rate_log_scales: float = 0.01
    """Learning rate of the log scales."""

    rate_color: float = 1e-4
    """Learning rate of the colors."""

    prune_every: int = 5
    """Key frames between two prunings."""

    prune_opacity: float = 0.1
    """Opacity below which Gaussians are pruned, as are those that no key frame sees any more."""


DISCS = MapSettings()
"""Active-GS: mapper/incremental.yaml."""

BALLS = MapSettings(flat=False)
"""The same map of balls, for FisherRF's rule for photos, which brings no online map of its own."""

GAUSS_MI = MapSettings(
    flat=False, steps=20, recent=8, older=2, by_error=False, color_weight=0.9, depth_weight=0.1,
    isotropy=10.0,
)  # fmt: skip
"""GauSS-MI: 20 steps per key frame over a window of 8 and 2 older ones, with its loss."""


_THICKNESS = 1e-5
"""Standard deviation of a disc across its plane [m]; it must not be 0."""

_FACING = -0.01
"""Cosine between ray and normal above which a surface is seen edge-on."""

_EDGE = 0.05
"""A step of depth up to this is no edge, for normals [m]."""

_normals = jax.jit(pixel_normals)


@dataclass(frozen=True)
class Born:
    """New Gaussians."""

    means: np.ndarray
    """Centers [b, 3] [m]."""

    quats: np.ndarray
    """Rotations, wxyz [b, 4]."""

    log_scales: np.ndarray
    """Logarithms of the standard deviations [b, 3]."""

    colors: np.ndarray
    """RGB in [0, 1] [b, 3]."""


def born_in(
    rgb: np.ndarray,
    depth: np.ndarray,
    pose: np.ndarray,
    camera: Camera,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    settings: MapSettings,
    rng: np.random.Generator,
) -> Born:
    """Finds the pixels that the map renders wrongly; one Gaussian per voxel of the spacing.

    Args:
        rgb: the frame's color in steps of 1/255, [h, w, 3].
        depth: its depth, 0 where there is none, [h, w] [m].
        pose: its T_world_camera.
        camera: its intrinsics.
        seen: color, depth and opacity that the map renders there, composited on black.
        settings: thresholds, spacing and size.
        rng: which pixel of a voxel is taken.
    """
    rgb = rgb.astype(np.float32) / 255.0
    is_valid = depth > 0.0
    normals = np.asarray(
        _normals(camera, jnp.asarray(depth), jnp.asarray(is_valid), jnp.float32(_EDGE))
    ).T
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    rays = _rays(camera)
    cosine = np.sum(normals * rays, axis=1) / np.linalg.norm(rays, axis=1)
    wanted = is_wrong(rgb, depth, seen, settings).ravel() & is_valid.ravel() & (cosine < _FACING)
    points = (rays * depth.reshape(-1, 1)) @ pose[:3, :3].T + pose[:3, 3]
    chosen = one_per_voxel(points, np.flatnonzero(wanted), settings.spacing, rng)
    size = np.full((len(chosen), 3), np.log(settings.size))
    if settings.flat:
        size[:, 2] = np.log(_THICKNESS)
    return Born(
        means=points[chosen].astype(np.float32),
        quats=turned_to(normals[chosen] @ pose[:3, :3].T).astype(np.float32),
        log_scales=size.astype(np.float32),
        colors=rgb.reshape(-1, 3)[chosen],
    )


def is_wrong(
    rgb: np.ndarray,
    depth: np.ndarray,
    seen: tuple[np.ndarray, np.ndarray, np.ndarray],
    settings: MapSettings,
) -> np.ndarray:
    """Finds pixels of the wrong color, of too little opacity, or before the map's surface."""
    color, distance, alpha = seen
    error = np.mean((color - rgb) ** 2, axis=-1)
    return (
        (error > settings.birth_color)
        | (alpha < settings.birth_opacity)
        | (depth - distance < -settings.birth_depth * depth)
    )


def one_per_voxel(
    points: np.ndarray, index: np.ndarray, spacing: float, rng: np.random.Generator
) -> np.ndarray:
    """Draws one of the points [p, 3] at `index` for each voxel that holds any, in their order."""
    shuffled = rng.permutation(index)
    voxel = np.floor(points[shuffled] / spacing).astype(np.int64)
    _, first = np.unique(voxel, axis=0, return_index=True)
    return np.sort(shuffled[first])


def turned_to(normals: np.ndarray) -> np.ndarray:
    """Computes quaternions wxyz that turn z to unit vectors [b, 3], along the shortest arc."""
    x, y, z = normals.T
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(x)], axis=1)
    # Straight down there is no shortest arc: half a turn about x.
    quats[z < -0.999999] = (0.0, 1.0, 0.0, 0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _rays(camera: Camera) -> np.ndarray:
    """Computes the rays (u, v, 1) of all pixels, row by row, [h w, 3]."""
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    u = (np.arange(camera.width) + 0.5 - cx) / fx
    v = (np.arange(camera.height) + 0.5 - cy) / fy
    columns, rows = np.meshgrid(u, v)
    return np.stack([columns, rows, np.ones_like(columns)], axis=-1).reshape(-1, 3)


Rows = tuple[GaussianScene, Array]
"""The scene and the marks: all that is kept per Gaussian."""


def grown(rows: Rows, capacity: int) -> Rows:
    """Adds unused rows up to a capacity."""
    before = rows[0].capacity
    more = capacity - before
    if more == 0:
        return rows

    def extended(x: Array) -> np.ndarray:
        return np.concatenate([x, np.zeros((more, *x.shape[1:]), x.dtype)])

    return _with_unused(jax.tree.map(extended, rows), before)


def kept_rows(rows: Rows, keep: np.ndarray) -> Rows:
    """Moves the rows to keep [n] to the front, in their order; the others are unused."""
    # Stable: what stays keeps its order, and with it every later result.
    order = np.argsort(~keep, kind="stable")
    return _with_unused(jax.tree.map(lambda x: np.asarray(x)[order], rows), int(keep.sum()))


def _with_unused(rows: Any, num: int) -> Rows:
    """Marks all rows from `num` on as unused, in place, and moves all to the device."""
    for array in jax.tree.leaves(rows):
        array[num:] = 0
    scene: Any = rows[0]
    scene.quats[num:, 0] = 1.0
    scene.opacity_logits[num:] = DEAD_LOGIT
    return jax.tree.map(jnp.asarray, rows)


FIRST_CAPACITY = 1 << 14
"""Rows at the start; they double when they are used up."""

FIRST_ERROR = 10.0
"""Error of a key frame that has not been trained on: it comes first."""

_OPAQUE = 1e-3
"""Colors count where the map is more opaque than this."""

_REACH = 3.4
"""Standard deviations beyond which no Gaussian is drawn: alpha is below 1/255 there."""

SUPPORT = 0.03
"""A key frame sees a Gaussian that weighs more than this at one of its pixels with depth."""

_LONGEST_STEP = 3.2
"""Longest step of Adam [learning rates]: (1 - beta1) / sqrt(1 - beta2)."""


class Keyframes(eqx.Module):
    """Images that the map is trained on. On the host: they grow by one at a time."""

    rgb: UInt8[np.ndarray, "F h w 3"]
    """Color in steps of 1/255."""

    depth: Float[np.ndarray, "F h w"]
    """z-depth [m]; 0 or inf: none."""

    T_world_camera: Float[np.ndarray, "F 4 4"]
    """Poses, float32."""

    error: Float[np.ndarray, " F"]
    """Color and depth error when it was last trained on."""

    def __len__(self) -> int:
        return self.rgb.shape[0]


class OnlineMap(eqx.Module):
    """The Gaussians, what a rival notes of each, and the frames behind them."""

    scene: GaussianScene
    """Rows in use come first."""

    marks: Float[Array, "n m"]
    """Numbers that a rival keeps per Gaussian."""

    frames: Keyframes
    """All frames so far."""

    camera: Camera
    """Camera of the key frames."""

    seed: UInt32[np.ndarray, "..."]
    """Words of the key that all randomness follows from."""

    @property
    def num_gaussians(self) -> int:
        """Rows in use."""
        return int(jnp.sum(self.scene.is_alive))


def empty_online_map(
    camera: Camera, settings: MapSettings, key: Array, num_marks: int = 0
) -> OnlineMap:
    """Makes the map before the first frame.

    Args:
        camera: of the frames to come.
        settings: size of the training images.
        key: of all randomness.
        num_marks: numbers per Gaussian that the rival keeps.
    """
    width, height = fitted_size(camera.width, camera.height, settings.image_width)
    is_typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return OnlineMap(
        scene=empty_scene(FIRST_CAPACITY, 0),
        marks=jnp.zeros((FIRST_CAPACITY, num_marks)),
        frames=Keyframes(
            rgb=np.zeros((0, height, width, 3), np.uint8),
            depth=np.zeros((0, height, width), np.float32),
            T_world_camera=np.zeros((0, 4, 4), np.float32),
            error=np.zeros(0, np.float32),
        ),
        camera=camera.resized(width, height),
        seed=np.asarray(jax.random.key_data(key) if is_typed else key),
    )


def add_frame(
    online: OnlineMap, frame: Frame, max_range: float, settings: MapSettings
) -> OnlineMap:
    """Adds a key frame: births, training, and every few frames pruning. Not to be jitted.

    Args:
        online: the map before.
        frame: a posed RGB-D image.
        max_range: depth beyond this is not measured [m].
        settings: how.
    """
    online = _with_frame(online, frame, max_range)
    rng = np.random.default_rng([*online.seed.ravel().tolist(), len(online.frames)])
    online = _with_births(online, settings, rng)
    online = _trained(online, settings, rng)
    if len(online.frames) % settings.prune_every == 0:
        online = _pruned(online, settings)
    return online


def _with_frame(online: OnlineMap, frame: Frame, max_range: float) -> OnlineMap:
    height, width = online.frames.depth.shape[1:]
    view = load_views([frame], max(height, width))
    depth = np.asarray(view.depth)
    depth = np.where((depth > 0.0) & (depth <= max_range), depth, 0.0)
    before = online.frames
    frames = Keyframes(
        rgb=np.concatenate([before.rgb, np.asarray(view.rgb)]),
        depth=np.concatenate([before.depth, depth.astype(np.float32)]),
        T_world_camera=np.concatenate([before.T_world_camera, np.asarray(view.T_world_camera)]),
        error=np.append(before.error, np.float32(FIRST_ERROR)),
    )
    return replace(online, frames=frames)


class Seen(eqx.Module):
    """What the map shows of a view, composited on black."""

    rgb: Float[Array, "h w 3"]
    """Sum of weight x color."""

    depth: Float[Array, "h w"]
    """Sum of weight x z-depth [m]."""

    alpha: Float[Array, "h w"]
    """Sum of the weights."""


@jax.jit
def _show(
    config: RasterConfig, scene: GaussianScene, camera: Camera, pose: Array
) -> tuple[Seen, Array]:
    offsets = jnp.zeros((scene.capacity, 2))
    result = find_backend(config.backend)(scene, camera, pose, offsets, config)
    return Seen(result.rgb, result.depth_sum, result.alpha), result.overflow


def show(scene: GaussianScene, camera: Camera, T_world_camera: Any) -> Seen:
    """Renders a view of the map; the budget grows until it fits."""
    pose = jnp.asarray(T_world_camera, dtype=jnp.float32)
    return with_room(_show, scene, camera, pose)


def _with_births(online: OnlineMap, settings: MapSettings, rng: np.random.Generator) -> OnlineMap:
    """Adds Gaussians where the latest frame is rendered wrongly."""
    frames, num = online.frames, online.num_gaussians
    seen = show(online.scene, online.camera, frames.T_world_camera[-1])
    born = born_in(
        frames.rgb[-1], frames.depth[-1], frames.T_world_camera[-1], online.camera,
        (np.asarray(seen.rgb), np.asarray(seen.depth), np.asarray(seen.alpha)), settings, rng,
    )  # fmt: skip
    more = len(born.means)
    capacity = max(online.scene.capacity, _length_for(num + more))
    scene, marks = grown((online.scene, online.marks), capacity)
    # On the host: on the device, every number of births would be compiled.
    scene, rows = jax.tree.map(np.array, scene), slice(num, num + more)
    scene.means[rows], scene.quats[rows] = born.means, born.quats
    scene.log_scales[rows], scene.opacity_logits[rows] = born.log_scales, 0.0
    scene.sh[rows, 0] = (born.colors - 0.5) / SH0
    return replace(online, scene=jax.tree.map(jnp.asarray, scene), marks=marks)


def rows_in_view(
    means: Float[np.ndarray, "n 3"], camera: Camera, T_world_camera: Any, settings: MapSettings
) -> Int[np.ndarray, " r"]:
    """Finds the Gaussians that a view may show while they are trained on a key frame.

    Those within the planes of the image's edges, with room for the largest Gaussian, for what
    the training may move it by, and for what the image of the smallest one is dilated by. The
    planes are exact, the rest errs to the safe side: the omitted ones would have no gradient.

    Args:
        means: centers [m].
        camera: of the view.
        T_world_camera: its pose.
        settings: largest Gaussian, learning rate and steps.
    """
    pose = np.asarray(T_world_camera, np.float32)
    x, y, z = ((means - pose[:3, 3]) @ pose[:3, :3]).T
    drift = np.sqrt(3.0) * _LONGEST_STEP * settings.rate_means * settings.steps
    is_in = z > NEAR_PLANE - drift
    for along, focal, middle, size in (
        (x, float(camera.fx), float(camera.cx), camera.width),
        (y, float(camera.fy), float(camera.cy), camera.height),
    ):
        edges = np.array([-middle, size - middle]) / focal
        # The Jacobian is taken at most this far outside, where it stretches a ball most.
        stretch = np.hypot(1.0, np.abs(edges).max() + FRUSTUM_MARGIN * size / focal)
        dilated = _REACH * np.sqrt(DILATION) / focal
        for edge, outward in zip(edges, (-1.0, 1.0), strict=True):
            room = _REACH * settings.max_size * stretch + drift * np.hypot(1.0, edge)
            is_in &= outward * (along - edge * z) <= room + dilated * (z + drift)
    return np.flatnonzero(is_in)


@partial(jax.jit, static_argnames="settings")
def _gradient_of_view(
    config: RasterConfig,
    scene: GaussianScene,
    camera: Camera,
    frame: Any,
    rows: Int[Array, " r"],
    settings: MapSettings,
) -> tuple[tuple[GaussianScene, Float[Array, ""]], Array]:
    """Computes the gradient of a key frame's loss by rows, both errors, and the overflow."""

    def loss(part: GaussianScene) -> tuple[Array, tuple[Array, Array]]:
        seen, overflow = _show(config, part, camera, frame.T_world_camera)
        rgb = frame.rgb.astype(jnp.float32) / 255.0
        opaque = (seen.alpha > _OPAQUE).astype(jnp.float32)
        valid = (frame.depth > 0.0).astype(jnp.float32)
        color = _mean_over(jnp.mean(jnp.abs(seen.rgb - rgb), axis=-1), opaque)
        depth = _mean_over(jnp.abs(seen.depth - frame.depth), valid)
        weighted = settings.color_weight * color + settings.depth_weight * depth
        return weighted, (color + depth, overflow)

    part = jax.tree.map(lambda x: x.at[rows].get(mode="clip"), scene)
    logits = jnp.where(rows < scene.capacity, part.opacity_logits, DEAD_LOGIT)
    part = eqx.tree_at(lambda s: s.opacity_logits, part, logits)
    gradient, (error, overflow) = jax.grad(loss, has_aux=True)(part)
    return (gradient, error), overflow


@partial(jax.jit, donate_argnums=0)
def _added(total: GaussianScene, part: GaussianScene, rows: Int[Array, " r"]) -> GaussianScene:
    """Adds a part to the rows of the total; rows beyond its capacity are dropped."""
    add = lambda t, p: t.at[rows].add(p, mode="drop", unique_indices=True)
    return jax.tree.map(add, total, part)


def _unevenness(scene: GaussianScene) -> Float[Array, ""]:
    """Computes the mean difference between a Gaussian's sizes and their mean [m]."""
    sizes = jnp.exp(scene.log_scales)
    uneven = jnp.mean(jnp.abs(sizes - sizes.mean(axis=1, keepdims=True)), axis=1)
    return _mean_over(uneven, scene.is_alive.astype(jnp.float32))


def _mean_over(values: Array, mask: Array) -> Float[Array, ""]:
    return jnp.sum(values * mask) / jnp.maximum(jnp.sum(mask), 1.0)


def _trained(online: OnlineMap, settings: MapSettings, rng: np.random.Generator) -> OnlineMap:
    """Takes the steps of Adam of one key frame."""
    scene, frames, camera = online.scene, online.frames, online.camera
    moments, error = empty_moments(scene), frames.error.copy()
    means, rows = np.asarray(scene.means)[: online.num_gaussians], dict[int, np.ndarray]()
    function = partial(_gradient_of_view, settings=settings)
    for _ in range(settings.steps):
        batch = drawn_batch(error, settings, rng)
        total = jax.tree.map(jnp.zeros_like, scene)
        for number in batch:
            frame = jax.tree.map(lambda x, number=number: x[number], frames)
            if number not in rows:
                in_view = rows_in_view(means, camera, frame.T_world_camera, settings)
                rows[number] = _filled_up(in_view, scene.capacity)
            gradient, found = with_room(function, scene, camera, frame, rows[number])
            total, error[number] = _added(total, gradient, rows[number]), float(found)
        scene, moments = _stepped(scene, moments, total, len(batch), settings)
    return replace(online, scene=scene, frames=replace(frames, error=error))


def _filled_up(rows: np.ndarray, capacity: int) -> Int[np.ndarray, " r"]:
    """Pads rows to one of few lengths, as each is compiled; the last lie beyond the capacity."""
    beyond = capacity + np.arange(_length_for(len(rows)) - len(rows))
    return np.concatenate([rows, beyond]).astype(np.int32)


def _length_for(num: int) -> int:
    """Returns the first of the few lengths that holds this number of rows."""
    length = FIRST_CAPACITY
    while length < num:
        length *= 2
    return length


def drawn_batch(error: np.ndarray, settings: MapSettings, rng: np.random.Generator) -> list[int]:
    """Draws the key frames of a step: the latest, and some earlier ones.

    Args:
        error: last error of each key frame [F].
        settings: how many of each, and whether by their errors.
        rng: random numbers.
    """
    num = len(error)
    recent = list(range(max(0, num - settings.recent), num))
    earlier = num - len(recent)
    share = error[:earlier].astype(np.float64) + 1e-9
    size = min(settings.older, earlier)
    odds = share / share.sum() if settings.by_error else None
    drawn = rng.choice(earlier, size, replace=False, p=odds) if size else []
    return [*recent, *(int(number) for number in drawn)]


@partial(jax.jit, static_argnames="settings")
def _stepped(
    scene: GaussianScene,
    moments: Moments,
    total: GaussianScene,
    num: Array,
    settings: MapSettings,
) -> tuple[GaussianScene, Moments]:
    """Takes one step of Adam down the mean gradient of a batch of `num` key frames."""
    gradient = jax.tree.map(lambda g: g / num, total)
    if settings.isotropy > 0.0:
        uneven = jax.grad(_unevenness)(scene)
        weight = settings.isotropy / num  # beside the sum, of which this is the mean
        gradient = jax.tree.map(lambda g, u: g + weight * u, gradient, uneven)
    if settings.flat:
        # The third axis of a disc has no size to learn.
        gradient = eqx.tree_at(
            lambda g: g.log_scales, gradient, gradient.log_scales.at[:, 2].set(0.0)
        )
    config = TrainConfig(
        rate_quats=settings.rate_quats,
        rate_log_scales=settings.rate_log_scales,
        rate_opacities=settings.rate_opacities,
        # The color is 0.5 + SH0 times the coefficient.
        rate_sh=settings.rate_color / SH0,
    )
    rate = jnp.asarray(settings.rate_means)
    scene, moments = adam_update(scene, gradient, moments, rate, config, jnp.asarray(True))
    largest = jnp.log(settings.max_size)
    scene = eqx.tree_at(lambda s: s.log_scales, scene, jnp.minimum(scene.log_scales, largest))
    return scene, moments


@jax.jit
def _supported(
    config: RasterConfig, scene: GaussianScene, camera: Camera, pose: Array, depth: Array
) -> tuple[Bool[Array, " n"], Array]:
    is_valid = (depth > 0.0).astype(jnp.float32)
    tallies, overflow = pixel_tallies(
        scene, camera, pose, is_valid, is_valid, config, least_weight=SUPPORT
    )
    return tallies[:, 1] > 0.0, overflow


def supported_by(online: OnlineMap, number: int) -> Bool[np.ndarray, " n"]:
    """Finds the Gaussians that a key frame sees, by the map as it is."""
    frames = online.frames
    frame = jnp.asarray(frames.T_world_camera[number]), jnp.asarray(frames.depth[number])
    # To the host, so that it may join arrays on an accelerator.
    return np.asarray(with_room(_supported, *on_cpu((online.scene, online.camera, *frame))))


def _pruned(online: OnlineMap, settings: MapSettings) -> OnlineMap:
    """Prunes faint Gaussians and those that no key frame sees any more; the rest moves up."""
    opaque = jax.nn.sigmoid(online.scene.opacity_logits) >= settings.prune_opacity
    is_seen = np.zeros(online.scene.capacity, dtype=bool)
    for number in range(len(online.frames)):
        is_seen |= supported_by(online, number)
    keep = np.asarray(online.scene.is_alive & opaque) & is_seen
    scene, marks = kept_rows((online.scene, online.marks), keep)
    return replace(online, scene=scene, marks=marks)


def colored(scene: GaussianScene, values: Float[Array, " n"]) -> GaussianScene:
    """Gives each Gaussian of the scene a gray of any value >= 0.

    Rendering then composites the values.
    """
    sh = jnp.broadcast_to(((values - 0.5) / SH0)[:, None, None], scene.sh.shape)
    return eqx.tree_at(lambda s: s.sh, scene, sh)


def memory_of(situation: Any) -> OnlineMap:
    """Returns the map in a situation."""
    online = situation.memory
    assert isinstance(online, OnlineMap)
    return online


@dataclass(frozen=True)
class OnlineConfig(PlannerConfig):
    """Settings of all policies that keep a map of their own."""

    score_width: int = 128
    """Longer side of the images that candidates are scored on [px]; never more than recorded."""

    train_width: int = 128
    """Longer side of the images that the map is trained on [px]; never more than recorded."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        for name in ("score_width", "train_width"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class OnlinePolicy(GreedyPolicy):
    """A policy whose memory is an online Gaussian map."""

    config: OnlineConfig = field(default_factory=OnlineConfig)

    Config: ClassVar[type[PlannerConfig]] = OnlineConfig

    settings: ClassVar[MapSettings] = BALLS
    """How the map is kept."""

    num_marks: ClassVar[int] = 0
    """Numbers that are kept per Gaussian."""

    @property
    def map_settings(self) -> MapSettings:
        """Settings of the map, at the requested size."""
        return replace(self.settings, image_width=self.config.train_width)

    def note(self, online: OnlineMap) -> OnlineMap:
        """Takes note of the latest frame, after the map was trained on it: nothing."""
        return online

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """Returns the state before the first frame: an empty map."""
        state = super().init(camera, grid, key=key)
        online = empty_online_map(camera, self.map_settings, key, self.num_marks)
        return replace(state, memory=online)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Trains the map on the frame, too."""
        del map_state
        reach = float(self.config.scoring.max_range)
        online = add_frame(state.memory, frame, reach, self.map_settings)
        return replace(state, memory=self.note(online))

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Computes the utility's share minus the path's; random scores if all utilities are 0."""
        is_reachable = np.isfinite(utilities["path"])
        # A map without Gaussians: the first candidate would be as good as any, but always the same.
        if not np.any(utilities["utility"][is_reachable]):
            return np.where(is_reachable, utilities["lot"], -np.inf)
        return super().weigh(utilities)

    def score_camera(self, camera: Camera) -> Camera:
        """Returns the camera that candidates are scored with.

        It has the same field of view and fewer pixels.
        """
        return camera.resized(*fitted_size(camera.width, camera.height, self.config.score_width))
