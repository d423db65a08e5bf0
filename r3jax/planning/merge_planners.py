"""Merges what several planners have mapped of one place: robots or processes that join."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from r3jax.errors import InputError
from r3jax.mapping.tiles import World, merge_worlds
from r3jax.planning.far import Far, layers_of, merged_far, with_layers
from r3jax.planning.planner import Planner, a_planner


def merge_planners(planners: Iterable[Planner]) -> Planner:
    """Merges what several planners with tiles have mapped of one place.

    Voxels are merged by the rule of `merge`, tile by tile: no table holds the whole place, and
    tiles that only one of them has are taken as they are. In the grid log-odds add up. Views left
    for later, paths, refused goals and zones are those of all. Give each frame to one planner only,
    or it counts twice.

    Args:
        planners: started with the same camera, bounds and settings, at least one. The first one's
            policy, costmap, place and tile folder are those of the result.

    Returns:
        A new planner; the given ones are unchanged.

    Raises:
        ValueError: no planner, one without tiles, or settings that differ.
        PathError: a tile on disk is missing or damaged, or cannot be written.
    """
    planners = list(planners)
    for planner in planners:
        a_planner("planners", planner)
    if not planners:
        raise InputError("merge_planners needs at least one planner")
    first, fars = planners[0], [_far_of(planner) for planner in planners]
    for i, (planner, far) in enumerate(zip(planners[1:], fars[1:], strict=True), 1):
        same = {
            "maps (MappingConfig)": replace(planner.config, capacity=first.config.capacity)
            == first.config,
            "tiles (the camera of start)": far.tiles.lattice == fars[0].tiles.lattice,
            "bounds": np.array_equal(far.box, fars[0].box),
            "policies": planner.policy.name == first.policy.name,
        }
        if not all(same.values()):
            different = ", ".join(name for name, is_same in same.items() if not is_same)
            raise InputError(
                f"planners 0 and {i} differ in {different}: start them with the same values"
            )
    worlds = [_world_of(planner, far) for planner, far in zip(planners, fars, strict=True)]
    map_state, layers, tiles = merge_worlds(worlds)
    far = merged_far(fars, tiles)
    memory = with_layers(first.policy_state, layers, far)
    if memory.driven is not None:
        memory = replace(memory, driven=np.concatenate([p.policy_state.driven for p in planners]))
    return replace(
        first,
        map_state=map_state,
        grid=far.grid(layers["log_odds"]),
        policy_state=memory,
        far=far,
    )


def _far_of(planner: Planner) -> Far:
    if planner.far is None:
        raise InputError(
            "merge_planners is for planners with tiles (start without bounds, or with "
            "MappingConfig(tiles=True)): merge the maps of others with r3jax.merge"
        )
    return planner.far


def _world_of(planner: Planner, far: Far) -> World:
    return planner.map_state, layers_of(planner.grid, planner.policy_state), far.tiles
