"""Small clouds of Gaussians, the golden case, and the pixels that no threshold decides."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import reference
from r3jax.splatting.scene import GaussianScene

_rasterize = jax.jit(reference.rasterize)

BAND = 1e-4
"""Relative distance from a threshold at which float32 may decide either way."""


def random_cloud(seed: int, count: int = 120, sh_degree: int = 3) -> GaussianScene:
    """Gaussians in a ball of 1 m: thin and round, faint and solid, some larger than the view."""
    rng = np.random.default_rng(seed)
    k = (sh_degree + 1) ** 2
    log_scales = rng.normal(-2.6, 0.7, (count, 3))
    log_scales[:3] += 2.0
    fields = (
        rng.normal(size=(count, 3)) * 0.6,
        rng.normal(size=(count, 4)) * 2.0,
        log_scales,
        rng.normal(0.5, 2.5, count),
        rng.normal(size=(count, k, 3)) * 0.5,
    )
    return GaussianScene(*(jnp.asarray(field, dtype=jnp.float32) for field in fields))


def view(width: int, height: int, distance: float = 2.0) -> tuple[Camera, jax.Array]:
    """A camera that looks at the origin from the side, principal point off the middle."""
    camera = Camera(width, height, 0.9 * width, 0.95 * width, 0.48 * width, 0.53 * height)
    return camera, look_at(np.array([distance, -0.7, 0.5]), np.zeros(3))


class Golden(NamedTuple):
    """The case that was worked out in float64."""

    scene: GaussianScene
    camera: Camera
    T_world_camera: jax.Array
    expected: dict[str, np.ndarray]


def read_golden(path) -> Golden:
    """Reads `splats.npz`."""
    data = dict(np.load(path))
    names = ("means", "quats", "log_scales", "opacity_logits", "sh")
    K = data["K"]
    camera = Camera(int(data["width"]), int(data["height"]), K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    scene = GaussianScene(*(jnp.asarray(data[name]) for name in names))
    return Golden(scene, camera, jnp.asarray(data["T_world_camera"]), data)


def safe_pixels(scene: GaussianScene, camera: Camera, T_world_camera: jax.Array) -> np.ndarray:
    """Pixels at which no cut-off (1/255, the end at T = 1e-4) is within `BAND`: [H, W] bool.

    Opacities moved up and down by `BAND` keep or drop the same Gaussians there, so that the
    image changes no more than in proportion.
    """
    zeros = jnp.zeros((scene.capacity, 2))

    def alpha(sign: float) -> jax.Array:
        opacity = jax.nn.sigmoid(scene.opacity_logits) * (1.0 + sign * BAND)
        moved = jnp.clip(opacity, 1e-7, 1.0 - 1e-7)
        logits = jnp.log(moved) - jnp.log1p(-moved)
        shifted = GaussianScene(scene.means, scene.quats, scene.log_scales, logits, scene.sh)
        config = RasterConfig(backend="reference")
        return _rasterize(shifted, camera, T_world_camera, zeros, config).alpha

    change = np.asarray(jnp.abs(alpha(1.0) - alpha(-1.0)))
    # A Gaussian at the cut-off appears or goes with alpha 1/255 times the transmittance.
    return change < 4.0 * BAND
