"""Flat things with marks on them: screens, boards, book spines, packaging, clocks, keyboards.

Same rules as in `pictures`.
"""

import functools

import numpy as np
from PIL import Image, ImageDraw

from r3jax.simulators.scenes.procedural.materials.artwork import (
    PALETTES,
    ink,
    landscape,
    to_float,
    write_lines,
)
from r3jax.simulators.scenes.procedural.materials.random_fields import cloud, smoothstep, texels
from r3jax.simulators.scenes.procedural.materials.textures import Color

SPINES = 32
"""Books in the atlas that `book_spines` draws, side by side."""


@functools.cache
def desktop(seed: int, height: int = 320, width: int = 512) -> np.ndarray:
    """A computer screen: wallpaper, an editor, a chart, a bar of icons."""
    rng = np.random.default_rng(seed)
    canvas = Image.fromarray(landscape(seed, height, width, 0.7))
    draw = ImageDraw.Draw(canvas)
    for k in range(3):
        x, y = (20 + 150 * k + 30 * rng.random()), 18 + 60 * rng.random()
        w, h = 170 + 80 * rng.random(), 150 + 70 * rng.random()
        ground = (30, 34, 44) if (k + seed) % 2 else (244, 244, 240)
        draw.rectangle([x, y, x + w, y + h], ground, (120, 120, 130))
        draw.rectangle([x, y, x + w, y + 12], (90, 110, 150))
        if k == 1:
            heights = rng.random(14)
            for i, v in enumerate(heights):
                left = x + 8 + i * (w - 16) / 14
                draw.rectangle(
                    [left, y + h - 8 - v * (h - 40), left + 6, y + h - 8], ink(PALETTES[0][i % 4])
                )
        else:
            for line in range(int((h - 26) / 9)):
                color = ink(PALETTES[seed % 4][int(rng.integers(4))], 1.2)
                indent = 8 * int(rng.integers(0, 4))
                top = y + 18 + 9 * line
                write_lines(draw, (x + 6 + indent, top, x + w - 8, top + 6), 5, rng, color, 0.8)
    draw.rectangle([0, height - 22, width, height], (24, 26, 32))
    for k in range(12):
        draw.rectangle(
            [10 + 26 * k, height - 19, 26 + 26 * k, height - 4], ink(PALETTES[k % 4][k % 5])
        )
    return texels(to_float(canvas))


@functools.cache
def whiteboard(seed: int, height: int = 512, width: int = 1024) -> np.ndarray:
    """A whiteboard with boxes, arrows, curves, notes and half-wiped smears."""
    return _board(
        seed,
        height,
        width,
        (0.93, 0.94, 0.94),
        ((0.1, 0.15, 0.5), (0.7, 0.1, 0.1), (0.05, 0.4, 0.2), (0.1, 0.1, 0.1)),
    )


@functools.cache
def blackboard(seed: int, height: int = 512, width: int = 1024) -> np.ndarray:
    """A green chalkboard in use."""
    return _board(
        seed,
        height,
        width,
        (0.13, 0.25, 0.2),
        ((0.9, 0.9, 0.86), (0.95, 0.85, 0.5), (0.9, 0.65, 0.65)),
    )


