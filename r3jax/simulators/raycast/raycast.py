"""A simulator that casts rays into a textured triangle mesh.

One ray through each pixel's center gives depth and color. Where neighboring pixels show different
faces in different colors, further rays inside the pixel smooth the edge; elsewhere the texture
filter suffices. Mirrors use one reflected ray.

Shape symbols: H W image size; n rays; F faces.
"""

import copy
import functools
import hashlib

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.simulators import clearance
from r3jax.simulators.clearance import SurfaceDistance
from r3jax.simulators.raycast.rays import Hits, TriangleScene
from r3jax.simulators.raycast.shading_tables import build_shading_tables
from r3jax.simulators.world import World

# A rotated grid: nearly horizontal and vertical edges, the most visible ones, get four steps.
_SUBPIXELS = np.array([[0.125, 0.375], [-0.375, 0.125], [-0.125, -0.375], [0.375, -0.125]])


class RaycastSimulator:
    """RGB-D frames of a `World`. Pure: the same pose gives the same frame."""

    def __init__(
        self,
        world: World,
        camera: Camera | None = None,
        *,
        max_range: float | int | None = 5.0,
        start_pose: np.ndarray | None = None,
        cull_back_faces: bool = False,
        supersample: int = 4,
        lighting: bool = True,
        seed: int = 0,
    ) -> None:
        """Prepares the search tree, the textures and the start.

        Args:
            world: the scene.
            camera: intrinsics; None: 512x512 pixels, 60 degrees.
            max_range: range of the depth sensor in z [m]; None: unlimited. Colors have no such
                limit.
            start_pose: `T_world_camera` at the start; None: the world's own, or a search.
            cull_back_faces: do not render back faces, like Habitat.
            supersample: extra rays in a pixel on an edge, 0 to 4.
            lighting: False shows every surface in its own color: no lamps, no mirrors.
            seed: of the search for a start.

        Raises:
            ValueError: settings out of range, or a start inside or too close to the mesh.
        """
        if not 0 <= supersample <= len(_SUBPIXELS):
            raise InputError(f"supersample must be 0 to {len(_SUBPIXELS)}, got {supersample}")
        self.world = world
        self._camera = Camera.from_fov(512, 512, 60.0) if camera is None else camera
        self._max_depth = _depth_limit(max_range)
        self._cull = cull_back_faces
        self._offsets = _SUBPIXELS[:supersample]
        self._seed = seed
        self._bounds = world.bounds
        self._scene = TriangleScene(world.vertices, world.faces)
        self._tables = build_shading_tables(world, lighting=lighting)
        mirror = np.array([m.mirror if lighting else 0.0 for m in world.materials], np.float32)
        hole = np.array([m.is_hole for m in world.materials])
        self._face_mirror = mirror[world.face_material] if mirror.any() else None
        self._face_hole = hole[world.face_material] if hole.any() else None
        self._pixels = self._pixel_directions()
        self._start = self._given_start(start_pose)

    @property
    def camera(self) -> Camera:
        """Intrinsics of every frame."""
        return self._camera

    @property
    def bounds(self) -> np.ndarray:
        """Axis-aligned box of the mesh, [2, 3] [m]."""
        return self._bounds.copy()

    @property
    def content_hash(self) -> str:
        """SHA-256 of the world, and of the setting for back faces."""
        known = self.world.content_hash
        return hashlib.sha256(f"culled {known}".encode()).hexdigest() if self._cull else known

    @property
    def start_pose(self) -> np.ndarray:
        """`T_world_camera` at the start, [4, 4] float64; searched for on first use.

        Raises:
            ValueError: no position in the mesh has half a meter of free space around it.
        """
        if self._start is None:
            self._start = clearance.find_start(
                self._bounds, self._scene, self._distance, self._seed
            )
        if self._start is None:
            raise InputError(
                f"{self.world.name}: found no place with {clearance.PROMISED_CLEARANCE} m free all "
                "round to start from; is the scale meters and the up axis right? Otherwise give "
                "a start_pose"
            )
        return self._start.copy()

    def with_camera(
        self,
        camera: Camera,
        *,
        max_range: float | int | None,
        cull_back_faces: bool | None = None,
    ) -> "RaycastSimulator":
        """Returns a simulator of the same world with another camera; shares all data.

        Args:
            camera: its intrinsics.
            max_range: as at the start [m].
            cull_back_faces: as at the start; None: as this one.

        Raises:
            ValueError: `max_range` is not positive.
        """
        other = copy.copy(self)
        other._camera, other._max_depth = camera, _depth_limit(max_range)
        other._cull = self._cull if cull_back_faces is None else cull_back_faces
        other._pixels = other._pixel_directions()
        return other

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Measures the distances [n] of `points` [n, 3] to the mesh [m].

        For tests only; the exploration loop has no access.
        """
        return self._distance(np.asarray(points, dtype=np.float64))

    def segment_is_clear(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Checks that no surface lies between the points `a` and `b` [3] [m]."""
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        if np.array_equal(a, b):
            return True
        hits = self._scene.cast(a[None].astype(np.float32), (b - a)[None].astype(np.float32))
        return bool(hits.distance[0] > 1.0)

    def render(self, T_world_camera: np.ndarray | jax.Array) -> Frame:
        """Renders the RGB-D frame at a pose [4, 4].

        Depth is 0 on surfaces that the sensor fails on (`Material.is_hole`), and inf where no
        surface lies within `max_range`.

        Raises:
            ValueError: the pose is not finite or not rigid.
        """
        T = np.asarray(T_world_camera, dtype=np.float64)
        problem = rigid_error(T)
        if problem is not None:
            raise InputError(f"cannot render: {problem}")
        from r3jax.simulators.raycast.shading import turned  # not before: it needs Numba

        height, width = self._camera.height, self._camera.width
        directions = turned(self._pixels, T[:3, :3].astype(np.float32))
        colors, hits = self._look(T, directions)
        image = colors.reshape(height, width, 3)
        depth = np.where(hits.distance <= self._max_depth, hits.distance, np.float32(np.inf))
        if self._face_hole is not None:
            is_hole = self._face_hole[hits.face] & (hits.face >= 0) & np.isfinite(depth)
            depth = np.where(is_hole, np.float32(0.0), depth)
        if len(self._offsets):
            self._smooth_edges(image, hits.face.reshape(height, width), directions, T)
        depth = depth.reshape(height, width)
        return Frame(
            rgb=jnp.asarray(image),
            depth=jnp.asarray(depth),
            T_world_camera=jnp.asarray(T.astype(np.float32)),
            camera=self._camera,
            far=True,
        )

    @functools.cached_property
    def _distance(self) -> SurfaceDistance:
        return SurfaceDistance(self.world.vertices, self.world.faces)

    def _pixel_directions(self) -> np.ndarray:
        """Computes rays through the pixel centers with z = 1, row by row, [H * W, 3] float32."""
        camera = self._camera
        x = (np.arange(camera.width) + 0.5 - float(camera.cx)) / float(camera.fx)
        y = (np.arange(camera.height) + 0.5 - float(camera.cy)) / float(camera.fy)
        grid = np.stack(np.broadcast_arrays(x[None], y[:, None], 1.0), axis=-1)
        return np.ascontiguousarray(grid.reshape(-1, 3), dtype=np.float32)

    def _given_start(self, start_pose: np.ndarray | None) -> np.ndarray | None:
        """Checks the start that the caller or the world sets.

        None means that one must be searched.
        """
        if start_pose is not None:
            pose = np.array(start_pose, dtype=np.float64)
            problem = rigid_error(pose)
            if problem is not None:
                raise InputError(f"start_pose: {problem}")
            least = clearance.MIN_CLEARANCE
        elif self.world.start_position is not None:
            pose = clearance.level_pose(self.world.start_position, self.world.start_yaw)
            least = clearance.PROMISED_CLEARANCE
        else:
            return None
        position = pose[:3, 3]
        problem = clearance.start_problem(
            position, self._bounds, self._scene, self._distance, least
        )
        if problem is None:
            return pose
        free = clearance.find_start(self._bounds, self._scene, self._distance, self._seed)
        place = "" if free is None else f", for example {np.round(free[:3, 3], 2).tolist()}"
        raise InputError(
            f"{self.world.name}: the start at {np.round(position, 3).tolist()} {problem}. "
            f"Choose a free place{place}, or leave the start out and one is searched for"
        )

    def _pixel_steps(self, T: np.ndarray) -> np.ndarray:
        """Computes how the ray changes from one column, and one row, to the next, [2, 3]."""
        focal = np.array([[float(self._camera.fx)], [float(self._camera.fy)]])
        return (T[:3, :2].T / focal).astype(np.float32)

    def _look(self, T: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, Hits]:
        """Casts rays `directions` [n, 3] from the camera; returns colors [n, 3] and hits."""
        from r3jax.simulators.raycast.shading import shade

        steps = self._pixel_steps(T)
        origin = T[None, :3, 3].astype(np.float32)
        hits = self._scene.cast(origin, directions, cull_back_faces=self._cull, neighbors=True)
        colors = shade(self._tables, hits, origin, directions, steps)
        if self._face_mirror is not None:
            share = np.where(hits.face >= 0, self._face_mirror[hits.face], np.float32(0.0))
            rays = np.flatnonzero(share)
            weight, seen = share[rays, None], self._reflect(hits, rays, origin, directions, steps)
            colors[rays] = (np.float32(1.0) - weight) * colors[rays] + weight * seen
        return colors, hits

    def _reflect(
        self,
        hits: Hits,
        rays: np.ndarray,
        origin: np.ndarray,
        directions: np.ndarray,
        steps: np.ndarray,
    ) -> np.ndarray:
        """Shades what the mirrors hit by `rays` (indices) show, one bounce deep, [n, 3]."""
        from r3jax.simulators.raycast.shading import shade

        normal = self._face_normals[hits.face[rays]]
        incoming, path = directions[rays], hits.distance[rays]
        along = np.einsum("ij,ij->i", normal, incoming)
        outgoing = incoming - 2.0 * along[:, None] * normal
        # Off the mirror by a tenth of a millimeter, to the side that the ray came from.
        side = -np.sign(along)[:, None] * normal * np.float32(1e-4)
        points = origin + path[:, None] * incoming + side
        onward = self._scene.cast(points, outgoing, cull_back_faces=self._cull)
        return shade(self._tables, onward, points, outgoing, steps, path_before=path, mirror=normal)

    @functools.cached_property
    def _face_normals(self) -> np.ndarray:
        """Unit normals of the faces, [F, 3] float32."""
        corners = self.world.vertices[self.world.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return (normal / np.where(length == 0.0, 1.0, length)).astype(np.float32)

    def _smooth_edges(
        self, image: np.ndarray, face: np.ndarray, directions: np.ndarray, T: np.ndarray
    ) -> None:
        """Averages pixels on visible edges over more rays, in place.

        Args:
            image: colors of the pixel centers [H, W, 3].
            face: faces at the pixel centers [H, W].
            directions: their rays, row by row [H * W, 3].
            T: `T_world_camera`.
        """
        from r3jax.simulators.raycast.shading import average, find_edges, inside

        is_edge = np.zeros(face.shape, dtype=bool)
        find_edges(image, face, is_edge)
        pixels = np.flatnonzero(is_edge)
        if len(pixels) == 0:
            return
        shifts = (self._offsets @ self._pixel_steps(T)).astype(np.float32)  # [S, 3]
        # The rays of a pixel beside each other: neighbors are traced together.
        colors, _ = self._look(T, inside(directions, pixels, shifts))
        average(image.reshape(-1, 3), pixels, colors)


def _depth_limit(max_range: float | int | None) -> np.float32:
    """Returns the depth beyond which nothing is measured [m]."""
    if max_range is not None and not max_range > 0.0:
        raise InputError(f"max_range must be positive or None, got {max_range}")
    return np.float32(np.inf if max_range is None else max_range)
