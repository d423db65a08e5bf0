"""Maps a capture for cross-validation: a map of all images, and one for each fold.

An image must not be in the map on which it is scored, and frames cannot be removed from a map. The
images are therefore divided into folds, and every fold gets its own map over *the same rows*:

    1. all images join one map, which gives the surfaces;
    2. each image joins the map of its fold, which starts empty with the rows of the first map.
       The surfaces of all images determine which voxels are in view (`mark_seen`).

Maps with the same rows are merged row by row, so the map without a fold is the union of the other
folds. No result depends on the order of the images.

Shape symbols: N rows; F folds.
"""

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.captures.neighborhoods import Neighborhood, divided, neighborhoods
from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import Source
from r3jax.captures.survey import LARGEST_VOXEL, MARGIN, RANGE, Survey
from r3jax.errors import InputError
from r3jax.frame import Frame, read_ahead
from r3jax.kernels import calls
from r3jax.kernels.constants import LOG_ODDS_LIMIT
from r3jax.kernels.native.platform import by_platform
from r3jax.mapping.join import combine_moments
from r3jax.mapping.occupancy import (
    VOUCHED_LOG_ODDS,
    OccupancyGrid,
    empty_grid,
    integrate_depth,
)
from r3jax.mapping.seen import hidden_by_none, mark_seen
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.tiles import Union
from r3jax.mapping.update import MAX_LOAD, add_pixels, for_kernels, update_growing, with_rows

_CAPACITY = 1 << 15
_MOST_ROWS = 1 << 22
"""Maximum number of rows, so that the folds fit into memory."""

_SPARSE_REACH = 1.1
"""Without depth images, an image sees this many times as far as its farthest point."""


_integrate_depth = jax.jit(integrate_depth)


class TooManyVoxelsError(InputError):
    """A capture of more voxels than fit into memory in all folds."""


OnFrame = Callable[[], None]
"""Callback after each image; each image is processed twice."""

_COARSER = 1.5
"""Least factor of the voxel size for a place of too many voxels: 2.25 times fewer hold its
surfaces."""

Mapped = TypeVar("Mapped")

Window = tuple[int, int, int]
"""Number of cells along each axis."""


def in_fitting_voxels(
    survey: Survey,
    settings: SurveySettings,
    make: Callable[[Survey, OnFrame], Mapped],
    on_frame: OnFrame = lambda: None,
) -> tuple[Survey, Mapped]:
    """Makes a map, in larger voxels where the user leaves that open and the place is large.

    The next size is that in which all images would fit if the others show as much as those so far.

    Args:
        survey: the images to use and the resolution.
        settings: the user's choices.
        make: makes the map from all images; called again after an overflow.
        on_frame: progress callback.

    Raises:
        TooManyVoxelsError: the user's voxels are too small, or the largest are.
    """
    done = 0

    def counted() -> None:
        nonlocal done
        done += 1
        on_frame()

    while True:
        done = 0
        try:
            return survey, make(survey, counted)
        except TooManyVoxelsError:
            size = survey.voxel_size
            if settings.voxel_size is not None or _COARSER * size > LARGEST_VOXEL:
                raise
            factor = max(_COARSER, math.sqrt(len(survey.chosen) / max(done, 1)))
            survey = survey.with_voxels(min(factor * size, LARGEST_VOXEL))


@dataclass(frozen=True)
class Seen:
    """Maps of everything that the images show."""

    state: MapState
    """Map of all images."""

    grid: OccupancyGrid
    """Free and occupied space, from depth images or from the rays to single points."""

    folds: tuple[MapState, ...]
    """Maps of the images of each fold, on the rows of `state`."""

    fold_of: np.ndarray
    """Fold of each image used, in the order of `Survey.chosen`."""

    def without(self, fold: int) -> MapState:
        """Merges the maps of all folds but one."""
        return united([part for i, part in enumerate(self.folds) if i != fold])


