"""The loop's state on disk after every view, saved with Orbax in the background.

A checkpoint holds tables of named arrays: `map`, `grid`, `policy` and `loop`. It is a short cut,
never the only copy: frames and rows rebuild all of it. Checkpoints of earlier versions of this
package hold `map` and `grid` only.
"""

import contextlib
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.checkpoints import (
    Tables,
    discard,
    make_folder,
    numbered,
    read_arrays,
    write_checkpoint,
)
from r3jax.errors import InputError
from r3jax.exploration.state import LoopState
from r3jax.exploration.taken_views import StepRow
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.runs.header import RunError
from r3jax.validation.errors import ForeignFileError

# Not one: if the newest is damaged, an older one still saves most of the mapping.
KEPT = 3
"""Older checkpoints are deleted."""


_APART = ("planner", "leg", "planned")

_LOOP = tuple(field.name for field in fields(LoopState) if field.name not in _APART)
"""Fields of the state in the table `loop`; what the planner holds has tables of its own, and what
is under way is decided again."""

_LATER = {"captured": np.asarray(0)}
"""Fields that came after the first checkpoints, as they were then."""


class CheckpointWriter:
    """Saves checkpoints one after the other in a thread of its own; each is whole or absent."""

    def __init__(self, folder: Path):
        """Makes the folder and clears away what a killed process left behind.

        Raises:
            OSError: the folder is a link, or cannot be made.
        """
        make_folder(folder)
        self._folder = folder.resolve()  # the thread may outlive a change of folder
        # One thread: two checkpoints at a time would discard each other's elders.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._under_way: Future[None] | None = None

    def save(self, step: int, tables: Tables, *, wait: bool = False) -> bool:
        """Begins to save the state after view `step`, unless the one before is still being saved.

        A map of gigabytes takes longer to write than a step takes: then there is a checkpoint
        every few views, and the mission is not held up.

        Args:
            step: number of the view.
            tables: the state; its arrays must not be written afterwards.
            wait: True waits for the one before, and for this one.

        Returns:
            Whether it is being saved.

        Raises:
            OSError: the one before, or with `wait` this one, could not be written.
        """
        # Leaving one out costs some frames at a resume; waiting would cost time of the mission.
        if self._under_way is not None and not wait and not self._under_way.done():
            return False
        self.wait()  # it is done, but may have failed: this is where the loop hears of it
        # Orbax refuses a tree without leaves, such as the memory of a policy that keeps none.
        tree = {name: to_storable(table) for name, table in tables.items() if table}
        self._under_way = self._thread.submit(self._write, step, tree)
        if wait:
            self.wait()
        return True

    def wait(self) -> None:
        """Waits until the checkpoint in progress is complete.

        Raises:
            OSError: it could not be written.
        """
        # Cleared before its result is read, so that a failed write is reported once.
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.result()

    def _write(self, step: int, tree: dict[str, dict[str, np.ndarray]]) -> None:
        """In the thread: writes one and discards all but the newest three."""
        # The new one is whole before an old one goes, so that there is always one to resume from.
        write_checkpoint(self._folder / f"{step:06d}", tree)
        for old in numbered(self._folder)[:-KEPT]:
            discard(old)

    def close(self) -> None:
        """Waits and ends the thread. What `wait` would say of the last one is lost."""
        # Nothing is lost with it: frames and rows rebuild the state.
        with contextlib.suppress(OSError):
            self.wait()
        self._thread.shutdown()


def checkpoint_steps(folder: Path) -> list[int]:
    """Lists the views after which a state is stored, oldest first."""
    return [int(path.name) for path in numbered(folder)]


def load_checkpoint(folder: Path, step: int) -> dict[str, dict[str, np.ndarray]]:
    """Reads the tables that were stored after view `step`.

    Raises:
        RunError: it is not there, damaged, or it cannot be read.
    """
    path = folder / f"{step:06d}"
    try:
        tables = read_arrays(path)
    except (OSError, ForeignFileError) as error:
        raise RunError(
            path,
            f"the checkpoint cannot be read ({error}); resuming the run rebuilds it",
        ) from None
    # Orbax restores any tree; only two levels are tables of arrays.
    if not all(isinstance(table, dict) for table in tables.values()):
        raise RunError(path, "the checkpoint does not hold tables of arrays")
    return {name: from_storable(table) for name, table in tables.items()}


