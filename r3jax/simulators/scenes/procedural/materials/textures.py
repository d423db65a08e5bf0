"""Textures of building materials and of soft, printed things, and random fields for them.

Every texture tiles in both directions (rugs excepted), has detail from the tile's size down to the
texel, and is a read-only [h, w, 3] uint8 array that is made once per process. Colors are (r, g, b)
in [0, 1], sRGB-encoded. Grain and brushing run along the rows.

Shape symbols: h w texels. Fields have mean 0 and standard deviation 1.
"""

import functools
import itertools

import numpy as np
from PIL import Image, ImageDraw

from r3jax.errors import InputError

Real = float | int
"""A number as people write it: 2 as well as 2.0."""


@functools.lru_cache(maxsize=8)
def _spectrum(height: int, width: int, seed: int) -> np.ndarray:
    """Draws the Fourier transform of white noise, [h, w // 2 + 1].

    Many fields are shaped from one.
    """
    noise = np.random.default_rng(seed).standard_normal((height, width), dtype=np.float32)
    return np.fft.rfft2(noise)


@functools.lru_cache(maxsize=64)
def _field(
    height: int, width: int, seed: int, slope: Real, stretch_x: Real, lowest: Real
) -> np.ndarray:
    fy = np.fft.fftfreq(height, 1.0 / height)[:, None] * (width / height)
    fx = np.fft.rfftfreq(width, 1.0 / width)[None, :]
    squared = ((fx * stretch_x) ** 2 + fy**2).astype(np.float32)
    gain = np.maximum(squared, 1.0) ** np.float32(-0.5 * slope)
    gain[squared < lowest**2] = 0.0
    field = np.fft.irfft2(_spectrum(height, width, seed) * gain, s=(height, width))
    field = (field - field.mean()) / field.std()
    field.flags.writeable = False
    return field


def cloud(
    height: int,
    width: int,
    seed: int,
    slope: Real = 1.6,
    stretch_x: Real = 1.0,
    lowest: Real = 1.0,
) -> np.ndarray:
    """Makes a periodic random field with the amplitude spectrum 1 / f ** slope.

    Fields are drawn from a small pool and shifted by the seed: a Fourier transform per field
    would make a scene take seconds, and a shifted field under another color looks new.

    Args:
        height: rows [texels].
        width: columns [texels].
        seed: which field.
        slope: 0 gives white noise, 1 rough, 2 smooth clouds.
        stretch_x: features are this many times longer along a row than across.
        lowest: frequencies below this many cycles per tile are left out.

    Returns:
        [h, w] float32, mean 0, standard deviation 1.
    """
    field = _field(height, width, seed % 2, slope, stretch_x, lowest)
    if seed < 2:
        return field
    shift = np.random.default_rng(seed).integers(0, (height, width))
    return np.roll(field, tuple(int(n) for n in shift), axis=(0, 1))


def ridge(num: int, seed: int, slope: Real = 1.5) -> np.ndarray:
    """Makes a periodic one-dimensional skyline, [num] float32, mean 0, standard deviation 1."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft(rng.standard_normal(num))
    frequency = np.arange(len(spectrum))
    gain = np.where(frequency == 0, 0.0, np.maximum(frequency, 1) ** -slope)
    line = np.fft.irfft(spectrum * gain, n=num)
    return ((line - line.mean()) / line.std()).astype(np.float32)


def smoothstep(low: Real, high: Real, x: np.ndarray) -> np.ndarray:
    """Computes a smooth ramp: 0 below `low`, 1 above `high`."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Mixes two color images (or colors [3]) by a weight [h, w]: 0 gives a, 1 gives b."""
    return a + (b - a) * weight[..., None].astype(np.float32)


