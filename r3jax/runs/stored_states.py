"""The loop's state on disk after every view, saved with Orbax in the background.

A checkpoint holds tables of named arrays: `map`, `grid`, `policy` and `loop`, and `far` in a run
with tiles, whose `map` and `grid` are those at hand. It is a cache: frames
and rows suffice to rebuild it. Checkpoints of earlier versions contain only `map` and `grid`.
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
from r3jax.geometry.cameras import Camera
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.mapping.tiles import whole_map
from r3jax.planning.far import far_arrays, far_of
from r3jax.planning.planner import Planner
from r3jax.runs.header import RunError
from r3jax.validation.errors import ForeignFileError

# More than one: if the newest is damaged, an older one still saves most of the mapping.
KEPT = 3
"""Number of checkpoints to keep."""


_APART = ("planner", "leg", "planned")

_LOOP = tuple(field.name for field in fields(LoopState) if field.name not in _APART)
"""Fields of the state in the table `loop`; the planner has its own tables, and an unfinished path
is decided again."""

_LATER = {"captured": np.asarray(0)}
"""Fields missing in the first checkpoints, with their values at that time."""


class CheckpointWriter:
    """Saves checkpoints one after the other in its own thread; each is complete or absent."""

    def __init__(self, folder: Path):
        """Makes the folder and removes leftovers of killed processes.

        Raises:
            OSError: the folder is a link, or cannot be made.
        """
        make_folder(folder)
        self._folder = folder.resolve()  # the thread may outlive a change of folder
        # One thread: two checkpoints at a time would discard each other's elders.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._under_way: Future[None] | None = None

    def save(self, step: int, tables: Tables, *, wait: bool = False) -> bool:
        """Starts to save the state after view `step`, unless the previous one is still being saved.

        Writing a map of gigabytes takes longer than a step: then there is a checkpoint every few
        views, without delaying the mission.

        Args:
            step: number of the view.
            tables: the state; its arrays must not be modified afterwards.
            wait: True waits for the previous one, and for this one.

        Returns:
            True if it is being saved.

        Raises:
            OSError: the previous one, or with `wait` this one, could not be written.
        """
        # Skipping one costs some frames when resuming; waiting would delay the mission.
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
        """Writes a checkpoint, and deletes all but the newest three. Runs in the thread."""
        # The new one is complete before an old one is deleted, so that one always exists.
        write_checkpoint(self._folder / f"{step:06d}", tree)
        for old in numbered(self._folder)[:-KEPT]:
            discard(old)

    def close(self) -> None:
        """Waits and ends the thread. An error of the last checkpoint is ignored."""
        # Frames and rows suffice to rebuild the state.
        with contextlib.suppress(OSError):
            self.wait()
        self._thread.shutdown()


def checkpoint_steps(folder: Path) -> list[int]:
    """Lists the views after which a state is stored, oldest first."""
    return [int(path.name) for path in numbered(folder)]


def load_checkpoint(folder: Path, step: int) -> dict[str, dict[str, np.ndarray]]:
    """Reads the checkpoint after view `step`.

    Raises:
        RunError: it is missing, damaged, or cannot be read.
    """
    path = folder / f"{step:06d}"
    try:
        tables = read_arrays(path)
    except (OSError, ForeignFileError) as error:
        raise RunError(
            path,
            f"the checkpoint cannot be read ({error}); resuming the run rebuilds it",
        ) from None
    # Orbax restores any tree; tables of arrays have two levels.
    if not all(isinstance(table, dict) for table in tables.values()):
        raise RunError(path, "the checkpoint does not hold tables of arrays")
    return {name: from_storable(table) for name, table in tables.items()}


def to_storable(table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Replaces empty arrays, which Orbax refuses, by names that describe them."""

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


def read_checkpoint(
    folder: Path, config: MappingConfig | None = None, camera: Camera | None = None
) -> tuple[int, MapState, OccupancyGrid]:
    """Reads the newest stored map and grid, and the view after which they were stored.

    Args:
        folder: of the checkpoints.
        config: of the run; with its camera needed to join the tiles of a run that has some.
        camera: of the run.

    Raises:
        RunError: there is none, or it cannot be read.
    """
    steps = checkpoint_steps(folder)
    if not steps:
        raise RunError(folder, "the run has no checkpoint")
    tables = load_checkpoint(folder, steps[-1])
    try:
        arrays: dict[str, Any] = {name: jnp.asarray(x) for name, x in tables["map"].items()}
        # It is static in MapState, not an array.
        num_bins = int(arrays.pop("num_bins"))
        map_state = MapState(**arrays, num_bins=num_bins)
        grid = OccupancyGrid(**{name: jnp.asarray(x) for name, x in tables["grid"].items()})
        if "far" in tables and config is not None and camera is not None:
            far = far_of(tables["far"], config, camera)
            map_state, grid = whole_map(map_state, far.tiles), far.whole_grid(grid)
        return steps[-1], map_state, grid
    except (ValueError, KeyError, TypeError) as error:
        path = folder / f"{steps[-1]:06d}"
        raise RunError(path, f"the checkpoint cannot be read ({error})") from None


def map_tables(map_state: MapState, grid: OccupancyGrid) -> dict[str, dict[str, np.ndarray]]:
    """Returns the tables `map` and `grid` of a checkpoint."""
    num_bins = {"num_bins": np.asarray(map_state.num_bins)}
    return {"map": named_arrays(map_state) | num_bins, "grid": named_arrays(grid)}


