"""Maps corrected key frames again, after a loop closure: what a voxel has seen cannot be moved."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.arguments import checked
from r3jax.planning.planner import Planner, a_planner, first_map, mark_starts, take_in

_END: Any = object()


@checked(planner=a_planner)
def rebuild(
    planner: Planner,
    frames: Iterable[Frame],
    *,
    starts: Iterable[ArrayLike] | None = None,
    key: Array | None = None,
) -> Planner:
    """Returns a planner of the same settings that has observed these frames instead.

    As `start` and then `observe` of each frame, in a map as large as the present one: nothing is
    compiled for another size in the middle. The planner that is given stays as it is and may go on
    observing and deciding in another thread, until the new one takes its place:

        future = executor.submit(r3jax.rebuild, planner, corrected)
        ...
        if future.done():
            planner = future.result()

    Args:
        planner: whose bounds, policy and settings stay.
        frames: key frames with corrected poses, in order, at least one. They may be read from a
            disk: of an iterator the next frame is read while one is mapped.
        starts: as in `start`; None: the place of the first frame.
        key: as in `start`.

    Raises:
        ValueError: no frame.
    """
    frames = _read_ahead(frames)
    first = next(frames, None)
    if first is None:
        raise InputError("rebuild needs at least one frame")
    starts = [np.asarray(first.T_world_camera)] if starts is None else starts
    unknown = jnp.zeros_like(planner.grid.log_odds)
    grid = eqx.tree_at(lambda g: g.log_odds, planner.grid, unknown)
    grid = mark_starts(grid, starts, planner.config)
    config = replace(planner.config, capacity=planner.map_state.capacity)
    key = jax.random.key(0) if key is None else key
    policy_state = planner.policy.init(first.camera, grid, key=key)
    after = replace(planner, map_state=first_map(config), grid=grid, policy_state=policy_state)
    after = take_in(after, first)
    for frame in frames:
        after = take_in(after, frame)
    return after


def _read_ahead(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yields the same frames, each read in a thread while the one before it is used."""
    frames = iter(frames)
    with ThreadPoolExecutor(1, thread_name_prefix="frames") as reader:
        coming = reader.submit(next, frames, _END)
        while (frame := coming.result()) is not _END:
            coming = reader.submit(next, frames, _END)
            yield frame
