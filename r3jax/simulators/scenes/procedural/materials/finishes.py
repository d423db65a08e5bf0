"""Named finishes: what things are made of. Each call with the same arguments is one material.

Tiles are sized for about 320 texels per meter on walls and floors, more on small things.
"""

import functools

import numpy as np

from r3jax.errors import InputError
from r3jax.simulators.scenes.procedural.materials import artwork, textures
from r3jax.simulators.scenes.procedural.materials.textures import Color, Real
from r3jax.simulators.scenes.procedural.model import Finish
from r3jax.simulators.world import Material

OAK, WALNUT, PINE, BEECH, EBONY = (
    (0.72, 0.54, 0.35),
    (0.46, 0.3, 0.19),
    (0.84, 0.68, 0.46),
    (0.8, 0.6, 0.42),
    (0.26, 0.2, 0.17),
)
"""Woods by color."""

WHITE, CREAM, CHARCOAL, SAGE, NAVY, TERRACOTTA, MUSTARD, BLUSH, TEAL = (
    (0.9, 0.89, 0.87),
    (0.9, 0.85, 0.75),
    (0.24, 0.25, 0.27),
    (0.6, 0.67, 0.56),
    (0.2, 0.27, 0.4),
    (0.76, 0.44, 0.31),
    (0.82, 0.63, 0.24),
    (0.84, 0.66, 0.6),
    (0.2, 0.45, 0.46),
)
"""Paints and cloths by color."""


@functools.cache
def plaster(color: Color, seed: int, strength: Real = 1.0) -> Finish:
    """Makes the finish of painted plaster on walls and ceilings."""
    return Finish(Material(textures.plaster(color, seed, strength)), (2.4, 2.4))


@functools.cache
def wallpaper(ground: Color, inks: tuple[Color, ...], motif: str, seed: int) -> Finish:
    """Makes the finish of printed wallpaper."""
    return Finish(Material(textures.wallpaper(ground, inks, motif, seed)), (1.9, 1.9))


@functools.cache
def concrete(color: Color, seed: int) -> Finish:
    """Makes the finish of cast concrete."""
    return Finish(Material(textures.concrete(color, seed), specular=0.08), (2.4, 2.4))


@functools.cache
def brick(seed: int, color: Color = (0.62, 0.33, 0.25)) -> Finish:
    """Makes the finish of a brick wall."""
    return Finish(Material(textures.brick(seed, color)), (2.0, 1.85))


@functools.cache
def acoustic_ceiling(seed: int) -> Finish:
    """Makes the finish of mineral ceiling tiles of 0.6 m."""
    return Finish(Material(textures.acoustic(seed)), (2.4, 2.4))


@functools.cache
def wood(color: Color, seed: int = 0, gloss: Real = 0.15) -> Finish:
    """Makes the finish of oiled or lacquered furniture wood."""
    material = Material(textures.wood(color, seed), specular=gloss, shininess=24.0)
    return Finish(material, (1.1, 0.8))


@functools.cache
def plank_floor(color: Color, seed: int, gloss: Real = 0.2, rows: int = 14) -> Finish:
    """Makes the finish of a floor of boards; glossy ones mirror a little."""
    material = Material(
        textures.planks(color, seed, rows), specular=gloss, shininess=40.0, mirror=0.18 * gloss
    )
    return Finish(material, (2.2, 2.2))


@functools.cache
def parquet_floor(color: Color, seed: int, gloss: Real = 0.3) -> Finish:
    """Makes the finish of basket-weave parquet."""
    material = Material(
        textures.parquet(color, seed), specular=gloss, shininess=48.0, mirror=0.25 * gloss
    )
    return Finish(material, (2.4, 2.4))


@functools.cache
def tiled(
    colors: tuple[Color, ...],
    seed: int,
    columns: int = 6,
    rows: int = 6,
    edge: Real = 0.3,
    bond: Real = 0.0,
    mirror: Real = 0.05,
) -> Finish:
    """Makes the finish of glazed tiles; `edge` is the height of one [m], the width follows."""
    texture = textures.tiles(colors, seed, columns, rows, bond=bond)
    width = edge * rows
    return Finish(Material(texture, specular=0.45, shininess=60.0, mirror=mirror), (width, width))