def planner_tables(planner: Planner) -> dict[str, dict[str, np.ndarray]]:
    """Returns the tables `map`, `grid`, `policy`, and with tiles `far`."""
    tables = map_tables(planner.map_state, planner.grid)
    tables["policy"] = named_arrays(planner.policy_state)
    return tables if planner.far is None else tables | {"far": far_arrays(planner.far)}


def state_tables(state: LoopState) -> dict[str, dict[str, np.ndarray]]:
    """Returns the tables of a checkpoint of the state."""
    tables = planner_tables(state.planner)
    return tables | {"loop": {name: np.asarray(getattr(state, name)) for name in _LOOP}}


def newest_state(folder: Path, rows: Sequence[StepRow], start: LoopState) -> LoopState:
    """Reads the newest usable checkpoint; returns the start if there is none.

    Args:
        folder: of the checkpoints.
        rows: of the run, possibly interrupted anywhere.
        start: the state before the first view; everything but the arrays is taken from it.
    """
    # Newest first: every view after a checkpoint costs one more mapping and decision.
    for step in reversed(checkpoint_steps(folder)):
        # The trace was cut before it: its map contains views that the run no longer has. Or a path
        # is unfinished: it is decided again from its start.
        if step >= len(rows) or rows[step].captured:
            continue
        try:
            state = state_of(load_checkpoint(folder, step), start)
        except ValueError:
            continue  # an older one, or the frames, suffice
        row = rows[step]
        # Exact: JSON and checkpoints store floats exactly, so that any difference is a mismatch.
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
        like: a state of the same run, such as its first, for everything but arrays.

    Raises:
        ValueError: a table or an array is missing or of another type.
    """
    _check_tables(tables, "map", "grid", "loop")
    # With `fill`, so that totals are plain numbers again.
    rest = {name: getattr(like, name) for name in _LOOP}
    planner = replace(
        known_of(tables, like.planner),
        policy_state=memory_of(like.policy_state, tables),
    )
    return LoopState(planner=planner, **fill(rest, _LATER | dict(tables["loop"])))


def known_of(tables: Tables, like: Planner) -> Planner:
    """Restores all but a planner's memory from the tables of `planner_tables`.

    Args:
        tables: of a checkpoint.
        like: a planner of the same run.

    Raises:
        ValueError: a table or an array is missing or of another type.
    """
    _check_tables(tables, "map", "grid", *(() if like.far is None else ("far",)))
    arrays = dict(tables["map"])
    # Not an array of the map, so `fill` would not notice: with other bins the visited bits mean
    # other directions.
    if int(arrays.pop("num_bins", -1)) != like.map_state.num_bins:
        raise InputError("the checkpoint's map has other direction bins than the run")
    far = like.far
    if far is not None:
        try:
            far = far_of(tables["far"], like.config, like.policy_state.camera)
        except KeyError as error:
            raise InputError(f"the checkpoint's tiles are missing {error}") from None
    return replace(
        like,
        map_state=fill(like.map_state, arrays),
        grid=fill(like.grid, tables["grid"]),
        far=far,
    )


def _check_tables(tables: Tables, *names: str) -> None:
    missing = sorted(set(names) - set(tables))
    if missing:
        raise InputError(f"the checkpoint is missing {', '.join(missing)}")


def memory_of(like: Any, tables: Tables) -> Any:
    """Restores a policy's memory from the tables of a state, like `fill`."""
    arrays = dict(tables.get("policy", {}))  # a policy without memory has no such table
    driven = getattr(like, "driven", None)
    if driven is not None:  # checkpoints of the first robots on the floor do not have it
        arrays.setdefault("driven", driven)
    return fill(like, arrays)


def named_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Returns every leaf of a tree by its path in it, such as `memory.of_stage.0.left`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): np.asarray(leaf) for path, leaf in leaves}


def fill(template: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Fills a tree like `template` with the leaves `arrays`: the inverse of `named_arrays`.

    Shapes may differ from the template's, as tables grow; types may not.

    Args:
        template: gives the structure, everything but arrays, and the type of each leaf.
        arrays: by path.

    Raises:
        ValueError: a leaf is missing, of another type, or there is one too many.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [_name(path) for path, _ in leaves]
    # An extra array means another version of the policy, whose memory would be incomplete.
    if set(names) != set(arrays):
        odd = sorted(set(names) ^ set(arrays))
        raise InputError(f"these arrays are missing or unexpected: {', '.join(odd)}")
    filled = [
        _like(leaf, arrays[name], name) for name, (_, leaf) in zip(names, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, filled)


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".") or "value"


def _like(leaf: Any, array: np.ndarray, name: str) -> Any:
    """Converts the array to the type of the leaf: a device array, NumPy, or a number."""
    wanted = np.asarray(leaf)
    # Sizes may differ, as tables double; types and axes may not, as compiled code depends on them.
    if array.dtype != wanted.dtype or array.ndim != wanted.ndim:
        raise InputError(
            f"{name} is {array.dtype} with {array.ndim} axes, expected {wanted.dtype} with "
            f"{wanted.ndim}"
        )
    if isinstance(leaf, jax.Array):
        return jnp.asarray(array)
    if isinstance(leaf, np.ndarray | np.generic):
        return array
    # A Python number: as an array it would be traced where the loop needs a plain value.
    return type(leaf)(array.item())
