"""The loss of an image and Adam's step in machine code on CPUs.

Shape symbols: H W image size.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.kernels.native.ffi import num_workers
from r3jax.kernels.training.bridge import ADAM, LOSS, register
from r3jax.splatting.scene import GaussianScene

_Residuals = tuple[Float[Array, "H W 3"], Float[Array, ""] | float]


@jax.custom_vjp
def image_loss(
    rgb: Float[Array, "H W 3"], target: Float[Array, "H W 3"], weight: Float[Array, ""] | float
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns `loss.loss_and_error`; the loss has a gradient by `rgb`, and nothing else has any."""
    return _loss_forward(rgb, target, weight)[0]


def _loss_forward(
    rgb: Float[Array, "H W 3"], target: Float[Array, "H W 3"], weight: Float[Array, ""] | float
) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], _Residuals]:
    register(LOSS)
    height, width = rgb.shape[:2]
    shapes = [
        jax.ShapeDtypeStruct((2,), jnp.float32),
        jax.ShapeDtypeStruct((height, width * 3), jnp.float32),
    ]
    numbers, gradient = jax.ffi.ffi_call(LOSS, shapes, vmap_method="sequential")(
        rgb.reshape(height, -1),
        target.reshape(height, -1),
        jnp.asarray(weight, dtype=jnp.float32).reshape(1),
        np.array([num_workers()], dtype=np.int32),
    )
    return (numbers[0], numbers[1]), (gradient.reshape(rgb.shape), weight)


def _loss_backward(
    residuals: _Residuals, by_results: tuple[Float[Array, ""], Float[Array, ""]]
) -> tuple[Array, Array, Array]:
    gradient, weight = residuals
    return by_results[0] * gradient, jnp.zeros_like(gradient), jnp.zeros_like(weight)


image_loss.defvjp(_loss_forward, _loss_backward)


def adam_step(
    trees: tuple[GaussianScene, GaussianScene, GaussianScene, GaussianScene],
    rates: Float[Array, " 6"],
    corrections: Float[Array, " 2"],
    num_open: Int[Array, ""],
    is_wanted: Bool[Array, ""],
) -> tuple[tuple[GaussianScene, GaussianScene, GaussianScene], Bool[Array, ""]]:
    """Returns `optimizer.adam_update` in the buffers of what it changes.

    Args:
        trees: the scene, the moments of first and second order, and the gradient.
        rates: of means, quats, log scales, logits, the constant harmonic and the others.
        corrections: what each moment is multiplied by.
        num_open: harmonics that take part.
        is_wanted: if not, or if a number or a gradient is not finite, nothing changes.

    Returns:
        Scene and moments, and whether the step was done.
    """
    register(ADAM)
    leaves, structure = jax.tree.flatten(trees[:3])
    # Not flat: XLA would copy what it has to view as another shape.
    shapes = [jax.ShapeDtypeStruct(x.shape, jnp.float32) for x in leaves]
    *after, applied = jax.ffi.ffi_call(
        ADAM,
        [*shapes, jax.ShapeDtypeStruct((1,), jnp.int32)],
        input_output_aliases={i: i for i in range(len(leaves))},
        vmap_method="sequential",
    )(
        *leaves, *jax.tree.leaves(trees[3]), rates, corrections,
        _options(trees[0], num_open, is_wanted),
    )  # fmt: skip
    return jax.tree.unflatten(structure, after), applied[0] > 0


def _options(
    scene: GaussianScene, num_open: Int[Array, ""], is_wanted: Bool[Array, ""]
) -> Int[Array, " 4"]:
    row = 3 * scene.sh.shape[1]
    return jnp.stack([jnp.int32(x) for x in (row, 3 * num_open, is_wanted, num_workers())])
