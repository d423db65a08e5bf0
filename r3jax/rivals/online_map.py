"""A Gaussian map that grows with every key frame: the one map that all rivals here keep.

After a frame: Gaussians are born where the map renders it wrongly, some steps of Adam follow over
this and earlier frames, and now and then what is faint goes. All randomness follows from the key
of the run and the number of key frames, so that the same frames make the same map.

Shape symbols: n rows of the scene; F key frames; h w their size; m marks per Gaussian.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8, UInt32

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.rivals.births import born_in, grown, kept_rows
from r3jax.rivals.settings import MapSettings
from r3jax.splatting.backend import find_backend
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.harmonics import C0
from r3jax.splatting.information import with_room
from r3jax.splatting.scene import GaussianScene, empty_scene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.optimizer import Moments, adam_update, empty_moments
from r3jax.splatting.views import fitted_size, load_views

FIRST_CAPACITY = 1 << 14
"""Rows at the start; they double when they are used up."""

FIRST_ERROR = 10.0
"""Error of a key frame that has not been trained on: it comes first."""

_OPAQUE = 1e-3
"""Colors count where the map is more opaque than this."""


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

    shown: Bool[Array, " n"]
    """True where a training view has shown the Gaussian."""

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
        shown=jnp.zeros(FIRST_CAPACITY, dtype=bool),
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
    capacity = online.scene.capacity
    while capacity < num + more:
        capacity *= 2
    scene, marks, shown = grown((online.scene, online.marks, online.shown), capacity)
    # On the host: on the device, every number of births would compile anew.
    scene, rows = jax.tree.map(np.array, scene), slice(num, num + more)
    scene.means[rows], scene.quats[rows] = born.means, born.quats
    scene.log_scales[rows], scene.opacity_logits[rows] = born.log_scales, 0.0
    scene.sh[rows, 0] = (born.colors - 0.5) / C0
    return replace(online, scene=jax.tree.map(jnp.asarray, scene), marks=marks, shown=shown)


@partial(jax.jit, static_argnames="settings")
def _mean_gradient(
    config: RasterConfig,
    scene: GaussianScene,
    camera: Camera,
    frames: Any,
    num: Array,
    settings: MapSettings,
) -> tuple[tuple[GaussianScene, Float[Array, " F"]], Array]:
    """Mean gradient of the first `num` key frames, color and depth error of each, overflow."""

    def loss(scene: GaussianScene, i: Array) -> tuple[Array, tuple[Array, Array]]:
        seen, overflow = _show(config, scene, camera, frames.T_world_camera[i])
        opaque = (seen.alpha > _OPAQUE).astype(jnp.float32)
        valid = (frames.depth[i] > 0.0).astype(jnp.float32)
        rgb = frames.rgb[i].astype(jnp.float32) / 255.0
        color = _mean_over(jnp.mean(jnp.abs(seen.rgb - rgb), axis=-1), opaque)
        depth = _mean_over(jnp.abs(seen.depth - frames.depth[i]), valid)
        weighted = settings.color_weight * color + settings.depth_weight * depth
        return weighted, (color + depth, overflow)

    def add_frame_of(i: Array, found: Any) -> Any:
        total, errors, most = found
        gradient, (error, overflow) = jax.grad(loss, has_aux=True)(scene, i)
        total = jax.tree.map(jnp.add, total, gradient)
        return total, errors.at[i].set(error), jnp.maximum(most, overflow)

    nothing = jax.tree.map(jnp.zeros_like, scene), jnp.zeros(frames.error.shape), jnp.int32(0)
    total, errors, most = jax.lax.fori_loop(0, num, add_frame_of, nothing)
    gradient = jax.tree.map(lambda g: g / num, total)
    if settings.isotropy > 0.0:
        # The same for every frame: once is enough.
        uneven = jax.grad(_unevenness)(scene)
        gradient = jax.tree.map(lambda g, u: g + settings.isotropy * u, gradient, uneven)
    return (gradient, errors), most


def _unevenness(scene: GaussianScene) -> Float[Array, ""]:
    """Mean difference between a Gaussian's sizes and their mean [m]."""
    sizes = jnp.exp(scene.log_scales)
    uneven = jnp.mean(jnp.abs(sizes - sizes.mean(axis=1, keepdims=True)), axis=1)
    return _mean_over(uneven, scene.is_alive.astype(jnp.float32))