def to_storable(table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Replaces arrays without elements, which Orbax refuses, by names that say what they are."""

    def named(name: str, x: np.ndarray) -> str:
        return name if x.size else f"{name} empty {x.dtype.str} {list(x.shape)}"

    return {named(name, x): x if x.size else np.zeros(1, np.uint8) for name, x in table.items()}


def from_storable(table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Undoes `to_storable`."""
    arrays: dict[str, np.ndarray] = {}
    for full_name, array in table.items():
        name, is_empty, rest = full_name.partition(" empty ")
        if is_empty:
            dtype, _, shape = rest.partition(" ")
            array = np.zeros(json.loads(shape), np.dtype(dtype))
        arrays[name] = np.asarray(array)
    return arrays


def read_checkpoint(folder: Path) -> tuple[int, MapState, OccupancyGrid]:
    """Reads the newest stored map and grid, and the view after which they were stored.

    Raises:
        RunError: there is none, or it cannot be read.
    """
    steps = checkpoint_steps(folder)
    if not steps:
        raise RunError(folder, "the run has no checkpoint")
    tables = load_checkpoint(folder, steps[-1])
    try:
        arrays: dict[str, Any] = {name: jnp.asarray(x) for name, x in tables["map"].items()}
        # It is static in MapState, a part of what is compiled, and no array there.
        num_bins = int(arrays.pop("num_bins"))
        grid = {name: jnp.asarray(x) for name, x in tables["grid"].items()}
        return steps[-1], MapState(**arrays, num_bins=num_bins), OccupancyGrid(**grid)
    except (ValueError, KeyError, TypeError) as error:
        path = folder / f"{steps[-1]:06d}"
        raise RunError(path, f"the checkpoint cannot be read ({error})") from None


def map_tables(map_state: MapState, grid: OccupancyGrid) -> dict[str, dict[str, np.ndarray]]:
    """Returns the tables `map` and `grid` of a checkpoint."""
    num_bins = {"num_bins": np.asarray(map_state.num_bins)}
    return {"map": named_arrays(map_state) | num_bins, "grid": named_arrays(grid)}


def state_tables(state: LoopState) -> dict[str, dict[str, np.ndarray]]:
    """Returns the tables that a checkpoint of the state contains."""
    tables = map_tables(state.map_state, state.grid)
    tables["policy"] = named_arrays(state.policy_state)
    return tables | {"loop": {name: np.asarray(getattr(state, name)) for name in _LOOP}}


def newest_state(folder: Path, rows: Sequence[StepRow], start: LoopState) -> LoopState:
    """Reads the newest stored state that can be used; returns the start if there is none.

    Args:
        folder: of the checkpoints.
        rows: of the run, which may have been cut off anywhere.
        start: the state before the first view; everything but the arrays is taken from it.
    """
    # Newest first: every view after a checkpoint costs one more mapping and decision.
    for step in reversed(checkpoint_steps(folder)):
        # The trace was cut before it: its map holds views that the run no longer has. Or a path is
        # under way: it is decided again, from where it begins.
        if step >= len(rows) or rows[step].captured:
            continue
        try:
            state = state_of(load_checkpoint(folder, step), start)
        except ValueError:
            continue  # an older one, or the frames, will do
        row = rows[step]
        # Exact: JSON and checkpoints hold every float as it is, so any difference is a mismatch.
        if (
            state.views == row.step + 1
            and np.array_equal(np.asarray(state.T_world_camera, np.float32), row.pose)
            and (state.seconds, state.metres) == (row.seconds, row.metres)
        ):
            return state
    return start


def state_of(tables: Tables, like: LoopState) -> LoopState:
    """Restores a state from the tables of `state_tables`.

    Args:
        tables: of a checkpoint.
        like: a state of the same run, such as its first: what is not an array is taken from it.

    Raises:
        ValueError: a table or an array is missing or of another kind.
    """
    # Not `policy`: a policy that remembers nothing has no such table.
    missing = sorted({"map", "grid", "loop"} - set(tables))
    if missing:
        raise InputError(f"the checkpoint is missing {', '.join(missing)}")
    arrays = dict(tables["map"])
    # No array of the map, so `fill` would not notice: with other bins the visited bits of a row
    # stand for other directions.
    if int(arrays.pop("num_bins", -1)) != like.map_state.num_bins:
        raise InputError("the checkpoint's map has other direction bins than the run")
    # Through `fill`, so that totals come back as plain numbers and are summed as before.
    rest = {name: getattr(like, name) for name in _LOOP}
    planner = replace(
        like.planner,
        map_state=fill(like.map_state, arrays),
        grid=fill(like.grid, tables["grid"]),
        policy_state=fill(like.policy_state, tables.get("policy", {})),
    )
    return LoopState(planner=planner, **fill(rest, _LATER | dict(tables["loop"])))


def named_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Returns every leaf of a tree by its path in it, such as `memory.of_stage.0.left`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): np.asarray(leaf) for path, leaf in leaves}


def fill(template: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Fills a tree built like `template` with the leaves `arrays`: the inverse of `named_arrays`.

    Shapes may differ from the template's, as tables grow; types may not.

    Args:
        template: gives the structure, all that is not an array, and the type of each leaf.
        arrays: by path.

    Raises:
        ValueError: a leaf is missing, of another type, or there is one too many.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [_name(path) for path, _ in leaves]
    # One array too many means another version of the policy: its memory would be half understood.
    if set(names) != set(arrays):
        odd = sorted(set(names) ^ set(arrays))
        raise InputError(f"these arrays are missing or of no use: {', '.join(odd)}")
    filled = [
        _like(leaf, arrays[name], name) for name, (_, leaf) in zip(names, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, filled)


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".") or "value"


def _like(leaf: Any, array: np.ndarray, name: str) -> Any:
    """Converts the array to the kind of the leaf: a device array, NumPy, or a number."""
    wanted = np.asarray(leaf)
    # Sizes may differ, as tables double; a type or an axis may not, as compiled code rests on them.
    if array.dtype != wanted.dtype or array.ndim != wanted.ndim:
        raise InputError(
            f"{name} is {array.dtype} with {array.ndim} axes, expected {wanted.dtype} with "
            f"{wanted.ndim}"
        )
    if isinstance(leaf, jax.Array):
        return jnp.asarray(array)
    if isinstance(leaf, np.ndarray | np.generic):
        return array
    # A Python number: as an array it would be traced where the loop wants a plain value.
    return type(leaf)(array.item())
