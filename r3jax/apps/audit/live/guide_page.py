"""Serves a guide's page for the browser: where to go next, progress, and faults of the pictures.

    with open_guide() as page:
        print(page.url)
        planner = r3jax.observe(planner, frame)
        page.observed(planner, frame)              # progress
        decision, planner, info = r3jax.decide(planner, frame.T_world_camera, key)
        page.decided(frame, decision)              # where to go next

Unlike the viewer's page, which needs viser, it is served by the standard library: robots and
headless machines need no extra for it. It is read-only: no request changes anything.

Shape symbols: N rows of the map; h, w image size; k places.
"""

import contextlib
import http
import json
import threading
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from matplotlib import colormaps

from r3jax.apps.audit.diagnosis import (
    CAUSES,
    demand_of,
    diagnose,
    score_from_standpoints,
    unseen_edges,
)
from r3jax.apps.audit.directions import steps_between
from r3jax.apps.audit.sentences import GOOD, SHORT, listed
from r3jax.apps.audit.settings import AuditSettings
from r3jax.captures.capture_maps import free_round
from r3jax.captures.standpoints import places_of
from r3jax.captures.survey import RANGE
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.network import LOOPBACK, check_free
from r3jax.planning.planner import Planner
from r3jax.planning.policy import Decision
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.plots import style
from r3jax.plots.page import render
from r3jax.plots.pictures import floor_picture, png, small_png
from r3jax.scoring.config import ScoringConfig

_LATEST = 480
"""Longer side of the latest picture [px]."""


class GuidePage:
    """Content of the page. Its methods may be called from any thread."""

    def __init__(self, url: str):
        """Shows that no frame has arrived yet."""
        self.url = url
        """URL of the page."""
        self._lock = threading.Lock()
        self._path: list[np.ndarray] = []
        self._pose, self._target = np.eye(4), list[np.ndarray]()
        self._page = render("apps/audit/live/guide_page.html").encode()
        self._pictures: dict[str, bytes] = {}
        self._news: dict[str, Any] = {"version": 0, "warnings": []}
        self._tell(next="Waiting for the first frame ...", note="", is_current=False)

    def _tell(self, **news: Any) -> None:
        with self._lock:
            self._news |= news
            self._news["version"] += 1

    def say(self, text: str, note: str = "") -> None:
        """Shows a sentence in place of where to go next."""
        if (self._news["next"], self._news["note"]) == (text, note):
            return
        self._tell(next=text, note=note, is_current=False)

    def forget(self) -> None:
        """Clears the path: poses were corrected, and all frames will be added again."""
        self._path, self._target = [], []

    def passed(self, frame: Frame) -> None:
        """Adds a frame to the path without showing it, as newer frames have arrived."""
        self._path.append(np.asarray(frame.T_world_camera, np.float64)[:3, 3])

    def observed(
        self, planner: Planner, frame: Frame, *, name: str = "", warnings: Iterable[str] = ()
    ) -> None:
        """Shows the progress after a frame, and the directions from it to the next view.

        Args:
            planner: a planner that has observed the frame.
            frame: the latest frame; z up, meters.
            name: name of the frame.
            warnings: its faults, one sentence each.
        """
        self._pose = np.asarray(frame.T_world_camera, np.float64)
        self._path.append(self._pose[:3, 3])
        done = scan_progress(planner, frame.camera, np.stack(self._path))
        rgb = np.rint(255.0 * np.asarray(frame.rgb)).astype(np.uint8)
        latest = small_png(rgb, self._pose, np.array([0.0, 0.0, 1.0]), _LATEST)
        with self._lock:
            self._pictures |= {"plan.png": png(done.plan), "latest.png": latest}
        self._tell(
            done=done.words(len(self._path)),
            fine_share=done.fine_share,
            extent=done.extent,
            path=[[float(x), float(y)] for x, y, _ in self._path],
            camera=_from_above(self._pose, frame.camera),
            name=name or f"{len(self._path)}",
            warnings=list(warnings),
            **self._advice(),
        )

    def decided(self, frame: Frame, decision: Decision | None) -> None:
        """Shows where to go next.

        Args:
            frame: the frame whose camera goes there.
            decision: None if there is no view to take.
        """
        if decision is None:
            self._target = []
            text = "Nothing new can be reached from here."
            note = "Step back and look around, or end the scan."
            self._tell(next=text, note=note, is_current=True, target=None, way=[])
            return
        self._target = [decision.T_world_camera]
        self._tell(
            target=_from_above(decision.T_world_camera, frame.camera),
            way=[[float(x), float(y)] for x, y, _ in decision.waypoints],
            **self._advice(),
        )

    def _advice(self) -> dict[str, Any]:
        """Describes the path from the latest frame to the target."""
        target = self._target
        if not target:
            return {"next": "Keep scanning ...", "note": "searching for the best view",
                    "is_current": False}  # fmt: skip
        words = ", ".join(steps_between(self._pose, target[0], meter=1.0))
        note = "Directions start at the latest picture. Walk slowly and take pictures as you go."
        return {"next": f"{words[:1].upper()}{words[1:]}.", "note": note, "is_current": True}

    def answer(self, path: str) -> tuple[str, bytes] | None:
        """Returns the kind and content of a resource, or None if there is no such resource."""
        name = path.partition("?")[0].lstrip("/")
        with self._lock:
            if name == "":
                return "text/html; charset=utf-8", self._page
            if name == "news.json":
                return "application/json", json.dumps(self._news, allow_nan=False).encode()
            found = self._pictures.get(name)
        return None if found is None else ("image/png", found)