def texels(image: np.ndarray) -> np.ndarray:
    """Rounds a color image in [0, 1] to read-only bytes, [h, w, 3] uint8."""
    out = np.clip(image * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    out.flags.writeable = False
    return out


Color = tuple[Real, Real, Real]
"""Red, green and blue in [0, 1]."""

Ink = tuple[int, int, int]
"""The same as Pillow wants it: in 0 .. 255."""


def _rgb(color: Color) -> np.ndarray:
    return np.asarray(color, dtype=np.float32)


@functools.cache
def plaster(color: Color, seed: int, strength: Real = 1.0, size: int = 768) -> np.ndarray:
    """Paints painted plaster: roller grain, trowel strokes, faint stains."""
    broad = cloud(size, size, seed, 1.9)
    strokes = cloud(size, size, seed + 1, 1.1, 3.0, 8.0)
    grain = cloud(size, size, seed + 2, 0.5, 1.0, 60.0)
    stain = smoothstep(0.9, 2.4, cloud(size, size, seed + 3, 2.2))
    shade = 1.0 + strength * (0.022 * broad + 0.03 * strokes + 0.036 * grain - 0.06 * stain)
    warmth = strength * 0.012 * np.roll(broad, size // 3, axis=1)
    tint = np.stack([1.0 + warmth, np.ones_like(warmth), 1.0 - warmth], axis=-1)
    return texels(_rgb(color) * tint * shade[..., None])


@functools.cache
def concrete(color: Color, seed: int, size: int = 768) -> np.ndarray:
    """Paints cast concrete: clouds, pits, the seams and tie holes of its formwork."""
    broad, fine = cloud(size, size, seed, 1.5), cloud(size, size, seed + 1, 0.4, 1.0, 30.0)
    pits = smoothstep(2.1, 2.6, cloud(size, size, seed + 2, 0.9, 1.0, 24.0))
    row, column = np.mgrid[0:size, 0:size] / size
    seam = np.minimum(np.abs((2 * row) % 1.0 - 0.5), np.abs(column - 0.5) * 2.0) < 0.004
    hole = np.hypot((2 * row) % 1.0 - 0.25, (2 * column) % 1.0 - 0.25) < 0.022
    shade = 1.0 + 0.07 * broad + 0.035 * fine - 0.35 * pits - 0.3 * seam - 0.45 * hole
    return texels(_rgb(color) * shade[..., None])


def _grain(color: Color, seed: int, height: int, width: int, rings: Real) -> np.ndarray:
    """Paints wood cut along the grain, [h, w, 3] float32."""
    warp = cloud(height, width, seed, 2.1, 7.0)
    fibre = cloud(height, width, seed + 1, 0.7, 24.0, 6.0)
    row = np.arange(height, dtype=np.float32)[:, None] / height
    # A whole number of rings across the tile keeps it seamless.
    ring = np.sin(2.0 * np.pi * (round(rings) * row + 1.3 * warp))
    late = smoothstep(0.2, 1.0, ring)
    pores = smoothstep(1.4, 2.6, fibre)
    shade = 1.0 + 0.06 * warp - 0.17 * late + 0.06 * fibre - 0.28 * pores
    dark = _rgb(color) * np.array([0.92, 0.84, 0.76], dtype=np.float32)
    return blend(_rgb(color), dark, late) * shade[..., None]


@functools.cache
def wood(color: Color, seed: int, rings: Real = 11.0, size: int = 512) -> np.ndarray:
    """Paints furniture wood, grain along the rows."""
    return texels(_grain(color, seed, size, size, rings))


@functools.cache
def planks(
    color: Color, seed: int, rows: int = 14, contrast: Real = 0.16, size: int = 768
) -> np.ndarray:
    """Paints a floor of staggered planks, each cut from another place of the wood."""
    rng = np.random.default_rng(seed)
    base = _grain(color, seed, size, size, 17.0)
    image = np.empty_like(base)
    edges = np.linspace(0, size, rows + 1).astype(int)
    for top, bottom in itertools.pairwise(edges):
        joints = np.sort(rng.integers(0, size, 2))
        shift = np.roll(base, tuple(rng.integers(0, size, 2)), axis=(0, 1))
        strip = np.empty((bottom - top, size, 3), dtype=np.float32)
        for i, (start, stop) in enumerate([(0, joints[0]), tuple(joints), (joints[1], size)]):
            tone = 1.0 + contrast * (rng.random() - 0.5) * 2.0
            if i == 2:  # The last piece goes on in the first: the tile repeats.
                match = float(strip[0, 0, 0] / max(shift[0, 0, 0], 1e-3))
                tone = min(max(match, 1.0 - contrast), 1.0 + contrast)
            piece = shift if i != 1 else np.roll(shift, size // 2, axis=1)
            strip[:, start:stop] = piece[top:bottom, start:stop] * tone
        strip[:2] *= 0.45
        strip[2:4] *= 1.08
        for joint in joints:
            strip[:, joint : joint + 3] *= 0.5
        image[top:bottom] = strip
    return texels(image)


@functools.cache
def parquet(color: Color, seed: int, blocks: int = 6, size: int = 768) -> np.ndarray:
    """Paints basket-weave parquet: square blocks of five staves, turned by turns."""
    rng = np.random.default_rng(seed)
    base = _grain(color, seed, size, size, 15.0)
    image = np.empty_like(base)
    edges = np.linspace(0, size, blocks + 1).astype(int)
    for i in range(blocks):
        for j in range(blocks):
            h, w = edges[i + 1] - edges[i], edges[j + 1] - edges[j]
            top, left = rng.integers(0, size - max(h, w), 2)
            block = base[top : top + max(h, w), left : left + max(h, w)].copy()
            for stave in np.array_split(np.arange(len(block)), 5):
                block[stave] *= 1.0 + 0.3 * (rng.random() - 0.5)
                block[stave[0]] *= 0.5
            block[:, :2] *= 0.5
            if (i + j) % 2:
                block = block.transpose(1, 0, 2)
            image[edges[i] : edges[i + 1], edges[j] : edges[j + 1]] = block[:h, :w]
    return texels(image)


@functools.cache
def tiles(
    colors: tuple[Color, ...],
    seed: int,
    columns: int = 6,
    rows: int = 6,
    grout: Color = (0.62, 0.6, 0.57),
    bond: Real = 0.0,
    size: int = 768,
) -> np.ndarray:
    """Paints glazed tiles with grout. `bond` shifts every other row by that share of a tile."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[0:size, 0:size].astype(np.float32) / size
    i = np.floor(row * rows).astype(int)
    across = column * columns + bond * (i % 2)
    j = np.floor(across).astype(int) % columns
    drawn = rng.integers(0, len(colors), (rows, columns))[i, j]
    which = (i + j) % 2 if len(colors) == 2 else drawn
    tone = 1.0 + 0.07 * rng.standard_normal((rows, columns))[i, j]
    fy, fx = row * rows - i, across - np.floor(across)
    edge = np.minimum(
        np.minimum(fx, 1 - fx) / columns, np.minimum(fy, 1 - fy) / rows
    )  # in tiles of the texture
    joint = 1.0 - smoothstep(0.0028, 0.0045, edge)
    bevel = smoothstep(0.0045, 0.011, edge)
    stone = 0.06 * cloud(size, size, seed + 1, 1.3) + 0.025 * cloud(size, size, seed + 2, 0.4)
    image = np.asarray(colors, dtype=np.float32)[which]
    image = image * (tone * (0.86 + 0.14 * bevel) + stone)[..., None]
    dirt = 1.0 + 0.12 * cloud(size, size, seed + 3, 0.8)
    return texels(blend(image, _rgb(grout) * dirt[..., None], joint))


@functools.cache
def brick(seed: int, color: Color = (0.62, 0.33, 0.25), size: int = 768) -> np.ndarray:
    """Paints a brick wall in running bond with rough mortar."""
    tone = (0.72, 0.55, 0.45)
    colors = tuple(
        tuple(float(c * k + 0.12 * t * (k < 0.9)) for c, t in zip(color, tone, strict=True))
        for k in (1.0, 0.82, 1.18, 0.68, 1.05, 0.9)
    )
    base = tiles(colors, seed, 8, 24, (0.7, 0.66, 0.6), 0.5, size).astype(np.float32) / 255.0
    rough = 1.0 + 0.11 * cloud(size, size, seed + 7, 0.7, 1.0, 12.0)
    return texels(base * rough[..., None])


@functools.cache
def marble(color: Color, vein: Color, seed: int, size: int = 768) -> np.ndarray:
    """Paints polished marble: thin veins of two scales on cloudy stone."""
    broad = cloud(size, size, seed, 1.9)
    thick = np.exp(-np.abs(cloud(size, size, seed + 1, 1.7)) * 14.0)
    thin = np.exp(-np.abs(cloud(size, size, seed + 2, 1.45, 1.0, 3.0)) * 18.0)
    grain = 0.02 * cloud(size, size, seed + 3, 0.4)
    weight = np.clip(0.75 * thick * smoothstep(-0.6, 1.2, broad) + 0.4 * thin, 0.0, 1.0)
    stone = _rgb(color) * (1.0 + 0.05 * broad + grain)[..., None]
    return texels(blend(stone, _rgb(vein) * (1.0 + grain)[..., None], weight))


@functools.cache
def terrazzo(color: Color, chips: tuple[Color, ...], seed: int, size: int = 768) -> np.ndarray:
    """Paints terrazzo: angular chips of several sizes in cement."""
    rng = np.random.default_rng(seed)
    image = Image.new("RGB", (size, size), tuple(int(255 * c) for c in color))
    draw = ImageDraw.Draw(image)
    for _ in range(1500):
        center, radius = rng.random(2) * size, 4.0 + 16.0 * rng.random() ** 2.5
        angles = np.sort(rng.random(6)) * 2.0 * np.pi
        shade = 0.8 + 0.35 * rng.random()
        fill = tuple(int(255 * min(1.0, c * shade)) for c in chips[rng.integers(len(chips))])
        ring = np.stack([np.cos(angles), np.sin(angles)], 1) * radius * (0.6 + 0.4 * rng.random())
        for wrap in np.array([[0, 0], [size, 0], [0, size], [-size, 0], [0, -size]]):
            draw.polygon([tuple(p) for p in (center + ring + wrap)], fill=fill)
    grain = 1.0 + 0.035 * cloud(size, size, seed, 1.0)
    return texels(np.asarray(image, dtype=np.float32) / 255.0 * grain[..., None])


@functools.cache
def metal(color: Color, seed: int, size: int = 384) -> np.ndarray:
    """Paints brushed metal with smudges."""
    brushed = cloud(size, size, seed, 0.5, 40.0)
    smudge = cloud(size, size, seed + 1, 1.7)
    shade = 1.0 + 0.06 * brushed + 0.05 * smudge
    return texels(_rgb(color) * shade[..., None])


@functools.cache
def enamel(color: Color, seed: int, size: int = 384) -> np.ndarray:
    """Paints lacquer, ceramic or plastic: nearly even, with wear, dust and scratches."""
    broad, fine = cloud(size, size, seed, 1.7), cloud(size, size, seed + 1, 0.5, 1.0, 20.0)
    scratch = smoothstep(2.2, 3.2, cloud(size, size, seed + 2, 0.8, 12.0, 10.0))
    shade = 1.0 + 0.05 * broad + 0.035 * fine - 0.12 * scratch
    return texels(_rgb(color) * shade[..., None])


@functools.cache
def acoustic(seed: int, size: int = 768) -> np.ndarray:
    """Paints a suspended ceiling of perforated mineral tiles (4 x 4 to the texture)."""
    row, column = np.mgrid[0:size, 0:size].astype(np.float32) / size * 4.0
    edge = np.minimum(
        np.minimum(row % 1.0, 1.0 - row % 1.0), np.minimum(column % 1.0, 1.0 - column % 1.0)
    )
    holes = smoothstep(1.5, 2.2, cloud(size, size, seed, 0.35, 1.0, 40.0))
    bar = 1.0 - smoothstep(0.018, 0.024, edge)
    tone = np.random.default_rng(seed).normal(0.0, 0.025, (4, 4))
    tile_tone = tone[np.floor(row).astype(int), np.floor(column).astype(int)]
    board = 0.84 + tile_tone + 0.02 * cloud(size, size, seed + 1, 1.6) - 0.3 * holes
    shade = board * (1.0 - bar) + (0.93 - 0.25 * (edge > 0.015)) * bar
    return texels(shade[..., None] * np.array([1.0, 0.995, 0.97], dtype=np.float32))


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
