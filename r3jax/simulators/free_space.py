"""The evaluation protocol's access to a world: its free space, and images from any pose.

The free space of a scene in Habitat-Sim is that of its mesh file; its images are Habitat's.

The free space is sampled by nodes a tenth of a meter apart. A node is free if every surface is at
least the margin away; the nodes that a camera can reach are those connected to its start. Two
neighbors that are free have no surface between them, as their distance is below the margin: the
space behind walls, inside furniture and outside a closed house stays out.

Shape symbols: I J K nodes along the axes; n points; V views.
"""

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.simulators.base import NoisySimulator, Simulator
from r3jax.simulators.clearance import SurfaceDistance, cut_triangles, point_triangle
from r3jax.simulators.habitat import HabitatSimulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.raycast.rays import TriangleScene

_STEP = 0.1
"""Nodes are no farther apart along an axis, nor farther than the margin [m]."""

_TOLERANCE = 1e-4
"""A wall at exactly the margin is kept away from, whatever rounding does to its vertices [m]."""

_ALONG = 0.02
"""Places on a path are at most so far apart where its room is measured [m]."""

_MIN_MARGIN = 0.05
_MAX_NODES = 2e8
_BLOCK = 8
"""Nodes along the side of the largest block that is decided at once; a power of two."""

_CHUNK = 2000
"""Points that are measured exactly at once."""

_PIECE = 0.1
"""Surface pieces are cut to about this size [m]; larger ones where there would be millions."""


