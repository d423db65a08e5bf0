"""Diagnoses how well every surface would render from other places, and what limits its quality.

Renderability depends on a voxel *and* on the position from which it is viewed. The standpoints used
here are spread over the places near the pictures where a person could stand
(`captures.standpoints`). The scores of each voxel are averaged over the standpoints that see it.
Regions are blocks of voxels with a large deficit, the worst first.

Shape symbols: N rows of the map; p standpoints; P pairs of a standpoint and a voxel it sees; m bad
voxels; X Y Z cells of the coarse grid.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from r3jax.captures.alignment import evenly_spaced
from r3jax.captures.source import projected
from r3jax.captures.survey import RANGE
from r3jax.geometry.cameras import Camera
from r3jax.geometry.selection import CHUNK
from r3jax.mapping.occupancy import OccupancyGrid, centers_on_host
from r3jax.mapping.seen import visible_rows
from r3jax.mapping.state import MapState
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images
from r3jax.scoring.terms import Renderability, score_voxels
from r3jax.visibility.views import panorama_view

TERMS = ("bias", "noise", "resolution")
"""Factors of renderability, in the paper's order."""

LEAST = 1e-3
"""Lower bound of a term, so that its logarithm stays finite."""


@dataclass(frozen=True)
class ViewScore:
    """Predicted render quality of one view, and what limits it."""

    renderability: float
    """Mean over all pixels, where a pixel without a voxel counts 0. If surfaces may be unknown, the
    mean over the pixels that are known to be good, bad or unseen; NaN if there are none."""

    coverage: float
    """Share of the pixels that show a known voxel."""

    bias: float
    """Mean over the pixels that show a voxel."""

    noise: float
    """Mean over the pixels that show a voxel."""

    resolution: float
    """Mean over the pixels that show a voxel."""

    cause: str
    """Main cause of the deficit: `unseen` (pixels without a voxel), `angle`, `noise` or `distance`;
    `not_known` if no pixel shows a known surface."""

    shares: dict[str, float]
    """Share of all pixels with each of `CAUSES`, `unseen` and, if surfaces may be unknown,
    `not_known`; they sum to 1."""

    @property
    def judged(self) -> float:
        """Share of the pixels that are known: all but `not_known`."""
        return 1.0 - self.shares.get(NOT_KNOWN, 0.0)


CAUSE_OF_TERM = {"bias": "angle", "noise": "noise", "resolution": "distance"}
"""Cause that a low factor stands for."""


NOT_KNOWN = "not_known"
"""Cause of pixels without a known surface that pictures may show, in captures without a depth
camera."""

FEWEST_PICTURES = 2
"""Minimum number of pictures that must measure a voxel for it to count as known, if depth is
inferred from pictures."""


def known_rows(state: MapState, is_complete: bool) -> np.ndarray:
    """Returns a mask of the map's rows that are known surfaces, [N].

    Args:
        state: the map of all images.
        is_complete: True if a depth camera measured it: then all rows are known.
    """
    return np.asarray(state.count) >= (1 if is_complete else FEWEST_PICTURES)


class Pictures(NamedTuple):
    """The pictures of a map that may have unknown surfaces."""

    known: np.ndarray
    """Mask of the map's rows that are known surfaces, [N]."""

    cameras: Sequence[Camera]
    """Of each picture, n of them."""

    poses: np.ndarray
    """`T_world_camera`, [n, 4, 4] [audit units]."""


