"""Guides a person who scans: maps frames as they arrive and decides on the next view in parallel.

It uses the same three verbs as a robot: `start`, `observe`, `decide`. A frame appears on the page
as soon as it is in the map. The decision is made in a separate thread, so that no frame waits for
it. The suggested view stays the same until the camera has been near it or several frames have
arrived, because advice that changes with every step cannot be followed.
"""

import queue
import threading
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from r3jax.apps.audit.live.growing import Arrival, GrowingCapture
from r3jax.apps.audit.live.guide_page import GuidePage
from r3jax.captures.alignment import Alignment, rotation_to_z, up_of
from r3jax.captures.capture_maps import mark_again
from r3jax.captures.faults.blocks import BlockImage, block_image
from r3jax.captures.faults.faults import Kind, faults_of
from r3jax.captures.source import Source
from r3jax.captures.survey import MARGIN, RANGE, on_lattice
from r3jax.captures.vertical import Normals, block_normals, estimated_up
from r3jax.formats.ros.bags import Topics
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.config import MappingConfig
from r3jax.planning.growth import GrowthAhead
from r3jax.planning.planner import Planner, decide, observe, start
from r3jax.planning.policy import Decision

_POLL = 0.05
"""Interval at which the folder is polled [s]."""

_HALF_SIZE = np.array([10.0, 10.0, 3.5])
"""Half-size of the explored box around the first camera [m]."""

_RIM = 2.0
"""The box grows when a camera comes closer to its boundary than this [m]."""

_TILTED = 5.0
"""Change of the estimated vertical above which everything is mapped again [deg]."""

_NEAR, _FACING = 0.5, 30.0
"""A view counts as taken within this distance [m] and this angle [deg]."""

_PATIENCE = 8
"""Number of frames after which a new view is chosen, even if the last one was not taken."""

_COMPARED = 8
"""Number of recent frames with which a new one is compared for blur and light."""

_MARKED_AGAIN = 8
"""Number of earlier frames, in turn, in whose views voxels are marked again with each new one."""

_DEEPEST = 65.0
"""Largest depth that is stored of an earlier frame, in whole millimeters [m]."""

_CAPACITY = 1 << 17
"""Initial number of rows of the map: 200 square meters of surface."""


_WARNINGS: dict[Kind, str] = {
    "blur": "Blurred: move more slowly, or turn on the light.",
    "focus": "Out of focus: keep a larger distance, and wait for the autofocus.",
    "brightness": "Brightness has changed: lock the exposure.",
    "tint": "White balance has changed: lock it.",
    "pose": "The pose contradicts the depth: go back slowly to surfaces seen before.",
    "scale": "The scale of the depth is wrong.",
    "ray": "Depth is measured along the ray, and not along the axis.",
    "camera": "The intrinsics of the camera are wrong.",
    "repeat": "Nothing new: move on.",
}
"""Immediate advice on the latest frame."""