@functools.cache
def marble(color: Color, vein: Color, seed: int, mirror: Real = 0.08) -> Finish:
    """Makes the finish of polished stone."""
    texture = textures.marble(color, vein, seed)
    return Finish(Material(texture, specular=0.5, shininess=80.0, mirror=mirror), (1.8, 1.8))


@functools.cache
def terrazzo(color: Color, chips: tuple[Color, ...], seed: int) -> Finish:
    """Makes the finish of polished terrazzo."""
    texture = textures.terrazzo(color, chips, seed)
    return Finish(Material(texture, specular=0.4, shininess=64.0, mirror=0.08), (1.8, 1.8))


@functools.cache
def metal(color: Color = (0.68, 0.69, 0.7), seed: int = 0, mirror: Real = 0.15) -> Finish:
    """Makes the finish of brushed metal."""
    texture = textures.metal(color, seed)
    return Finish(Material(texture, specular=0.7, shininess=50.0, mirror=mirror), (0.9, 0.9))


@functools.cache
def enamel(color: Color, seed: int = 0, gloss: Real = 0.4) -> Finish:
    """Makes the finish of lacquer, ceramic or plastic."""
    texture = textures.enamel(color, seed)
    return Finish(
        Material(texture, specular=gloss, shininess=60.0, mirror=0.06 * gloss), (0.9, 0.9)
    )


@functools.cache
def fabric(color: Color, seed: int = 0) -> Finish:
    """Makes the finish of plain woven cloth."""
    return Finish(Material(textures.fabric(color, seed)), (0.7, 0.7))


@functools.cache
def striped(colors: tuple[Color, ...], seed: int = 0, repeats: int = 4) -> Finish:
    """Makes the finish of striped cloth."""
    return Finish(Material(textures.stripes(colors, seed, repeats)), (0.9, 0.9))


@functools.cache
def plaid(ground: Color, first: Color, second: Color, seed: int = 0) -> Finish:
    """Makes the finish of tartan cloth."""
    return Finish(Material(textures.plaid(ground, first, second, seed)), (0.8, 0.8))


@functools.cache
def printed(ground: Color, inks: tuple[Color, ...], motif: str, seed: int) -> Finish:
    """Makes the finish of printed cloth for curtains and cushions."""
    return Finish(Material(textures.wallpaper(ground, inks, motif, seed, 512)), (0.9, 0.9))


@functools.cache
def leather(color: Color, seed: int = 0) -> Finish:
    """Makes the finish of upholstery leather."""
    return Finish(Material(textures.leather(color, seed), specular=0.3, shininess=20.0), (0.8, 0.8))


@functools.cache
def carpet(color: Color, fleck: Color, seed: int = 0) -> Finish:
    """Makes the finish of fitted carpet."""
    return Finish(Material(textures.carpet(color, fleck, seed)), (2.0, 2.0))


@functools.cache
def rug(palette: tuple[Color, ...], seed: int) -> Finish:
    """Makes the finish of a knotted rug, fitted once."""
    return Finish(Material(textures.rug(palette, seed)))


@functools.cache
def leaf(color: Color, seed: int = 0) -> Finish:
    """Makes the finish of a leaf, fitted once."""
    return Finish(Material(textures.leaf(color, seed), specular=0.15, shininess=16.0))


@functools.cache
def glow(color: Color, seed: int = 0, emission: Real = 0.95) -> Finish:
    """Makes the finish of a lamp shade or diffuser that shines by itself."""
    return Finish(Material(textures.fabric(color, seed, 64), emission=emission), (0.5, 0.5))


@functools.cache
def mirror() -> Finish:
    """Makes the finish of a silvered mirror with faint clouding."""
    texture = textures.enamel((0.8, 0.83, 0.84), 77)
    return Finish(Material(texture, specular=0.3, shininess=120.0, mirror=0.85), (0.9, 0.9))


@functools.cache
def window(seed: int) -> Finish:
    """Makes the finish of a pane with the view through it. Depth sensors see nothing there."""
    material = Material(
        artwork.window_view(seed), emission=0.9, mirror=0.06, specular=0.3, is_hole=True
    )
    return Finish(material)