def view_score(
    state: MapState,
    camera: Camera,
    pose: np.ndarray,
    config: ScoringConfig,
    pictures: Pictures | None = None,
    depth: np.ndarray | None = None,
) -> ViewScore:
    """Evaluates one view.

    Args:
        state: the map.
        camera: camera of the view, with its focal length in the unit used for the map.
        pose: `T_world_camera`, [4, 4] [audit units].
        config: range and size of the depth buffer.
        pictures: what the map was made of, if surfaces may be unknown: a pixel without a known one
            is unseen if no picture can show what is there, or if it is beyond the range; else it is
            not known. None: all rows are known, and pixels without a voxel are unseen.
        depth: z-depth of the view's own picture, if it has one, [H, W] [audit units]; 0: not known.
    """
    seen = term_images(state, camera, jnp.asarray(pose, dtype=jnp.float32), config)
    row, value = np.asarray(seen.row), np.asarray(seen.value)
    is_hit = row < state.capacity
    if pictures is not None:
        is_hit &= pictures.known[np.where(is_hit, row, 0)]
    coverage = float(is_hit.mean())
    unseen = 1.0 - coverage
    if pictures is not None:
        if depth is None or not (depth > 0.0).any():
            center = np.asarray(state.center, np.float64).T
            depth = np.zeros(is_hit.shape)
            depth[is_hit] = (center[row[is_hit]] - pose[:3, 3]) @ pose[:3, 2]
        unseen *= _shown_by_none(depth, is_hit, camera, pose, pictures)
    images = {name: np.asarray(getattr(seen, name))[is_hit] for name in TERMS}
    mean = {name: float(x.mean()) if x.size else 0.0 for name, x in images.items()}
    # log R is the sum of the terms' logarithms, so the cost of each term adds up over the pixels.
    costs = -np.log(np.maximum(np.stack([images[name] for name in TERMS]), LEAST))
    cost = {
        CAUSE_OF_TERM[name]: float(x.sum()) / is_hit.size
        for name, x in zip(TERMS, costs, strict=True)
    }
    count = np.asarray(state.count)[np.asarray(seen.row)[is_hit]]
    pixels = np.bincount(cause_of(value[is_hit], costs, count), minlength=len(CAUSES))
    cost["unseen"] = unseen * -np.log(LEAST)
    judged = coverage + unseen
    if judged <= 0.0:
        cost = {NOT_KNOWN: 0.0}
    mean_value = float(value[is_hit].sum()) / is_hit.size / judged if judged else float("nan")
    known = {} if pictures is None else {NOT_KNOWN: 1.0 - judged}
    return ViewScore(
        renderability=mean_value,
        coverage=coverage,
        bias=mean["bias"],
        noise=mean["noise"],
        resolution=mean["resolution"],
        cause=max(cost, key=lambda name: cost[name]),
        shares={
            **dict(zip(CAUSES, (pixels / is_hit.size).tolist(), strict=True)),
            "unseen": unseen,
            **known,
        },
    )


_PROBES = 400
"""Maximum number of pixels of a view that are looked for in other pictures."""


def _shown_by_none(
    depth: np.ndarray, is_hit: np.ndarray, camera: Camera, pose: np.ndarray, pictures: Pictures
) -> float:
    """Estimates which share of a view's pixels without a surface no picture can show.

    What is there is taken to be as far as the nearest pixel of known depth. Beyond the range, or
    where it is in the field of view of no picture within the range, no picture shows it.

    Args:
        depth: z-depth of the view, of any resolution, [H, W] [audit units]; 0: not known.
        is_hit: pixels that show a surface, [h, w].
        camera: of the view.
        pose: `T_world_camera`, [4, 4] [audit units].
        pictures: the pictures.
    """
    is_known = depth > 0.0
    if not is_known.any() or is_hit.all():
        return 0.0
    row, column = np.nonzero(~is_hit)
    some = evenly_spaced(len(row), _PROBES)
    across, down = (column[some] + 0.5) / is_hit.shape[1], (row[some] + 0.5) / is_hit.shape[0]
    u, v = across * camera.width, down * camera.height
    nearest = ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    assert nearest is not None
    at = (down * depth.shape[0]).astype(int), (across * depth.shape[1]).astype(int)
    z = depth[nearest[0][at], nearest[1][at]].astype(np.float64)
    x, y = (u - float(camera.cx)) / float(camera.fx), (v - float(camera.cy)) / float(camera.fy)
    points = (z * np.stack([x, y, np.ones_like(x)])).T @ pose[:3, :3].T + pose[:3, 3]
    is_shown = np.zeros(len(points), dtype=bool)
    for other, at in zip(pictures.cameras, pictures.poses, strict=True):
        place = projected(other, at, points)
        is_shown |= place.is_in & (place.z <= RANGE)
    return float(1.0 - (is_shown & (z <= RANGE)).mean())


