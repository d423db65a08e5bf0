"""A posed RGB-D image, made from arrays of this or another library.

Accepts arrays of NumPy and JAX, and everything that supports DLPack
(https://dmlc.github.io/dlpack), such as tensors of PyTorch, CuPy and TensorFlow. They are always
copied: camera drivers reuse their buffers, and JAX arrays must never change.

Shape symbols: H W image size.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from r3jax.errors import InputError
from r3jax.geometry.arguments import one
from r3jax.geometry.cameras import Camera, is_rigid, is_traced, rigid_error
from r3jax.geometry.voxels import check_near_origin

FAR = 50.0
"""A median depth beyond this is taken for a wrong unit [m]."""

_MEDIAN_SIZE = 64
"""Side of the subsampled image whose median is taken [px]; it is the same to a few percent."""

CONVENTIONS: dict[str, tuple[bool, np.ndarray]] = {
    "opencv": (False, np.eye(4)),
    "world-to-camera": (True, np.eye(4)),
    "opengl": (False, np.diag([1.0, -1.0, -1.0, 1.0])),
    "ros": (
        False,
        np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64),
    ),
}
"""Pose conventions: whether the pose is inverted, and the OpenCV axes in those of the
convention."""

_ON_HOST = (1, 3)
"""DLPack's device types of CPU memory and of pinned CUDA memory."""


def _as_image(image: ArrayLike) -> Array:
    """Converts half and double precision to float32; leaves integers, which are refused later."""
    array = jnp.asarray(image)
    # Cast to float, 8-bit colors would be 255 times too bright and millimeters too far.
    return array.astype(jnp.float32) if jnp.issubdtype(array.dtype, jnp.floating) else array


def _as_pose(pose: ArrayLike) -> Array:
    """Converts a pose to single precision.

    Under jit, where it cannot be refused, a pose that is not rigid becomes NaN.
    """
    T = jnp.asarray(pose, dtype=jnp.float32)
    # A wrong shape is refused by `_check_structure`, a known value by `_check_values`.
    if T.shape != (4, 4) or not is_traced(T):
        return T
    # NaN spreads into every number made from the pose; 0 or the identity would look sound.
    return T * jnp.where(is_rigid(T), 1.0, jnp.nan)