def see(source: Source, survey: Survey, folds: int, on_frame: OnFrame = lambda: None) -> Seen:
    """Reads every image twice and maps it.

    Args:
        source: the images.
        survey: the images to use and the resolution.
        folds: number of folds; with fewer images, one for each image.
        on_frame: progress callback.

    Raises:
        FormatError, RunError: a file is missing or broken.
        ValueError: there are more voxels than with any reasonable voxel size.
    """
    whole, grid = _surfaces(source, survey, on_frame)
    count = min(folds, len(survey.chosen))
    parts = [blank(whole) for _ in range(count)]
    fold_of = np.arange(len(survey.chosen)) % count
    order = np.concatenate(divided(eyes_of(source, survey), RANGE))
    numbers = survey.chosen[order].tolist()
    frames = read_ahead(source.frame(index, survey.alignment) for index in numbers)
    for near in neighborhoods_of(whole, source, survey, for_lookups=True):
        own = [near.part_of(part) for part in parts]
        for fold, frame in zip(fold_of[near.numbers], frames, strict=False):
            own[fold] = join_frame(own[fold], near.state, source, frame)
            on_frame()
        parts = [near.put_into(part, new) for part, new in zip(parts, own, strict=True)]
    return Seen(united(parts), grid, tuple(parts), fold_of)


def neighborhoods_of(
    whole: MapState, source: Source, survey: Survey, *, for_lookups: bool
) -> Iterator[Neighborhood]:
    """Yields the neighborhoods of the images used, numbered in the order of `Survey.chosen`."""
    cameras = map(source.camera, survey.chosen.tolist())
    return neighborhoods(whole, eyes_of(source, survey), cameras, RANGE, for_lookups=for_lookups)


def eyes_of(source: Source, survey: Survey) -> np.ndarray:
    """Returns the camera centers of the images used, [n, 3] [audit units]."""
    return survey.alignment.points(source.poses[survey.chosen, :3, 3])


def _surfaces(source: Source, survey: Survey, on_frame: OnFrame) -> tuple[MapState, OccupancyGrid]:
    grid = empty_grid(survey.bounds, survey.cell_size)

    def update(frame: Frame) -> None:
        nonlocal grid
        grid = _update_grid(grid, source, frame)
        on_frame()

    state = map_of_images(source, survey, update)
    return state, _with_cameras(grid, source, survey)


def map_of_images(
    source: Source, survey: Survey, on_frame: Callable[[Frame], None] = lambda frame: None
) -> MapState:
    """Maps all images.

    Args:
        source: the images.
        survey: the images to use and the resolution.
        on_frame: called with each image.

    Raises:
        FormatError, RunError: a file is missing or broken.
        ValueError: there are more voxels than with any reasonable voxel size.
    """
    groups = divided(eyes_of(source, survey), RANGE)

    def frames() -> Iterator[Frame]:
        numbers = survey.chosen[np.concatenate(groups)].tolist()
        for frame in read_ahead(source.frame(index, survey.alignment) for index in numbers):
            on_frame(frame)
            yield frame

    return map_of_all(frames(), groups, survey.voxel_size, drop_edges=source.is_dense)


def map_of_all(
    frames: Iterator[Frame | None],
    groups: Sequence[np.ndarray],
    voxel_size: float,
    *,
    max_range: float = RANGE,
    drop_edges: bool = True,
) -> MapState:
    """Maps all frames, one neighborhood after the other.

    Args:
        frames: the frames in the order of the groups; None for those that cannot be read.
        groups: `divided` cameras.
        voxel_size: edge of a voxel.
        max_range: surfaces farther than this do not count.
        drop_edges: False to include pixels on depth edges.

    Raises:
        ValueError: there are more voxels than with any reasonable voxel size.
    """
    part, union = empty_map(_CAPACITY, voxel_size), Union(int(MAX_LOAD * _MOST_ROWS))
    for numbers in groups:
        # The next one begins with what this one needed: growing maps a frame twice.
        part = empty_map(part.capacity, voxel_size)
        for frame in islice(frames, len(numbers)):
            if frame is not None:
                part = _grown(part, frame, drop_edges, max_range)
        if len(groups) > 1:
            with _overflow():
                union.add(part)
    if len(groups) == 1:
        return part
    with _overflow():
        return union.table(part)


