"""Poses from transforms between frames, as tf keeps them: a tree, each edge moving in time.

An edge takes points of a frame to its parent. Between two samples the translation is interpolated
linearly and the rotation on the shortest arc (slerp); as tf2 does, transforms that are not finite
or whose quaternion is none are passed over.

Shape symbols: n times.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from r3jax.formats.poses import MAX_DISTANCE

_MAX_GAP = 1_000_000_000
"""Samples of tf farther than this from a time say nothing about it [ns]."""

_MAX_HOLD = 50_000_000
"""So long before its first and after its last sample an edge stays where it was [ns]."""

_STILL = 1e-3
"""Samples that differ by no more are the same [m, and parts of a quaternion]."""

_MAX_DENORMAL = 1e-2
"""Quaternions longer or shorter by more are none."""


@dataclass
class Edge:
    """How a frame moves in its parent."""

    parent: str
    """Name of the parent."""

    times: list[int] = field(default_factory=list[int])
    """When the samples were taken [ns], in any order; empty: it never moves."""

    positions: list[np.ndarray] = field(default_factory=list[np.ndarray])
    """Origin of the frame in its parent, [3] each; of an edge that never moves just one."""

    rotations: list[np.ndarray] = field(default_factory=list[np.ndarray])
    """Quaternions x y z w, frame to parent, [4] each."""

    def at(self, times: np.ndarray, max_gap: float = _MAX_GAP) -> tuple[np.ndarray, np.ndarray]:
        """Interpolates transforms `T_parent_frame` [n, 4, 4], and marks the known ones [n].

        Args:
            times: [n] int64 [ns].
            max_gap: samples farther than this from a time say nothing about it [ns].
        """
        moves = np.tile(np.eye(4), (len(times), 1, 1))
        positions, rotations = np.stack(self.positions), np.stack(self.rotations)
        if not self.times:
            moves[:, :3, :3] = Rotation.from_quat(rotations[-1]).as_matrix()
            moves[:, :3, 3] = positions[-1]
            return moves, np.ones(len(times), bool)
        known, first = np.unique(np.asarray(self.times, np.int64), return_index=True)
        right = np.searchsorted(known, times).clip(0, len(known) - 1)
        left = np.where(known[right] > times, right - 1, right).clip(0)
        off = np.maximum(np.abs(times - known[left]), np.abs(known[right] - times))
        is_inside = (known[0] <= times) & (times <= known[-1])
        is_known = off <= np.where(is_inside, max_gap, _MAX_HOLD)
        seconds = (known - known[0]) * 1e-9
        asked = (times.clip(known[0], known[-1]) - known[0]) * 1e-9
        for axis in range(3):
            moves[:, axis, 3] = np.interp(asked, seconds, positions[first, axis])
        if len(known) == 1:
            moves[:, :3, :3] = Rotation.from_quat(rotations[first[0]]).as_matrix()
        else:
            slerp = Slerp(seconds, Rotation.from_quat(rotations[first]))
            moves[:, :3, :3] = slerp(asked.clip(seconds[0], seconds[-1])).as_matrix()
        return moves, is_known


class TransformTree:
    """All transforms of a recording."""

    def __init__(self):
        self.edges: dict[str, Edge] = {}
        """By the frame that moves; a frame has one parent."""

    def add(
        self, parent: str, child: str, time: int | None, position: np.ndarray, xyzw: np.ndarray
    ) -> None:
        """Adds a sample of an edge.

        Args:
            parent: its name.
            child: name of the frame that moves in it.
            time: when [ns]; None: always.
            position: [3] [m].
            xyzw: quaternion from the frame to its parent, [4].
        """
        length = float(np.linalg.norm(xyzw))
        is_rotation = abs(length - 1.0) <= _MAX_DENORMAL  # NaN makes it false
        if not is_rotation or not np.abs(position).max() <= MAX_DISTANCE or parent == child:
            return
        edge = self.edges.get(child)
        if edge is None or edge.parent != parent:  # as tf2, it believes the latest parent
            edge = self.edges[child] = Edge(parent)
        if time is None:
            edge.times.clear()
        elif edge.times or not edge.positions:
            edge.times.append(time)
        else:
            return  # it never moves: /tf_static goes before /tf
        edge.positions.append(position)
        edge.rotations.append(xyzw)

    def chain(self, frame: str, world: str | None = None) -> list[str]:
        """Lists the frames from `frame` up to the world, both included.

        If no world is named, it leads up to the root.

        Returns:
            What there is of it: it ends elsewhere where no transform leads on.
        """
        found = [frame]
        while found[-1] != world and found[-1] in self.edges:
            parent = self.edges[found[-1]].parent
            if parent in found:
                break
            found.append(parent)
        return found

    def is_timed(self, chain: list[str]) -> bool:
        """Returns True if an edge of a chain has samples in time."""
        return any(self.edges[frame].times for frame in chain[:-1])

    def is_moving(self, chain: list[str]) -> bool:
        """Returns True if these samples differ: ROS 1 also repeats fixed transforms."""
        edges = [self.edges[frame] for frame in chain[:-1]]
        samples = [part for edge in edges for part in (edge.positions, edge.rotations)]
        return any(np.ptp(np.stack(part), axis=0).max() > _STILL for part in samples)

    def latest(self, chain: list[str]) -> int:
        """Returns the time up to which all edges of a chain have samples [ns].

        Later poses may still change.
        """
        times = [max(self.edges[frame].times) for frame in chain[:-1] if self.edges[frame].times]
        return min(times, default=0)

    def poses(self, chain: list[str], times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes poses of a chain's first frame in its last, [n, 4, 4], and which are known [n].

        Args:
            chain: of `chain`.
            times: [n] int64 [ns].
        """
        poses, is_known = np.tile(np.eye(4), (len(times), 1, 1)), np.ones(len(times), bool)
        for frame in chain[:-1]:
            moves, is_here = self.edges[frame].at(times)
            poses, is_known = moves @ poses, is_known & is_here
        return poses, is_known
