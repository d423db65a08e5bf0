"""The stored form of a frame: 8-bit RGB and 16-bit depth, as PNG.

What is integrated is what is recorded: the loop rounds a frame to its stored form *before* it
enters the map, so that a map rebuilt from the files is the same map, bit for bit.

Shape symbols: H, W image size.
"""

import hashlib
import io
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.trace import BEYOND_RANGE, DEPTH_STEPS_PER_METRE
from r3jax.trace.errors import RunError
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import image_pixels

# Measured at 512x512: level 2 takes 17 ms and a third of the bytes of level 0 (17 ms); level 6
# saves another tenth and takes 60 ms.
_PNG_LEVEL = 2


def to_integers(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Color [H, W, 3] uint8 and depth [H, W] uint16 in steps of 0.2 mm."""
    rgb = np.rint(np.asarray(frame.rgb) * np.float32(255.0)).astype(np.uint8)
    depth = np.asarray(frame.depth)
    # inf times a number is inf, and its integer is undefined: it gets its own value below.
    finite = np.where(np.isfinite(depth), depth, 0.0)
    # In float64 the product is exact; float32 would round it once more, before `rint` does.
    steps = np.rint(finite.astype(np.float64) * DEPTH_STEPS_PER_METRE)
    # A surface closer than half a step is still a surface, not a missing measurement.
    steps = np.where((finite > 0.0) & (steps < 1.0), 1.0, steps)
    steps = np.where(np.isinf(depth), BEYOND_RANGE, np.minimum(steps, BEYOND_RANGE))
    return rgb, steps.astype(np.uint16)


def from_integers(
    rgb: np.ndarray, depth: np.ndarray, T_world_camera: np.ndarray, camera: Camera
) -> Frame:
    """The frame that stored images stand for: inverse of `to_integers`."""
    metres = depth.astype(np.float32) / np.float32(DEPTH_STEPS_PER_METRE)
    return Frame(
        rgb=jnp.asarray(rgb.astype(np.float32) / np.float32(255.0)),
        depth=jnp.asarray(np.where(depth == BEYOND_RANGE, np.float32(np.inf), metres)),
        T_world_camera=jnp.asarray(T_world_camera, dtype=jnp.float32),
        camera=camera,
    )


def stored_form(frame: Frame) -> Frame:
    """The frame as it will be read back: rounded to 8-bit color and 0.2 mm of depth."""
    rgb, depth = to_integers(frame)
    return from_integers(rgb, depth, np.asarray(frame.T_world_camera), frame.camera)


def content_hash(rgb: np.ndarray, depth: np.ndarray) -> str:
    """SHA-256 over the stored pixels; it does not depend on the PNG compressor."""
    digest = hashlib.sha256(np.ascontiguousarray(rgb).tobytes())
    # Little-endian by name: the hash must be the same on every machine.
    digest.update(np.ascontiguousarray(depth).astype("<u2").tobytes())
    return digest.hexdigest()


def frame_hash(frame: Frame) -> str:
    """`content_hash` of a frame."""
    return content_hash(*to_integers(frame))


def encode_png(image: np.ndarray) -> bytes:
    """A PNG of [H, W, 3] uint8 or [H, W] uint16."""
    from PIL import Image  # a run is read without images more often than with them

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png", compress_level=_PNG_LEVEL)
    return buffer.getvalue()


def read_png(path: Path, width: int, height: int, *, is_depth: bool) -> np.ndarray:
    """Reads a stored image, [H, W, 3] uint8 or [H, W] uint16.

    Raises:
        RunError: the file is missing, broken, of another size or of another kind.
    """
    kind, modes = ("16-bit depth", ("I;16", "I")) if is_depth else ("8-bit RGB", ("RGB",))
    try:
        pixels = image_pixels(path, ["PNG"], (width, height), modes, f"expected {kind}")
    except FileNotFoundError:
        raise RunError(path, "the image is missing") from None
    except OSError as error:
        raise RunError(path, f"the image cannot be read ({error.strerror})") from None
    except ForeignFileError as error:
        raise RunError(path, str(error)) from None
    return pixels.astype(np.uint16) if is_depth else pixels
