"""The training loss against SciPy in float64, scikit-image and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import convolve
from skimage.metrics import structural_similarity as skimage_ssim

from r3jax.splatting.training import train_step

HEIGHT, WIDTH = 24, 20


def images(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two pictures that resemble each other, float64 in [0, 1]."""
    rng = np.random.default_rng(seed)
    first = rng.random((HEIGHT, WIDTH, 3))
    return first, np.clip(first + 0.3 * rng.normal(size=first.shape), 0.0, 1.0)


def ssim_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """SSIM of each pixel and channel by a direct 2-D convolution, zeros beyond the edge."""
    offset = np.arange(-5, 6)
    window = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2.0 * 1.5**2))
    window /= window.sum()
    mean = lambda image: np.stack(
        [convolve(image[..., c], window, mode="constant") for c in range(3)], axis=-1
    )
    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    numerator = (2.0 * mx * my + 0.01**2) * (2.0 * cov + 0.03**2)
    return numerator / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))


def loss64(x: np.ndarray, y: np.ndarray, lambda_dssim: float) -> float:
    l1 = np.abs(x - y).mean()
    return (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - ssim_map(x, y).mean())


def float32(image: np.ndarray) -> jax.Array:
    return jnp.asarray(image, dtype=jnp.float32)


def test_the_oracle_is_scikit_image_away_from_the_edges():
    x, y = images(0)
    _, theirs = skimage_ssim(
        x,
        y,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    inner = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(ssim_map(x, y)[inner], theirs[inner], atol=1e-10)


def test_loss_equals_the_oracle() -> None:
    for seed, weight in ((1, 0.2), (2, 0.0), (3, 1.0)):
        x, y = images(seed)
        ours = train_step.photometric_loss(float32(x), float32(y), weight)
        assert abs(float(ours) - loss64(x, y, weight)) < 2e-6


def test_gradient_equals_finite_differences() -> None:
    x, y = images(4)
    objective = train_step.photometric_loss
    gradient = jax.jit(jax.grad(lambda image: objective(image, float32(y), 0.2)))(float32(x))
    # Corner, edge and middle; the step stays on one side of |x - y| = 0.
    for pixel in ((0, 0, 0), (0, 7, 1), (12, 10, 2), (23, 19, 0), (5, 18, 1)):
        step = np.zeros_like(x)
        step[pixel] = min(1e-5, 0.5 * abs(x[pixel] - y[pixel]))
        slope = (loss64(x + step, y, 0.2) - loss64(x - step, y, 0.2)) / (2.0 * step[pixel])
        assert abs(float(gradient[pixel]) - slope) < 1e-3 * np.abs(gradient).max()


@given(st.integers(0, 2**31))
def test_equal_images_have_no_loss_and_others_have_some(seed):
    x, y = (float32(image) for image in images(seed))
    objective = jax.jit(train_step.photometric_loss)
    assert abs(float(objective(x, x, 0.2))) < 1e-6
    assert float(objective(x, y, 0.2)) > 0.01


@given(st.integers(0, 2**31))
def test_the_blur_is_its_own_transpose(seed):
    a, b = np.random.default_rng(seed).normal(size=(2, 3, HEIGHT, WIDTH))
    a, b = float32(a), float32(b)
    blur = jax.jit(train_step.blur)
    left, right = jnp.vdot(blur(a), b), jnp.vdot(a, blur(b))
    np.testing.assert_allclose(left, right, atol=1e-3)


def test_psnr_of_known_errors():
    mse = jnp.array([1.0, 0.1, 0.01, 0.0])
    np.testing.assert_allclose(train_step.psnr_of(mse), [0.0, 10.0, 20.0, 100.0], atol=1e-4)
