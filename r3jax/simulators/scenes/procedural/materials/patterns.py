"""Textures of soft and printed things: cloth, carpets, rugs, wallpaper, leather, leaves.

Same rules as in `textures`: tileable (rugs excepted), read-only, [h, w, 3] uint8, made once.
"""

import functools

import numpy as np
from PIL import Image, ImageDraw

from r3jax.errors import InputError
from r3jax.simulators.scenes.procedural.materials.textures import (
    Color,
    Ink,
    Real,
    blend,
    cloud,
    smoothstep,
    texels,
)


def _rgb(color: Color) -> np.ndarray:
    return np.asarray(color, dtype=np.float32)


def _bytes(color: Color, shade: Real = 1.0) -> Ink:
    r, g, b = (int(255 * min(1.0, max(0.0, c * shade))) for c in color)
    return r, g, b


def _weave(size: int, seed: int, threads: int) -> np.ndarray:
    """Computes the brightness of a plain weave, [size, size], about 1."""
    row, column = np.mgrid[0:size, 0:size].astype(np.float32) * (np.pi * threads / size)
    over = np.sin(row) * np.sin(column) > 0
    yarn = np.where(over, np.abs(np.sin(row)), np.abs(np.sin(column)))
    melange = cloud(size, size, seed, 0.6, 1.0, 4.0)
    return 0.84 + 0.22 * yarn + 0.07 * melange + 0.05 * cloud(size, size, seed + 1, 1.8)


@functools.cache
def fabric(color: Color, seed: int, threads: int = 96, size: int = 512) -> np.ndarray:
    """Paints woven upholstery in one color, with melange and wear."""
    return texels(_rgb(color) * _weave(size, seed, threads)[..., None])


@functools.cache
def stripes(colors: tuple[Color, ...], seed: int, repeats: int = 4, size: int = 512) -> np.ndarray:
    """Paints woven stripes of uneven width along the columns."""
    rng = np.random.default_rng(seed)
    widths = rng.random(2 * len(colors)) + 0.25
    edges = np.cumsum(widths) / widths.sum()
    place = (np.arange(size) * repeats / size) % 1.0
    band = np.searchsorted(edges, place, side="right") % len(colors)
    image = np.asarray(colors, dtype=np.float32)[band][None].repeat(size, axis=0)
    return texels(image * _weave(size, seed + 1, 96)[..., None])


@functools.cache
def plaid(ground: Color, first: Color, second: Color, seed: int, size: int = 512) -> np.ndarray:
    """Paints a tartan blanket: bands of two colors cross on a ground."""
    place = np.arange(size) / size * 4.0 % 1.0
    wide = smoothstep(0.1, 0.12, place) * (1.0 - smoothstep(0.4, 0.42, place))
    thin = smoothstep(0.68, 0.69, place) * (1.0 - smoothstep(0.75, 0.76, place))
    zeros = np.zeros((size, size), dtype=np.float32)
    image = np.broadcast_to(_rgb(ground), (size, size, 3))
    for band, color, weight in ((wide, first, 0.5), (thin, second, 0.6)):
        image = blend(image, _rgb(color), zeros + weight * band[:, None])
        image = blend(image, _rgb(color), zeros + weight * band[None, :])
    return texels(image * _weave(size, seed, 96)[..., None])


@functools.cache
def carpet(color: Color, fleck: Color, seed: int, size: int = 768) -> np.ndarray:
    """Paints cut-pile carpet with flecks."""
    pile = cloud(size, size, seed, 0.35, 1.0, 20.0)
    trodden = cloud(size, size, seed + 1, 1.6)
    weight = 0.55 * smoothstep(0.6, 1.6, cloud(size, size, seed + 2, 0.6, 1.0, 16.0))
    image = blend(np.broadcast_to(_rgb(color), (size, size, 3)), _rgb(fleck), weight)
    return texels(image * (1.0 + 0.11 * pile + 0.06 * trodden)[..., None])