def _board(
    seed: int, height: int, width: int, ground: Color, pens: tuple[Color, ...]
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    canvas = Image.new("RGB", (width, height), ink(ground))
    draw = ImageDraw.Draw(canvas)
    cells = [(i, j) for i in range(3) for j in range(6)]
    for i, j in cells:
        x, y = (j + 0.12) * width / 6, (i + 0.14) * height / 3
        w, h = width / 6 * 0.74, height / 3 * 0.66
        pen = ink(pens[int(rng.integers(len(pens)))])
        kind = rng.integers(4)
        if kind == 0:
            write_lines(draw, (x, y, x + w, y + h), 15, rng, pen)
        elif kind == 1:
            t = np.linspace(0, 1, 40)
            line = 0.5 + 0.2 * ridge_line(rng, 40)
            draw.line([(x + w * a, y + h * b) for a, b in zip(t, line, strict=True)], pen, 4)
            draw.line([(x, y), (x, y + h), (x + w, y + h)], pen, 3)
        elif kind == 2:
            for k in range(3):
                cx, cy = x + w * (0.2 + 0.3 * k), y + h * rng.random()
                draw.rectangle([cx - 20, cy - 13, cx + 20, cy + 13], outline=pen, width=3)
                draw.line([(cx + 20, cy), (cx + 42, cy + 8)], pen, 3)
        else:
            sides = int(rng.integers(3, 7))
            ring = np.linspace(0, 2 * np.pi, sides + 1) + rng.random()
            corners = [(x + w / 2 + 52 * np.cos(a), y + h / 2 + 52 * np.sin(a)) for a in ring]
            draw.line(corners, pen, 4)
            write_lines(draw, (x, y + h - 12, x + w / 2, y + h), 11, rng, pen)
    smear = 0.05 * smoothstep(0.2, 2.0, cloud(height, width, seed, 1.2, 4.0))
    grain = 0.03 * cloud(height, width, seed + 1, 0.6)
    return texels(to_float(canvas) * (1.0 + grain)[..., None] + smear[..., None])


def ridge_line(rng: np.random.Generator, num: int) -> np.ndarray:
    """A short random curve with mean 0, [num]."""
    line = np.cumsum(rng.normal(size=num))
    return (line - line.mean()) / max(float(np.abs(line).max()), 1e-6)


@functools.cache
def book_spines(seed: int, height: int = 256, width: int = 1024) -> np.ndarray:
    """An atlas of `SPINES` book spines side by side: bands, titles, emblems."""
    rng = np.random.default_rng(seed)
    canvas = Image.new("RGB", (width, height))
    draw = ImageDraw.Draw(canvas)
    w = width // SPINES
    for k in range(SPINES):
        palette = PALETTES[int(rng.integers(len(PALETTES)))]
        ground = np.asarray(palette[int(rng.integers(5))]) * (0.6 + 0.5 * rng.random())
        pen = ink((0.93, 0.88, 0.7) if ground.mean() < 0.5 else (0.14, 0.12, 0.12))
        x = k * w
        draw.rectangle([x, 0, x + w, height], ink(ground))
        draw.rectangle([x, 0, x + 1, height], ink(ground * 0.6))
        for y in (18, 30, height - 26):
            draw.rectangle([x, y, x + w, y + 1 + int(rng.integers(4))], pen)
        # Titles run down the spine: draw them level, then turn them.
        title = Image.new("RGB", (int(height * 0.6), w - 10), ink(ground))
        size = 8 + int(rng.integers(0, 8))
        write_lines(ImageDraw.Draw(title), (2, 2, title.width, title.height), size, rng, pen, 0.3)
        canvas.paste(title.rotate(-90, expand=True), (x + 5, 44))
        draw.ellipse([x + w / 2 - 6, height - 22, x + w / 2 + 6, height - 10], outline=pen, width=2)
    wear = 1.0 + 0.07 * cloud(height, width, seed, 0.8) + 0.04 * cloud(height, width, seed + 1, 0.3)
    return texels(to_float(canvas) * wear[..., None])


@functools.cache
def package(seed: int, height: int = 192, width: int = 128) -> np.ndarray:
    """The front of a carton, tin or jar: a badge, a headline, small print."""
    rng = np.random.default_rng(seed)
    palette = PALETTES[seed % 4]
    canvas = Image.new("RGB", (width, height), ink(palette[(seed // 4) % 5]))
    draw = ImageDraw.Draw(canvas)
    accent, other = palette[(seed // 4 + 1) % 5], palette[(seed // 4 + 3) % 5]
    draw.rectangle([0, height * 0.55, width, height], ink(accent))
    r = width * (0.22 + 0.14 * rng.random())
    cx, cy = width / 2, height * 0.5
    draw.ellipse([cx - r, cy - r, cx + r, cy + r], ink(other), ink((1, 1, 1)), 4)
    write_lines(draw, (12, 14, width - 8, 60), 18, rng, ink((0.08, 0.08, 0.1)), 0.1)
    write_lines(draw, (12, height * 0.8, width - 8, height - 8), 6, rng, ink((1, 1, 0.95)))
    for k in range(14):
        draw.line(
            [width - 44 + 3 * k, height - 26, width - 44 + 3 * k, height - 8], (0, 0, 0), 1 + k % 2
        )
    return texels(to_float(canvas) * (1.0 + 0.05 * cloud(height, width, seed, 0.9))[..., None])


@functools.cache
def clock(seed: int, size: int = 256) -> np.ndarray:
    """A clock's dial."""
    canvas = Image.new("RGB", (size, size), (238, 234, 222))
    draw = ImageDraw.Draw(canvas)
    c = size / 2
    for k in range(60):
        a, inner = k * np.pi / 30, 0.36 if k % 5 == 0 else 0.42
        ends = [(c + size * r * np.sin(a), c - size * r * np.cos(a)) for r in (inner, 0.46)]
        draw.line(ends, (30, 30, 34), 7 if k % 5 == 0 else 2)
    for turn, reach, width in ((seed * 0.61 % 1, 0.24, 9), (seed * 0.37 % 1, 0.38, 5)):
        a = 2 * np.pi * turn
        draw.line(
            [(c, c), (c + size * reach * np.sin(a), c - size * reach * np.cos(a))],
            (20, 20, 24),
            width,
        )
    return texels(to_float(canvas) * (1.0 + 0.04 * cloud(size, size, seed, 0.9))[..., None])


@functools.cache
def keyboard(height: int = 128, width: int = 384) -> np.ndarray:
    """A keyboard from above."""
    canvas = Image.new("RGB", (width, height), (38, 40, 44))
    draw = ImageDraw.Draw(canvas)
    for i in range(5):
        for j in range(16):
            x, y = 6 + j * 23.3 + 4 * (i % 2), 6 + i * 24
            draw.rectangle([x, y, x + 19, y + 19], (72, 74, 80), (120, 122, 128))
            draw.line([x + 6, y + 12, x + 11, y + 6], (220, 220, 220), 2)
    return texels(to_float(canvas) * (1.0 + 0.05 * cloud(height, width, 3, 0.6))[..., None])