class Guide:
    """Maps frames and decides on views. A context manager: leaving it ends its thread."""

    def __init__(self, page: GuidePage, up: str | None = None, policy: str = "r3-pano"):
        """Creates a guide without frames.

        Args:
            page: the page that shows progress and advice.
            up: axis of the capture that points up; None: from its format, or estimated.
            policy: name of the policy that chooses views.
        """
        self._page, self._up_name, self._policy = page, up, policy
        self._planner: Planner | None = None
        self._growth = GrowthAhead()
        self._alignment = Alignment(np.eye(3), 1.0, np.zeros(3))
        self._bounds = np.zeros((2, 3))
        self._normals: dict[int, Normals] = {}  # in the cameras' axes: poses may be corrected
        self._guess: tuple[int, np.ndarray] | None = None
        self._recent: deque[tuple[str, BlockImage]] = deque(maxlen=_COMPARED)
        self._earlier: deque[tuple[np.ndarray, Camera, Array]] = deque()
        self._target: np.ndarray | None = None
        self._since = 0
        self._questions: queue.SimpleQueue[tuple[Planner, Frame] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._decide, name="guide", daemon=True)

    def needs_anew(self, source: Source) -> bool:
        """Returns True if the vertical or the space has changed and all must be mapped again."""
        if self._planner is None:
            return False
        old = self._alignment.rotation[2]
        is_tilted = float(old @ self._up(source)) < np.cos(np.radians(_TILTED))
        stood = self._alignment.points(source.poses[:, :3, 3])[:, :2]
        low, high = self._bounds[:, :2]
        is_outside = (stood < low + _RIM).any() or (stood > high - _RIM).any()
        return is_tilted or bool(is_outside)

    def forget(self) -> None:
        """Forgets everything: all frames will be added again."""
        self._planner, self._target = None, None
        self._recent.clear()
        self._earlier.clear()
        self._page.forget()

    def add(self, source: Source, arrival: Arrival, *, is_latest: bool) -> None:
        """Maps a frame and shows the progress, unless newer frames have arrived."""
        depth, camera = arrival.picture[1], source.camera(arrival.index)
        self._normals[arrival.index] = block_normals(depth, camera, np.eye(3))
        if self._planner is None:
            self._begin(source, arrival)
        assert self._planner is not None
        frame = source.framed(arrival.picture, arrival.index, self._alignment)
        self._planner = observe(self._planner, frame)
        self._growth.look(self._planner, frame)
        depth_mm = np.rint(1000.0 * np.clip(frame.depth, 0.0, _DEEPEST)).astype(np.uint16)
        self._earlier.append((depth_mm, frame.camera, frame.T_world_camera))
        if not is_latest:
            self._page.passed(frame)
            return
        self._mark_again()
        warnings = self._warnings(source, arrival)
        self._page.observed(self._planner, frame, name=arrival.name, warnings=warnings)
        self._since += 1
        if self._target is None or self._since > _PATIENCE or self._has_arrived(frame):
            self._target, self._since = None, 0
            self._questions.put((self._planner, frame))

    def _mark_again(self) -> None:
        """Marks voxels in the views of some earlier frames, as an audit does in those of all.

        When these frames arrived, the map lacked the surfaces that were added since.
        """
        assert self._planner is not None
        state = self._planner.map_state
        for _ in range(min(_MARKED_AGAIN, len(self._earlier))):
            depth_mm, camera, pose = self._earlier[0]
            self._earlier.rotate(-1)
            depth = jnp.asarray(depth_mm, jnp.float32) / 1000.0
            frame = Frame(jnp.zeros((*depth.shape, 3)), depth, pose, camera)
            state = mark_again(state, frame, jnp.float32(RANGE))
        self._planner = replace(self._planner, map_state=state)

    def _up(self, source: Source) -> np.ndarray:
        """Returns the vertical.

        An estimated vertical is updated whenever the number of frames has doubled.
        """
        if self._up_name is not None:
            return up_of(self._up_name)
        if source.up is not None:
            return source.up
        size = len(source).bit_length()
        if self._guess is None or self._guess[0] != size:
            seen = [
                normals._replace(direction=normals.direction @ source.poses[index, :3, :3].T)
                for index, normals in self._normals.items()
                if index < len(source)
            ]
            self._guess = size, estimated_up(source.poses, seen).direction
        return self._guess[1]

    def _begin(self, source: Source, arrival: Arrival) -> None:
        self._alignment = Alignment(rotation_to_z(self._up(source)), 1.0, np.zeros(3))
        poses = self._alignment.poses(source.poses)
        center = poses[arrival.index, :3, 3]
        far = np.abs(poses[:, :3, 3] - center).max(axis=0) + 2.0 * _RIM
        half = np.where([True, True, False], np.maximum(_HALF_SIZE, 1.5 * far), _HALF_SIZE)
        config = MappingConfig(capacity=_CAPACITY, remove_moved=False, start_radius=MARGIN)
        self._bounds = on_lattice(np.stack([center - half, center + half]), config.cell_size)
        self._planner = start(
            source.camera(arrival.index),
            self._bounds,
            self._policy,
            starts=[poses[arrival.index]],
            # As in the audit of the finished capture.
            config=config,
        )

    def _warnings(self, source: Source, arrival: Arrival) -> list[str]:
        """Describes the faults of the latest frame, compared with the frames before it."""
        camera, pose = source.camera(arrival.index), source.poses[arrival.index]
        self._recent.append((arrival.name, block_image(*arrival.picture, camera, pose)))
        names, images = zip(*self._recent, strict=True)
        last = len(images) - 1
        found = faults_of(images, np.arange(len(images)), names).findings
        return [
            f"{_WARNINGS[finding.kind]} ({finding.captions[finding.frames.index(last)]})"
            for finding in found
            if last in finding.frames
        ]

    def _has_arrived(self, frame: Frame) -> bool:
        """Returns True if the camera is at the target's position and faces the same way."""
        assert self._target is not None
        pose = np.asarray(frame.T_world_camera, np.float64)
        is_near = np.linalg.norm(pose[:3, 3] - self._target[:3, 3]) < _NEAR
        return bool(is_near and pose[:3, 2] @ self._target[:3, 2] > np.cos(np.radians(_FACING)))

    def _decide(self) -> None:
        """Decides on the next view for the latest frame, in a loop."""
        key, number = jax.random.key(0), 0
        while (question := self._latest()) is not None:
            planner, frame = question
            number += 1
            try:
                decision, _, _ = decide(
                    planner, frame.T_world_camera, jax.random.fold_in(key, number)
                )
            except Exception as error:  # of any kind: the next frame may succeed
                self._page.say("No view could be chosen here; keep scanning.", str(error))
            else:
                self._show(frame, decision)

    def _latest(self) -> tuple[Planner, Frame] | None:
        question = self._questions.get()
        while question is not None and not self._questions.empty():
            question = self._questions.get()
        return question

    def _show(self, frame: Frame, decision: Decision | None) -> None:
        self._target = None if decision is None else decision.T_world_camera
        self._page.decided(frame, decision)

    def __enter__(self) -> "Guide":
        """Starts the worker thread; returns the guide itself."""
        self._thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        """Ends the thread after its current decision."""
        self._questions.put(None)
        self._thread.join()
        self._growth.wait()


