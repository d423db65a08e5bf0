"""All textures of a world in one flat array of texels, mip levels included.

The shading kernel fetches any texel of any material by one integer index. Levels are box-filtered
on the stored (sRGB-encoded) bytes, as GL's own mipmaps and Habitat's are.

Shape symbols: T textures; S texels of all levels of all textures.
"""

from dataclasses import dataclass

import numpy as np

MAX_LEVELS = 14
"""Levels kept per texture: enough for 8192 texels a side."""


@dataclass(frozen=True)
class TextureAtlas:
    """Mip pyramids, packed one after the other; row 0 of every level is the image's top row."""

    texels: np.ndarray
    """red + 256 green + 65536 blue, [S] uint32."""

    sizes: np.ndarray
    """Width and height of level 0, [T, 2] int32; 1 in the rows beyond the last texture."""

    offsets: np.ndarray
    """Index of each level's first texel, [T, MAX_LEVELS] int32; the last level repeats."""


def build_atlas(images: list[np.ndarray]) -> TextureAtlas:
    """Packs images and their mip levels.

    Args:
        images: textures [h, w, 3] uint8 of any size.

    Returns:
        The atlas. Its tables are rounded up in size (see `round_up`).

    Raises:
        ValueError: the textures together are too large to be indexed with 31 bits.
    """
    pieces: list[np.ndarray] = []
    rows = round_up(len(images), least=16)
    sizes = np.ones((rows, 2), dtype=np.int32)
    offsets = np.zeros((rows, MAX_LEVELS), dtype=np.int64)
    total = 0
    for i, image in enumerate(images):
        sizes[i] = image.shape[1], image.shape[0]
        levels = mip_levels(image)
        for k in range(MAX_LEVELS):
            if k < len(levels):
                offsets[i, k] = total
                pieces.append(_pack(levels[k]))
                total += len(pieces[-1])
            else:
                offsets[i, k] = offsets[i, k - 1]
    length = round_up(total)
    if length >= 2**31:
        raise ValueError(
            f"the world's textures hold {total:.3g} texels, more than the 2^31 that can be "
            "indexed: halve the texture sizes"
        )
    texels = np.zeros(length, dtype=np.uint32)
    if pieces:
        np.concatenate(pieces, out=texels[:total])
    return TextureAtlas(texels, sizes, offsets.astype(np.int32))


def mip_levels(image: np.ndarray) -> list[np.ndarray]:
    """The image [h, w, 3] uint8 and its halvings down to 1x1, at most MAX_LEVELS in all."""
    levels = [image]
    while len(levels) < MAX_LEVELS and max(levels[-1].shape[:2]) > 1:
        levels.append(_halve(levels[-1]))
    return levels


def _halve(image: np.ndarray) -> np.ndarray:
    """Box filter of 2x2 texels, size floor(n / 2) but at least 1 (an odd last row is dropped)."""
    height, width = image.shape[:2]
    rows = image[: height - height % 2] if height > 1 else np.repeat(image, 2, axis=0)
    both = rows[:, : width - width % 2] if width > 1 else np.repeat(rows, 2, axis=1)
    total = both[0::2, 0::2].astype(np.uint16)
    for row, column in ((0, 1), (1, 0), (1, 1)):
        total += both[row::2, column::2]
    return ((total + 2) >> 2).astype(np.uint8)


def _pack(image: np.ndarray) -> np.ndarray:
    quads = np.zeros((*image.shape[:2], 4), dtype=np.uint8)
    quads[..., :3] = image
    return quads.reshape(-1, 4).view("<u4")[:, 0]


def round_up(count: int, least: int = 1024) -> int:
    """The next power of two, at least `least`: most worlds then share one compiled kernel."""
    return 1 << (max(count, least) - 1).bit_length()