@functools.cache
def glass(color: Color = (0.62, 0.74, 0.72), seed: int = 5) -> Finish:
    """Makes the finish of clear glass of a partition: streaks, half a reflection, and no depth."""
    texture = textures.metal(color, seed)
    return Finish(
        Material(texture, specular=0.6, shininess=120.0, mirror=0.45, is_hole=True), (1.6, 1.6)
    )


@functools.cache
def frosted(seed: int = 6) -> Finish:
    """Makes the finish of glass with an etched pattern: depth sensors do see it."""
    etched = ((0.9, 0.94, 0.94), (0.58, 0.69, 0.69))
    texture = textures.wallpaper((0.74, 0.82, 0.82), etched, "trellis", seed, 512)
    return Finish(Material(texture, specular=0.4, shininess=60.0, mirror=0.08), (0.9, 0.9))


def _flat(texture: np.ndarray, gloss: Real = 0.15, emission: Real = 0.0) -> Finish:
    return Finish(Material(texture, specular=gloss, shininess=40.0, emission=emission))


@functools.cache
def picture(kind: str, seed: int, wide: bool = False) -> Finish:
    """Makes the finish of a picture under glass: "landscape", "sunset", "abstract" or "poster"."""
    size = (384, 512) if wide else (512, 384)
    makers = {
        "landscape": lambda: artwork.landscape(seed, *size),
        "sunset": lambda: artwork.landscape(seed, *size, 0.9),
        "abstract": lambda: artwork.abstract(seed, *size),
        "poster": lambda: artwork.poster(seed, *size),
    }
    if kind not in makers:
        raise InputError(f"unknown kind of picture {kind!r}; known: {sorted(makers)}")
    return _flat(makers[kind](), gloss=0.2)


@functools.cache
def screen(seed: int) -> Finish:
    """Makes the finish of a computer screen that is on."""
    material = Material(
        artwork.desktop(seed), emission=0.85, specular=0.3, shininess=80.0, mirror=0.05
    )
    return Finish(material)


@functools.cache
def board(kind: str, seed: int) -> Finish:
    """Makes the finish of a "white" or "black" writing board, written on."""
    texture = artwork.whiteboard(seed) if kind == "white" else artwork.blackboard(seed)
    return _flat(texture, gloss=0.5 if kind == "white" else 0.1)


@functools.cache
def spines(seed: int) -> Finish:
    """Makes the finish of the atlas of book spines."""
    return _flat(artwork.book_spines(seed), gloss=0.12)


@functools.cache
def package(seed: int) -> Finish:
    """Makes the finish of the print on a carton, tin or jar."""
    return _flat(artwork.package(seed), gloss=0.25)


@functools.cache
def clock_face(seed: int) -> Finish:
    """Makes the finish of a clock's dial."""
    return _flat(artwork.clock(seed))


@functools.cache
def keyboard() -> Finish:
    """Makes the finish of a keyboard's keys."""
    return _flat(artwork.keyboard())


PERSIAN = (
    (0.52, 0.13, 0.13),
    (0.16, 0.2, 0.36),
    (0.86, 0.76, 0.56),
    (0.36, 0.24, 0.2),
    (0.7, 0.48, 0.3),
)
NORDIC = (
    (0.87, 0.84, 0.77),
    (0.3, 0.38, 0.45),
    (0.75, 0.5, 0.36),
    (0.56, 0.6, 0.55),
    (0.2, 0.22, 0.26),
)
BERBER = (
    (0.9, 0.87, 0.8),
    (0.25, 0.22, 0.2),
    (0.8, 0.62, 0.4),
    (0.62, 0.35, 0.25),
    (0.45, 0.5, 0.42),
)
LEAFY = ((0.42, 0.53, 0.42), (0.56, 0.64, 0.5), (0.8, 0.55, 0.46))
CHIPS = ((0.6, 0.3, 0.22), (0.3, 0.35, 0.36), (0.92, 0.9, 0.86), (0.72, 0.6, 0.4))
