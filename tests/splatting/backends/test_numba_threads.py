"""The numba rasterizer among threads, on one core, inside loops: same bits, no deadlock."""

import os
import subprocess
import sys
import textwrap
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.kernels.native import ffi, platform
from r3jax.splatting import backend
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import numba
from r3jax.splatting.backends.xla import rasterize as xla_rasterize
from tests.splatting.clouds import random_cloud, view

pytestmark = pytest.mark.full

COUNT, SIZE = 600, (70, 52)  # more than one block of Gaussians
CONFIG = RasterConfig(backend="numba", max_intersections=1 << 14)


def loss(scene, camera, pose):
    result = numba.rasterize(scene, camera, pose, jnp.zeros((COUNT, 2)), CONFIG)
    ramp = jnp.arange(SIZE[0], dtype=jnp.float32)[None, :]
    return jnp.sum(result.rgb.sum(axis=-1) * ramp + result.depth_sum), result


value_and_gradients = jax.value_and_grad(
    lambda variables: loss(*variables), has_aux=True
)  # by the scene, the camera and the pose


@pytest.fixture(scope="module")
def case():
    return random_cloud(11, COUNT), *view(*SIZE)


@pytest.fixture(scope="module")
def expected(case):
    return eqx.filter_jit(value_and_gradients)(case)


def assert_same_bits(found, expected):
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("workers", [1, 2, 3, 7])
def test_any_number_of_workers_gives_the_same_bits(case, expected, monkeypatch, workers):
    monkeypatch.setattr(ffi, "num_workers", lambda: workers)
    for _ in range(3):
        assert_same_bits(eqx.filter_jit(value_and_gradients)(case), expected)


def test_two_threads_at_once_give_the_same_bits(case, expected):
    step, found = eqx.filter_jit(value_and_gradients), []
    step(case)
    threads = [
        threading.Thread(target=lambda: found.extend(step(case) for _ in range(20)))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 60
    for result in found:
        assert_same_bits(result, expected)


def test_without_jit(case, expected):
    (value, _), gradients = value_and_gradients(case)
    np.testing.assert_allclose(value, expected[0][0], rtol=1e-6)
    # Outside jit the pose is inverted by other instructions: equal but for rounding.
    for one, other in zip(jax.tree.leaves(gradients), jax.tree.leaves(expected[1]), strict=True):
        assert np.linalg.norm(one - other) <= 1e-4 * np.linalg.norm(other)


def test_vmap_over_poses_and_scan(case):
    scene, camera, pose = case
    poses = jnp.stack([pose.at[:3, 3].add(0.05 * i) for i in range(3)])
    one = lambda pose: value_and_gradients((scene, camera, pose))
    mapped = jax.jit(jax.vmap(one))(poses)
    scanned = jax.jit(lambda poses: jax.lax.scan(lambda c, p: (c, one(p)), 0, poses)[1])(poses)
    values = [float(loss(scene, camera, pose)[0]) for pose in poses]
    assert len(set(values)) == 3
    for result in (mapped, scanned):
        np.testing.assert_allclose(result[0][0], values, rtol=1e-5)
    for one, other in zip(jax.tree.leaves(mapped), jax.tree.leaves(scanned), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


TRAINING = """
    import os, sys
    if sys.argv[1] == "before": os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import jax, jax.numpy as jnp
    from r3jax.splatting.backend import RasterConfig
    from r3jax.splatting.render import render
    from tests.splatting.clouds import random_cloud, view
    if sys.argv[1] == "after":
        jnp.zeros(3).block_until_ready()
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    scene, (camera, pose) = random_cloud(1, 600), view(70, 52)
    config = RasterConfig(backend="numba", max_intersections=1 << 14)
    @jax.jit
    def step(scene):
        def loss(scene):
            return jnp.mean((render(scene, camera, pose, config=config).rgb - 0.5) ** 2)
        value, gradient = jax.value_and_grad(loss)(scene)
        return jax.tree.map(lambda x, g: x - 0.1 * g, scene, gradient), value
    values = []
    for i in range(200):  # asynchronous: nothing waits for a step before the next is sent
        scene, value = step(scene)
        values.append(value)
    print(float(values[0]), float(values[-1]))
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs affinities of threads")
@pytest.mark.parametrize("when", ["before", "after"])
def test_training_on_one_core_does_not_hang(when):
    """A loop of asynchronous steps in a process with one core, from its start or from later on."""
    command = [sys.executable, "-c", textwrap.dedent(TRAINING), when]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    first, last = (float(word) for word in done.stdout.split())
    assert last < first


def test_workers_follow_the_cores_of_the_process(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3}, raising=False)
    assert ffi.num_workers() == 1


@pytest.mark.parametrize("name", ["auto", "numba"])
def test_other_structs_of_xla_are_not_read_by_our_offsets(name, monkeypatch):
    monkeypatch.setattr(platform, "misread", lambda: "XLA_FFI_Buffer.data lies at 32, not at 24")
    platform.warn_once.cache_clear()
    with pytest.warns(RuntimeWarning, match=r"XLA_FFI_Buffer\.data.*32.*backend='xla'"):
        assert backend.find_backend(name) is xla_rasterize