CAUSES = ("fine", "angle", "rare", "distance", "noise")
"""Main causes of a voxel's deficit; `Diagnosis.cause` contains indices into this."""

FINE = 0.5
"""A voxel whose mean renderability is at least this counts as fine."""

FEW = 3
"""A voxel measured in fewer images counts as seen too rarely."""


class Demand(eqx.Module):
    """Which voxels will be viewed from which standpoints: pairs of both.

    Computed once, as surfaces do not move. A voxel is seen from a few standpoints only: a table of
    all voxels and standpoints would take gigabytes in a large building.
    """

    position: Float[Array, "p 3"]
    """The standpoints [audit units]."""

    row: Int[Array, " P"]
    """Row of the voxel of each pair; N in padding."""

    standpoint: Int[Array, " P"]
    """Index of the standpoint of each pair."""

    num_seen: Float[Array, " N"]
    """Number of standpoints that see each voxel."""


class StandpointScores(eqx.Module):
    """Scores of the voxels from the standpoints."""

    value: Float[Array, " P"]
    """Renderability of each pair of the demand."""

    total: Float[Array, " N"]
    """Sum of a voxel's values."""

    terms: Float[Array, "3 N"]
    """Sums of bias, noise and resolution over the standpoints that see a voxel."""

    costs: Float[Array, "3 N"]
    """Sums of -log of the same terms."""


@dataclass(frozen=True)
class Diagnosis:
    """Quality and main deficit of each voxel. Means are over the standpoints that see it."""

    num_seen: np.ndarray
    """Number of standpoints that see the voxel, [N]; if 0, the other fields are 0."""

    value: np.ndarray
    """Mean renderability, [N]."""

    bias: np.ndarray
    """Mean factor of the angle, [N]."""

    noise: np.ndarray
    """Mean factor of the color's consistency, [N]."""

    resolution: np.ndarray
    """Mean factor of the distance, [N]."""

    num_directions: np.ndarray
    """Number of direction bins from which the voxel was seen, [N]."""

    cause: np.ndarray
    """Index into `CAUSES`, [N] int."""

    @property
    def is_seen(self) -> np.ndarray:
        """True for voxels that some standpoint sees, [N]."""
        return self.num_seen > 0.0

    @property
    def mean(self) -> float:
        """Mean renderability of the visible surfaces; 0 if there are none."""
        return float(self.value[self.is_seen].mean()) if self.is_seen.any() else 0.0

    @property
    def fine_share(self) -> float:
        """Share of the visible surfaces that are fine."""
        evaluated = self.is_seen
        return float((self.value[evaluated] >= FINE).mean()) if evaluated.any() else 0.0

    def share(self, cause: str) -> float:
        """Returns the share of a cause among the visible surfaces, in [0, 1]."""
        evaluated = self.is_seen
        wanted = self.cause[evaluated] == CAUSES.index(cause)
        return float(wanted.mean()) if evaluated.any() else 0.0


def demand_of(
    state: MapState,
    standpoints: np.ndarray,
    config: ScoringConfig,
    known: np.ndarray | None = None,
) -> Demand:
    """Computes which voxels each standpoint sees.

    Args:
        state: the map.
        standpoints: [p, 3] [audit units].
        config: range and size of the panoramic depth buffer.
        known: mask of the rows that count, [N]; None: all.
    """
    position, rows, points = jnp.asarray(standpoints, dtype=jnp.float32), [], []
    for start in range(0, len(position), _AT_ONCE):
        some = position[start : start + _AT_ONCE]
        found = np.array(map_over_devices(functools.partial(_visible, state, config), some))
        if known is not None:
            found &= known
        index, row = np.nonzero(found)
        rows.append(row)
        points.append((index + start).astype(np.int32))
    row, standpoint = (np.concatenate([*parts, np.zeros(0, int)]) for parts in (rows, points))
    # To a power of two, as programs are compiled for a number of pairs.
    blank = (1 << max(len(row) - 1, CHUNK - 1).bit_length()) - len(row)
    return Demand(
        position,
        jnp.asarray(np.pad(row, (0, blank), constant_values=state.capacity), jnp.int32),
        jnp.asarray(np.pad(standpoint, (0, blank)), jnp.int32),
        jnp.asarray(np.bincount(row, minlength=state.capacity), jnp.float32),
    )


