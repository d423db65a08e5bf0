"""Furnished scenes, made by code: nine homes and offices, and a tower of three stories.

    from r3jax.simulators.scenes import procedural
    world = procedural.build("flat")

They are fixed by name, the same on every run. Every scene is closed (a camera inside sees surfaces
only), has image-like textures, glossy and mirror-like materials, windows on which depth sensors
fail, and doorways that a robot of 0.3 m radius passes. World: z up, meters; one room's floor has a
corner at the origin.
"""

import importlib

from r3jax.errors import InputError
from r3jax.simulators.world import World
from r3jax.validation.errors import did_you_mean

_SCENES = {
    "flat": "flat",
    "kitchen": "kitchen_diner",
    "loft": "loft",
    "apartment": "apartment",
    "office": "office",
    "gallery": "gallery",
    "corridor": "corridor",
    "classroom": "classroom",
    "library": "library",
    "tower": "tower",
}
"""Names, and the files of the catalog that make them; these load on first use."""


def names() -> tuple[str, ...]:
    """Lists the names, from the demo's scene on; the last is a tower, larger than a house."""
    return tuple(_SCENES)


def _scene(name: str):
    if name not in _SCENES:
        hint = did_you_mean(name, _SCENES)
        raise InputError(f"unknown procedural scene {name!r}{hint}; known: {', '.join(_SCENES)}")
    return importlib.import_module(f"r3jax.simulators.scenes.procedural.catalog.{_SCENES[name]}")


def build(name: str) -> World:
    """Makes the scene of that name in one to two seconds, the tower in some more.

    Raises:
        ValueError: no scene has that name.
    """
    return _scene(name).build()


def rooms(name: str) -> dict[str, tuple[float, float, float, float]]:
    """Returns the rooms of the scene of that name: free rectangles (x0, y0, x1, y1) [m].

    Raises:
        ValueError: no scene has that name.
    """
    drawn = _scene(name).plan()
    return {
        key: (float(r.x0), float(r.y0), float(r.x1), float(r.y1)) for key, r in drawn.rooms.items()
    }


def describe(name: str) -> str:
    """Describes the scene of that name in one line.

    Raises:
        ValueError: no scene has that name.
    """
    return _scene(name).SUMMARY