@functools.cache
def rug(palette: tuple[Color, ...], seed: int, height: int = 512, width: int = 768) -> np.ndarray:
    """Paints a knotted rug: a mirrored field, a medallion, a border and fringes."""
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    y, x = np.abs(row / height * 2 - 1), np.abs(column / width * 2 - 1)
    aspect = width / height
    field = cloud(height, width, seed, 1.35, 1.0, 3.0)
    field = field[:, ::-1] + field + field[::-1] + field[::-1, ::-1]
    level = np.digitize(field + 0.7 * np.sin(9.0 * (x * aspect + y)), [-1.6, -0.5, 0.6, 1.7])
    colors = np.asarray(palette, dtype=np.float32)
    image = colors[level % len(colors)]
    star = (x * aspect) ** 0.8 + y**0.8
    for radius, k in ((0.75, 2), (0.68, 0), (0.6, 3), (0.42, 1)):
        inside = star < radius
        image[inside] = 0.35 * image[inside] + 0.65 * colors[k % len(colors)]
    margin = np.minimum((1 - y) * height, (1 - x) * width) / 2.0  # texels from the edge
    diamonds = np.abs(row % 32 - 16) + np.abs(column % 32 - 16)
    for low, high, k, motif in ((10, 42, 1, True), (42, 50, 2, False), (6, 10, 3, False)):
        band = (margin >= low) & (margin < high)
        image[band] = colors[k % len(colors)]
        if motif:
            image[band & (diamonds < 11)] = colors[(k + 2) % len(colors)]
            image[band & (diamonds < 5)] = colors[0]
    fringe = margin < 6
    image[fringe] = np.where((row % 5 < 3)[fringe, None], 0.86, 0.5)
    knots = 0.86 + 0.09 * np.sin(row * np.pi / 2) * np.sin(column * np.pi / 2)
    shade = knots + 0.08 * cloud(height, width, seed + 1, 0.7) + 0.04
    return texels(image * shade[..., None])


def _leaf(draw: ImageDraw.ImageDraw, at: np.ndarray, angle: Real, length: Real, fill: Ink) -> None:
    along = np.linspace(0.0, 1.0, 9)
    half = 0.22 * np.sin(np.pi * along**0.8)
    direction = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-direction[1], direction[0]])
    spine = at + np.outer(along * length, direction)
    edge = np.outer(half * length, normal)
    draw.polygon([tuple(p) for p in np.concatenate([spine + edge, (spine - edge)[::-1]])], fill)


def _sprig(
    draw: ImageDraw.ImageDraw, at: np.ndarray, size: Real, rng: np.random.Generator, inks: list[Ink]
) -> None:
    """Paints a branch with leaves on both sides and a flower on top."""
    lean = rng.normal(0.0, 0.35) - np.pi / 2
    tip = at + size * np.array([np.cos(lean), np.sin(lean)])
    draw.line([tuple(at), tuple(tip)], fill=inks[0], width=max(2, int(size / 40)))
    for k in range(1, 6):
        base = at + (tip - at) * k / 6.0
        for side in (-1, 1):
            _leaf(draw, base, lean + side * 0.95, size * (0.42 - 0.04 * k), inks[k % len(inks)])
    for petal in range(6):
        _leaf(draw, tip, petal * np.pi / 3 + lean, size * 0.2, inks[-1])


@functools.cache
def wallpaper(
    ground: Color, inks: tuple[Color, ...], motif: str, seed: int, size: int = 768
) -> np.ndarray:
    """Paints printed wallpaper on textured paper.

    Args:
        ground: color of the paper.
        inks: colors of the print.
        motif: "botanical", "damask", "trellis" or "lines".
        seed: which paper.
        size: texels along an edge.
    """
    draws = {"botanical": _botanical, "damask": _damask, "trellis": _trellis, "lines": _lines}
    if motif not in draws:
        raise InputError(f"unknown wallpaper motif {motif!r}; known: {sorted(draws)}")
    image = Image.new("RGB", (2 * size, 2 * size), _bytes(ground))
    draws[motif](ImageDraw.Draw(image), 2 * size, np.random.default_rng(seed), inks)
    printed = np.asarray(image.resize((size, size), Image.Resampling.BOX), dtype=np.float32) / 255
    emboss = 0.03 * cloud(size, size, seed, 0.5, 1.0, 40.0) + 0.03 * cloud(
        size, size, seed + 1, 1.6
    )
    fibres = 0.022 * cloud(size, size, seed + 2, 0.8, 0.1, 20.0)
    return texels(printed * (1.0 + emboss + fibres)[..., None])