class GroundTruth:
    """Full access to a world, which the exploration loop never gets."""

    def __init__(self, simulator: Simulator) -> None:
        """Accesses the world of a simulator, with or without noise.

        Raises:
            ValueError: the simulator has no mesh.
        """
        inner = simulator.simulator if isinstance(simulator, NoisySimulator) else simulator
        if not isinstance(inner, (RaycastSimulator, HabitatSimulator)):
            raise InputError(f"a {type(inner).__name__} has no mesh to take ground truth from")
        self._shown = inner
        self._simulator = inner.mesh if isinstance(inner, HabitatSimulator) else inner

    @property
    def scene(self) -> str:
        """The scene's name; of a mesh file its name without folder and suffix."""
        kind, colon, file = self._simulator.world.name.partition(":")
        return PurePath(file).stem if colon else kind

    @property
    def scene_hash(self) -> str:
        """SHA-256 of geometry, colors and lamps, and of who renders them if it is not we."""
        return self._scene_hash

    @functools.cached_property
    def _scene_hash(self) -> str:
        return self._shown.content_hash

    def free_positions(self, spacing: Sequence[float | int], margin: float | int) -> np.ndarray:
        """Finds the lattice points that a camera can reach from the start.

        The lattice begins half a spacing from the lower corner of the world's box. Under a
        start with a ceiling only points with a ceiling count: a path through an open window
        leaves the house.

        Args:
            spacing: of the lattice along x, y, z [m].
            margin: minimum distance to every surface [m], up to 0.2 mm, at the point and on a path
                to it.

        Returns:
            Positions [n, 3] [m] float64 in lexicographic order, rounded to 0.1 mm.

        Raises:
            ValueError: spacing or margin out of range, a world too large for the nodes, or a
                start that is nearer to a surface than the margin.
        """
        sides = np.asarray(spacing, dtype=np.float64)
        if sides.shape != (3,) or not (np.isfinite(sides) & (sides > 0.0)).all():
            raise InputError(f"spacing must be three lengths > 0 [m], got {spacing}")
        if not _MIN_MARGIN <= margin < math.inf:
            raise InputError(f"margin must be at least {_MIN_MARGIN} m, got {margin}")
        start = self._simulator.start_pose[:3, 3]
        room = float(self._simulator.clearance(start[None])[0])
        if room < margin - _TOLERANCE:
            raise InputError(
                f"{self.scene}: the start at {np.round(start, 2).tolist()} has only {room:.2f} m "
                f"free all round, less than the margin of {margin} m: lower the margin, or give "
                "the simulator another start_pose"
            )
        nodes = _nodes(self._simulator.bounds, sides, float(margin))
        is_reached = _reached(self._free_nodes(nodes, float(margin)), nodes, start)
        index = np.argwhere(is_reached[nodes.on_lattice])
        points = np.round(nodes.first + index * sides, 4)
        has_ceiling = self._has_ceiling(np.concatenate([start[None], points]))
        return points[has_ceiling[1:]] if has_ceiling[0] else points

    def seen_share(self, poses: np.ndarray) -> np.ndarray:
        """Computes the share of 60 degree views at `poses` [V, 4, 4] that shows a surface, [V]."""
        x = (np.arange(12) + 0.5) / 6.0 - 1.0
        x = x * math.tan(math.radians(30.0))
        cone = np.stack(np.broadcast_arrays(x[None], x[:, None], 1.0), axis=-1).reshape(-1, 3)
        directions = np.einsum("vij,rj->vri", poses[:, :3, :3], cone)
        origins = np.broadcast_to(poses[:, None, :3, 3], directions.shape)
        return np.isfinite(self._distances(origins, directions)).mean(axis=1)

    def frames(self, poses: np.ndarray, camera: Camera) -> Iterator[Frame]:
        """Yields frames without noise or limit of range at `poses` [V, 4, 4], one by one."""
        simulator = self._shown.with_camera(camera, max_range=None)
        return (simulator.render(pose) for pose in poses)

    def room_along(
        self, paths: Sequence[np.ndarray], limit: float = math.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Computes the minimum distances to a surface along paths, and their positions.

        Sampled every 2 cm. Glass that no depth sensor sees (`Material.is_hole`) does not count:
        no explorer can detect it.

        Args:
            paths: waypoints [K, 3] [m] of each, one at least.
            limit: larger distances are not computed, which saves most of the time [m].

        Returns:
            Distances [n] [m], 0 where a surface lies across the path and `inf` beyond the limit;
            and the places [n, 3].
        """
        distance, rays = self._seen_surfaces
        # Each waypoint with the one before; the first one twice, as it may be the only one.
        begin = np.concatenate([np.concatenate([path[:1], path[:-1]]) for path in paths])
        along = np.concatenate(paths) - begin
        owner = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
        length = np.linalg.norm(along, axis=1)
        pieces = np.maximum(1, np.ceil(length / _ALONG)).astype(int)
        number = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 1
        places = np.repeat(begin, pieces, axis=0)
        places += (number / np.repeat(pieces, pieces))[:, None] * np.repeat(along, pieces, axis=0)
        room = distance(places, limit)
        # The first of the nearest places of each path, or where a surface is crossed.
        order = np.lexsort((room, np.repeat(owner, pieces)))
        first = order[np.searchsorted(np.repeat(owner, pieces), np.arange(len(paths)))]
        least, where = room[first], places[first]
        moves = np.flatnonzero(length > 0.0)
        ends = begin[moves].astype(np.float32), along[moves].astype(np.float32)
        crossed = moves[rays.cast(*ends).distance <= 1.0][::-1]  # the first of a path comes last
        least[owner[crossed]] = 0.0
        where[owner[crossed]] = begin[crossed] + 0.5 * along[crossed]
        return least, where

    @functools.cached_property
    def _seen_surfaces(self) -> tuple[SurfaceDistance, TriangleScene]:
        """The surfaces that a depth sensor sees."""
        world = self._simulator.world
        is_hole = np.array([material.is_hole for material in world.materials], dtype=bool)
        faces = world.faces[~is_hole[world.face_material]]
        return SurfaceDistance(world.vertices, faces), TriangleScene(world.vertices, faces)

    def _has_ceiling(self, points: np.ndarray) -> np.ndarray:
        """Checks whether nearly all that is above a point is a surface, [n] bool."""
        up = fibonacci_lattice(96)
        up = up[up[:, 2] > 0.8]
        directions = np.broadcast_to(up, (len(points), *up.shape))
        origins = np.broadcast_to(points[:, None], directions.shape)
        return np.isfinite(self._distances(origins, directions)).mean(axis=1) > 0.8

    def _distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Measures rays [n, r, 3] up to the first surface, [n, r], in units of their directions."""
        hits = self._rays.cast(
            np.ascontiguousarray(origins.reshape(-1, 3), dtype=np.float32),
            np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32),
        )
        return hits.distance.reshape(directions.shape[:2])

    @functools.cached_property
    def _rays(self) -> TriangleScene:
        return TriangleScene(self._simulator.world.vertices, self._simulator.world.faces)

    def _free_nodes(self, nodes: "_Nodes", margin: float) -> np.ndarray:
        """Finds the nodes that keep the margin, [I, J, K] bool.

        Blocks of nodes are decided by bounds on their center's distance; those that are not are
        halved; single nodes that the bounds leave open are measured exactly.
        """
        least = margin - _TOLERANCE
        surface = _Surface(self._simulator.world.vertices, self._simulator.world.faces)
        shape = [math.ceil(n / _BLOCK) for n in nodes.shape]
        is_free, is_open, size = np.zeros(shape, dtype=bool), np.ones(shape, dtype=bool), _BLOCK
        while True:
            blocks = np.argwhere(is_open)
            reach = 0.5 * (size - 1) * nodes.step
            low, high = surface.bounds(nodes.low + blocks * size * nodes.step + reach)
            radius = float(np.linalg.norm(reach))
            is_free[is_open] = low >= least + radius
            is_open[is_open] = (low < least + radius) & (high >= least - radius)
            if size == 1:
                break
            is_free, is_open, size = _halved(is_free), _halved(is_open), size // 2
        points = nodes.low + np.argwhere(is_open) * nodes.step
        is_free[is_open] = surface.keeps(points, least)
        return is_free[tuple(slice(n) for n in nodes.shape)]


