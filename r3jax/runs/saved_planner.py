"""A planner on disk: its map and grid, its policy's memory, and all of its settings.

    NAME/  planner.json  000000/  tiles/

`planner.json` names the policy, its settings, the camera and the settings of the map; the folder
beside it holds the arrays, as a run's checkpoint does, with the hash of each of its files. The
voxels of tiles lie in `tiles/`, a file for each, named by its hash: all of them, whether they were
in memory or in a tile folder.
"""

import json
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax import files
from r3jax.checkpoints import discard, numbered, read_arrays, write_checkpoint
from r3jax.errors import InputError, PathError
from r3jax.geometry.arguments import checked
from r3jax.geometry.cameras import Camera
from r3jax.mapping.config import MappingConfig, mapping_config_of
from r3jax.mapping.occupancy import OccupancyGrid, empty_grid
from r3jax.mapping.state import empty_map
from r3jax.mapping.tile_files import (
    TILE_MEMORY,
    Voxels,
    open_tile_folder,
    read_tiles,
    remove_other_tiles,
    write_tiles,
)
from r3jax.planning.far import far_arrays, far_of
from r3jax.planning.planner import Planner, a_planner
from r3jax.planning.registry import config_class, make_policy
from r3jax.planning.robot.motion import motion_of_record
from r3jax.runs.header import RunError, camera_fields, policy_fields
from r3jax.runs.stored_states import (
    fill,
    from_storable,
    map_tables,
    memory_of,
    named_arrays,
    to_storable,
)
from r3jax.scoring.config import scoring_config_of
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import parse_json, sealed, unsealed

FORMAT, VERSION = "r3jax-planner", 2
_READ = (1, 2)
"""The first kept the voxels of tiles among its arrays."""

_TILES = "tiles"

_MAX_BYTES = 1 << 20


@checked(planner=a_planner)
def save(planner: Planner, path: str | Path) -> None:
    """Saves a planner for `load`, also on another machine.

    Args:
        planner: with a policy whose memory consists of arrays, not an external program.
        path: a new or empty folder, or one with an earlier saved planner, which is replaced.

    Raises:
        ValueError: a policy without a camera.
        OSError: the disk is full, not writable, ...; or something else is there.
    """
    folder = Path(path)
    camera = getattr(planner.policy_state, "camera", None)
    if not isinstance(camera, Camera):
        raise InputError(
            f"the policy {planner.policy.name!r} cannot be saved: its memory has no camera"
        )
    files.own_folder(folder, "planner")
    tables = map_tables(planner.map_state, planner.grid)
    tables["policy"] = named_arrays(planner.policy_state)
    listed = {"sha256": np.zeros((0, 32), np.uint8)}
    if planner.far is not None:
        listed = write_tiles(planner.far.tiles.voxels, folder / _TILES)
        without = replace(planner.far, tiles=replace(planner.far.tiles, voxels=Voxels()))
        tables |= {"far": far_arrays(without), _TILES: listed}
    plain = {
        "format": FORMAT,
        "version": VERSION,
        "policy": policy_fields(planner.policy),
        "camera": camera_fields(camera),
        "mapping": asdict(planner.config),
    }
    steps = [int(at.name) for at in numbered(folder)]
    number = max(steps, default=-1) + 1
    write_checkpoint(folder / f"{number:06d}", {k: to_storable(v) for k, v in tables.items()})
    # The arrays are complete before the file refers to them: if interrupted, the old planner stays.
    text = json.dumps(sealed(plain | {"arrays": f"{number:06d}"}), indent=2, allow_nan=False)
    files.write_atomic(folder / "planner.json", (text + "\n").encode())
    for old in numbered(folder)[:-1]:
        discard(old)
    remove_other_tiles(folder / _TILES, listed)


