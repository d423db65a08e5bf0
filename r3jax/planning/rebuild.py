"""Rebuilds the map from corrected key frames after a loop closure: voxels cannot be moved."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from r3jax.errors import InputError
from r3jax.frame import Frame, read_ahead
from r3jax.geometry.arguments import checked
from r3jax.mapping.tile_files import Voxels
from r3jax.planning.decide import GreedyPolicy
from r3jax.planning.far import NO_VIEWS
from r3jax.planning.planner import Planner, a_planner, first_map, mark_starts, take_in


@checked(planner=a_planner)
def rebuild(
    planner: Planner,
    frames: Iterable[Frame],
    *,
    starts: Iterable[ArrayLike] | None = None,
    key: Array | None = None,
) -> Planner:
    """Returns a planner with the same settings that has observed these frames instead.

    As `start` and then `observe` of each frame, in a map as large as the present one: so that
    nothing is recompiled. The given planner is unchanged; it can continue to observe and decide in
    another thread until the new one replaces it:

        future = executor.submit(r3jax.rebuild, planner, corrected)
        ...
        if future.done():
            planner = future.result()

    Args:
        planner: its bounds, policy and settings are used.
        frames: key frames with corrected poses, in order, at least one. May be an iterator that
            reads them from disk: the next frame is read while one is mapped.
        starts: as in `start`; None: the place of the first frame.
        key: as in `start`.

    Raises:
        ValueError: no frame.
    """
    frames = read_ahead(frames)
    first = next(frames, None)
    if first is None:
        raise InputError("rebuild needs at least one frame")
    starts = [np.asarray(first.T_world_camera)] if starts is None else starts
    unknown, far = jnp.zeros_like(planner.grid.log_odds), planner.far
    grid = eqx.tree_at(lambda g: g.log_odds, planner.grid, unknown)
    if far is not None:
        # Trails and views were found on poses that were wrong.
        tiles = replace(far.tiles, voxels=Voxels(), cells={})
        coarse = replace(far.coarse, tiles={}, links={})
        far = replace(far, tiles=tiles, coarse=coarse, trails=far.trails[:0], views=NO_VIEWS,
                      left=None, goal=far.goal[:0], tried=far.tried[:0])  # fmt: skip
    grid = mark_starts(grid, starts, planner.config)
    config = replace(planner.config, capacity=planner.map_state.capacity)
    key = jax.random.key(0) if key is None else key
    policy_state = planner.policy.init(first.camera, grid, key=key)
    after = replace(
        planner, map_state=first_map(config), grid=grid, policy_state=policy_state, far=far
    )
    # Between two frames no one else has this planner. A policy that is not ours may keep the map.
    owned = isinstance(planner.policy, GreedyPolicy)
    for frame in chain([first], frames):
        after = take_in(after, frame, donate=owned)
    return after
