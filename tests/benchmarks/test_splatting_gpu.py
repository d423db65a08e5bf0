"""A full step on an NVIDIA GPU: ours beside splax called directly, in the same run.

Run by `make benchmark` where there is a GPU; ours must not be slower than the call that it wraps
by more than the noise, and `xla` shows what the pure-JAX way costs there.
"""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry.cameras import invert_pose
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends.splax import load_splax
from r3jax.splatting.render import render
from tests.benchmarks.test_splatting import SIZES, room_cloud, room_view

pytestmark = [
    pytest.mark.skipif(jax.default_backend() == "cpu", reason="there is no GPU"),
    pytest.mark.skipif(importlib.util.find_spec("splax") is None, reason="splax is not installed"),
]


def ours(config: RasterConfig):
    """Loss of our rendering."""

    def loss(scene, camera, pose):
        image = render(scene, camera, pose, config=config)
        return jnp.mean((image.rgb - 0.5) ** 2) + 0.1 * jnp.mean(image.depth)

    return loss


def direct(scene, camera, pose):
    """The same loss through splax itself, for a camera whose principal point is the middle."""
    image, _ = load_splax().render(
        scene.means,
        scene.log_scales,
        scene.quats,
        scene.sh,
        scene.opacity_logits,
        viewmat=invert_pose(pose),
        background=jnp.zeros(3),
        img_shape=(camera.height, camera.width),
        f=(float(0.5 * camera.width / np.tan(np.pi / 6)),) * 2,
        render_depth=True,
    )
    return jnp.mean((image[..., :3] - 0.5) ** 2) + 0.1 * jnp.mean(image[..., 3])


LOSSES = {
    "direct": direct,
    "splax": ours(RasterConfig(backend="splax")),
    "xla": ours(RasterConfig(backend="xla", tiles_per_batch=1024, gaussians_per_chunk=32)),
}


@pytest.mark.parametrize("way", LOSSES)
@pytest.mark.parametrize(("num_gaussians", "edge"), SIZES)
def test_full_step(benchmark, way, num_gaussians, edge):
    scene = room_cloud(num_gaussians)
    camera, pose = room_view(edge)
    step = jax.jit(jax.value_and_grad(LOSSES[way]))
    run = lambda: jax.block_until_ready(step(scene, camera, pose))
    run()
    value, _ = benchmark.pedantic(run, rounds=50, warmup_rounds=5)
    expected = jax.jit(LOSSES["direct"])(scene, camera, pose)
    assert float(value) == pytest.approx(float(expected), rel=1e-2)
