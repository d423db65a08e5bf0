"""GauSS-MI: views of Gaussians with low reliability, from one of four sides.

Every Gaussian has four reliabilities r_k, for +x, +y, -x, -y of the world. A view along the unit
vector u weighs them by w_k: |u_x| goes to +x or -x by its sign, |u_y| to +y or -y.

    utility = (sum over pixels and Gaussians of weight x sum over k of w_k (-ln r_k)) / 1000
              x (1 - 0.95^k), k the number of poses back to the first like it; 1 if there is none
    D_k     = 10 w_k (sum over pixels of weight x (-ln l)), added to the log-odds of r_k

with l the loss of the pixel after a key frame. Confidence rises wherever l is below 1, which is a
loss of 0.588 before its factor of 1.7: hardly a pixel of any map is so bad, as published.

Left out: the box round an object, to which the published utility and update are limited; its 86
actions, as all policies here choose among the same hundred candidates; its 1050 steps before the
first plan, its densification by gradients and the pruning below an opacity of 0.7.

Shape symbols: C candidates; n Gaussians; h w pixels; F frames so far.
"""

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.baselines.information import on_cpu, pixel_tallies, with_room
from r3jax.baselines.online_map import (
    GAUSS_MI,
    OnlineConfig,
    OnlineMap,
    OnlinePolicy,
    Seen,
    colored,
    memory_of,
    show,
)
from r3jax.geometry.cameras import Camera, angle_between
from r3jax.geometry.numerics import safe_norm
from r3jax.planning.candidates import Candidates, draw_lots
from r3jax.planning.policy import Situation
from r3jax.splatting.backend import RasterConfig, find_backend
from r3jax.splatting.scene import GaussianScene

LIMIT = 10.0
"""Log-odds, and each step of them, are clipped to +- this."""

RELIABILITY = (1e-4, 0.9999)
"""Range of r_k."""

GAIN = 10.0
"""Factor of a step of the log-odds."""

IN_FRONT = 0.8
"""A pixel counts for a Gaussian if more light than this reaches it."""

LEAST_PIXELS = 5
"""A Gaussian that fewer pixels touch is left as it is."""

LOSS_FACTOR, LEAST_LOSS = 1.7, 1e-4
"""What a loss is multiplied by, and its floor after that."""

PUBLISHED_PIXELS = 640 * 480
"""Size of the images that the published utility is a sum over."""

SAME_PLACE, SAME_DIRECTION = 0.3, np.deg2rad(10.0)
"""Poses this near [m], [rad] are alike."""


def side_weights(scene: GaussianScene, position: Float[Array, " 3"]) -> Float[Array, "n 4"]:
    """Computes w_k of a view from `position`: how much of it goes along +x, +y, -x, -y."""
    offset = scene.means - position[None, :]
    unit = offset / jnp.maximum(safe_norm(offset, axis=1), 1e-6)[:, None]
    x, y = unit[:, 0], unit[:, 1]
    sides = [jnp.maximum(x, 0.0), jnp.maximum(y, 0.0), jnp.maximum(-x, 0.0), jnp.maximum(-y, 0.0)]
    return jnp.stack(sides, axis=1)


