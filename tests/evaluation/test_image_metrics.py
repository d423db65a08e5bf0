"""PSNR and SSIM: closed forms, laws, scikit-image, gradients; faults that the laws must notice."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from r3jax.evaluation import image_metrics
from r3jax.evaluation.image_metrics import MAX_PSNR, psnr, ssim, to_8_bits

HEIGHT, WIDTH = 17, 14  # odd, even, and not square

psnr_fast, ssim_fast = jax.jit(psnr), jax.jit(ssim)
oracle = functools.partial(
    structural_similarity,
    gaussian_weights=True,
    sigma=1.5,
    use_sample_covariance=False,
    channel_axis=-1,
    data_range=1,
)


def noise(seed, *shape):
    rng = np.random.default_rng(seed)
    return rng.random(shape or (HEIGHT, WIDTH, 3), dtype=np.float32)


@st.composite
def pairs(draw):
    """Two images, from equal over similar to unrelated, of any contrast and brightness."""
    seed = draw(st.integers(0, 2**16))
    share = np.float32(draw(st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0])))
    contrast = np.float32(draw(st.sampled_from([0.0, 0.02, 0.3, 1.0])))
    brightness = np.float32(draw(st.sampled_from([0.0, 0.5, 1.0])))
    x, other = noise(seed), noise(seed + 1)
    y = (np.float32(1) - share) * x + share * other
    place = lambda image: contrast * image + (np.float32(1) - contrast) * brightness
    return jnp.asarray(place(x)), jnp.asarray(place(y))


@given(pairs())
def test_ssim_equals_scikit_image(pair):
    x, y = pair
    expected = oracle(np.asarray(x, np.float64), np.asarray(y, np.float64))
    np.testing.assert_allclose(ssim_fast(x, y), expected, atol=1e-5)


@pytest.mark.parametrize("shape", [(11, 11), (11, 12), (12, 23), (64, 48)])
def test_ssim_equals_scikit_image_at_every_size(shape):
    x, y = noise(0, *shape, 3), noise(1, *shape, 3)
    y = np.float32(0.7) * x + np.float32(0.3) * y
    expected = oracle(x.astype(np.float64), y.astype(np.float64))
    np.testing.assert_allclose(ssim(jnp.asarray(x), jnp.asarray(y)), expected, atol=1e-5)


@given(pairs())
def test_both_are_symmetric_and_bounded(pair):
    x, y = pair
    np.testing.assert_allclose(ssim_fast(x, y), ssim_fast(y, x), atol=1e-6)
    np.testing.assert_allclose(psnr_fast(x, y), psnr_fast(y, x), rtol=1e-6)
    assert -1.0 <= float(ssim_fast(x, y)) <= 1.0 + 1e-6
    assert 0.0 <= float(psnr_fast(x, y)) <= MAX_PSNR


@given(pairs())
def test_equal_images_have_the_best_values(pair):
    x, _ = pair
    np.testing.assert_allclose(ssim_fast(x, x), 1.0, atol=1e-6)
    assert float(psnr_fast(x, x)) == MAX_PSNR


@pytest.mark.parametrize("shift", [0.5, 0.1, 0.01, 1 / 255])
def test_psnr_of_a_shift_is_its_logarithm(shift):
    x = jnp.full((HEIGHT, WIDTH, 3), 0.25)
    np.testing.assert_allclose(psnr_fast(x, x + shift), -20 * np.log10(shift), rtol=1e-4)


def test_ssim_of_constants_is_the_luminance_term():
    x, y = 0.3, 0.8
    expected = (2 * x * y + 1e-4) / (x * x + y * y + 1e-4)
    constant = functools.partial(jnp.full, (HEIGHT, WIDTH, 3))
    np.testing.assert_allclose(ssim_fast(constant(x), constant(y)), expected, atol=1e-5)


def test_more_noise_is_worse():
    x, other = noise(0), noise(1)
    mixed = [jnp.asarray((1 - t) * x + t * other) for t in np.float32([0, 0.05, 0.1, 0.2, 0.4, 1])]
    for metric in (psnr_fast, ssim_fast):
        values = [float(metric(jnp.asarray(x), y)) for y in mixed]
        assert values == sorted(values, reverse=True)
        assert len(set(values)) == len(values)


@given(st.integers(0, 2**16))
def test_a_batch_is_its_images(seed):
    x, y = (jnp.asarray(noise(seed + i, 3, HEIGHT, WIDTH, 3)) for i in range(2))
    for metric, batched in ((psnr, psnr_fast), (ssim, ssim_fast)):
        single = [metric(a, b) for a, b in zip(x, y, strict=True)]
        np.testing.assert_allclose(batched(x, y), jnp.stack(single), rtol=1e-5, atol=1e-6)


def test_valid_pixels() -> None:
    metric = image_metrics.psnr
    x, y = jnp.asarray(noise(2)), jnp.asarray(noise(3))
    valid = jnp.asarray(noise(4)[..., 0] < 0.3)
    picked = np.asarray(valid)
    error = np.mean((np.asarray(x, np.float64) - np.asarray(y, np.float64))[picked] ** 2)
    np.testing.assert_allclose(metric(x, y, valid), -10 * np.log10(error), rtol=1e-5)
    spoiled = jnp.where(valid[..., None], x, 0.123)
    np.testing.assert_allclose(metric(spoiled, y, valid), metric(x, y, valid), rtol=1e-6)
    np.testing.assert_allclose(metric(x, y, jnp.ones_like(valid)), metric(x, y), rtol=1e-6)
    assert np.isnan(metric(x, y, jnp.zeros_like(valid)))


@given(st.floats(-0.5, 1.5, width=32))
def test_eight_bits_are_the_nearest_of_256_levels(value):
    stored = float(to_8_bits(jnp.full((1, 1, 3), value, jnp.float32))[0, 0, 0])
    level = stored * 255.0
    assert abs(level - round(level)) < 1e-4
    clipped = min(max(value, 0.0), 1.0)
    assert abs(stored - clipped) <= 0.5 / 255.0 + 1e-6


def test_gradients() -> None:
    """Against differences of scikit-image's value in float64."""
    metric = image_metrics.ssim
    x, y = noise(5), np.float32(0.6) * noise(5) + np.float32(0.4) * noise(6)
    by_x, by_y = jax.grad(metric, argnums=(0, 1))(jnp.asarray(x), jnp.asarray(y))
    direction, step = np.random.default_rng(7).standard_normal(x.shape), 1e-5
    for value, gradient in ((0, by_x), (1, by_y)):
        ends = []
        for sign in (1.0, -1.0):
            images = [x.astype(np.float64), y.astype(np.float64)]
            images[value] = images[value] + sign * step * direction
            ends.append(oracle(*images))
        expected = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(np.sum(np.asarray(gradient) * direction), expected, rtol=1e-3)


