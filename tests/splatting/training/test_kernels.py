"""The kernels of training on a CPU, against the plain formulas."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.kernels.native import ffi
from r3jax.kernels.native.compiled import flush_denormals, parallel_kernel
from r3jax.splatting.scene import GaussianScene, empty_scene
from r3jax.splatting.training import optimizer, train_step
from r3jax.splatting.training.config import TrainConfig

WEIGHT = 0.3
SIZES = ((7, 5), (24, 20), (70, 33), (1, 1))
"""Of images: lower than the window, of whole vectors, of several bands, a pixel."""

CONFIG = TrainConfig(iterations=100, num_gaussians=50, sh_degree=2)
RATE = jnp.float32(3e-4)
YES = jnp.asarray(True)


def images(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Two pictures that resemble each other; colors of the first leave [0, 1]."""
    rng = np.random.default_rng(height)
    first = 1.4 * rng.random((height, width, 3)) - 0.2
    second = np.clip(first + 0.3 * rng.normal(size=first.shape), 0.0, 1.0)
    return first.astype(np.float32), second.astype(np.float32)


def loss_by(implementation, x, y, weight=WEIGHT):
    """Loss, error and gradient."""
    step = jax.jit(
        jax.value_and_grad(lambda x: implementation(x, jnp.asarray(y), weight), has_aux=True)
    )
    (value, error), gradient = step(jnp.asarray(x))
    return value, error, gradient


def assert_same_loss(found, expected) -> None:
    np.testing.assert_allclose(found[0], expected[0], atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-5)
    np.testing.assert_allclose(found[2], expected[2], atol=2e-6 * np.abs(expected[2]).max())


@pytest.mark.parametrize("size", SIZES)
def test_the_loss_and_its_gradient_are_those_of_the_formulas(size):
    x, y = images(*size)
    for weight in (0.0, 0.2, 1.0):
        found = loss_by(train_step._by_kernels, x, y, weight)
        assert_same_loss(found, loss_by(train_step._by_formulas, x, y, weight))


def test_an_image_that_is_no_number_has_a_loss_that_is_none():
    x, y = images(24, 20)
    x[3, 4, 1] = np.nan
    value, _, _ = loss_by(train_step._by_kernels, x, y)
    assert np.isnan(value)


def random_scene(seed: int, scale: float = 1.0, rows: int = 50, degree: int = 2) -> GaussianScene:
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: jnp.asarray(scale * rng.normal(size=x.shape), dtype=jnp.float32),
        empty_scene(rows, degree),
    )


def moments_after(scene: GaussianScene) -> optimizer.Moments:
    """Moments as they are on the way; those of second order are not negative."""
    rows, degree = scene.capacity, scene.sh_degree
    mean = random_scene(5, 0.1, rows, degree)
    square = jax.tree.map(jnp.square, random_scene(6, 0.1, rows, degree))
    return optimizer.Moments(mean, square, jnp.asarray(7, dtype=jnp.int32))


def adam_by(step, scene, gradient, degree=2, is_wanted=YES):
    state = scene, gradient, moments_after(scene)
    return jax.jit(step)(*state, RATE, jnp.int32(degree), CONFIG, is_wanted)


def assert_same_step(found, expected) -> None:
    """To rounding: parameters near 1 resolve 6e-8."""
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-7), *(
        (step[0], step[1].mean, step[1].square, step[1].count, step[2])
        for step in (found, expected)
    ))  # fmt: skip


@pytest.mark.parametrize(("rows", "degree"), [(50, 2), (7, 0), (3000, 3)])
def test_a_step_is_that_of_the_formulas(rows, degree):
    scene, gradient = random_scene(0, 1.0, rows, degree), random_scene(1, 0.1, rows, degree)
    for opened in range(degree + 2):
        found = adam_by(optimizer._by_kernels, scene, gradient, opened)
        assert bool(found[2])
        assert_same_step(found, adam_by(optimizer._by_formulas, scene, gradient, opened))


@pytest.mark.parametrize(
    ("value", "name"), [(np.nan, "sh"), (np.inf, "means"), (3e30, "opacity_logits")]
)
def test_what_is_not_finite_changes_no_bit(value, name):
    scene, gradient = random_scene(0), random_scene(1)
    field = lambda tree: getattr(tree, name)
    bad = lambda tree: eqx.tree_at(field, tree, field(tree).at[-1].set(value))
    for state in ((scene, bad(gradient)), (bad(scene), gradient)):
        after = adam_by(optimizer._by_kernels, *state)
        assert not bool(after[2])
        jax.tree.map(np.testing.assert_array_equal, after[:2], (state[0], moments_after(scene)))


def test_a_step_that_is_not_wanted_changes_no_bit():
    scene = random_scene(0)
    after = adam_by(optimizer._by_kernels, scene, random_scene(1), is_wanted=jnp.asarray(False))
    jax.tree.map(np.testing.assert_array_equal, after[:2], (scene, moments_after(scene)))
    assert not bool(after[2])


@parallel_kernel
def _tiny_products(numbers, results):
    for i in ffi.prange(results.shape[0]):
        flush_denormals()
        results[i] = numbers[0] * numbers[1]


def _tiny(frame):
    if ffi.answers_metadata(frame):
        return 0
    _tiny_products(ffi.floats1(frame, ffi.ARGUMENTS, 0), ffi.floats1(frame, ffi.RESULTS, 0))
    return 0


def test_all_threads_take_the_tiniest_numbers_for_0():
    for _ in range(2):  # once and no more: XLA refuses a name that it knows
        ffi.register_handlers({"r3jax_test_tiny": _tiny})
    call = jax.ffi.ffi_call("r3jax_test_tiny", jax.ShapeDtypeStruct((64,), jnp.float32))
    assert not np.any(jax.jit(call)(jnp.array([1e-30, 1e-10])))