def reliability(marks: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """Computes r_k from log-odds."""
    return jnp.clip(jax.nn.sigmoid(marks), *RELIABILITY)


@jax.jit
def evidence(
    seen: Seen, rgb: Float[Array, "h w 3"], depth: Float[Array, "h w"]
) -> Float[Array, "h w"]:
    """Computes -ln l of every pixel.

    Here l = 1.7 (0.95 color error + 0.05 depth error), at least 1e-4.
    """
    # By the photo, whatever the map shows there: where it shows nothing it is wrong.
    has_color, has_depth = rgb.sum(axis=-1) > 0.01, depth > 0.01
    color = jnp.where(has_color, jnp.mean(jnp.abs(seen.rgb - rgb), axis=-1), 0.0)
    distance = jnp.where(has_depth, jnp.abs(seen.depth - depth), 0.0)
    loss = LOSS_FACTOR * (0.95 * color + 0.05 * distance)
    return -jnp.log(jnp.maximum(loss, LEAST_LOSS))


@jax.jit
def _tallied(
    config: RasterConfig, scene: GaussianScene, camera: Camera, pose: Array, value: Array
) -> tuple[Array, Array]:
    ones = jnp.ones_like(value)
    return pixel_tallies(scene, camera, pose, value, ones, config, least_through=IN_FRONT)


@jax.jit
def believe(
    marks: Float[Array, "n 4"], weights: Float[Array, "n 4"], tallies: Float[Array, "n 2"]
) -> Float[Array, "n 4"]:
    """Updates the log-odds by a frame: each Gaussian's summed evidence and touched pixels."""
    is_touched = tallies[:, 1] >= LEAST_PIXELS
    change = jnp.clip(GAIN * weights * tallies[:, :1], -LIMIT, LIMIT)
    return jnp.clip(marks + jnp.where(is_touched[:, None], change, 0.0), -LIMIT, LIMIT)


@jax.jit
def _scores(
    config: RasterConfig,
    scene: GaussianScene,
    camera: Camera,
    marks: Float[Array, "n 4"],
    poses: Float[Array, "C 4 4"],
) -> tuple[Array, Array]:
    """Computes the sum over pixels of weight x sum over k of w_k (-ln r_k), for every pose."""
    doubt, offsets = -jnp.log(reliability(marks)), jnp.zeros((scene.capacity, 2))

    def score(pose: Array) -> tuple[Array, Array]:
        values = jnp.sum(side_weights(scene, pose[:3, 3]) * doubt, axis=1)
        shown = colored(scene, values)
        result = find_backend(config.backend)(shown, camera, pose, offsets, config)
        return jnp.sum(result.rgb[..., 0]), result.overflow

    return jax.lax.map(score, poses)


def novelty(pose: np.ndarray, before: np.ndarray) -> float:
    """Computes 1 - 0.95^k, where k counts the poses back to the latest similar one.

    The search starts at the second-last pose.

    Args:
        pose: of the view on offer, [4, 4].
        before: poses of all frames so far, [F, 4, 4]; with five or fewer no view is held back. As
            published, the very first pose is not compared.
    """
    if len(before) <= 5:
        return 1.0
    for back in range(1, len(before) - 1):
        earlier = before[-1 - back]
        is_near = np.linalg.norm(pose[:3, 3] - earlier[:3, 3]) < SAME_PLACE
        if is_near and angle_between(pose, earlier) < SAME_DIRECTION:
            return 1.0 - 0.95**back
    return 1.0


@dataclass(frozen=True)
class GaussMIConfig(OnlineConfig):
    """Settings of `gauss-mi`."""

    lambda2: float = 0.0
    """Returns no cost: the published rule ignores the path."""


@dataclass(frozen=True)
class GaussMI(OnlinePolicy):
    """Views of Gaussians with low reliability from their side, on a map trained online."""

    config: GaussMIConfig = field(default_factory=GaussMIConfig)

    name = "gauss-mi"
    source = "GauSS-MI, Xie et al., RSS 2025, on the shared online map"
    Config = GaussMIConfig
    settings = GAUSS_MI
    num_marks = 4

    def note(self, online: OnlineMap) -> OnlineMap:
        """Believes more or less in what the latest frame shows."""
        frames, scene = online.frames, online.scene
        pose = jnp.asarray(frames.T_world_camera[-1])
        rgb = jnp.asarray(frames.rgb[-1], jnp.float32) / 255.0
        value = evidence(show(scene, online.camera, pose), rgb, jnp.asarray(frames.depth[-1]))
        arguments = on_cpu((scene, online.camera, pose, value))
        # Through the host, so that they may join arrays on an accelerator.
        tallies = jnp.asarray(np.asarray(with_room(_tallied, *arguments)))
        marks = believe(online.marks, side_weights(scene, pose[:3, 3]), tallies)
        return replace(online, marks=marks)

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes the utility of every view, scaled to images of the published size."""
        online, camera = memory_of(situation), self.score_camera(situation.camera)
        poses = candidates.poses_on_device()
        sums = with_room(_scores, online.scene, camera, online.marks, poses)
        scale = PUBLISHED_PIXELS / (camera.width * camera.height)
        whole = np.floor(scale * np.asarray(sums, np.float64))
        before = online.frames.T_world_camera.astype(np.float64)
        factor = [novelty(pose, before) for pose in np.asarray(poses, np.float64)]
        lots = draw_lots(len(candidates.valid), key=key)
        return candidates, {"utility": whole / 1000.0 * np.asarray(factor)} | lots