_AT_ONCE = 8
"""Standpoints that are looked from at once: each takes a byte a row."""


@jax.jit
def _visible(
    voxels: MapState, config: ScoringConfig, positions: Float[Array, "p 3"]
) -> Bool[Array, "p N"]:
    def seen_from(position: Float[Array, " 3"]) -> Bool[Array, " N"]:
        return visible_rows(voxels, panorama_view(position, config), config)

    # One after another: together they would take a kilobyte for each row of the map.
    return jax.lax.map(seen_from, positions)


@jax.jit
def score_from_standpoints(
    state: MapState, demand: Demand, focal: Float[Array, ""], config: ScoringConfig
) -> StandpointScores:
    """Scores the voxels of the map from every standpoint that sees them.

    Args:
        state: the map; its surfaces are those of the demand.
        demand: the standpoints, and the voxels that each sees.
        focal: focal length of the rendering camera [px], in the map's unit.
        config: settings of the closed forms.
    """

    def score(pairs: tuple[Array, Array]) -> tuple[Array, Array]:
        terms = score_pairs(state, demand.position, *pairs, focal, config)
        return terms.value, jnp.stack([terms.bias, terms.noise, terms.resolution])

    chunks = demand.row.reshape(-1, CHUNK), demand.standpoint.reshape(-1, CHUNK)
    value, factors = jax.lax.map(score, chunks)
    value, factors = value.reshape(-1), jnp.moveaxis(factors, 1, 0).reshape(3, -1)
    costs = -jnp.log(jnp.maximum(factors, LEAST))

    def summed(x: Array) -> Array:
        return jnp.zeros((*x.shape[:-1], state.capacity)).at[..., demand.row].add(x, mode="drop")

    return StandpointScores(value, summed(value), summed(factors), summed(costs))


def score_pairs(
    state: MapState,
    position: Float[Array, "p 3"],
    row: Int[Array, " K"],
    standpoint: Int[Array, " K"],
    focal: Float[Array, ""],
    config: ScoringConfig,
) -> Renderability:
    """Computes the terms of pairs of a voxel and a standpoint; 0 where there is no such row."""
    valid = row < state.capacity
    part = state.take(jnp.where(valid, row, 0), valid)
    return score_voxels(part, position[standpoint].T, focal, config.score)


def diagnose(state: MapState, demand: Demand, answers: StandpointScores) -> Diagnosis:
    """Evaluates every voxel by its mean score over the standpoints.

    Args:
        state: the map.
        demand: the standpoints.
        answers: their scores of this map.
    """
    count = np.asarray(demand.num_seen)
    value = np.asarray(answers.total) / np.maximum(count, 1.0)
    bias, noise, resolution = np.asarray(answers.terms) / np.maximum(count, 1.0)
    directions = np.bitwise_count(np.asarray(state.visited)).sum(axis=0).astype(np.int16)
    return Diagnosis(
        num_seen=count,
        value=value,
        bias=bias,
        noise=noise,
        resolution=resolution,
        num_directions=directions,
        cause=cause_of(value, np.asarray(answers.costs), np.asarray(state.count)),
    )