def map_grid(source: Source, survey: Survey, numbers: np.ndarray) -> OccupancyGrid:
    """Returns free and occupied space from some images, computed as in `see`.

    Raises:
        FormatError, RunError: a file is missing or broken.
    """
    grid = empty_grid(survey.bounds, survey.cell_size)
    for index in numbers.tolist():
        grid = _update_grid(grid, source, source.frame(index, survey.alignment))
    return _with_cameras(grid, source, survey)


def _update_grid(grid: OccupancyGrid, source: Source, frame: Frame) -> OccupancyGrid:
    if source.is_dense:
        return _integrate_depth(grid, frame, RANGE)
    return integrate_rays(grid, np.asarray(frame.position), _measured_points(frame))


def window_of(grid: OccupancyGrid, eye: np.ndarray) -> tuple[np.ndarray, Window]:
    """Finds the cells within range of a camera: the first along each axis [3], and how many."""
    shape, cell = np.array(grid.log_odds.shape), float(grid.cell_size)
    size = np.minimum(shape, 2 * int(np.ceil(RANGE / cell)) + 3)
    first = np.floor((eye - np.asarray(grid.origin) - RANGE) / cell) - 1
    x, y, z = size.tolist()
    return np.clip(first, 0, shape - size).astype(np.int32), (x, y, z)


@partial(jax.jit, static_argnames="size")
def cut_grid(grid: OccupancyGrid, start: Int[Array, " 3"], size: Window) -> OccupancyGrid:
    """Cuts cells out of a grid without masks: from `start` on, `size` along each axis."""
    origin = grid.origin + start.astype(jnp.float32) * grid.cell_size
    log_odds = jax.lax.dynamic_slice(grid.log_odds, start, size)
    return OccupancyGrid(log_odds, origin, grid.cell_size)


def _with_cameras(grid: OccupancyGrid, source: Source, survey: Survey) -> OccupancyGrid:
    """Marks the cameras' positions as free, regardless of the sensor, which is unreliable there."""
    return free_round(grid, eyes_of(source, survey))


_MOST_RAYS = 1000
"""Maximum number of rays of an image that mark free space."""

_SAMPLES_PER_CELL = 4
"""Number of ray samples per cell edge."""

_LEAST_SAMPLES = 2
"""Minimum number of samples in a cell to count as passed by a ray: half of its edge."""


def integrate_rays(grid: OccupancyGrid, eye: np.ndarray, points: np.ndarray) -> OccupancyGrid:
    """Marks free space along the rays from an image to single points.

    With depth images each cell is projected into the image (`integrate_depth`); between single
    points most cells would have no measurement.

    Args:
        grid: the grid before.
        eye: the camera's center, [3] [audit units].
        points: the points that it sees, [m, 3] [audit units].
    """
    cell, shape = float(grid.cell_size), np.array(grid.log_odds.shape)
    if len(points) > _MOST_RAYS:
        points = points[np.random.default_rng(0).choice(len(points), _MOST_RAYS, replace=False)]
    offset = points - eye
    length = np.linalg.norm(offset, axis=1)
    is_near = (length > 1e-6) & (length <= RANGE)
    offset, length = offset[is_near], length[is_near]
    origin = np.asarray(grid.origin, np.float64)

    def inside(positions: np.ndarray) -> np.ndarray:
        """Returns the flat indices of the cells that hold positions, leaving out those outside."""
        index = np.floor((positions - origin) / cell).astype(np.int64)
        index = index[np.all((index >= 0) & (index < shape), axis=1)]
        return (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]

    steps = np.arange(0.5 * cell / _SAMPLES_PER_CELL, RANGE, cell / _SAMPLES_PER_CELL)
    # Stop half a cell before the point, where its surface is.
    is_before = steps < length[:, None] - 0.5 * cell
    along = eye + (steps[:, None] / np.maximum(length, 1e-6)[:, None, None]) * offset[:, None, :]
    count = int(shape.prod())
    passed = np.bincount(inside(along[is_before]), minlength=count) >= _LEAST_SAMPLES
    hit = np.zeros(count, dtype=bool)
    hit[inside(eye + offset)] = True
    step = np.where(hit, _RAY_STEP, np.where(passed, -_RAY_STEP, 0.0)).reshape(grid.log_odds.shape)
    log_odds = np.clip(np.asarray(grid.log_odds) + step, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)
    return eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(log_odds, dtype=jnp.float32))


