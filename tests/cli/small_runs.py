"""Small runs, for the tests of the command line."""

from pathlib import Path

from r3jax.cli.main import main


def explore(room: str, out: Path, *words: str) -> int:
    """A small run; the same shapes everywhere, so that each part compiles once."""
    options = {"scene": room, "policy": "random", "budget": "views:3", "clock": "model"}
    options |= {"resolution": 48, "fov": 90, "capacity": 16384, "voxel-size": 0.1}
    options |= {"out": out, "name": "box", "candidates": 20}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return main(["explore", *given, *words])
