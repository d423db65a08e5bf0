"""Pictures that hang, stand or glow: landscapes, prints, screens, boards, window views.

Flat things with marks on them, too: book spines, packaging, clocks, keyboards. Each fits its
surface once (it does not tile). Read-only [h, w, 3] uint8, made once.
"""

import functools

import numpy as np
from PIL import Image, ImageDraw

from r3jax.simulators.scenes.procedural.materials.textures import (
    Color,
    Ink,
    Real,
    blend,
    cloud,
    ridge,
    smoothstep,
    texels,
)

PALETTES = (
    (
        (0.91, 0.35, 0.22),
        (0.16, 0.27, 0.42),
        (0.95, 0.77, 0.36),
        (0.3, 0.55, 0.5),
        (0.93, 0.9, 0.84),
    ),
    ((0.12, 0.2, 0.3), (0.8, 0.52, 0.33), (0.9, 0.86, 0.75), (0.42, 0.53, 0.4), (0.6, 0.2, 0.24)),
    ((0.95, 0.93, 0.88), (0.1, 0.1, 0.12), (0.85, 0.16, 0.14), (0.98, 0.8, 0.1), (0.1, 0.3, 0.6)),
    (
        (0.36, 0.22, 0.42),
        (0.93, 0.62, 0.58),
        (0.98, 0.89, 0.7),
        (0.2, 0.42, 0.5),
        (0.75, 0.35, 0.45),
    ),
)
"""Colors that go together, five each."""


def ink(color: Color | np.ndarray, shade: Real = 1.0) -> Ink:
    """Converts a color in [0, 1] to the bytes that Pillow draws with."""
    r, g, b = (int(255 * min(1.0, max(0.0, c * shade))) for c in color)
    return r, g, b


def to_float(image: Image.Image) -> np.ndarray:
    """Converts a Pillow image to [h, w, 3] float32 in [0, 1]."""
    return np.asarray(image.convert("RGB"), dtype=np.float32) / 255.0


def write_lines(
    draw: ImageDraw.ImageDraw,
    box: tuple[Real, Real, Real, Real],
    height: Real,
    rng: np.random.Generator,
    fill: Ink,
    ragged: Real = 0.35,
) -> None:
    """Fills a box (left, top, right, bottom) with marks that look like lines of print."""
    left, top, right, bottom = box
    y = top
    while y + height <= bottom:
        end = right - ragged * rng.random() * (right - left)
        x = left
        while x < end:
            for _ in range(int(rng.integers(2, 9))):
                w = height * (0.25 + 0.3 * rng.random())
                kind = rng.integers(4)
                if kind == 0:
                    draw.rectangle([x, y + 0.3 * height, x + 0.7 * w, y + height], outline=fill)
                elif kind == 1:
                    draw.line([x, y, x, y + height], fill=fill, width=max(1, int(height / 7)))
                else:
                    low = y + height * (0.3 if kind == 2 else 0.0)
                    draw.line([x, y + height, x + 0.5 * w, low], fill=fill)
                    draw.line([x + 0.5 * w, low, x + 0.8 * w, y + height], fill=fill)
                x += w
            x += 0.5 * height
        y += 1.75 * height


_MOODS = (
    ((0.55, 0.63, 0.75), (0.2, 0.36, 0.14)),
    ((0.62, 0.56, 0.6), (0.52, 0.3, 0.1)),
    ((0.78, 0.66, 0.56), (0.66, 0.46, 0.26)),
    ((0.78, 0.84, 0.92), (0.5, 0.56, 0.62)),
    ((0.45, 0.58, 0.6), (0.3, 0.42, 0.2)),
)
"""Colors of the farthest and the nearest hills."""