def test_gradients_are_finite_for_flat_and_equal_images():
    slope = jax.jit(jax.grad(lambda x, y: ssim(x, y)))
    flat = jnp.full((HEIGHT, WIDTH, 3), 0.5)
    for x, y in ((flat, flat), (flat * 0, flat * 2), (flat * 0, flat * 0), (noise(8), noise(8))):
        assert np.all(np.isfinite(slope(jnp.asarray(x), jnp.asarray(y))))


def test_mistakes_are_named():
    x = jnp.zeros((HEIGHT, WIDTH, 3))
    with pytest.raises(ValueError, match=r"11 x 11.*14 x 10"):
        ssim(x[:10], x[:10])
    for metric in map(inspect.unwrap, (psnr, ssim)):  # without the tests' type checker
        with pytest.raises(ValueError, match=r"\(17, 14, 3\).*\(16, 14, 3\)"):
            metric(x, x[1:])
    with pytest.raises(ValueError, match=r"valid.*\(17, 13\)"):
        inspect.unwrap(psnr)(x, x, jnp.ones((17, 13), dtype=bool))


def test_oracle() -> None:
    x, y = noise(9), np.float32(0.8) * noise(9) + np.float32(0.2) * noise(10)
    dark = lambda image: np.float32(0.1) * image + np.float32(0.05)
    for a, b in ((x, y), (dark(x), dark(y)), (dark(x), dark(y) / np.float32(2))):
        expected = oracle(a.astype(np.float64), b.astype(np.float64))
        value = image_metrics.ssim(jnp.asarray(a), jnp.asarray(b))
        np.testing.assert_allclose(value, expected, atol=1e-5)


def test_8_bits() -> None:
    values = jnp.asarray([-0.2, 0.0, 0.3 / 255, 0.6 / 255, 0.5, 254.6 / 255, 1.0, 1.7])
    expected = np.array([0, 0, 0, 1, 128, 255, 255, 255]) / 255
    np.testing.assert_allclose(image_metrics.to_8_bits(values), expected, atol=1e-6)
