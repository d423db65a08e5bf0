"""How long a rival's map takes for a key frame. Run by `make benchmark`."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.baselines.online_map import GAUSS_MI, Keyframes, _trained, empty_online_map, grown
from r3jax.geometry.cameras import Camera, pose_along
from tests.benchmarks.test_splatting import ROOM, room_cloud

pytestmark = pytest.mark.full


def room_map(num_gaussians: int, capacity: int, num_frames: int = 24):
    """GauSS-MI's map of a room in balls of 1 cm, with key frames from its middle, all round."""
    camera = Camera.from_fov(128, 128, 60.0)
    online = empty_online_map(camera, GAUSS_MI, jax.random.key(0))
    scene = room_cloud(num_gaussians)
    sizes = jnp.full((num_gaussians, 3), np.log(0.01))
    scene = eqx.tree_at(lambda s: (s.sh, s.log_scales), scene, (scene.sh[:, :1], sizes))
    scene, marks = grown((scene, jnp.zeros((num_gaussians, 0))), capacity)
    rng = np.random.default_rng(0)
    angles = 0.3 * np.arange(num_frames)
    ahead = np.stack([np.cos(angles), np.sin(angles), -0.2 * np.ones(num_frames)], axis=1)
    poses = [pose_along(jnp.asarray(ROOM / 2), jnp.asarray(x, jnp.float32)) for x in ahead]
    frames = Keyframes(
        rgb=rng.integers(0, 256, (num_frames, 128, 128, 3)).astype(np.uint8),
        depth=np.full((num_frames, 128, 128), 2.0, np.float32),
        T_world_camera=np.stack(poses).astype(np.float32),
        error=np.ones(num_frames, np.float32),
    )
    return replace(online, scene=scene, marks=marks, frames=frames)


@pytest.mark.parametrize(
    ("num_gaussians", "capacity"),
    [
        (16_000, 1 << 14),
        pytest.param(250_000, 1 << 18, marks=pytest.mark.measured),
        pytest.param(270_000, 1 << 19, marks=pytest.mark.measured),
    ],
)
def test_steps_of_a_key_frame(benchmark, num_gaussians, capacity):
    """Four of the twenty steps of Adam, over ten frames each, that GauSS-MI takes."""
    online, settings = room_map(num_gaussians, capacity), replace(GAUSS_MI, steps=4)
    train = lambda: jax.block_until_ready(_trained(online, settings, np.random.default_rng(0)))
    after = benchmark.pedantic(train, rounds=5, warmup_rounds=1)
    moved = np.any(np.asarray(after.scene.means != online.scene.means), axis=1)
    assert 0.3 < moved[:num_gaussians].mean() < 1.0
    assert not moved[num_gaussians:].any()