def _refuse_far(depth: ArrayLike) -> None:
    """Refuses depth that is surely in another unit, where it is known."""
    # A wrong number of axes is reported later, with the camera's shape.
    if is_traced(depth) or np.ndim(depth) != 2:
        return
    array = np.asarray(depth)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        return  # refused later, with the correct reason
    # A sample is enough: millimeters taken for meters are off by 1000, not by a few percent.
    rows, columns = (max(1, size // _MEDIAN_SIZE) for size in array.shape)
    some = array[::rows, ::columns].astype(np.float64)
    # 0 and inf are codes, not distances: an image full of them must not shift the median.
    measured = some[(some > 0.0) & np.isfinite(some)]
    # The median, not the maximum: a few outliers must not reject a frame.
    if len(measured) and (median := float(np.median(measured))) > FAR:
        raise InputError(
            f"the median depth is {median:.4g} m: is it in millimeters? (Frame.from_arrays: "
            "depth_scale=0.001; transforms.json: depth_unit_scale_factor. If it is correct: Frame "
            "with far=True)"
        )


class Frame(eqx.Module):
    """One posed RGB-D image; invalid ones are refused.

    Raises:
        ValueError: shapes that do not fit the camera, integer images (divide by 255 first),
            colors outside [0, 1] or not finite, depth that is NaN or negative, a pose that is
            not finite, not rigid, or more than 32 km from the origin, a median depth of more
            than 50 m (without `far`). Values are checked where they are known (outside jit).
    """

    rgb: Float[Array, "H W 3"]
    """Color in [0, 1]."""

    depth: Float[Array, "H W"]
    """z-depth [m]. 0: no measurement. inf: nothing within the sensor's range."""

    T_world_camera: Float[Array, "4 4"]
    """Camera-to-world pose; OpenCV axes, world z up [m]."""

    camera: Camera
    """Intrinsics of both images."""

    def __init__(
        self,
        rgb: ArrayLike,
        depth: ArrayLike,
        T_world_camera: ArrayLike,
        camera: Camera,
        *,
        far: bool = False,
    ):
        """Takes the fields; `far` allows a median depth of more than 50 m."""
        self.rgb, self.depth = _as_image(rgb), _as_image(depth)
        self.T_world_camera, self.camera = _as_pose(T_world_camera), camera
        # The argument, not the field: it may still be on the host.
        if not far:
            _refuse_far(depth)

    @staticmethod
    def from_arrays(
        rgb: Any,
        depth: Any,
        T_world_camera: Any,
        camera: Any,
        *,
        depth_scale: float | int | None = None,
        pixel_center: float | int = 0.0,
        convention: str = "opencv",
        ignore: Any = None,
        far: bool = False,
    ) -> "Frame":
        """Makes a frame from arrays of any library.

        Arrays are NumPy's, JAX's, or anything with `__dlpack__`: a PyTorch tensor on the CPU, or
        on a device that JAX uses too. They are copied; their memory may be written again.

            frame = r3jax.Frame.from_arrays(tensor, depth_mm, pose, K, depth_scale=0.001)

        Args:
            rgb: colors, [H, W, 3]: uint8, or floats in [0, 1].
            depth: z-depth, [H, W], not the length of the ray; 0 means no measurement and inf
                that nothing lies within the sensor's range. Meters, or steps of `depth_scale`.
            T_world_camera: camera-to-world pose, [4, 4]; OpenCV axes (x right, y down, z
                forward), world z up [m]; or a pose of another `convention`.
            camera: a `Camera`, or the 3x3 pinhole matrix for images of this size.
            depth_scale: meters per step of the depth, 0.001 for millimeters. None: meters; only for
                floats.
            pixel_center: coordinate of the upper left pixel's center in the matrix' convention
                [px]: 0 in OpenCV and ROS, 0.5 in COLMAP and nerfstudio. A `Camera` has it at 0.5.
            convention: the convention of the pose. `opencv`: camera to world, OpenCV axes, as ROS'
                optical frames have them. `world-to-camera`: its inverse, as COLMAP and OpenCV's
                `solvePnP` give it. `opengl`: camera to world, x right, y up, z back (Blender,
                    nerfstudio, ARKit). `ros`: camera to world, x ahead, y left, z up
                    (`camera_link`, `base_link`). `observe` warns if the depth images contradict it.
            ignore: mask of pixels to leave out, [H, W] bool, for example people found by a
                detector. Their depth becomes 0 (no measurement) and their color is not used. None:
                use all.
            far: allow a median depth of more than 50 m, which otherwise is taken for a wrong unit.

        Raises:
            ValueError: as `Frame`; colors or depth of an unexpected type or shape, integer depth
                without `depth_scale`, a matrix that does not fit the images, an unknown convention,
                a mask of another shape or type.
            TypeError: not an array, or one that cannot be converted.
        """
        # Colors first: they give the image size, which a matrix of intrinsics lacks. # words: ok
        colors = color_image(rgb)
        height, width = colors.shape[:2]
        own_depth = depth_image(depth, depth_scale)
        if ignore is not None:
            own_depth = without(own_depth, ignore)
        return Frame(
            rgb=colors,
            depth=own_depth,
            T_world_camera=to_camera_to_world(
                own_matrix("T_world_camera", T_world_camera), convention
            ),
            camera=pinhole_camera(camera, height, width, pixel_center),
            far=far,
        )

    def __check_init__(self) -> None:
        """Refuses values that would cause NaN or silent errors later."""
        # Shapes are known while tracing; values are not.
        self._check_structure()
        if not is_traced(self.rgb, self.depth, self.T_world_camera):
            self._check_values()

    def _check_structure(self) -> None:
        height, width = self.camera.height, self.camera.width
        if self.rgb.shape != (height, width, 3):
            raise InputError(
                f"rgb has shape {self.rgb.shape}, but the camera's image is {(height, width, 3)}"
            )
        if self.depth.shape != (height, width):
            raise InputError(
                f"depth has shape {self.depth.shape}, but the camera's image is {(height, width)}"
            )
        if self.T_world_camera.shape != (4, 4):
            raise InputError(
                f"T_world_camera is a 4x4 matrix, got shape {self.T_world_camera.shape}"
            )
        # No conversion here: only the caller knows the unit of an integer.
        for name, array in (("rgb", self.rgb), ("depth", self.depth)):
            if not jnp.issubdtype(array.dtype, jnp.floating):
                raise InputError(
                    f"{name} must be float32, got {array.dtype}: convert it first "
                    "(8-bit color / 255, depth to meters)"
                )

    def _check_values(self) -> None:
        # NumPy: JAX would compile a program for each image size of a recording.
        rgb, depth = np.asarray(self.rgb), np.asarray(self.depth)
        low, high = float(rgb.min()), float(rgb.max())  # NaN makes the comparison false
        if not (low >= 0.0 and high <= 1.0):
            raise InputError(f"rgb must lie in [0, 1], got values from {low:.4g} to {high:.4g}")
        # Written as a condition that NaN fails; `< 0` would let NaN pass.
        if not float(depth.min()) >= 0.0:
            bad = np.argwhere(~(depth >= 0.0))
            row, column = (int(i) for i in bad[0])
            raise InputError(
                f"depth must be >= 0 and not NaN; {len(bad)} pixels are not, the first at row "
                f"{row}, column {column}: {depth[row, column]} (use 0 for no measurement)"
            )
        problem = rigid_error(np.asarray(self.T_world_camera))
        if problem is not None:
            raise InputError(f"T_world_camera: {problem}")
        check_near_origin("T_world_camera", np.asarray(self.T_world_camera)[:3, 3])

    @property
    def position(self) -> Float[Array, " 3"]:
        """Camera center in the world [m]."""
        return self.T_world_camera[:3, 3]


a_frame = one(Frame, "Frame.from_arrays makes one of arrays", leaf="depth", ndim=2)


def as_array(name: str, value: Any) -> np.ndarray | Array:
    """Converts any supported kind of array; to a NumPy array if it is in CPU memory.

    Args:
        name: the caller's name of it, for errors.
        value: an array of NumPy or JAX, anything with `__dlpack__` or `__array__`, or numbers in
            lists. Arrays on a device stay there; JAX must support the device.

    Returns:
        A NumPy array, which may share the caller's memory; a JAX array for JAX arrays (also under
        jit) and for arrays on a device.

    Raises:
        TypeError: not an array, or one that cannot be converted.
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
            f"{name}: cannot convert the {type(value).__name__} by DLPack ({error}); "
            "pass a NumPy array instead (PyTorch: tensor.detach().cpu().numpy())"
        ) from error


def color_image(rgb: Any) -> Float[Array, "H W 3"]:
    """Converts 8-bit colors to [0, 1]; floats must be so already.

    Raises:
        ValueError: another shape, no pixels, whole numbers of another size.
        TypeError: not an array.
    """
    array = as_array("rgb", rgb)
    if array.ndim != 3 or array.shape[2] != 3:
        raise InputError(f"rgb must have shape [H, W, 3], got {array.shape}{_hint(array.shape)}")
    if array.size == 0:
        raise InputError(f"rgb has no pixels: its shape is {array.shape}")
    if array.dtype == np.uint8:
        return jnp.asarray(_float32(array) / 255.0)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise InputError(
            f"rgb must be uint8 (0 to 255) or floating (0 to 1), got {array.dtype}: divide it by "
            "its white first"
        )
    return jnp.asarray(_float32(array))


def _hint(shape: tuple[int, ...]) -> str:
    """Suggests how to convert the shapes that other libraries use."""
    if len(shape) == 3 and shape[2] == 4:
        return ": drop the alpha channel, rgb[..., :3]"
    if len(shape) == 3 and shape[0] == 3:
        return ": the channels must come last, transpose it by (1, 2, 0)"
    if len(shape) == 4 and shape[0] == 1:
        return ": drop the batch axis"
    return ""


def depth_image(depth: Any, metres_per_step: float | int | None = None) -> Float[Array, "..."]:
    """Returns z-depth [m] from meters, or from steps of `metres_per_step`.

    Raises:
        ValueError: integers without a unit, an invalid unit, not numbers.
        TypeError: not an array.
    """
    array = as_array("depth", depth)
    is_whole = jnp.issubdtype(array.dtype, jnp.integer)
    if not (is_whole or jnp.issubdtype(array.dtype, jnp.floating)):
        raise InputError(f"depth must be numbers, got {array.dtype}")
    if metres_per_step is None:
        if is_whole:
            raise InputError(
                f"depth is {array.dtype}: give the meters per step, depth_scale=0.001 for "
                "millimeters"
            )
        return jnp.asarray(_float32(array))
    scale = float(metres_per_step)
    if not 0.0 < scale < np.inf or (is_whole and scale >= 1.0):
        raise InputError(
            "depth_scale must be the meters per step of the depth, such as 0.001 for "
            f"millimeters, got {scale:g}"
        )
    if isinstance(array, np.ndarray):
        return jnp.asarray((array.astype(np.float64) * scale).astype(np.float32))
    return array.astype(jnp.float32) * scale


def pinhole_camera(camera: Any, height: int, width: int, pixel_center: float | int) -> Camera:
    """Makes a camera from a matrix of intrinsics; returns a `Camera` as it is.

    Args:
        camera: a `Camera`, or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
        height: rows of the images.
        width: columns of the images.
        pixel_center: where the matrix has the center of the upper left pixel [px].

    Raises:
        ValueError: not a matrix of intrinsics, or one that does not fit the images.
        TypeError: not an array.
    """
    if isinstance(camera, Camera):
        return camera
    K = np.asarray(as_array("camera", camera))
    if K.shape != (3, 3):
        raise InputError(
            f"camera must be an r3jax.Camera or a 3x3 matrix of intrinsics, got shape {K.shape}"
        )
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    wanted = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if not (np.isfinite(wanted).all() and np.array_equal(K, wanted)):
        raise InputError(
            "camera must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], finite and without skew, got "
            f"{K.tolist()}"
        )
    column, row = (value + 0.5 - float(pixel_center) for value in (cx, cy))
    if not (0.0 <= column <= width and 0.0 <= row <= height):
        raise InputError(
            f"the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} images: is "
            "the matrix for another resolution? (For cropped images pass an r3jax.Camera)"
        )
    return Camera(width, height, fx, fy, column, row)


def without(depth: Float[Array, "H W"], ignore: Any) -> Float[Array, "H W"]:
    """Removes the pixels of a mask from the depth: they become 0, no measurement.

    Args:
        depth: z-depth [m].
        ignore: True for pixels to leave out, [H, W]; bool, or 8-bit with 0 for False.

    Raises:
        ValueError: a mask of another shape or type.
        TypeError: not an array.
    """
    mask = as_array("ignore", ignore)
    if mask.shape != depth.shape or str(mask.dtype) not in ("bool", "uint8"):
        raise InputError(
            f"ignore must be a mask of the depth's shape {depth.shape}, bool or uint8, got "
            f"{mask.dtype} of shape {mask.shape}"
        )
    return jnp.where(jnp.asarray(mask).astype(bool), 0.0, depth)


def to_camera_to_world(pose: Any, convention: str) -> Any:
    """Converts a pose to camera-to-world in OpenCV axes.

    Args:
        pose: a matrix [4, 4], NumPy's or JAX's; other shapes are returned unchanged, and refused
            later.
        convention: one of `CONVENTIONS`.

    Raises:
        ValueError: an unknown convention.
    """
    if convention not in CONVENTIONS:
        raise InputError(f"convention must be one of {', '.join(CONVENTIONS)}, got {convention!r}")
    is_inverted, axes = CONVENTIONS[convention]
    if pose.shape != (4, 4) or convention == "opencv":
        return pose
    if not is_inverted:
        return pose @ axes.astype(pose.dtype)
    # The transpose, not a solver: a matrix that is not rigid stays so, and is refused later.
    R, library = pose[:3, :3].T, jnp if isinstance(pose, jax.Array) else np
    shift = -(R @ pose[:3, 3])
    top = library.concatenate([R, shift[:, None]], axis=1)
    return library.concatenate([top, pose[3:]], axis=0)


def own_matrix(name: str, value: Any) -> np.ndarray | Array:
    """Copies a small matrix.

    Raises:
        TypeError: not an array.
    """
    array = as_array(name, value)
    return array.copy()


def _float32(array: np.ndarray | Array) -> np.ndarray | Array:
    """Copies an array to float32 in memory of its own."""
    if isinstance(array, np.ndarray):
        return np.array(array, dtype=np.float32)
    return array.astype(jnp.float32)


_END: Any = object()

Read = TypeVar("Read")


def read_ahead(frames: Iterable[Read]) -> Iterator[Read]:
    """Yields the same frames, each read in a thread while the one before it is used."""
    frames = iter(frames)
    with ThreadPoolExecutor(1, thread_name_prefix="frames") as reader:
        coming = reader.submit(next, frames, _END)
        while (frame := coming.result()) is not _END:
            coming = reader.submit(next, frames, _END)
            yield frame