def _botanical(
    draw: ImageDraw.ImageDraw, size: int, rng: np.random.Generator, inks: tuple[Color, ...]
) -> None:
    cells = 4
    pitch = size / cells
    for i in range(cells):
        for j in range(cells):
            at = np.array([(j + 0.5 * (i % 2)) * pitch, (i + 1.0) * pitch])
            at += rng.normal(0.0, 0.06, 2) * pitch
            fills = [_bytes(c, 0.85 + 0.3 * rng.random()) for c in inks]
            state = rng.bit_generator.state
            for wrap in np.array([[0, 0], [-size, 0], [0, -size], [0, size], [size, 0]]):
                rng.bit_generator.state = state  # the same sprig on both sides of the seam
                _sprig(draw, at + wrap, pitch * 0.95, rng, fills)


def _damask(
    draw: ImageDraw.ImageDraw, size: int, rng: np.random.Generator, inks: tuple[Color, ...]
) -> None:
    pitch = size / 4
    for i in range(-1, 6):
        for j in range(-1, 6):
            at = np.array([(j + 0.5 * (i % 2)) * pitch, (i + 0.5) * pitch])
            for k in range(8):
                angle = k * np.pi / 4
                reach = pitch * (0.44 if k % 2 == 0 else 0.3)
                _leaf(draw, at, angle, reach, _bytes(inks[k % len(inks)]))
            for radius, ink in ((0.1, inks[0]), (0.06, inks[-1])):
                r = pitch * radius
                draw.ellipse([at[0] - r, at[1] - r, at[0] + r, at[1] + r], fill=_bytes(ink, 0.8))


def _trellis(
    draw: ImageDraw.ImageDraw, size: int, rng: np.random.Generator, inks: tuple[Color, ...]
) -> None:
    pitch = size // 8
    width = max(3, size // 130)
    for k in range(-size, 2 * size, pitch):
        draw.line([(k, 0), (k + size, size)], fill=_bytes(inks[0]), width=width)
        draw.line([(k, size), (k + size, 0)], fill=_bytes(inks[0]), width=width)
    for i in range(0, 17):
        for j in range(0, 17):
            x, y, r = j * pitch / 2, i * pitch / 2, size // 90
            if (i + j) % 2 == 0:
                draw.ellipse([x - r, y - r, x + r, y + r], fill=_bytes(inks[-1]))


def _lines(
    draw: ImageDraw.ImageDraw, size: int, rng: np.random.Generator, inks: tuple[Color, ...]
) -> None:
    pitch = size // 8
    for k in range(8):
        x = k * pitch
        draw.rectangle([x, 0, x + pitch // 2, size], fill=_bytes(inks[0]))
        draw.rectangle([x + pitch * 0.7, 0, x + pitch * 0.74, size], fill=_bytes(inks[-1]))
        for j in range(16):
            y = (j + 0.5 * (k % 2)) * size / 16
            draw.ellipse([x + 20, y + 8, x + 36, y + 28], fill=_bytes(inks[-1], 0.9))


@functools.cache
def leather(color: Color, seed: int, size: int = 512) -> np.ndarray:
    """Paints grained leather with creases and worn places."""
    creases = np.exp(-np.abs(cloud(size, size, seed, 0.9, 1.0, 10.0)) * 9.0)
    worn = cloud(size, size, seed + 1, 1.7)
    shade = 1.04 - 0.22 * creases + 0.08 * worn + 0.03 * cloud(size, size, seed + 2, 0.4)
    return texels(_rgb(color) * shade[..., None])


@functools.cache
def leaf(color: Color, seed: int, size: int = 256) -> np.ndarray:
    """Paints a leaf blade: midrib along the rows' middle, side veins, mottling. Fits one leaf."""
    row, column = np.mgrid[0:size, 0:size].astype(np.float32) / size
    side = np.abs(row - 0.5)
    midrib = 1.0 - smoothstep(0.01, 0.04, side)
    veins = smoothstep(0.8, 0.97, np.sin(2 * np.pi * 9.0 * (column - 0.7 * side)))
    mottle = 0.16 * cloud(size, size, seed, 1.2) + 0.07 * cloud(size, size, seed + 1, 0.5)
    image = _rgb(color) * (1.0 + mottle - 0.35 * side)[..., None]
    pale = _rgb(color) * 0.5 + np.array([0.42, 0.45, 0.25], dtype=np.float32)
    return texels(blend(image, pale, np.maximum(midrib, 0.4 * veins)))