_RAY_STEP = 1.4
"""Log-odds of an observation by single rays: one is decisive, like a depth image from 5 m."""


def _measured_points(frame: Frame) -> np.ndarray:
    """Returns the points of a frame's pixels that have a depth, [m, 3] [audit units]."""
    depth, camera = np.asarray(frame.depth), frame.camera
    row, column = np.nonzero(depth > 0.0)
    z = depth[row, column].astype(np.float64)
    x = (column + 0.5 - float(camera.cx)) / float(camera.fx)
    y = (row + 0.5 - float(camera.cy)) / float(camera.fy)
    T = np.asarray(frame.T_world_camera, np.float64)
    return (z * np.stack([x, y, np.ones_like(x)])).T @ T[:3, :3].T + T[:3, 3]


def free_round(grid: OccupancyGrid, cameras: np.ndarray) -> OccupancyGrid:
    """Marks the space around the cameras [n, 3] as free, within the margin [audit units].

    It is equivalent to `mark_free_ball` around each, in time proportional to the cells near the
    cameras, as a live page calls it for every frame.
    """
    origin, cell = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    reach = np.arange(-int(np.ceil(MARGIN / cell)), int(np.ceil(MARGIN / cell)) + 1)
    around = np.stack(np.meshgrid(reach, reach, reach, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.floor((cameras - origin) / cell).astype(np.int64)[:, None] + around
    gap = np.linalg.norm(origin + (cells + 0.5) * cell - cameras[:, None], axis=-1)
    is_near = (gap <= MARGIN) & np.all((cells >= 0) & (cells < grid.log_odds.shape), axis=-1)
    log_odds, free = np.array(grid.log_odds), np.zeros(grid.log_odds.shape, dtype=bool)
    free[tuple(cells[is_near].T)] = True
    free &= ~np.asarray(grid.occupied)
    log_odds[free] = np.minimum(log_odds[free], np.float32(VOUCHED_LOG_ODDS))
    return eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(log_odds))


def _grown(state: MapState, frame: Frame, drop_edges: bool, max_range: float) -> MapState:
    """Returns the map with a frame's pixels added, in a larger table if needed.

    Raises:
        ValueError: there are more voxels than with any reasonable voxel size.
    """
    arguments = frame, jnp.float32(max_range), jnp.asarray(drop_edges)
    with _overflow():
        return update_growing(lambda now: _add_pixels(now, *arguments), state, _MOST_ROWS)


@contextmanager
def _overflow() -> Generator[None]:
    """Says what to do about more voxels than fit."""
    try:
        yield
    except ValueError as error:
        raise TooManyVoxelsError(
            f"the capture fills more than {_MOST_ROWS} voxels: choose a larger --voxel-size"
        ) from error


_add_pixels = jax.jit(add_pixels)


def _reach(source: Source, frame: Frame) -> Float[Array, ""]:
    """Returns the distance up to which an image shows surfaces [audit units]."""
    if source.is_dense:
        return jnp.float32(RANGE)
    farthest = float(jnp.max(frame.depth))
    return jnp.float32(min(RANGE, _SPARSE_REACH * farthest))


def blank(state: MapState) -> MapState:
    """Returns a map with the same rows, without observations."""
    empty = jax.tree.map(jnp.zeros_like, state)
    kept = lambda m: (m.key, m.voxel_size)
    return eqx.tree_at(kept, empty, kept(state))


def join_frame(part: MapState, whole: MapState, source: Source, frame: Frame) -> MapState:
    """Joins a frame of a capture to a map with the rows of all frames.

    Args:
        part: the map to join.
        whole: the map of all frames, with the same rows.
        source: the capture.
        frame: the frame; its pixels have rows.
    """
    drop_edges = jnp.asarray(source.is_dense)
    if source.kind == "tracks":  # a point is seen only by the images of its track
        return _add_pixels(part, frame, jnp.float32(RANGE), drop_edges)
    reach = _reach(source, frame)
    return join_on_rows(part, whole, frame, reach, drop_edges, jnp.float32(RANGE))


@jax.jit
def join_on_rows(
    part: MapState,
    whole: MapState,
    frame: Frame,
    reach: Float[Array, ""],
    drop_edges: Bool[Array, ""],
    max_range: Float[Array, ""],
) -> MapState:
    """Joins a frame to a map with the rows of all frames, whose surfaces determine visibility.

    Args:
        part: the map to join.
        whole: the map of all frames, with the same rows.
        frame: the frame; its pixels have rows.
        reach: how far the frame sees [audit units].
        drop_edges: False to include pixels on depth edges.
        max_range: pixels farther away do not count [audit units].
    """
    after = add_pixels(part, frame, max_range, drop_edges)
    # A first measurement clears a row's marks, as its voxel may have been removed; not so here.
    marks = part.visited | after.visited, jnp.maximum(part.resolution, after.resolution)
    return _mark(eqx.tree_at(_marks, after, marks), whole, frame, reach)


@jax.jit
def mark_again(state: MapState, frame: Frame, max_range: Float[Array, ""]) -> MapState:
    """Marks the voxels in view of an earlier frame, those that later frames have added included.

    Args:
        state: the map after all frames.
        frame: the earlier frame.
        max_range: voxels farther from the camera do not count [audit units].
    """
    return _mark(state, state, frame, max_range)


def _mark(part: MapState, whole: MapState, frame: Frame, reach: Float[Array, ""]) -> MapState:
    return by_platform(cpu=_mark_by_kernel, default=_mark_by_formula)(part, whole, frame, reach)


_marks = lambda m: (m.visited, m.resolution)


def _mark_by_formula(
    part: MapState, whole: MapState, frame: Frame, reach: Float[Array, ""]
) -> MapState:
    marked = mark_seen(eqx.tree_at(_marks, whole, _marks(part)), frame, reach)
    return eqx.tree_at(_marks, part, _marks(marked))


def _mark_by_kernel(
    part: MapState, whole: MapState, frame: Frame, reach: Float[Array, ""]
) -> MapState:
    is_visible = hidden_by_none(whole, frame, reach).astype(jnp.uint8)
    image = for_kernels(frame, reach, jnp.asarray(False))  # edges matter to pixels only
    rows, *_ = calls.map_look(part.rows, part.mean, None, image, is_visible, part.num_bins)
    return with_rows(part, rows)


def united(parts: Sequence[MapState]) -> MapState:
    """Merges maps with the same rows, row by row; the result is that of `merge`."""
    total = parts[0]
    for part in parts[1:]:
        total = _unite(total, part)
    return total


@jax.jit
def _unite(a: MapState, b: MapState) -> MapState:
    count, mean, m2 = combine_moments((a.count, a.mean, a.m2), (b.count, b.mean, b.m2))
    return MapState(
        key=a.key,
        visited=a.visited | b.visited,
        count=count,
        mean=mean,
        m2=m2,
        resolution=jnp.maximum(a.resolution, b.resolution),
        voxel_size=a.voxel_size,
        dropped=a.dropped + b.dropped,
        num_bins=a.num_bins,
    )