def follow(
    path: Path,
    page: GuidePage,
    scratch: Path,
    *,
    up: str | None = None,
    topics: Topics | None = None,
    stop: threading.Event | None = None,
) -> Source | None:
    """Follows a growing capture until Ctrl-C or until `stop` is set.

    Args:
        path: the folder, a transforms.json, or a ROS bag; it is only read.
        page: shows progress and where to go next.
        scratch: an empty temporary folder, which must exist as long as the result is read.
        up: axis of the capture that points up.
        topics: names of a bag's topics and frames; None to detect them.
        stop: event set by another thread.

    Returns:
        The frames received, ready to be audited; None if there were none.

    Raises:
        ValueError: the capture has no depth images, or is a bag that cannot be followed.
    """
    stop = threading.Event() if stop is None else stop
    capture = GrowingCapture(path, scratch, topics)
    try:
        with Guide(page, up) as guide:
            while not stop.is_set():
                if not _step(capture, guide, page):
                    stop.wait(_POLL)
    except KeyboardInterrupt:
        pass
    return capture.source


def _step(capture: GrowingCapture, guide: Guide, page: GuidePage) -> bool:
    """Checks once for new frames and maps them; returns True if there were any."""
    source, arrivals, has_moved = capture.look()
    if source is None:
        if capture.waiting_for:
            page.say("Waiting for the first frame ...", capture.waiting_for)
        return False
    if has_moved or (arrivals and guide.needs_anew(capture.source or source)):
        guide.forget()
        page.say("Mapping everything again ...", "poses were corrected, or the place has grown")
        earlier: Arrival | None = None
        for arrival in capture.again(source):
            if earlier is not None:
                guide.add(source, earlier, is_latest=False)
            earlier = arrival
        arrivals = [] if earlier is None else [earlier]
    for arrival in arrivals:
        guide.add(source, arrival, is_latest=arrival is arrivals[-1])
    return bool(arrivals)