@dataclass(frozen=True)
class _Nodes:
    """A grid in which every lattice point is a node."""

    first: np.ndarray
    """The first lattice point [3] [m]."""

    low: np.ndarray
    """The first node [3] [m]."""

    step: np.ndarray
    """From node to node along each axis [3] [m]."""

    shape: tuple[int, ...]
    """Nodes along each axis."""

    on_lattice: tuple[slice, ...]
    """Picks the lattice points out of an array of nodes."""


def _nodes(bounds: np.ndarray, spacing: np.ndarray, margin: float) -> _Nodes:
    """Fills the box `bounds` [2, 3] [m] with nodes."""
    finer = np.ceil(spacing / min(_STEP, margin) - 1e-9).astype(int)
    step = spacing / finer
    first = bounds[0] + 0.5 * spacing
    before = np.floor((first - bounds[0]) / step + 1e-9).astype(int)
    after = np.floor((bounds[1] - first) / step + 1e-9).astype(int)
    shape = tuple(int(n) for n in np.maximum(before + after + 1, 1))
    if math.prod(shape) > _MAX_NODES:
        raise InputError(
            f"the world extends {np.round(bounds[1] - bounds[0], 1).tolist()} m: its free space "
            f"needs {math.prod(shape):.2g} nodes, over {_MAX_NODES:.0g}; is the unit meters? "
            "Otherwise cut the mesh"
        )
    picks = [slice(b, None, f) for b, f in zip(before.tolist(), finer.tolist(), strict=True)]
    return _Nodes(first, first - before * step, step, shape, tuple(picks))


def _halved(blocks: np.ndarray) -> np.ndarray:
    """Halves the blocks: each becomes eight."""
    return blocks.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)


def _reached(is_free: np.ndarray, nodes: _Nodes, start: np.ndarray) -> np.ndarray:
    """Finds the free nodes that are connected to `start` [3] [m] face by face, [I, J, K] bool."""
    index = np.argwhere(is_free)
    away = np.linalg.norm(nodes.low + index * nodes.step - start, axis=1)
    # The start lies between eight nodes; nothing is between it and the free ones of them.
    beside = index[away <= np.linalg.norm(nodes.step)]
    seeds = np.zeros_like(is_free)
    seeds[tuple(beside.T)] = True
    return ndimage.binary_propagation(seeds, mask=is_free)


class _Surface:
    """A mesh cut so small that the distance to a piece's center nearly tells that to the mesh."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        corners = vertices[faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * float(np.linalg.norm(cross, axis=1).sum())
        self._pieces = cut_triangles(corners, max(_PIECE, math.sqrt(4e-6 * area)))
        centers = self._pieces.mean(axis=1)
        self._radius = float(np.linalg.norm(self._pieces - centers[:, None], axis=2).max())
        self._tree = KDTree(centers, balanced_tree=False)

    def bounds(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds the distance of each of `points` [n, 3]: its least and greatest value [n] [m]."""
        to_center, nearest = self._tree.query(points)
        # No piece reaches farther from its center than the radius.
        return to_center - self._radius, point_triangle(points, self._pieces[nearest])

    def keeps(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Checks whether the distance is at least `margin` [m], exactly, [n] bool."""
        kept = np.ones(len(points), dtype=bool)
        for begin in range(0, len(points), _CHUNK):
            chunk = points[begin : begin + _CHUNK]
            near = self._tree.query_ball_point(chunk, margin + self._radius)
            which = np.repeat(np.arange(len(chunk)), [len(pieces) for pieces in near])
            pieces = self._pieces[np.concatenate(near).astype(int)]
            is_near = point_triangle(chunk[which], pieces) < margin
            kept[begin + which[is_near]] = False
        return kept