def _mean_over(values: Array, mask: Array) -> Float[Array, ""]:
    return jnp.sum(values * mask) / jnp.maximum(jnp.sum(mask), 1.0)


def _trained(online: OnlineMap, settings: MapSettings, rng: np.random.Generator) -> OnlineMap:
    """Takes the steps of Adam of one key frame."""
    scene, shown, error = online.scene, online.shown, online.frames.error.copy()
    moments, room = empty_moments(scene), settings.recent + settings.older
    function = partial(_mean_gradient, settings=settings)
    for _ in range(settings.steps):
        batch = drawn_batch(error, settings, rng)
        # Always as many rows, the last ones unused: each number of them would compile anew.
        rows = np.resize(batch, room)
        frames = jax.tree.map(partial(np.take, indices=rows, axis=0), online.frames)
        gradient, found = with_room(function, scene, online.camera, frames, len(batch))
        error[batch] = np.asarray(found)[: len(batch)]
        scene, moments, shown = _stepped(scene, moments, shown, gradient, settings)
    return replace(online, scene=scene, shown=shown, frames=replace(online.frames, error=error))


def drawn_batch(error: np.ndarray, settings: MapSettings, rng: np.random.Generator) -> list[int]:
    """Draws the key frames of a step: the latest, and earlier ones by their last error [F]."""
    num = len(error)
    recent = list(range(max(0, num - settings.recent), num))
    earlier = num - len(recent)
    share = error[:earlier].astype(np.float64) + 1e-9
    size = min(settings.older, earlier)
    drawn = rng.choice(earlier, size, replace=False, p=share / share.sum()) if size else []
    return [*recent, *(int(number) for number in drawn)]


@partial(jax.jit, static_argnames="settings")
def _stepped(
    scene: GaussianScene,
    moments: Moments,
    shown: Bool[Array, " n"],
    gradient: GaussianScene,
    settings: MapSettings,
) -> tuple[GaussianScene, Moments, Bool[Array, " n"]]:
    """One step of Adam down the mean gradient of a batch."""
    if settings.flat:
        # The third axis of a disc has no size to learn.
        gradient = eqx.tree_at(
            lambda g: g.log_scales, gradient, gradient.log_scales.at[:, 2].set(0.0)
        )
    config = TrainConfig(
        rate_quats=settings.rate_quats,
        rate_log_scales=settings.rate_log_scales,
        rate_opacities=settings.rate_opacities,
        # The color is 0.5 + C0 times the coefficient.
        rate_sh=settings.rate_color / C0,
    )
    rate = jnp.asarray(settings.rate_means)
    scene, moments = adam_update(scene, gradient, moments, rate, config, jnp.asarray(True))
    largest = jnp.log(settings.max_size)
    scene = eqx.tree_at(lambda s: s.log_scales, scene, jnp.minimum(scene.log_scales, largest))
    return scene, moments, shown | (gradient.opacity_logits != 0.0)


def _pruned(online: OnlineMap, settings: MapSettings) -> OnlineMap:
    """Drops what is faint, and what no training view has shown; the rest moves up."""
    opaque = jax.nn.sigmoid(online.scene.opacity_logits) >= settings.prune_opacity
    keep = np.asarray(online.scene.is_alive & opaque & online.shown)
    scene, marks, shown = kept_rows((online.scene, online.marks, online.shown), keep)
    return replace(online, scene=scene, marks=marks, shown=shown)


def colored(scene: GaussianScene, values: Float[Array, " n"]) -> GaussianScene:
    """The scene with a gray of any value >= 0 per Gaussian: rendering composites the values."""
    sh = jnp.broadcast_to(((values - 0.5) / C0)[:, None, None], scene.sh.shape)
    return eqx.tree_at(lambda s: s.sh, scene, sh)
