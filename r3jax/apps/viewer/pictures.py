"""Pictures of a look: what each pixel shows, the panorama of directions, and tiles of them.

Shape symbols: B directions; H W picture size.
"""

import functools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from r3jax.apps.viewer.colors import WORTH, paint, spread, to_bytes
from r3jax.apps.viewer.look import Glance, Look
from r3jax.geometry.sphere import fibonacci_lattice

_INK, _PAPER, _MUTED = (31, 41, 55), (255, 255, 255), (107, 114, 128)


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The letters of all pictures."""
    return ImageFont.load_default(size)


@functools.cache
def _bin_of_pixel(width: int, num_bins: int) -> np.ndarray:
    """The nearest direction of the lattice for each pixel of a panorama, [width / 2, width]."""
    height = width // 2
    elevation = 0.5 * np.pi - (np.arange(height) + 0.5) * np.pi / height
    azimuth = np.pi - (np.arange(width) + 0.5) * 2.0 * np.pi / width
    level = np.cos(elevation)[:, None]
    rays = np.stack(
        [
            level * np.cos(azimuth),
            level * np.sin(azimuth),
            np.broadcast_to(np.sin(elevation)[:, None], (height, width)),
        ],
        axis=-1,
    )
    return np.argmax(rays.reshape(-1, 3) @ fibonacci_lattice(num_bins).T, axis=1).reshape(
        height, width
    )


def panorama_pixel(direction: np.ndarray, width: int) -> tuple[float, float]:
    """Where a direction lies in a panorama of that width: column and row [px]."""
    x, y, z = direction / np.linalg.norm(direction)
    column = (np.pi - np.arctan2(y, x)) / (2.0 * np.pi) * width
    row = (0.5 * np.pi - np.arcsin(np.clip(z, -1.0, 1.0))) / np.pi * (width // 2)
    return float(column), float(row)


def panorama_image(look: Look, width: int = 360) -> np.ndarray:
    """What looking in each direction is worth, from the look's position.

    The middle column looks along +x, azimuth grows to the left, up is up. Yellow is worth most;
    the ring marks the suggested direction, the cross where the camera looks.

    Returns:
        [width / 2, width, 3] uint8.
    """
    scores = spread(look.direction_scores)
    picture = paint(scores[_bin_of_pixel(width, len(scores))], WORTH)
    image = Image.fromarray(np.ascontiguousarray(picture))
    pen = ImageDraw.Draw(image)
    u, v = panorama_pixel(look.T_world_camera[:3, 2], width)
    for color, thick in ((_INK, 5), (_PAPER, 2)):
        pen.line([(u - 7, v), (u + 7, v)], fill=color, width=thick)
        pen.line([(u, v - 7), (u, v + 7)], fill=color, width=thick)
    u, v = panorama_pixel(look.best_direction, width)
    for color, radius, thick in ((_INK, 10, 5), ((239, 68, 68), 9, 3)):
        pen.ellipse([u - radius, v - radius, u + radius, v + radius], outline=color, width=thick)
    return np.asarray(image)


def fitted(picture: np.ndarray, width: int, height: int, *, is_photo: bool = False) -> np.ndarray:
    """A picture made to fit into a frame, in its middle, [height, width, 3] uint8.

    Args:
        picture: [H, W, 3] uint8.
        width: of the frame [px].
        height: of the frame [px].
        is_photo: whether its pixels may be smoothed when it is made larger.
    """
    image = Image.fromarray(np.ascontiguousarray(picture))
    scale = min(width / image.width, height / image.height)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    larger = Image.Resampling.BICUBIC if is_photo else Image.Resampling.NEAREST
    way = larger if scale > 1.0 else Image.Resampling.BOX
    canvas = Image.new("RGB", (width, height), _PAPER)
    canvas.paste(image.resize(size, way), ((width - size[0]) // 2, (height - size[1]) // 2))
    return np.asarray(canvas)


def tiles(pictures: Sequence[tuple[str, np.ndarray]], side: int = 176) -> np.ndarray:
    """Pictures with a word above each, two in a row.

    Args:
        pictures: words and pictures, [H, W, 3] uint8 each; at least one.
        side: width of a tile [px].
    """
    gap, head = 4, 18
    height = max(1, round(side * pictures[0][1].shape[0] / pictures[0][1].shape[1]))
    columns = min(2, len(pictures))
    rows = -(-len(pictures) // columns)
    canvas = Image.new(
        "RGB", (columns * (side + gap) - gap, rows * (height + head + gap) - gap), _PAPER
    )
    pen = ImageDraw.Draw(canvas)
    for number, (word, picture) in enumerate(pictures):
        x = (number % columns) * (side + gap)
        y = (number // columns) * (height + head + gap)
        pen.text((x + 1, y + 1), word, fill=_MUTED, font=font(13))
        canvas.paste(Image.fromarray(fitted(picture, side, height)), (x, y + head))
    return np.asarray(canvas)


def glance_image(glance: Glance, term: str) -> np.ndarray:
    """R or a term, pixel by pixel, [h, w, 3] uint8."""
    return paint(glance.images[term])


def look_image(look: Look, term: str = "renderability") -> np.ndarray:
    """The view as R (or a term) sees it, as the splats show it, and as it is, as far as known."""
    pictures = [(term, glance_image(look.glance, term))]
    if look.splats is not None:
        pictures.append(("splats", to_bytes(look.splats)))
    if look.truth is not None:
        pictures.append(("true image", to_bytes(look.truth)))
    if look.splats is not None and look.truth is not None:
        error = np.abs(look.splats - look.truth).mean(axis=-1)
        pictures.append(("error of the splats", paint(1.0 - (4.0 * error).clip(0.0, 1.0))))
    return tiles(pictures)
