"""One picture of all nine scenes: views from inside, and each flat cut open from above.

    python -m docs.figures.scene_gallery docs/images/scenes.png

Rendering uses the ray-cast simulator, so it takes about half a minute.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

from r3jax.geometry.cameras import Camera, look_at
from r3jax.simulators.scenes import procedural
from r3jax.simulators.world import World

_TILE = 240  # edge of one picture [px]
_SHARPER = 2  # pictures are rendered this many times larger
_COLUMNS = 3  # scenes side by side

VIEWS: dict[str, tuple[tuple[float, ...], ...]] = {
    "flat": ((4.9, 1.0, 1.5, 1.2, 3.1, 0.8), (1.0, 1.9, 1.5, 4.9, 3.4, 1.1)),
    "kitchen": ((0.6, 3.2, 1.55, 4.6, 1.9, 1.0), (5.3, 3.2, 1.55, 1.0, 0.6, 0.9)),
    "loft": ((7.9, 3.6, 1.6, 2.6, 0.6, 1.1), (3.9, 2.9, 1.7, 6.0, 6.2, 1.0)),
    "apartment": ((4.9, 3.6, 1.55, 0.8, 1.2, 0.9), (3.6, 6.4, 1.55, 0.8, 8.6, 0.9)),
    "office": ((5.4, 3.9, 1.6, 1.0, 0.9, 1.0), (9.7, 5.6, 1.6, 5.0, 1.0, 0.9)),
    "gallery": ((5.6, 4.9, 1.6, 1.6, 0.6, 1.3), (7.0, 1.6, 1.6, 12.0, 2.8, 1.2)),
    "corridor": ((13.2, 0.9, 1.5, 0.0, 1.0, 1.2), (12.9, -0.7, 1.6, 7.6, -2.4, 0.9)),
    "classroom": ((8.0, 1.2, 1.7, 1.2, 4.4, 0.9), (1.4, 5.6, 1.6, 8.2, 2.4, 0.9)),
    "library": ((8.9, 6.6, 1.65, 1.0, 4.6, 1.0), (8.0, 3.3, 1.65, 5.6, 1.2, 1.1)),
}
"""Per scene: eye and target (x, y, z, x, y, z) of each view [m]."""


def _opened(world: World, height: float = 1.9) -> World:
    """Returns the world without what lies above a height, to look into from above."""
    low = world.vertices[world.faces][:, :, 2].max(axis=1) < height
    on_shell = np.zeros(len(world.faces), dtype=bool)
    for bound in world.bounds:
        on_shell |= (
            (np.abs(world.vertices[world.faces] - bound) < 1e-6).all(axis=1)[:, :2].any(axis=1)
        )
    keep = low & ~on_shell
    assert world.face_color is not None
    return World(
        name=world.name,
        vertices=world.vertices,
        faces=world.faces[keep],
        materials=world.materials,
        face_material=world.face_material[keep],
        face_uv=world.face_uv[keep],
        face_color=world.face_color[keep],
        ambient=1.0,
    )


def _shoot(world: World, eyes_and_targets: list[np.ndarray], fov_deg: float) -> list[Image.Image]:
    from r3jax.simulators.raycast.raycast import RaycastSimulator

    edge = _TILE * _SHARPER
    simulator = RaycastSimulator(world, Camera.from_fov(edge, edge, fov_deg))
    pictures: list[Image.Image] = []
    for eye, target in eyes_and_targets:
        pose = look_at(jnp.asarray(eye, jnp.float32), jnp.asarray(target, jnp.float32))
        rgb = np.array(simulator.render(np.asarray(pose, dtype=np.float64)).rgb)
        rgb[rgb.max(axis=2) == 0.0] = 1.0  # what no ray hits is white paper round the cut
        picture = Image.fromarray((rgb * 255.0 + 0.5).astype(np.uint8))
        pictures.append(picture.resize((_TILE, _TILE), Image.Resampling.LANCZOS))
    return pictures


def _from_above(world: World) -> Image.Image:
    """The scene without its ceiling, from high above (the far camera is nearly orthographic)."""
    low, high = world.bounds
    middle, extent = (low + high) / 2, float((high - low)[:2].max())
    fov_deg = 20.0
    height = 0.5 * extent / np.tan(np.deg2rad(fov_deg / 2)) + 1.9
    eye = np.array([middle[0], middle[1] - 1e-3, height])
    return _shoot(_opened(world), [np.array([eye, [middle[0], middle[1], 0.0]])], fov_deg)[0]


def contact_sheet() -> Image.Image:
    """Returns two views and a cut per scene, three scenes to a row."""
    rows = -(-len(VIEWS) // _COLUMNS)
    gap = 6
    width, height = 3 * _TILE + gap, _TILE + gap
    sheet = Image.new("RGB", (_COLUMNS * width - gap, rows * height - gap), (255, 255, 255))
    for k, (name, views) in enumerate(VIEWS.items()):
        world = procedural.build(name)
        shots = _shoot(world, [np.reshape(v, (2, 3)) for v in views], 72.0)
        for i, picture in enumerate([*shots, _from_above(world)]):
            left, top = k % _COLUMNS * width + i * _TILE, k // _COLUMNS * height
            sheet.paste(picture, (left, top))
    return sheet


def main() -> None:
    """Writes the contact sheet to the path given on the command line."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: python -m docs.figures.scene_gallery OUT.png")
    out = Path(sys.argv[1])
    out.parent.mkdir(parents=True, exist_ok=True)
    # 256 colors keep the picture small enough for a README.
    sheet = contact_sheet().quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
    sheet.save(out, optimize=True)
    print(f"wrote {out} ({out.stat().st_size / 1e6:.2f} MB)")


if __name__ == "__main__":
    main()
