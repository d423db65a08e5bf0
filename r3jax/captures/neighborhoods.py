"""Divides a capture into neighborhoods, so that an image costs what is in its range.

Adding an image to a map of a building, or asking what it shows, passes over every row: at four
million of them that takes ten times as long as in a room. So cameras are divided into cubes, and
each step works on a table of the surfaces within range of the cameras of one cube. Exact: a row
beyond the range of all of them is neither measured nor seen, and hides nothing.

A capture that fits into a few cubes is one neighborhood, whose table is the map itself.

Shape symbols: n cameras; N rows of the whole map; M rows of a neighborhood's table.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Int

from r3jax.geometry.cameras import Camera
from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.mapping.state import MapState
from r3jax.mapping.tiles import longest_ray, table_from
from r3jax.mapping.update import MAX_LOAD

_TOGETHER = 4.0
"""Cameras that fit into a box with edges of this many ranges are one neighborhood. All others are
divided into cubes with edges of one range."""


def divided(eyes: np.ndarray, max_range: float) -> list[np.ndarray]:
    """Divides cameras [n, 3] into neighborhoods; returns the indices of each, ascending."""
    if not len(eyes) or (np.ptp(eyes, axis=0) <= _TOGETHER * max_range).all():
        return [np.arange(len(eyes))]
    cube = np.floor((eyes - eyes.min(axis=0)) / max_range)
    _, number = np.unique(cube, axis=0, return_inverse=True)
    number = number.reshape(-1)
    return np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])


@dataclass(frozen=True)
class Neighborhood:
    """Some cameras near each other, and the part of a map within their range."""

    numbers: np.ndarray
    """Indices of the cameras, ascending."""

    state: MapState
    """Table of the rows within range."""

    row: np.ndarray
    """Row of the whole map that each row of the table holds, [M] int64; N for empty rows."""

    is_whole: bool = False
    """True if the table is the whole map."""

    def part_of(self, state: MapState) -> MapState:
        """Takes the table's rows from a map with the rows of the whole map."""
        if self.is_whole:
            return state
        return _taken(state, self.row)

    def put_into(self, state: MapState, part: MapState) -> MapState:
        """Puts the table's rows back into a map with the rows of the whole map, which is used up.

        Args:
            state: the map that `part_of` has read.
            part: its rows, changed.
        """
        if self.is_whole:
            return part
        into, new = ({name: getattr(x, name) for name in _FIELDS} for x in (state, part))
        return replace(state, **_put(into, new, self.row), dropped=part.dropped)


_FIELDS = ("visited", "count", "mean", "m2", "resolution")
"""What a map knows of its voxels."""


@jax.jit
def _taken(state: MapState, row: Int[Array, " M"]) -> MapState:
    def at(x: Array, empty: int = 0) -> Array:
        return x.at[..., row].get(mode="fill", fill_value=empty)

    fields = {name: at(getattr(state, name)) for name in _FIELDS}
    return replace(state, **fields, key=at(state.key, EMPTY_WORD))


@partial(jax.jit, donate_argnums=0)
def _put(into: dict[str, Array], new: dict[str, Array], row: Int[Array, " M"]) -> dict[str, Array]:
    return {name: x.at[..., row].set(new[name], mode="drop") for name, x in into.items()}


def neighborhoods(
    whole: MapState,
    eyes: np.ndarray,
    cameras: Iterable[Camera],
    max_range: float,
    *,
    for_lookups: bool = True,
) -> Iterator[Neighborhood]:
    """Yields the neighborhoods of cameras in the order of `divided`, with tables of one capacity.

    Args:
        whole: the map.
        eyes: camera centers, [n, 3].
        cameras: their lenses.
        max_range: surfaces farther than this from a camera do not count.
        for_lookups: False if the tables are only seen and scored, and no frame joins them: then
            they are made in a third of the time.
    """
    groups = divided(eyes, max_range)
    if len(groups) == 1:
        rows = np.arange(whole.capacity)
        own = np.where(np.asarray(whole.occupied), rows, whole.capacity)
        yield Neighborhood(groups[0], whole, own, is_whole=True)
        return
    # A range is a depth for pixels: in the corner of an image they are farther away.
    lenses = {id(camera): camera for camera in cameras}.values()
    reach = max_range * max(map(longest_ray, lenses)) + 2.0 * float(whole.voxel_size)
    near = _Near(whole)
    most = max(len(near(eyes[group], reach)) for group in groups)
    capacity = 1 << max(12, math.ceil(math.log2(max(most, 1) / MAX_LOAD)))
    for group in groups:
        rows = near(eyes[group], reach)
        if for_lookups:
            yield Neighborhood(group, *table_from(whole, rows, capacity))
        else:
            row = np.concatenate([rows, np.full(capacity - len(rows), whole.capacity)])
            yield Neighborhood(group, _taken(whole, row), row)


class _Near:
    """Finds the rows of a map in boxes."""

    def __init__(self, state: MapState):
        """Sorts the rows along x."""
        rows = np.flatnonzero(np.asarray(state.occupied))
        center = np.asarray(state.center)[:, rows]
        order = np.argsort(center[0], kind="stable")
        self._rows, self._center = rows[order], center[:, order]

    def __call__(self, eyes: np.ndarray, reach: float) -> np.ndarray:
        """Finds the rows within the box of some cameras and a reach around it."""
        low, high = eyes.min(axis=0) - reach, eyes.max(axis=0) + reach
        slab = slice(*np.searchsorted(self._center[0], [low[0], high[0]]))
        y, z = self._center[1:, slab]
        is_in = (y >= low[1]) & (y <= high[1]) & (z >= low[2]) & (z <= high[2])
        return self._rows[slab][is_in]
