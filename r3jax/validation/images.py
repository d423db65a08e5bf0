"""Images from a path or from bytes: their size is known before a pixel is unpacked.

Shape symbols: H, W image size.
"""

import io
import warnings
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import check_regular

MAX_PIXELS = 1 << 24
"""Images with more pixels (4096 x 4096) come from no depth camera; as floats one takes 200 MB."""

MAX_PHOTO = 1 << 27
"""Photos with more pixels are not read; those of phones and 360 cameras have up to 108 million."""

_ORIENTATION = 0x0112
"""EXIF's tag of how an image is turned when it is shown."""

_TOPS = {3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""Where the top of the shown picture lies in the stored one (column, row), by that tag."""

_WITH_ALPHA = ("LA", "PA", "RGBA", "La", "RGBa")
"""Pillow's modes of images with an alpha channel."""

_OPAQUE = 128
"""Pixels with less alpha are cut out."""

_WHITE = (1 << 16) - 1
"""White of a gray image of 16 bits."""


def image_size(path: Path | bytes, formats: Sequence[str]) -> tuple[int, int]:
    """Reads the width and height of an image [px].

    Raises:
        ForeignFileError: not an image of these formats, broken, or too large.
        OSError: missing, or not permitted.
    """
    with _opened(path, formats) as image:
        return image.size


def shown_top(path: Path, formats: Sequence[str]) -> tuple[int, int]:
    """Reads where the top of a picture lies in its pixels, by EXIF: (0, -1) above, (-1, 0) left.

    Phones store pictures as the sensor reads them, and how to turn them when they are shown.

    Raises:
        ForeignFileError, OSError: as `image_size`.
    """
    with _opened(path, formats) as image:
        return _TOPS.get(image.getexif().get(_ORIENTATION, 1), (0, -1))


def first_size(paths: Iterable[Path], formats: Sequence[str]) -> tuple[int, int]:
    """Reads the width and height of the first image that opens, of some of one size [px].

    Raises:
        ForeignFileError, OSError: as `image_size`, of the first of them; none can be opened.
    """
    failed: Exception | None = None
    for path in paths:
        try:
            return image_size(path, formats)
        except (ForeignFileError, OSError) as error:
            failed = failed or error
    raise failed or ForeignFileError("there is no image")


def image_pixels(
    path: Path | bytes,
    formats: Sequence[str],
    size: tuple[int, int] | None = None,
    modes: Sequence[str] = (),
    wanted: str = "",
) -> np.ndarray:
    """Reads the pixels of an image.

    Args:
        path: the file, or what it holds.
        formats: those that Pillow may try, such as "PNG".
        size: width and height that it must have [px]; None: any.
        modes: Pillow's modes that it may have; none: any, and it becomes RGB.
        wanted: what to say of an image that has another mode.

    Returns:
        [H, W, 3] uint8 where no modes are given (see `masked_pixels`), else whatever the mode is.

    Raises:
        ForeignFileError: not an image of these formats, broken, too large, of another size or mode.
        OSError: missing, or not permitted.
    """
    with _opened(path, formats) as image:
        _check_size(image, size)
        if not modes:
            return _colors(image)[0]
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
    is_quarter = _TOPS.get(turn, (0, -1))[0] != 0
    if image.size == (wanted_height, wanted_width) and is_quarter:
        said += (
            f": its pixels are stored on their side (EXIF orientation {turn}), turn them by "
            "`mogrify -auto-orient`"
        )
    else:
        said += ": give the images that the poses were found with, not cropped or undistorted since"
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


def masked_pixels(
    path: Path | bytes, formats: Sequence[str], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Reads the colors of an image and the mask in its alpha channel.

    Gray becomes three equal colors, 16 bits become 8, a palette and CMYK are converted. A pixel
    whose alpha is below one half is cut out: its color, which no viewer shows, becomes black.

    Args:
        path: the file, or what it holds.
        formats: those that Pillow may try, such as "PNG".
        size: width and height that it must have [px].

    Returns:
        Colors [H, W, 3] uint8, and True for the pixels that are there, [H, W]; None: all are.

    Raises:
        ForeignFileError: not an image of these formats, broken, too large, of another size, or of
            numbers that do not say what white is.
        OSError: missing, or not permitted.
    """
    with _opened(path, formats) as image:
        _check_size(image, size)
        return _colors(image)


def small_gray(path: Path, formats: Sequence[str], size: tuple[int, int]) -> np.ndarray:
    """Reads an image reduced to a few gray pixels, [h, w] uint8, to compare it with others.

    Args:
        path: the file.
        formats: those that Pillow may try, such as "PNG".
        size: width and height of the result [px].

    Raises:
        ForeignFileError: not an image of these formats, broken, or too large.
        OSError: missing, or not permitted.
    """
    with _opened(path, formats) as image:
        image.draft("L", (4 * size[0], 4 * size[1]))  # JPEG: decoded at a fraction of its size
        return np.asarray(image.convert("L").resize(size, resample=4))  # 4: mean over each pixel


def _check_size(image: Any, size: tuple[int, int] | None) -> None:
    if size is not None and image.size != size:
        raise ForeignFileError(_other_size(image, size))


def _colors(image: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Reads colors as `masked_pixels` does, of an open image."""
    if image.mode == "F" or image.mode.startswith("I"):
        return np.repeat(_eight_bits(np.asarray(image))[..., None], 3, axis=2), None
    if image.mode not in _WITH_ALPHA and "transparency" not in image.info:
        return np.asarray(image.convert("RGB")), None
    pixels = np.asarray(image.convert("RGBA"))
    is_there = pixels[..., 3] >= _OPAQUE
    if is_there.all():
        return np.ascontiguousarray(pixels[..., :3]), None
    return np.where(is_there[..., None], pixels[..., :3], np.uint8(0)), is_there


def _eight_bits(gray: np.ndarray) -> np.ndarray:
    """Converts gray values of 16 bits [H, W] to 8.

    Pillow itself would clip them, and make almost all of them white.
    """
    if gray.dtype.kind == "f" or gray.min() < 0 or gray.max() > _WHITE:
        raise ForeignFileError(
            "the colors are numbers of 32 bits, which do not say what white is: save the image "
            "with 8 or 16 bits"
        )
    return ((gray.astype(np.int64) * 255 + _WHITE // 2) // _WHITE).astype(np.uint8)


@contextmanager
def _opened(path: Path | bytes, formats: Sequence[str]) -> Generator[Any]:
    """Opens an image; all errors of Pillow on a broken one become one kind."""
    from PIL import Image, UnidentifiedImageError

    if isinstance(path, Path):
        check_regular(path)
    source = io.BytesIO(path) if isinstance(path, bytes) else path
    try:
        # The size is compared by the caller: Pillow's own warning of bombs says nothing new.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(source, formats=tuple(formats)) as image:
                width, height = image.size
                if width * height > MAX_PHOTO:  # before a pixel is unpacked
                    raise ForeignFileError(
                        f"the image is {width} x {height}: more than {MAX_PHOTO} pixels are not "
                        "read, so reduce the images"
                    )
                yield image
    except (FileNotFoundError, ForeignFileError):
        raise
    except Image.DecompressionBombError:
        raise ForeignFileError(
            f"more than {MAX_PHOTO} pixels are not read: reduce the images"
        ) from None
    except UnidentifiedImageError:
        raise ForeignFileError(_no_image(source, formats)) from None
    except Exception as error:  # struct, zlib, syntax, overflow: every decoder has its own
        reason = str(error).replace(str(source), "the file") or type(error).__name__
        raise ForeignFileError(f"the image cannot be read ({reason[:200]})") from None
