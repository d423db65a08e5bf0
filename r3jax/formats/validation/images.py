"""Images from a path or from bytes: their size is known before a pixel is unpacked.

Shape symbols: H, W image size.
"""

import io
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.formats.validation.errors import ForeignFileError
from r3jax.formats.validation.files import check_regular

MAX_PIXELS = 1 << 24
"""Images with more pixels (4096 x 4096) come from no depth camera; as floats one takes 200 MB."""

_ORIENTATION = 0x0112
"""EXIF's tag of how an image is turned when it is shown."""

_QUARTER_TURNS = (5, 6, 7, 8)
"""Its values where width and height change places."""


def image_size(path: Path | bytes, formats: Sequence[str]) -> tuple[int, int]:
    """Width and height of an image [px].

    Raises:
        ForeignFileError: not an image of these formats, broken, or too large.
        OSError: missing, or not permitted.
    """
    with _opened(path, formats) as image:
        width, height = image.size
    if width * height > MAX_PIXELS:
        raise ForeignFileError(
            f"the image is {width} x {height}: more than {MAX_PIXELS} pixels are not read"
        )
    return width, height


def image_pixels(
    path: Path | bytes,
    formats: Sequence[str],
    size: tuple[int, int],
    modes: Sequence[str] = (),
    wanted: str = "",
) -> np.ndarray:
    """The pixels of an image.

    Args:
        path: the file, or what it holds.
        formats: those that Pillow may try, such as "PNG".
        size: width and height that it must have [px].
        modes: Pillow's modes that it may have; none: any, and it becomes RGB.
        wanted: what to say of an image that has another mode.

    Returns:
        [H, W, 3] uint8 where no modes are given, else whatever the mode is.

    Raises:
        ForeignFileError: not an image of these formats, broken, of another size or mode.
        OSError: missing, or not permitted.
    """
    with _opened(path, formats) as image:
        if image.size != size:
            raise ForeignFileError(_other_size(image, size))
        if not modes:
            return np.asarray(image.convert("RGB"))
        if image.mode not in modes:
            raise ForeignFileError(f"{wanted}, the image's mode is {image.mode}")
        return np.asarray(image)


def _other_size(image: Any, size: tuple[int, int]) -> str:
    """Says that an image does not have the size of its camera, and why where it is known."""
    (width, height), (wanted_width, wanted_height) = image.size, size
    said = (
        f"the image has {width} x {height} pixels, but its camera was said to have "
        f"{wanted_width} x {wanted_height}"
    )
    turn = image.getexif().get(_ORIENTATION, 1)
    if image.size == (wanted_height, wanted_width) and turn in _QUARTER_TURNS:
        said += (
            f": its pixels are stored on their side (EXIF orientation {turn}), turn them by "
            "`mogrify -auto-orient`"
        )
    return said


def _no_image(source: Path | io.BytesIO, formats: Sequence[str]) -> str:
    """Says what a file is that is no image of these formats."""
    if isinstance(source, io.BytesIO):
        head = source.getvalue()[:64]
    else:
        with open(source, "rb") as file:
            head = file.read(64)
    wanted = f"{', '.join(formats[:-1])} or {formats[-1]}" if len(formats) > 1 else formats[0]
    if not head:
        return "the file is empty"
    if head[4:8] == b"ftyp":
        kind = "AVIF" if head[8:12] in (b"avif", b"avis") else "HEIC"
        return (
            f"this is a {kind} image, which is not read: convert all images to JPEG or PNG "
            "(heif-convert, or `sips -s format jpeg` on a Mac) and name those in the capture"
        )
    if head.lstrip().lower().startswith((b"<!doctype", b"<html")):
        return "this is a web page and no image: download it again"
    return f"the image cannot be read (it does not begin like a {wanted})"


@contextmanager
def _opened(path: Path | bytes, formats: Sequence[str]) -> Generator[Any]:
    """An open image; whatever Pillow says of a broken one becomes one kind of error."""
    from PIL import Image, UnidentifiedImageError

    if isinstance(path, Path):
        check_regular(path)
    source = io.BytesIO(path) if isinstance(path, bytes) else path
    try:
        # The size is compared by the caller: Pillow's own warning of bombs says nothing new.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(source, formats=tuple(formats)) as image:
                yield image
    except (FileNotFoundError, ForeignFileError):
        raise
    except UnidentifiedImageError:
        raise ForeignFileError(_no_image(source, formats)) from None
    except Exception as error:  # struct, zlib, syntax, overflow: every decoder has its own
        reason = str(error).replace(str(source), "the file") or type(error).__name__
        raise ForeignFileError(f"the image cannot be read ({reason[:200]})") from None
