"""Snapshots of the map and the grid, saved with Orbax."""

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.trace.errors import RunError

KEPT = 3
"""Older snapshots are deleted."""


def _arrays(state: MapState | OccupancyGrid) -> dict[str, Any]:
    return {name: value for name, value in vars(state).items() if isinstance(value, jax.Array)}


def save_checkpoint(folder: Path, step: int, map_state: MapState, grid: OccupancyGrid) -> None:
    """Saves the state after view `step`, then drops all but the newest three.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    import orbax.checkpoint as ocp

    folder.mkdir(exist_ok=True)
    state = {
        "map": _arrays(map_state) | {"num_bins": np.asarray(map_state.num_bins)},
        "grid": _arrays(grid),
    }
    with ocp.StandardCheckpointer() as checkpointer:
        # Orbax writes under a temporary name and renames: a snapshot is whole or absent.
        checkpointer.save((folder / f"{step:06d}").resolve(), state, force=True)
        checkpointer.wait_until_finished()
    for old in _snapshots(folder)[:-KEPT]:
        shutil.rmtree(old)


def _snapshots(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("[0-9]*") if p.is_dir() and p.name.isdigit())


def read_checkpoint(folder: Path) -> tuple[int, MapState, OccupancyGrid]:
    """The newest snapshot: its step, the map and the grid.

    Raises:
        RunError: there is none, or it cannot be read.
    """
    import orbax.checkpoint as ocp

    snapshots = _snapshots(folder)
    if not snapshots:
        raise RunError(folder, "the run has no checkpoint")
    newest = snapshots[-1]
    try:
        with ocp.StandardCheckpointer() as checkpointer:
            target = _abstract(checkpointer.metadata(newest.resolve()))
            state = checkpointer.restore(newest.resolve(), target)
        arrays = jax.tree.map(jnp.asarray, state)
        num_bins = int(arrays["map"].pop("num_bins"))
        map_state = MapState(**arrays["map"], num_bins=num_bins)
        return int(newest.name), map_state, OccupancyGrid(**arrays["grid"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(newest, f"the checkpoint cannot be read ({error})") from None


def _abstract(metadata: Any) -> Any:
    """Shapes and types of what was saved, all on the first device."""
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    to_shape = lambda m: jax.ShapeDtypeStruct(m.shape, m.dtype, sharding=sharding)
    return jax.tree.map(to_shape, metadata.item_metadata.tree)
