"""Training on a growing set of views, with new Gaussians for the surfaces that they show.

Shape symbols: n rows of the scene; m newborn Gaussians.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from r3jax.splatting.training.optimizer import forget
from r3jax.splatting.training.train_step import TrainState
from r3jax.splatting.views import Views


class Addition(NamedTuple):
    """Views and Gaussians to continue with."""

    views: Views
    """Keeps the number and the size of those before: another number would recompile the step."""

    newborn: GaussianScene | None = None
    """Gaussians that join, of the scene's harmonics; unused rows count for nothing."""


class Growth(NamedTuple):
    """When to add views."""

    every: int
    """Steps between two additions."""

    add: Callable[[int, GaussianScene], Addition]
    """Called with the number of steps and the scene, which must not be stored: the next step
    donates its buffers."""


def with_newborn(state: TrainState, newborn: GaussianScene) -> TrainState:
    """Adds Gaussians in unused rows, without moments; those without a free row are counted."""
    is_born = np.asarray(newborn.is_alive)
    free = np.flatnonzero(~np.asarray(state.scene.is_alive))
    # Past the end where there is no room, and for rows that are not in use: dropped.
    rank = np.cumsum(is_born) - 1
    has_room = is_born & (rank < len(free))
    row = np.full(len(is_born), state.scene.capacity)
    row[has_room] = free[rank[has_room]]
    put = lambda x, y: x.at[jnp.asarray(row)].set(y, mode="drop")
    scene = jax.tree.map(put, state.scene, newborn)
    is_new = np.zeros(state.scene.capacity, dtype=bool)
    is_new[row[has_room]] = True
    lost = jnp.asarray(int(is_born.sum() - has_room.sum()), dtype=jnp.int32)
    return TrainState(
        scene=scene,
        moments=forget(state.moments, jnp.asarray(is_new)),
        statistics=state.statistics,
        step=state.step,
        dropped=state.dropped + lost,
    )


def where_new(newborn: GaussianScene, scene: GaussianScene) -> GaussianScene:
    """Keeps the Gaussians that are farther from all of a scene than they are large.

    Args:
        newborn: round Gaussians, as `initialize` makes them.
        scene: what is there already.
    """
    there = np.asarray(scene.means)[np.asarray(scene.is_alive)]
    if len(there) == 0:
        return newborn
    distance, _ = KDTree(there).query(np.asarray(newborn.means), workers=-1)
    is_known = distance < np.exp(np.asarray(newborn.log_scales)[:, 0])
    logits = jnp.where(jnp.asarray(is_known), DEAD_LOGIT, newborn.opacity_logits)
    return eqx.tree_at(lambda s: s.opacity_logits, newborn, logits)
