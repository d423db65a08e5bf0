"""What Habitat-Sim makes of a scene's file: which mesh it shows, and how it turns it.

Measured on 0.3.3: a bare GLB is taken as z-up and turned, and a stage config
(`<name>.stage_config.json`) says by `up` and `front` which axes its GLB has. A PLY is never turned,
whatever its stage config says: of all 24 rotations the identity alone agreed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.simulators.habitat.habitat_poses import BARE_GLB, habitat_from_axes
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.fields import check_type
from r3jax.validation.files import check_regular, read_bytes
from r3jax.validation.json_text import parse_json

_CONFIG = ".stage_config.json"
_PLY = ".ply"
_MAX_CONFIG = 1 << 20
"""HabitatStage configs have a few hundred bytes."""

_UNMOVED: dict[str, Any] = {"scale": [1, 1, 1], "origin": [0, 0, 0], "units_to_meters": 1}
"""What else could move or scale the mesh, and the only values that are understood."""


@dataclass(frozen=True)
class HabitatStage:
    """A scene for Habitat."""

    file: Path
    """What Habitat is told to load."""

    mesh: Path
    """What it then shows; the same file, but for a stage config."""

    habitat_from_file: np.ndarray
    """Rotation [3, 3] from the mesh file's axes to Habitat's world."""

    @property
    def is_ply(self) -> bool:
        """True if the mesh is a PLY."""
        return self.mesh.suffix.lower() == _PLY


def read_stage(path: str | Path) -> HabitatStage:
    """Finds out what Habitat will show.

    Args:
        path: a `.glb`, a `.ply`, or a `.stage_config.json`.

    Raises:
        ValueError: another kind of file, one that is missing, or a stage config that does not say
            which mesh it shows and how it is turned.
    """
    path = Path(path).absolute()
    try:
        if path.name.lower().endswith(_CONFIG):
            return _read_config(path)
        turn = {".glb": BARE_GLB, _PLY: np.eye(3)}.get(path.suffix.lower())
        if turn is None:
            raise ForeignFileError(f"Habitat scenes are .glb, .ply or {_CONFIG} files")
        check_regular(path)
    except FileNotFoundError:
        raise ValueError(f"no such file for Habitat: {path}") from None
    except (ForeignFileError, OSError) as error:
        raise ValueError(f"{path}: {error!s:.500}") from error
    return HabitatStage(path, path, turn)


def _read_config(path: Path) -> HabitatStage:
    """A stage config's mesh and axes."""
    config = parse_json(read_bytes(path, _MAX_CONFIG))
    check_type("the stage config", config, dict[str, Any])
    if "render_asset" not in config:
        raise ForeignFileError("it names no render_asset, so there is nothing to see")
    check_type("render_asset", config["render_asset"], str)
    for name, value in _UNMOVED.items():
        if config.get(name, value) != value:
            raise ForeignFileError(
                f"{name} {config[name]!s:.60} is not supported, only {value}: apply it to the mesh"
            )
    mesh = (path.parent / config["render_asset"]).absolute()
    try:
        check_regular(mesh)
    except FileNotFoundError:
        raise ForeignFileError(f"its render_asset {mesh} is missing") from None
    except ForeignFileError as error:
        raise ForeignFileError(f"its render_asset {mesh}: {error}") from None
    return HabitatStage(path, mesh, np.eye(3) if mesh.suffix.lower() == _PLY else _axes_of(config))


def _axes_of(config: dict[str, Any]) -> np.ndarray:
    """The rotation [3, 3] that a stage config's `up` and `front` ask for."""
    lacking = [name for name in ("up", "front") if name not in config]
    if lacking:
        raise ForeignFileError(
            f"it does not say {' and '.join(lacking)}; give the mesh's own axes, for z up "
            '"up": [0, 0, 1], "front": [0, 1, 0], for y up "up": [0, 1, 0], "front": [0, 0, -1]'
        )
    for name in ("up", "front"):
        check_type(name, config[name], list[float])
    try:
        return habitat_from_axes(config["up"], config["front"])
    except ValueError as error:
        raise ForeignFileError(str(error)) from None