def _from_above(pose: np.ndarray, camera: Camera) -> dict[str, float]:
    """Returns the position, azimuth and half the field of view of a camera, seen from above."""
    forward = pose[:3, 2]
    level = float(np.hypot(*forward[:2]))
    half = float(np.arctan(0.5 * camera.width / float(camera.fx)))
    # A camera that looks down faces along its upper edge.
    ahead = forward if level > 0.05 else -pose[:3, 1]
    azimuth = float(np.arctan2(ahead[1], ahead[0]))
    return {"x": float(pose[0, 3]), "y": float(pose[1, 3]), "azimuth": azimuth, "half": half}


@contextlib.contextmanager
def open_guide(host: str = "127.0.0.1", port: int = 8080) -> Generator[GuidePage]:
    """Serves a page until the block is left.

    Args:
        host: address to listen at; 127.0.0.1 can be reached from this machine only.
        port: 0 takes any free one.

    Raises:
        ValueError: the port is not a valid port number.
        OSError: the port is in use or not permitted, or the address is not one of this machine.
    """
    check_free(host, port)
    server = _Server((host, port), _Handler)
    address = f"[{host}]" if ":" in host else host
    page = GuidePage(f"http://{address}:{server.server_port}")
    server.page, server.is_private = page, host in LOOPBACK
    thread = threading.Thread(target=server.serve_forever, name="guide", daemon=True)
    thread.start()
    try:
        yield page
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Server(ThreadingHTTPServer):
    """Serves one page."""

    daemon_threads = True
    page: GuidePage

    is_private: bool
    """True if only this machine can reach it."""


