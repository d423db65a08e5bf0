"""How long a training step's rendering takes. Run by `make benchmark`.

Full step: projection, harmonics, compositing, forward and backward, gradients of all parameters
of a scene with SH degree 3, on a room-like cloud (see `room_cloud`).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene

pytestmark = pytest.mark.full

ROOM = np.array([6.0, 4.5, 2.7])
"""Length, width, height [m]."""

SIZES = [
    (20_000, 128),
    pytest.param(50_000, 256, marks=pytest.mark.measured),
    pytest.param(100_000, 512, marks=pytest.mark.measured),
    pytest.param(200_000, 512, marks=pytest.mark.measured),
]
"""Gaussians and edge of the image [px]."""


def room_cloud(num_gaussians: int, seed: int = 0) -> GaussianScene:
    """A furnished room: Gaussians on the walls and on 14 boxes, by their areas.

    Standard deviations are 0.8 of the mean spacing of the points, log-normal by axis (0.45), in
    random orientations; opacity logits are normal around 0.5 (1.7), so that some surfaces are
    opaque and others not; colors are gray with harmonics that fall off with the degree.
    """
    rng = np.random.default_rng(seed)
    size = np.concatenate([ROOM[None], rng.uniform([0.3, 0.3, 0.4], [1.4, 1.0, 1.9], (14, 3))])
    low = np.concatenate([np.zeros((1, 3)), rng.uniform(0.0, ROOM - size[1:])])
    low[:, 2] = 0.0
    # Faces are across x, y, z, two each.
    areas = np.stack([size[:, 1] * size[:, 2], size[:, 0] * size[:, 2], size[:, 0] * size[:, 1]])
    box, axis = np.divmod(rng.choice(areas.size, num_gaussians, p=areas.T.ravel() / areas.sum()), 3)
    place = rng.uniform(size=(num_gaussians, 3))
    rows = np.arange(num_gaussians)
    place[rows, axis] = rng.integers(0, 2, num_gaussians)
    spacing = np.sqrt(2.0 * areas.sum() / num_gaussians)
    falloff = 0.3 / np.repeat([1.0, 4.0, 8.0, 12.0], [1, 3, 5, 7])
    return GaussianScene(
        *(
            jnp.asarray(x, dtype=jnp.float32)
            for x in (
                low[box] + place * size[box],
                rng.standard_normal((num_gaussians, 4)),
                np.log(0.8 * spacing) + 0.45 * rng.standard_normal((num_gaussians, 3)),
                rng.normal(0.5, 1.7, num_gaussians),
                rng.standard_normal((num_gaussians, 16, 3)) * falloff[:, None],
            )
        )
    )


def room_view(edge: int) -> tuple[Camera, jax.Array]:
    """A 60 degree camera in a corner of the room, looking across it."""
    eye, target = jnp.array([0.6, 0.5, 1.6]), jnp.array([4.2, 3.2, 1.0])
    return Camera.from_fov(edge, edge, 60.0), look_at(eye, target)


@pytest.mark.parametrize("backend", ["numba", "xla"])
@pytest.mark.parametrize(("num_gaussians", "edge"), SIZES)
def test_full_step(benchmark, backend, num_gaussians, edge):
    """Targets on two cores: `numba` 11, 25, 70, 130 ms; `xla` 55, 130, 500, 900 ms."""
    scene = room_cloud(num_gaussians)
    camera, pose = room_view(edge)
    target = jnp.full((edge, edge, 3), 0.5)
    config = RasterConfig(backend=backend)

    def loss(scene):
        rendering = render(scene, camera, pose, config=config)
        error = jnp.mean((rendering.rgb - target) ** 2)
        return error + 0.1 * jnp.mean(rendering.depth), rendering

    step = jax.jit(jax.value_and_grad(loss, has_aux=True))
    run = lambda: jax.block_until_ready(step(scene))
    run()
    (_, rendering), gradient = benchmark.pedantic(run, rounds=30, warmup_rounds=3)
    benchmark.extra_info["intersections"] = int(rendering.num_intersections)
    assert int(rendering.overflow) == 0
    seen = np.any(np.asarray(gradient.means) != 0.0, axis=1).mean()
    assert 0.2 < seen < 0.5