def load(
    path: str | Path,
    *,
    tile_folder: str | Path | None = None,
    tile_memory: float | int = TILE_MEMORY,
) -> Planner:
    """Loads a planner written by `save`.

    Args:
        path: its folder.
        tile_folder: as in `start`; None: all tiles are read into memory. Not used by a planner
            without tiles.
        tile_memory: as in `start` [bytes].

    Raises:
        RunError: it is missing, damaged, or of a newer version; names the file.
        ValueError: a policy that is not installed here; a tile folder as in `start`; a tile that is
            missing or damaged.
    """
    folder = Path(path)
    file = folder / "planner.json"
    try:
        plain = parse_json(read_bytes(file, _MAX_BYTES))
    except FileNotFoundError:
        raise RunError(file, "the file is missing: this folder is not a saved planner") from None
    except (OSError, ForeignFileError) as error:
        raise RunError(file, f"the file cannot be read ({error})") from None
    if not isinstance(plain, dict) or plain.get("format") != FORMAT:
        raise RunError(file, f"the file is not a saved planner's (no format {FORMAT!r})")
    if plain.get("version") not in _READ:
        raise RunError(
            file,
            f"version {plain.get('version')!r:.20}, but this r3jax reads up to {VERSION}: "
            "install the one that wrote it",
        )
    try:
        settings = unsealed(plain)
        config = mapping_config_of(settings["mapping"])
        camera = _camera_of(settings["camera"])
        policy = _policy_of(settings["policy"])
        arrays_at = folder / str(settings["arrays"])
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(file, f"a setting cannot be used ({error})") from None
    try:
        stored = read_arrays(arrays_at)
        tables = {name: from_storable(table) for name, table in stored.items()}
        planner = _planner_of(tables, policy, camera, config)
        far = planner.far
        if far is None:
            return planner
        into = None if tile_folder is None else open_tile_folder(tile_folder, tile_memory)
        tiles = replace(far.tiles, folder=into)
        if _TILES in tables:
            voxels = read_tiles(folder / _TILES, tables[_TILES], into, tiles.middle)
            tiles = replace(tiles, voxels=voxels)
        return replace(planner, far=replace(far, tiles=tiles))
    except PathError:
        raise
    except (OSError, ValueError, KeyError, TypeError, ForeignFileError) as error:
        raise RunError(arrays_at, f"the arrays cannot be read ({error})") from None


def _camera_of(plain: dict[str, Any]) -> Camera:
    lens = {name: float(plain[name]) for name in ("fx", "fy", "cx", "cy")}
    return Camera(int(plain["width"]), int(plain["height"]), **lens)


def _policy_of(plain: dict[str, Any]) -> Any:
    key, settings = str(plain.get("class") or plain["name"]), dict(plain["settings"])
    scoring = scoring_config_of(settings.pop("scoring", {}))
    motion = motion_of_record(settings.pop("motion", None))
    known = {field.name for field in fields(config_class(key))}
    unknown = sorted(set(settings) - known)
    if unknown:
        raise InputError(f"the policy has no setting {', '.join(unknown)}")
    return make_policy(key, scoring=scoring, motion=motion, **settings)


def _planner_of(
    tables: dict[str, dict[str, np.ndarray]], policy: Any, camera: Camera, config: MappingConfig
) -> Planner:
    arrays = dict(tables["map"])
    num_bins = int(arrays.pop("num_bins"))
    map_state = fill(
        empty_map(2, config.voxel_size, num_bins, remove_moved="misses" in arrays), arrays
    )
    # Like a grid of one cell; the file lists its optional arrays.
    small = empty_grid(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), config.cell_size)
    optional = {"explorable": bool, "marks": np.uint8}
    extra = {name: jnp.zeros(small.log_odds.shape, kind) for name, kind in optional.items()
             if name in tables["grid"]}  # fmt: skip
    like = OccupancyGrid(small.log_odds, small.origin, small.cell_size, **extra)
    grid = fill(like, tables["grid"])
    first = policy.init(camera, grid, key=jax.random.key(0))
    policy_state = memory_of(first, tables)
    far = far_of(tables["far"], config, camera) if config.tiles else None
    return Planner(map_state, grid, policy_state, policy, config, far=far)