def _scene(seed: int, height: int, width: int, sunset: Real) -> np.ndarray:
    """Paints sky, clouds, four ranges of hills, a plain with trees; [h, w, 3] float32."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    y = row / height
    high = (
        np.array([0.28, 0.5, 0.82]) * (1 - 0.5 * sunset) + np.array([0.2, 0.12, 0.3]) * sunset * 0.5
    )
    low = np.array([0.82, 0.9, 0.97]) * (1 - sunset) + np.array([0.99, 0.66, 0.4]) * sunset
    image = blend(high.astype(np.float32), low.astype(np.float32), smoothstep(0.0, 0.6, y))
    clouds = smoothstep(0.3, 1.6, cloud(height, width, seed, 1.5, 2.5)) * (
        1 - smoothstep(0.3, 0.6, y)
    )
    image = blend(image, np.array([1.0, 0.97, 0.94], dtype=np.float32), 0.85 * clouds)
    center = (0.2 + 0.6 * rng.random()) * width, (0.2 + 0.15 * rng.random()) * height
    distance = np.hypot(column - center[0], row - center[1]) / height
    glow = np.clip(np.exp(-distance * 7.0) + (distance < 0.05), 0, 1) * (0.4 + 0.6 * sunset)
    image = blend(image, np.array([1.0, 0.93, 0.72], dtype=np.float32), glow)
    texture = 0.16 * cloud(height, width, seed + 5, 0.9) + 0.1 * cloud(height, width, seed + 6, 0.3)
    far, near = (np.array(c) for c in _MOODS[seed % len(_MOODS)])
    relief, rise = 0.03 + 0.06 * rng.random(), 0.34 + 0.14 * rng.random()
    for k in range(5):
        depth = k / 4.0
        profile = ridge(width, 7 * seed + k, 1.7 - 0.12 * k)
        line = rise + 0.11 * k - relief * (1 - 0.5 * depth) * profile
        color = (far * (1 - depth) + near * depth) * (1 - 0.25 * sunset)
        shade = color.astype(np.float32) * (1 + (0.3 + depth) * texture)[..., None]
        image = blend(image, shade, smoothstep(-0.004, 0.004, y - line[None, :]))
    return image


def _trees(image: np.ndarray, seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    hue = np.asarray(_MOODS[seed % len(_MOODS)][1]) * np.array([0.8, 1.15, 0.8])
    height, width = image.shape[:2]
    canvas = Image.fromarray(texels(image))
    draw = ImageDraw.Draw(canvas)
    for foot in np.sort(0.72 + 0.26 * rng.random(count)):
        x, size = rng.random() * width, height * (0.06 + 0.5 * (foot - 0.68))
        draw.rectangle(
            [x - size / 22, foot * height - size / 2, x + size / 22, foot * height], (70, 48, 32)
        )
        for _ in range(60):
            dx, dy = rng.normal(0, 0.17, 2) * size
            r = size * (0.04 + 0.05 * rng.random())
            green = hue * (0.7 + 0.8 * rng.random()) + 0.05 * rng.random(3)
            cx, cy = x + dx, foot * height - 0.72 * size + dy
            draw.ellipse([cx - r, cy - r, cx + r, cy + r], ink(green))
    return to_float(canvas)


@functools.cache
def landscape(seed: int, height: int = 384, width: int = 512, sunset: Real = 0.3) -> np.ndarray:
    """Paints a landscape with brush marks."""
    image = _trees(_scene(seed, height, width, sunset), seed, 14)
    brush = 0.06 * cloud(height, width, seed + 40, 0.6, 3.0) + 0.03 * cloud(height, width, 41, 0.2)
    return texels(image * (1.0 + brush)[..., None])


@functools.cache
def window_view(seed: int, height: int = 512, width: int = 512) -> np.ndarray:
    """Paints the view outside: sky, hills and a street of houses with lit windows."""
    rng = np.random.default_rng(seed)
    canvas = Image.fromarray(texels(_trees(_scene(seed, height, width, 0.15), seed, 10)))
    draw = ImageDraw.Draw(canvas)
    x = -30.0
    while x < width:
        w, top = 50 + 70 * rng.random(), height * (0.42 + 0.25 * rng.random())
        wall = np.array([0.72, 0.63, 0.53]) * (0.75 + 0.4 * rng.random()) + 0.05 * rng.normal(
            size=3
        )
        draw.rectangle([x, top, x + w, height], ink(wall))
        draw.polygon([(x - 4, top), (x + w / 2, top - 0.3 * w), (x + w + 4, top)], ink(wall * 0.5))
        for wy in np.arange(top + 12, height * 0.93, 30):
            for wx in np.arange(x + 8, x + w - 14, 21):
                glass = 0.25 + 0.5 * rng.random()
                draw.rectangle([wx, wy, wx + 11, wy + 17], ink((glass, glass * 1.05, glass * 1.1)))
                draw.line([wx + 5, wy, wx + 5, wy + 17], ink(wall * 1.2))
        x += w + 40 * rng.random() * (rng.random() < 0.5)
    canvas = to_float(_hedge(canvas, rng))
    grain = 1.0 + 0.05 * cloud(height, width, seed + 3, 0.7)
    return texels(np.clip(canvas * 1.12 + 0.04, 0, 1) * grain[..., None])


def _hedge(canvas: Image.Image, rng: np.random.Generator) -> Image.Image:
    width, height = canvas.size
    draw = ImageDraw.Draw(canvas)
    for _ in range(700):
        x, y = rng.random() * width, height * (0.9 + 0.11 * rng.random())
        r = 3 + 6 * rng.random()
        draw.ellipse([x - r, y - r, x + r, y + r], ink((0.15, 0.3 + 0.25 * rng.random(), 0.12)))
    return canvas


@functools.cache
def abstract(seed: int, height: int = 512, width: int = 384) -> np.ndarray:
    """Paints an abstract print: overlapping discs, bars, arcs and lines on a textured ground."""
    rng = np.random.default_rng(seed)
    palette = PALETTES[seed % len(PALETTES)]
    canvas = Image.new("RGB", (width, height), ink(palette[4]))
    draw = ImageDraw.Draw(canvas, "RGBA")
    for _ in range(26):
        x, y = rng.random() * width, rng.random() * height
        r = min(width, height) * (0.04 + 0.24 * rng.random() ** 2)
        fill = (
            *ink(palette[rng.integers(4)], 0.8 + 0.4 * rng.random()),
            int(150 + 100 * rng.random()),
        )
        kind = rng.integers(4)
        if kind == 0:
            draw.ellipse([x - r, y - r, x + r, y + r], fill)
        elif kind == 1:
            draw.rectangle([x - r, y - 0.3 * r, x + r, y + 0.3 * r], fill)
        elif kind == 2:
            draw.arc([x - r, y - r, x + r, y + r], 0, 250, fill, max(3, int(r / 6)))
        else:
            for k in range(7):
                draw.line([x - r, y + 6 * k, x + r, y + 6 * k - 0.4 * r], fill, 2)
    paint = (
        1.0 + 0.07 * cloud(height, width, seed, 1.2) + 0.05 * cloud(height, width, seed + 1, 0.4)
    )
    return texels(to_float(canvas) * paint[..., None])


@functools.cache
def poster(seed: int, height: int = 512, width: int = 384) -> np.ndarray:
    """Paints a poster: a picture, a headline and columns of print."""
    rng = np.random.default_rng(seed)
    palette = PALETTES[(seed + 1) % len(PALETTES)]
    canvas = Image.new("RGB", (width, height), ink(palette[(seed // 4) % 5]))
    split, margin = int(height * (0.5 + 0.12 * rng.random())), width // 14
    art = landscape(seed, 256, 320, 0.8 * rng.random()) if seed % 2 else abstract(seed, 320, 320)
    picture = Image.fromarray(art).resize((width - 2 * margin, split - 2 * margin))
    canvas.paste(picture, (margin, margin))
    draw = ImageDraw.Draw(canvas)
    dark = ink(palette[1] if (seed // 4) % 5 != 1 else palette[4], 0.8)
    write_lines(draw, (margin, split, width - margin, split + 64), 30, rng, dark, 0.1)
    for left, right in ((margin, width // 2 - 8), (width // 2 + 8, width - margin)):
        write_lines(draw, (left, split + 78, right, height - margin), 7, rng, dark)
    fold = 1.0 + 0.05 * cloud(height, width, seed, 1.6)
    return texels(to_float(canvas) * fold[..., None])


SPINES = 32
"""Books in the atlas that `book_spines` draws, side by side."""


@functools.cache
def desktop(seed: int, height: int = 320, width: int = 512) -> np.ndarray:
    """Paints a computer screen: wallpaper, an editor, a chart, a bar of icons."""
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
    """Paints a whiteboard with boxes, arrows, curves, notes and half-wiped smears."""
    return _board(
        seed,
        height,
        width,
        (0.93, 0.94, 0.94),
        ((0.1, 0.15, 0.5), (0.7, 0.1, 0.1), (0.05, 0.4, 0.2), (0.1, 0.1, 0.1)),
    )


@functools.cache
def blackboard(seed: int, height: int = 512, width: int = 1024) -> np.ndarray:
    """Paints a green chalkboard in use."""
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
    """Draws a short random curve with mean 0, [num]."""
    line = np.cumsum(rng.normal(size=num))
    return (line - line.mean()) / max(float(np.abs(line).max()), 1e-6)


@functools.cache
def book_spines(seed: int, height: int = 256, width: int = 1024) -> np.ndarray:
    """Paints an atlas of `SPINES` book spines side by side: bands, titles, emblems."""
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
    """Paints the front of a carton, tin or jar: a badge, a headline, small print."""
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
    """Paints a clock's dial."""
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
    """Paints a keyboard from above."""
    canvas = Image.new("RGB", (width, height), (38, 40, 44))
    draw = ImageDraw.Draw(canvas)
    for i in range(5):
        for j in range(16):
            x, y = 6 + j * 23.3 + 4 * (i % 2), 6 + i * 24
            draw.rectangle([x, y, x + 19, y + 19], (72, 74, 80), (120, 122, 128))
            draw.line([x + 6, y + 12, x + 11, y + 6], (220, 220, 220), 2)
    return texels(to_float(canvas) * (1.0 + 0.05 * cloud(height, width, 3, 0.6))[..., None])