def cause_of(value: np.ndarray, costs: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Returns the index into `CAUSES` of each voxel, [N]: its costliest term, or `fine`.

    A voxel with a low bias is called `rare` if hardly any image has measured it, else `angle`.

    Args:
        value: mean renderability, [N].
        costs: sums of -log of bias, noise and resolution, [3, N].
        count: images that have measured the voxel, [N].
    """
    dearest = np.argmax(costs, axis=0)
    of_bias = np.where(count < FEW, CAUSES.index("rare"), CAUSES.index("angle"))
    of_others = np.where(dearest == 1, CAUSES.index("noise"), CAUSES.index("distance"))
    found = np.where(dearest == 0, of_bias, of_others)
    return np.where(value >= FINE, CAUSES.index("fine"), found).astype(np.int8)


BLOCK = 1.0
"""Size of a region, and minimum distance between the centers of two [audit units]."""

MOST = 10
"""Maximum number of bad regions listed."""

MOST_UNSEEN = 6
"""Maximum number of unseen regions listed."""

_SMALLEST = 0.02
"""Smaller regions are not reported [square audit units]."""

_FACES = ndimage.generate_binary_structure(3, 1)


@dataclass(frozen=True)
class Region:
    """One bad place."""

    center: np.ndarray
    """Center of its bad voxels or cells, [3] [audit units]."""

    area: float
    """Area of its bad voxels or cells, counting one face of each [square audit units]."""

    cause: str
    """Most frequent cause among its bad voxels; `unseen` or `not_known` if it has no voxels yet."""

    renderability: float
    """Mean over its bad voxels; 0 where nothing is known."""

    bad_share: float
    """Share of bad voxels among the visible voxels of the block; 1 where nothing is known."""

    rows: np.ndarray
    """Rows of its bad voxels in the map; for `unseen`, flat indices of its cells; for `not_known`,
    empty."""

    @property
    def is_known(self) -> bool:
        """True if it has surfaces."""
        return self.cause not in ("unseen", NOT_KNOWN)


def bad_regions(state: MapState, diagnosis: Diagnosis, most: int = MOST) -> list[Region]:
    """Finds the known surfaces that would render badly, the largest deficit first.

    The loss of a block is the sum of 1 - R over its bad voxels. A region is what lies within half
    a block of the bad voxel in the middle of the worst block that is left.

    Args:
        state: the map.
        diagnosis: diagnosis of its voxels.
        most: maximum number of regions.
    """
    centers = np.asarray(state.center, np.float64).T
    face = float(state.voxel_size) ** 2
    left = diagnosis.is_seen & (diagnosis.value < FINE)
    found: list[Region] = []
    while len(found) < most and left.any():
        rows = np.flatnonzero(left)
        middle = _worst_block(centers[rows], 1.0 - diagnosis.value[rows])
        is_near = np.abs(centers - middle).max(axis=1) <= 0.5 * BLOCK
        bad = is_near & left
        area = float(bad.sum()) * face
        if area >= _SMALLEST:
            causes = np.bincount(diagnosis.cause[bad], minlength=len(CAUSES))
            region = Region(
                center=centers[bad].mean(axis=0),
                area=area,
                cause=CAUSES[int(np.argmax(causes))],
                renderability=float(diagnosis.value[bad].mean()),
                bad_share=float(bad.sum() / (is_near & diagnosis.is_seen).sum()),
                rows=np.flatnonzero(bad),
            )
            found.append(region)
        left &= ~is_near
    # A region differs slightly from the block in which it was found.
    return sorted(found, key=lambda region: -float((1.0 - diagnosis.value[region.rows]).sum()))


def _worst_block(points: np.ndarray, loss: np.ndarray) -> np.ndarray:
    """Returns the central point of the grid block with the largest total deficit, [3]."""
    index = np.floor(points / BLOCK).astype(np.int64)
    _, block = np.unique(index, axis=0, return_inverse=True)
    block = block.reshape(-1)
    worst = int(np.argmax(np.bincount(block, weights=loss)))
    inside = points[block == worst]
    # Choose one of the points, so that the center lies on a surface.
    return inside[np.argmin(np.linalg.norm(inside - inside.mean(axis=0), axis=1))]


def unseen_edges(grid: OccupancyGrid, open_cells: np.ndarray) -> np.ndarray:
    """Finds cells where known free space borders on unseen space, [X, Y, Z] bool.

    Args:
        grid: free and occupied space.
        open_cells: unexplored cells to consider, [X, Y, Z] bool; excludes the inside of walls.
    """
    return open_cells & ndimage.binary_dilation(np.asarray(grid.free), _FACES)


def unseen_regions(grid: OccupancyGrid, edges: np.ndarray, most: int = MOST_UNSEEN) -> list[Region]:
    """Finds the ends of a capture: blocks of unseen cells beside free space, the largest first.

    Args:
        grid: free and occupied space.
        edges: unseen cells beside free space, [X, Y, Z] bool.
        most: maximum number of regions.
    """
    cell = float(grid.cell_size)
    points = centers_on_host(grid, np.argwhere(edges))
    flat = np.flatnonzero(edges)
    left = np.ones(len(points), dtype=bool)
    found: list[Region] = []
    while len(found) < most and left.any():
        middle = _worst_block(points[left], np.ones(int(left.sum())))
        is_near = left & (np.abs(points - middle).max(axis=1) <= max(0.5 * BLOCK, cell))
        area = float(is_near.sum()) * cell * cell
        found.append(Region(points[is_near].mean(axis=0), area, "unseen", 0.0, 1.0, flat[is_near]))
        left &= ~is_near
    return found


def blank_points(
    state: MapState, known: np.ndarray, camera: Camera, pose: np.ndarray, config: ScoringConfig
) -> np.ndarray:
    """Estimates the points seen by pixels without a known surface, [k, 3] [audit units].

    Their depth is copied from the nearest pixel with a known surface. This is an estimate that
    works for a wall between its edges. An image without any known surface yields no points.

    Args:
        state: the map of all images.
        known: rows that are known surfaces, [N].
        camera: camera of the image.
        pose: `T_world_camera`, [4, 4] [audit units].
        config: range and size of the depth buffer.
    """
    row = np.asarray(term_images(state, camera, jnp.asarray(pose, jnp.float32), config).row)
    is_known = (row < state.capacity) & known[np.where(row < state.capacity, row, 0)]
    if not is_known.any():
        return np.zeros((0, 3))
    near = np.zeros((2, *row.shape), dtype=np.int32)
    ndimage.distance_transform_edt(
        ~is_known, return_distances=False, return_indices=True, indices=near
    )
    centers = np.asarray(state.center, np.float64).T
    depth = (centers[row[near[0], near[1]]] - pose[:3, 3]) @ pose[:3, 2]
    height, width = row.shape
    x = ((np.arange(width) + 0.5) * (camera.width / width) - float(camera.cx)) / float(camera.fx)
    y = ((np.arange(height) + 0.5) * (camera.height / height) - float(camera.cy)) / float(camera.fy)
    rays = np.stack([*np.meshgrid(x, y), np.ones_like(depth)], axis=-1)
    points = (depth[..., None] * rays) @ pose[:3, :3].T + pose[:3, 3]
    return points[~is_known]


def blank_regions(
    state: MapState, points: Sequence[np.ndarray], most: int = MOST_UNSEEN
) -> list[Region]:
    """Finds places that images show but where no surface is known, the largest first.

    Args:
        state: the map of all images, which provides the voxel size.
        points: `blank_points` of every image.
        most: maximum number of regions.
    """
    size = float(state.voxel_size)
    voxels = [np.unique(np.floor(part / size).astype(np.int64), axis=0) for part in points]
    if not sum(len(part) for part in voxels):
        return []
    found, count = np.unique(np.concatenate(voxels), axis=0, return_counts=True)
    taken = np.floor(np.asarray(state.center).T[np.asarray(state.present)] / size).astype(np.int64)
    blank = (found[count >= FEWEST_PICTURES] + 0.5) * size
    if len(taken) and len(blank):  # points beside a known surface do not count as unknown
        distance, _ = KDTree((taken + 0.5) * size).query(blank)
        blank = blank[np.asarray(distance) > 1.5 * size]
    left = np.ones(len(blank), dtype=bool)
    regions: list[Region] = []
    none = np.zeros(0, dtype=np.int64)
    while len(regions) < most and left.any():
        middle = _worst_block(blank[left], np.ones(int(left.sum())))
        is_near = left & (np.abs(blank - middle).max(axis=1) <= 0.5 * BLOCK)
        area = float(is_near.sum()) * size**2
        if area >= _SMALLEST:
            regions.append(Region(blank[is_near].mean(axis=0), area, NOT_KNOWN, 0.0, 1.0, none))
        left &= ~is_near
    return sorted(regions, key=lambda region: -region.area)
