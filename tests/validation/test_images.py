"""Colors of images in every mode that cameras and programs save."""

import io

import numpy as np
import pytest
from PIL import Image

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import image_pixels, masked_pixels

SIZE = 48, 36
FORMATS = ("PNG", "JPEG", "TIFF")


def colors() -> np.ndarray:
    """Smooth colors from dark to bright, [36, 48, 3] uint8."""
    v, u = np.mgrid[:36, :48].astype(float)
    return np.stack([40 + 4 * u, 30 + 5 * v, 200 - 3 * u], axis=-1).astype(np.uint8)


def gray() -> np.ndarray:
    return np.asarray(Image.fromarray(colors()).convert("L"))


def encoded(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def three(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[..., None], 3, axis=2)


MODES = {
    "RGB": (lambda: encoded(Image.fromarray(colors())), colors, 0),
    "L": (lambda: encoded(Image.fromarray(gray())), lambda: three(gray()), 0),
    "I;16": (
        lambda: encoded(Image.fromarray(gray().astype(np.uint16) * 257)),
        lambda: three(gray()),
        0,
    ),
    "I": (
        lambda: encoded(Image.fromarray(gray().astype(np.int32) * 257), "TIFF"),
        lambda: three(gray()),
        0,
    ),
    "LA": (lambda: encoded(Image.fromarray(gray()).convert("LA")), lambda: three(gray()), 0),
    "P": (
        lambda: encoded(Image.fromarray(colors()).convert("P", palette=Image.Palette.ADAPTIVE)),
        colors,
        24,
    ),
    "CMYK": (
        lambda: encoded(Image.fromarray(colors()).convert("CMYK"), "JPEG", quality=98),
        colors,
        12,
    ),
}


@pytest.mark.parametrize("mode", MODES)
def test_an_image_keeps_its_colors_in_every_mode(mode):
    data, expected, off = MODES[mode]
    found = image_pixels(data(), FORMATS, SIZE)
    assert found.dtype == np.uint8
    assert np.abs(found.astype(int) - expected().astype(int)).max() <= off
    assert masked_pixels(data(), FORMATS, SIZE)[1] is None


def test_white_and_black_of_sixteen_bits_are_white_and_black():
    steps = np.full((36, 48), 65535, np.uint16)
    steps[:, :24] = 0
    found = image_pixels(encoded(Image.fromarray(steps)), FORMATS, SIZE)
    assert set(np.unique(found[:, :24])) == {0}
    assert set(np.unique(found[:, 24:])) == {255}


@pytest.mark.parametrize("kind", ["RGBA", "palette"])
def test_pixels_that_alpha_cuts_out_are_not_there(kind):
    alpha = np.full((36, 48), 255, np.uint8)
    alpha[:, :16] = 0
    if kind == "RGBA":
        hidden = colors()
        hidden[:, :16] = [255, 0, 255]
        data = encoded(Image.fromarray(np.dstack([hidden, alpha])))
    else:
        paletted = Image.fromarray((alpha > 0).astype(np.uint8)).convert("P")
        paletted.putpalette([255, 0, 255, 10, 20, 30])
        data = encoded(paletted, transparency=0)
    rgb, is_there = masked_pixels(data, FORMATS, SIZE)
    np.testing.assert_array_equal(is_there, alpha > 0)
    assert not rgb[:, :16].any()  # nothing of the color below
    if kind == "RGBA":
        np.testing.assert_array_equal(rgb[:, 16:], colors()[:, 16:])
    np.testing.assert_array_equal(image_pixels(data, FORMATS, SIZE), rgb)


@pytest.mark.parametrize("values", [np.float32(0.5), np.int32(1 << 20)])
def test_numbers_of_which_white_is_not_known_are_refused(values):
    data = encoded(Image.fromarray(np.full((36, 48), values)), "TIFF")
    with pytest.raises(ForeignFileError, match="8 or 16 bits"):
        image_pixels(data, FORMATS, SIZE)
