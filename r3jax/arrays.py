"""Arrays of other programs as images and cameras: NumPy, JAX, and whatever speaks DLPack.

DLPack is how PyTorch, CuPy, TensorFlow and others hand over memory without copying it
(https://dmlc.github.io/dlpack). Everything is copied here all the same: a camera's driver writes
the next image into the buffer of the last one, and JAX arrays must never change.

Shape symbols: H W image size.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera

_ON_HOST = (1, 3)
"""DLPack's numbers of ordinary memory and of memory that CUDA has pinned."""


def as_array(name: str, value: Any) -> np.ndarray | Array:
    """An array of any of the known kinds, as NumPy's if it lies in ordinary memory.

    Args:
        name: what the caller calls it, for errors.
        value: an array of NumPy or JAX, anything with `__dlpack__` or `__array__`, or numbers in
            lists. What lies on a device stays there, and JAX must know the device.

    Returns:
        NumPy's array, whose memory may be the caller's; JAX's own one for JAX's arrays (under
        jit too) and for arrays on a device.

    Raises:
        TypeError: nothing of the kind, or an array that cannot be handed over.
    """
    if isinstance(value, jax.Array | np.ndarray):
        return value
    if hasattr(value, "__dlpack__") and hasattr(value, "__dlpack_device__"):
        return _from_dlpack(name, value)
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:
        raise TypeError(f"{name} cannot be read as an array: {error}") from error
    if array.dtype.kind not in "buif":
        raise TypeError(
            f"{name} must be an array (NumPy, JAX, or anything with __dlpack__, such as a PyTorch "
            f"tensor), got {type(value).__name__}"
        )
    return array


def _from_dlpack(name: str, value: Any) -> np.ndarray | Array:
    try:
        if int(value.__dlpack_device__()[0]) in _ON_HOST:
            return np.from_dlpack(value)
        return jax.dlpack.from_dlpack(value, copy=True)
    except Exception as error:  # every library refuses in its own way: gradients, devices, types
        raise TypeError(
            f"{name}: the {type(value).__name__} cannot be taken over by DLPack ({error}); hand "
            "over a NumPy array instead, of a PyTorch tensor: tensor.detach().cpu().numpy()"
        ) from error


def color_image(rgb: Any) -> Float[Array, "H W 3"]:
    """Colors in [0, 1] from 8-bit ones, or from floats that are so already.

    Raises:
        ValueError: another shape, no pixels, whole numbers of another size.
        TypeError: not an array.
    """
    array = as_array("rgb", rgb)
    if array.ndim != 3 or array.shape[2] != 3:
        raise ValueError(f"rgb must have shape [H, W, 3], got {array.shape}{_hint(array.shape)}")
    if array.size == 0:
        raise ValueError(f"rgb has no pixels: its shape is {array.shape}")
    if array.dtype == np.uint8:
        return jnp.asarray(_float32(array) / 255.0)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(
            f"rgb must be uint8 (0 to 255) or floating (0 to 1), got {array.dtype}: divide it by "
            "its white first"
        )
    return jnp.asarray(_float32(array))


def _hint(shape: tuple[int, ...]) -> str:
    """What to do about the shapes that other libraries prefer."""
    if len(shape) == 3 and shape[2] == 4:
        return ": leave out alpha, rgb[..., :3]"
    if len(shape) == 3 and shape[0] == 3:
        return ": channels come last here, transpose it by (1, 2, 0)"
    if len(shape) == 4 and shape[0] == 1:
        return ": leave out the axis of the batch"
    return ""


def depth_image(depth: Any, metres_per_step: float | int | None = None) -> Float[Array, "..."]:
    """z-depth [m]: from meters, or from steps of so many meters.

    Raises:
        ValueError: whole numbers without a unit, a unit that cannot be one, no numbers.
        TypeError: not an array.
    """
    array = as_array("depth", depth)
    is_whole = jnp.issubdtype(array.dtype, jnp.integer)
    if not (is_whole or jnp.issubdtype(array.dtype, jnp.floating)):
        raise ValueError(f"depth must be numbers, got {array.dtype}")
    if metres_per_step is None:
        if is_whole:
            raise ValueError(
                f"depth is {array.dtype}: say how many meters one step is, depth_scale=0.001 for "
                "millimeters"
            )
        return jnp.asarray(_float32(array))
    scale = float(metres_per_step)
    if not 0.0 < scale < np.inf or (is_whole and scale >= 1.0):
        raise ValueError(
            "depth_scale is how many meters one step of the depth is, such as 0.001 for "
            f"millimeters, got {scale:g}"
        )
    if isinstance(array, np.ndarray):
        return jnp.asarray((array.astype(np.float64) * scale).astype(np.float32))
    return array.astype(jnp.float32) * scale


def pinhole_camera(camera: Any, height: int, width: int, pixel_center: float | int) -> Camera:
    """A camera from a matrix of intrinsics; a `Camera` as it is.

    Args:
        camera: a `Camera`, or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
        height: rows of the images.
        width: columns of the images.
        pixel_center: where the matrix has the center of the upper left pixel [px].

    Raises:
        ValueError: a matrix that is not such a one, or one of other images.
        TypeError: not an array.
    """
    if isinstance(camera, Camera):
        return camera
    K = np.asarray(as_array("camera", camera))
    if K.shape != (3, 3):
        raise ValueError(
            f"camera must be an r3jax.Camera or a 3x3 matrix of intrinsics, got shape {K.shape}"
        )
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    wanted = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if not (np.isfinite(wanted).all() and np.array_equal(K, wanted)):
        raise ValueError(
            "camera must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], finite and without skew, got "
            f"{K.tolist()}"
        )
    column, row = (value + 0.5 - float(pixel_center) for value in (cx, cy))
    if not (0.0 <= column <= width and 0.0 <= row <= height):
        raise ValueError(
            f"the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} images: is "
            "the matrix for another resolution? (Of cropped images give an r3jax.Camera)"
        )
    return Camera(width, height, fx, fy, column, row)


def own_matrix(name: str, value: Any) -> np.ndarray | Array:
    """A small matrix whose memory is not the caller's.

    Raises:
        TypeError: not an array.
    """
    array = as_array(name, value)
    return array.copy()


def _float32(array: np.ndarray | Array) -> np.ndarray | Array:
    """The same numbers in memory of their own."""
    if isinstance(array, np.ndarray):
        return np.array(array, dtype=np.float32)
    return array.astype(jnp.float32)
