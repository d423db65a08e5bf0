"""A small scene whose truth is known, and a training on it in which everything happens."""

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.views import Views

WIDTH, HEIGHT, NUM_VIEWS = 48, 32, 8
ROOMY = RasterConfig(backend="numba", max_intersections=1 << 13)


def config(**changes) -> TrainConfig:
    """A short run in which everything happens: refinements, a reset, two degrees."""
    settings = {
        "iterations": 40,
        "num_gaussians": 300,
        "capacity": 400,
        "sh_degree": 1,
        "refine_every": 10,
        "refine_until": 35,
        "reset_every": 16,
        "raster": ROOMY,
    }
    return TrainConfig(**settings | changes)


def ball_views() -> Views:
    """A ball of 300 Gaussians, seen from a circle."""
    rng = np.random.default_rng(0)
    n = 300
    fields = (
        rng.normal(size=(n, 3)) * 0.5,
        rng.normal(size=(n, 4)),
        rng.normal(-2.3, 0.4, (n, 3)),
        rng.normal(1.0, 1.5, n),
        rng.normal(size=(n, 1, 3)),
    )
    scene = GaussianScene(*(jnp.asarray(field, dtype=jnp.float32) for field in fields))
    camera = Camera.from_fov(WIDTH, HEIGHT, 60.0)
    angles = np.arange(NUM_VIEWS) * 2.0 * np.pi / NUM_VIEWS
    eyes = np.stack([2.2 * np.cos(angles), 2.2 * np.sin(angles), 0.4 + 0.2 * np.sin(3 * angles)], 1)
    poses = jnp.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    pictures = jax.jit(jax.vmap(lambda T: render(scene, camera, T, None, ROOMY)))(poses)
    rgb = np.rint(np.clip(pictures.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
    return Views(
        rgb=jnp.asarray(rgb),
        depth=jnp.where(pictures.alpha > 0.5, pictures.depth, 0.0),
        T_world_camera=poses,
        cameras=jax.tree.map(lambda x: jnp.broadcast_to(x, (NUM_VIEWS,)), camera),
    )
