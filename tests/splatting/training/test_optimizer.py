"""Adam against float64 NumPy, group by group."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.splatting.scene import GaussianScene, empty_scene
from r3jax.splatting.training import optimizer
from r3jax.splatting.training.config import TrainConfig

ROWS, STEPS = 6, 5
CONFIG = TrainConfig(iterations=100, num_gaussians=ROWS, sh_degree=1)
EXTENT = 2.5
YES = jnp.asarray(True)
NAMES = ("means", "quats", "log_scales", "opacity_logits", "sh")


def random_scene(seed: int, scale: float = 1.0) -> GaussianScene:
    rng = np.random.default_rng(seed)
    shapes = jax.tree.map(jnp.shape, vars(empty_scene(ROWS, 1)), is_leaf=eqx.is_array)
    fields = {name: scale * rng.normal(size=shape) for name, shape in shapes.items()}
    return GaussianScene(**{k: jnp.asarray(v, dtype=jnp.float32) for k, v in fields.items()})


def rates64(step: int) -> dict[str, np.ndarray]:
    """The table of the 3DGS trainer; the centers' rate falls from 1.6e-4 to 1.6e-6."""
    means = EXTENT * 1.6e-4 * 0.01 ** (step / 100)
    sh = 2.5e-3 * np.array([1.0, 0.05, 0.05, 0.05])[None, :, None]
    return {"means": means, "quats": 1e-3, "log_scales": 5e-3, "opacity_logits": 5e-2, "sh": sh}


def adam64(scene: GaussianScene, gradients: list[GaussianScene]) -> dict[str, np.ndarray]:
    """Algorithm 1 of Kingma & Ba (2015)."""
    result = {}
    for name in NAMES:
        x = np.asarray(getattr(scene, name), dtype=np.float64)
        m, v = np.zeros_like(x), np.zeros_like(x)
        for t, gradient in enumerate(gradients, start=1):
            g = np.asarray(getattr(gradient, name), dtype=np.float64)
            m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
            m_hat, v_hat = m / (1.0 - 0.9**t), v / (1.0 - 0.999**t)
            x = x - rates64(t)[name] * m_hat / (np.sqrt(v_hat) + 1e-15)
        result[name] = x
    return result


def test_adam_equals_float64() -> None:
    start = scene = random_scene(0)
    # Down to gradients as faint as those of distant Gaussians: epsilon must not matter.
    gradients = [random_scene(10 + i, scale=10.0 ** (-2 * i)) for i in range(STEPS)]
    moments = optimizer.empty_moments(scene)
    for t, gradient in enumerate(gradients, start=1):
        rate = optimizer.mean_rate(CONFIG, jnp.asarray(EXTENT), jnp.asarray(t))
        scene, moments = optimizer.adam_update(scene, gradient, moments, rate, CONFIG, YES)
    for name, expected in adam64(start, gradients).items():
        moved = np.asarray(getattr(scene, name)) - np.asarray(getattr(start, name))
        wanted = expected - np.asarray(getattr(start, name))
        # Near 1 float32 resolves 6e-8 at each of five steps.
        np.testing.assert_allclose(moved, wanted, rtol=1e-3, atol=5e-7, err_msg=name)


@pytest.mark.parametrize(("step", "expected"), [(0, 1.6e-4), (50, 1.6e-5), (100, 1.6e-6)])
def test_the_rate_of_centers_decays_exponentially_to_its_last_value(step, expected):
    rate = optimizer.mean_rate(CONFIG, jnp.asarray(1.0), jnp.asarray(step))
    np.testing.assert_allclose(rate, expected, rtol=1e-5)


def test_an_update_that_is_not_applied_changes_no_bit():
    scene, gradient = random_scene(0), random_scene(1)
    gradient = eqx.tree_at(lambda g: g.means, gradient, jnp.full((ROWS, 3), jnp.nan))
    moments = optimizer.empty_moments(scene)
    rate = jnp.asarray(1e-3)
    after = optimizer.adam_update(scene, gradient, moments, rate, CONFIG, jnp.asarray(False))
    jax.tree.map(np.testing.assert_array_equal, after, (scene, moments))


def test_what_has_no_gradient_stays():
    scene = empty_scene(ROWS, 1)
    gradient = jax.tree.map(jnp.zeros_like, scene)
    moments = optimizer.empty_moments(scene)
    after, _ = optimizer.adam_update(scene, gradient, moments, jnp.asarray(1e-3), CONFIG, YES)
    jax.tree.map(np.testing.assert_array_equal, after, scene)


def test_forgetting_zeroes_the_moments_of_the_rows_alone():
    moments = optimizer.Moments(random_scene(1), random_scene(2), jnp.asarray(3))
    rows = jnp.array([True, False, False, True, False, False])
    after = optimizer.forget(moments, rows)
    for old, new in ((moments.mean, after.mean), (moments.square, after.square)):
        for x, y in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True):
            assert not np.any(y[rows])
            np.testing.assert_array_equal(y[~rows], x[~rows])
    assert int(after.count) == 3
