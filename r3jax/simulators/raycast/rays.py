"""Rays against a triangle mesh, through embree.

Shape symbols: V vertices; F faces; n rays.
"""

from dataclasses import dataclass

import numpy as np

from r3jax.kernels.native.platform import missing_for_machine_code

MAX_LAYERS = 64
"""Back faces that a ray may pass before it counts as a miss."""


@dataclass(frozen=True)
class Hits:
    """Where rays first meet the mesh."""

    face: np.ndarray
    """Index of the face that was hit, -1 where none, [n] int32."""

    u: np.ndarray
    """Barycentric weight of the face's second corner, [n] float32."""

    v: np.ndarray
    """Barycentric weight of the face's third corner, [n] float32."""

    distance: np.ndarray
    """Ray parameter of the hit, in lengths of the direction, inf where none, [n] float32."""

    is_back: np.ndarray
    """True where the face is seen from behind, [n] bool."""


class TriangleScene:
    """A mesh that answers ray queries. Faces are hit from both sides unless culled."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Builds the search tree over `vertices` [V, 3] [m] and `faces` [F, 3]."""
        self._packets = None
        if not missing_for_machine_code():
            from r3jax.simulators.raycast.embree import PacketScene, library

            embree = library()
            self._packets = None if embree is None else PacketScene(embree, vertices, faces)
        if self._packets is None:
            self._build_single(vertices, faces)

    def _build_single(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Builds the scene through embreex, which casts one ray at a time."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        # `robust`: a ray through an edge that two faces share must hit one of them.
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(
            self._scene,
            np.ascontiguousarray(vertices, dtype=np.float32),
            np.ascontiguousarray(faces, dtype=np.int32),
        )

    def cast(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        *,
        cull_back_faces: bool = False,
        neighbors: bool = False,
    ) -> Hits:
        """Casts rays, and finds their first hits.

        Args:
            origins: [n, 3], or [1, 3] if all start there [m].
            directions: [n, 3] of any length but 0.
            cull_back_faces: rays pass through faces seen from behind (corners clockwise).
            neighbors: rays that follow each other are neighbors, as in an image: faster. The
                distances are the same; of two faces at one distance the other may be named.

        Returns:
            The hits; distances are in multiples of the direction's length.
        """
        if len(directions) == 0:
            none = np.zeros(0, np.float32)
            return Hits(none.astype(np.int32), none, none, none, none.astype(bool))
        if self._packets is not None:
            found = self._packets.cast(
                origins, directions, cull=cull_back_faces, coherent=neighbors
            )
            return Hits(*found)
        origins = np.broadcast_to(origins, directions.shape)
        hits = self._first(origins, directions)
        return self._past_back_faces(hits, origins, directions) if cull_back_faces else hits

    def _first(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        found = self._scene.run(origins, directions, output=True)
        face = found["primID"]
        is_hit = face >= 0
        distance = np.where(is_hit, found["tfar"], np.float32(np.inf))
        normal = found["Ng"]
        along = normal[:, 0] * directions[:, 0]
        along += normal[:, 1] * directions[:, 1]
        along += normal[:, 2] * directions[:, 2]
        return Hits(face, found["u"], found["v"], distance, is_hit & (along > 0.0))

    def _past_back_faces(self, hits: Hits, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Moves hits on back faces on to the next front face, in place."""
        rays = np.flatnonzero(hits.is_back)
        for _ in range(MAX_LAYERS):
            if len(rays) == 0:
                return hits
            start = hits.distance[rays] * np.float32(1.0 + 1e-6) + np.float32(1e-5)
            onward = self._first(
                origins[rays] + start[:, None] * directions[rays], directions[rays]
            )
            hits.distance[rays] = start + onward.distance
            for name in ("face", "u", "v", "is_back"):
                getattr(hits, name)[rays] = getattr(onward, name)
            rays = rays[onward.is_back]
        hits.face[rays], hits.distance[rays] = -1, np.inf
        return hits