class _Handler(BaseHTTPRequestHandler):
    """Answers the page's requests."""

    def do_GET(self) -> None:
        """Sends the page, its news or a picture."""
        server = self.server
        assert isinstance(server, _Server)
        found = server.page.answer(self.path) if self._is_known_name(server) else None
        if found is None:
            self.send_error(http.HTTPStatus.NOT_FOUND)
            return
        kind, content = found
        self.send_response(http.HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.wfile.write(content)

    def _is_known_name(self, server: _Server) -> bool:
        """Returns False for requests under a foreign host name (DNS rebinding by another page)."""
        name = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        return name in LOOPBACK or not server.is_private

    def log_message(self, format: str, *args: object) -> None:
        """Logs nothing to the console."""


_HEADROOM = 0.35
"""As in `floor_picture` [m]."""

_LEAST_DARK = 1.0
"""Minimum unseen area that is mentioned [square meters]."""

_MARGIN = 0.6
"""Margin shown around the known part [m]."""

_COLORED = 0.75
"""Opacity of the renderability color over a surface on the plan."""


@dataclass(frozen=True)
class ScanProgress:
    """Progress of a scan."""

    fine_share: float
    """Share of `seen_from` that is seen well enough."""

    seen_from: str
    """Description of the evaluated surface, for reports."""

    causes: dict[str, float]
    """Share of each other cause in the evaluated surface."""

    area: float
    """Area of the evaluated surface, counting one face of each voxel [square meters]."""

    dark: float
    """Area of the boundary between free space and space that no picture shows [square meters]."""

    plan: np.ndarray
    """The place from above, surfaces from red to green, [h, w, 3] uint8; row 0 at the largest y."""

    extent: tuple[float, float, float, float]
    """Left, right, bottom and top of the plan [m]."""

    def words(self, pictures: int) -> str:
        """Describes the progress, the gaps, and whether that is enough."""
        parts = [
            f"{100 * share:.0f} % {SHORT[cause]}"
            for cause, share in sorted(self.causes.items(), key=lambda item: -item[1])
            if share >= 0.01
        ]
        text = (
            f"{100 * self.fine_share:.0f} % of {self.seen_from} is seen "
            f"well enough ({self.area:.0f} m² of floor, walls and furniture, "
            f"{pictures} pictures)"
        )
        rest = f"; seen {listed(parts)}." if parts else "."
        if self.dark >= _LEAST_DARK:
            rest += f" No picture shows about {self.dark:.0f} m² yet (gray beside white)."
        end = " That is good for splats: you can stop here." if self.fine_share >= GOOD else ""
        return text + rest + end


def scan_progress(planner: Planner, camera: Camera, places: np.ndarray) -> ScanProgress:
    """Scores the surfaces seen so far from the standpoints of an audit.

    Args:
        planner: provides map and grid.
        camera: the rendering camera.
        places: positions of the camera so far, [k, 3], k >= 1.
    """
    state = planner.map_state
    config = ScoringConfig(max_range=RANGE)
    # As in an audit: the camera's own positions are free, even if the sensor reports otherwise.
    grid = free_round(planner.grid, places)
    num = AuditSettings.num_places
    stand = places_of(state, grid, places, num, is_dense=True, meter=1.0, with_cameras=True)
    demand = demand_of(state, stand.standpoints, config)
    found = diagnose(state, demand, score_from_standpoints(state, demand, camera.focal, config))
    value = np.where(found.is_seen, found.value, np.nan)
    causes = {name: found.share(name) for name in CAUSES if name != "fine"}
    area = float(found.is_seen.sum()) * float(state.voxel_size) ** 2
    plan, extent = _plan(planner, value, places)
    dark = _dark_area(grid, places)
    return ScanProgress(found.fine_share, stand.seen_from, causes, area, dark, plan, extent)


def _dark_area(grid: OccupancyGrid, places: np.ndarray) -> float:
    """Measures the area where reachable free space borders on unseen space [square meters]."""
    cell, reached = float(grid.cell_size), np.zeros(grid.log_odds.shape, dtype=bool)
    cells = np.floor((places - np.asarray(grid.origin)) / cell).astype(np.int64)
    reached[tuple(cells.clip(0, np.array(reached.shape) - 1).T)] = True
    explorable = np.asarray(mask_unexplorable(grid, reached).unexplored)
    return float(unseen_edges(grid, explorable).sum()) * cell * cell


def _plan(
    planner: Planner, value: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Draws the place from above, cropped to the known part; also returns its extent."""
    height = float(np.median(places[:, 2]))
    picture, (left, right, bottom, _) = floor_picture(planner.map_state, planner.grid, height)
    pixel = (right - left) / picture.shape[1]
    center = np.asarray(planner.map_state.center, np.float64).T
    shown = np.isfinite(value) & (center[:, 2] < height + _HEADROOM)
    order = np.flatnonzero(shown)[np.argsort(center[shown, 2], kind="stable")]
    column, row = np.floor((center[order, :2] - [left, bottom]) / pixel).astype(int).T
    inside = (column >= 0) & (column < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
    column, row, order = column[inside], row[inside], order[inside]
    colors = colormaps[style.SCORE_MAP](value[order])[:, :3]
    picture[row, column] = _COLORED * colors + (1.0 - _COLORED) * picture[row, column]
    known = np.concatenate([center[shown, :2], places[:, :2]])
    low, high = known.min(axis=0) - _MARGIN, known.max(axis=0) + _MARGIN
    x0, y0 = np.maximum(np.floor((low - [left, bottom]) / pixel), 0).astype(int)
    x1, y1 = np.ceil((high - [left, bottom]) / pixel).astype(int)
    cut = picture[y0:y1, x0:x1]
    extent = (left + x0 * pixel, left + (x0 + cut.shape[1]) * pixel,
              bottom + y0 * pixel, bottom + (y0 + cut.shape[0]) * pixel)  # fmt: skip
    return np.rint(255.0 * cut[::-1]).clip(0, 255).astype(np.uint8), extent
