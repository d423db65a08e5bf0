"""What training minimizes: 0.8 L1 + 0.2 D-SSIM (Kerbl et al. 2023, eq. 7).

Shape symbols: H, W image size; c planes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from r3jax.kernels import calls
from r3jax.kernels.constants import SSIM_C1, SSIM_C2, TAPS, WINDOW_RADIUS
from r3jax.kernels.native.platform import by_platform


def loss_and_error(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Computes the loss of an image, and the mean squared error of its clipped colors.

    The loss can be differentiated by `rgb`.
    """
    return by_platform(cpu=_by_kernels, default=_by_formulas)(rgb, target, lambda_dssim)


def _by_formulas(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    error = jnp.mean((jnp.clip(rgb, 0.0, 1.0) - target) ** 2)
    return photometric_loss(rgb, target, lambda_dssim), error


@jax.custom_vjp
def _by_kernels(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    return _by_kernels_forward(rgb, target, lambda_dssim)[0]


def _by_kernels_forward(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], tuple[Array, Array]]:
    weight = jnp.asarray(lambda_dssim, dtype=jnp.float32)
    numbers, gradient = calls.image_loss(rgb, target, weight)
    return (numbers[0], numbers[1]), (gradient, weight)


def _by_kernels_backward(
    residuals: tuple[Array, Array], by_results: tuple[Float[Array, ""], Float[Array, ""]]
) -> tuple[Array, Array, Array]:
    gradient, weight = residuals
    return by_results[0] * gradient, jnp.zeros_like(gradient), jnp.zeros_like(weight)


_by_kernels.defvjp(_by_kernels_forward, _by_kernels_backward)


def photometric_loss(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Computes (1 - lambda) L1 + lambda (1 - SSIM)."""
    l1 = jnp.mean(jnp.abs(rgb - target))
    return (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - structural_similarity(rgb, target))


def structural_similarity(
    rgb: Float[Array, "H W 3"], target: Float[Array, "H W 3"]
) -> Float[Array, ""]:
    """Computes the mean SSIM in [-1, 1] with an 11 x 11 Gaussian window and zero padding.

    The zeros beyond the edge and the biased variances are those of the 3DGS trainer; the SSIM
    that evaluates (evaluation) follows scikit-image instead.
    """
    x, y = jnp.moveaxis(rgb, -1, 0), jnp.moveaxis(target, -1, 0)
    blurred = blur(jnp.concatenate([x, y, x * x, y * y, x * y]))
    mean_x, mean_y, xx, yy, xy = (blurred[3 * i : 3 * i + 3] for i in range(5))
    variances = (xx - mean_x * mean_x) + (yy - mean_y * mean_y)
    covariance = xy - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    return jnp.mean(luminance * (2.0 * covariance + SSIM_C2) / (variances + SSIM_C2))


@jax.custom_vjp
def blur(planes: Float[Array, "c H W"]) -> Float[Array, "c H W"]:
    """Filters each plane with the Gaussian window, zeros beyond the edges.

    Separable, as shifted sums: XLA's convolutions are 60 times slower on CPUs.
    """
    height, width = planes.shape[1:]
    padded = jnp.pad(
        planes, [(0, 0), (WINDOW_RADIUS, WINDOW_RADIUS), (WINDOW_RADIUS, WINDOW_RADIUS)]
    )
    rows = jnp.asarray(sum(w * padded[:, :, i : i + width] for i, w in enumerate(TAPS)))
    return jnp.asarray(sum(w * rows[:, i : i + height] for i, w in enumerate(TAPS)))


# The window is symmetric, so the blur is its own transpose; autodiff of the shifts is slower.
blur.defvjp(lambda planes: (blur(planes), None), lambda _, gradient: (blur(gradient),))


def psnr_of(mse: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Computes the PSNR [dB] from a mean squared error of colors in [0, 1]."""
    return -10.0 * jnp.log10(jnp.maximum(mse, 1e-10))
