"""The page of a scan: surfaces by renderability or cause, pictures, views to add, and a splat.

A click on a surface shows which pictures see it and what it still needs. An audit is read from
its folder; a recording without one is mapped, and shows surfaces in their colors only.

Everything is in the audit's coordinates: z up, about a meter to the unit.

Shape symbols: m voxels; n pictures; k suggested views.
"""

import contextlib
import functools
import shlex
import threading
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import viser
from PIL import Image, ImageDraw
from scipy.spatial import KDTree

from r3jax.apps.viewer.drawing import (
    SCORES,
    UNSEEN,
    css_color,
    paint,
    quaternion,
    splat_arrays,
    to_bytes,
)
from r3jax.apps.viewer.layout import dock_panel, place_eye
from r3jax.apps.viewer.server import close_server, open_server, url_of
from r3jax.captures.alignment import Alignment
from r3jax.captures.capture_maps import map_of_images
from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import Source, projected, source_of
from r3jax.captures.survey import survey_of
from r3jax.errors import InputError
from r3jax.formats.captures import open_capture
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.formats.points import read_point_table, read_points
from r3jax.plots.page import data_url, render_macro
from r3jax.plots.pictures import png
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import parse_json

_MAX_BYTES = 1 << 26

_SPREAD = 0.75
"""Maximum distance of a voxel's center from the ray of a click [voxels]."""

_BLOCKS, _SHORT = 0.55, 2.5
"""A line of sight is blocked by voxels with centers within the first distance from it, but not
within the second from its end, as a wall may be several voxels thick [voxels]."""

_SHOWN = 3
"""Maximum number of pictures shown for a click."""

_SIDE = 300
"""Longer side of such a picture [px]."""

_THUMBNAIL = 64
"""Width of the pictures in the frusta [px]."""

_MOST_FRUSTA = 150
"""Maximum number of cameras drawn, evenly spread."""

_HEADROOM = 0.35
"""Height above the cameras at which the drawing is cut at first [audit units]."""

_NEAREST = 0.05
"""Minimum distance of a point in a picture from its camera [audit units]."""

_PICTURE, _SUGGESTED = (120, 124, 134), (14, 116, 204)

_ASIDE = 1.1
"""Distance of the splat from the surfaces beside it, in their widths."""

_CUTS = 60
"""Approximate number of heights at which the drawing can be cut."""

_LABEL_AHEAD = 0.25
"""Distance of a suggested view's number from its position [audit units]."""

_STOPS = 12
"""Colors of the bar in the legend."""

_R_HINT = (
    "Renderability R: how well a picture of this surface could be rendered from the captured ones. "
    "0 is not at all, 1 is perfect."
)
_LAYER_HINT = (
    "Renderability: how well each surface would render. Cause: why it would not. Colors: those of "
    "the pictures."
)
_CUT_HINT = "Height above the floor. Nothing above it is drawn, so that you look into the rooms."
_UNITS = {"m": "In meters.", "u": "In the units of the file, which may not be meters."}
_PICTURES_HINT = "Draws a small camera for each picture; a click on one shows the picture."


@dataclass(frozen=True)
class Scan:
    """Content of the page."""

    title: str

    lead: str
    """A sentence below the title."""

    command: str = ""
    """A command that says more, if there is one."""

    centers: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """Centers of the voxels, [m, 3]."""

    edge: float = 0.01
    """Voxel size."""

    layers: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """Colors of the voxels, [m, 3] uint8, by the quantity that they show."""

    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """`T_world_camera` of the pictures, [n, 4, 4]; none where the capture is gone."""

    meter: float = 1.0
    """One of the capture's units in the audit's."""

    unit: str = "m"
    """Name of the capture's unit."""

    facts: np.ndarray | None = None
    """Rows of `causes.ply`, [m]; None: there is no audit."""

    causes: tuple[dict[str, str], ...] = ()
    """Name, meaning and remedy of each cause, by its number in `facts`."""

    suggested: np.ndarray | None = None
    """`T_world_camera` of the views to take, [k, 4, 4], in the order of the page."""

    source: Source | None = None
    """The pictures; None: they are gone."""

    splats: GaussianScene | None = None
    """The splat trained on them, if there is one."""

    @functools.cached_property
    def tree(self) -> KDTree:
        """Of the voxels' centers."""
        return KDTree(self.centers)


@dataclass(frozen=True)
class Answer:
    """Pictures and suggested views that see a clicked place."""

    row: int
    """The voxel."""

    pictures: np.ndarray
    """Pictures that see it, the nearest first."""

    distances: np.ndarray
    """Of these from it [audit units]."""

    angle: float
    """Largest angle between the directions to two of them [deg]."""

    suggested: tuple[int, ...]
    """Numbers of the suggested views that show it, from 1."""


def scan_of(path: Path) -> Scan:
    """Opens an audit, a splat, or a capture.

    Raises:
        InputError, FormatError, SceneFileError, OSError: as the functions below.
    """
    if (path / "audit.json").is_file():
        return read_audit(path)
    return splats_alone(path) if path.suffix.lower() == ".ply" else map_recording(path)


def read_audit(folder: Path) -> Scan:
    """Reads the folder of an audit, and opens its capture if that is still there.

    Raises:
        InputError: an audit of another version, or a damaged one.
        FormatError, OSError: a file that is missing or damaged.
    """
    try:
        record = parse_json(read_bytes(folder / "audit.json", _MAX_BYTES))
        moved = record["alignment"]
        alignment = Alignment(
            np.array(moved["rotation"], np.float64).reshape(3, 3),
            float(moved["scale"]),
            np.array(moved["origin"], np.float64).reshape(3),
        )
        causes = tuple(dict(cause) for cause in record["causes"])
        edge = float(record["voxel_size"]) * alignment.scale
        poses = [view["camera_to_world_opengl"] for view in record["suggested"]]
        capture, name, headline = record["capture_path"], record["capture"], record["headline"]
        unit, splat = "m" if record["unit"] == "metre" else "u", record["splat"]
        facts = read_point_table(folder / "causes.ply")
        value = np.where(facts["standpoints"] > 0, facts["renderability"], np.nan)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder}/audit.json: not an audit of this version ({error!s:.100}): audit the "
            "capture again"
        ) from error
    suggested = np.array(poses, np.float64).reshape(-1, 4, 4) @ OPENGL_FROM_OPENCV
    xyz, colors = read_points(folder / "causes.ply")
    source, remark = _source(Path(capture))
    return Scan(
        title=f"Audit of {name}",
        lead=f"{headline} {remark}",
        centers=alignment.points(xyz),
        edge=edge,
        layers={"renderability": paint(value), "cause": colors},
        poses=alignment.poses(np.zeros((0, 4, 4)) if source is None else source.poses),
        meter=alignment.scale,
        unit=unit,
        facts=facts,
        causes=causes,
        suggested=alignment.poses(suggested),
        source=source,
        splats=None if splat is None else read_scene(folder / str(splat)),
    )


def _source(path: Path) -> tuple[Source | None, str]:
    """Opens the pictures of an audit, or says why there are none."""
    try:
        capture = open_capture(path, "z")
        return source_of(capture.source, capture.name, can_compute=True), ""
    except (ValueError, OSError, ImportError) as error:
        return None, f"Its pictures cannot be shown ({' '.join(str(error).split())})."


def map_recording(path: Path) -> Scan:
    """Maps a capture that was not audited, in its colors.

    Raises:
        FormatError, InputError: not a capture, or one that cannot be mapped.
    """
    capture = open_capture(path, "z")
    source = source_of(capture.source, capture.name)
    survey = survey_of(source, SurveySettings())
    state = map_of_images(source, survey)
    present = np.asarray(state.present)
    colors = to_bytes(np.asarray(state.mean).T)
    return Scan(
        title=capture.name,
        lead=f"{len(source)} pictures. An audit says what they miss:",
        command=f"r3jax audit {shlex.quote(str(path))}",
        centers=np.asarray(state.center, np.float64).T[present],
        edge=survey.voxel_size,
        layers={"colors": colors[present]},
        poses=survey.alignment.poses(source.poses),
        meter=survey.alignment.scale,
        unit=survey.unit,
        source=source,
    )


def splats_alone(path: Path) -> Scan:
    """Shows the splats of a file, and nothing else; up is taken to be z.

    Raises:
        SceneFileError: a file without splats, or a damaged one.
    """
    scene = read_scene(path)
    centers = splat_arrays(scene)[0].astype(np.float64)
    return Scan(
        title=path.name,
        lead=f"{int(np.asarray(scene.is_alive).sum())} Gaussians.",
        centers=centers,
        unit="u",
        splats=scene,
    )


def picked(scan: Scan, origin: np.ndarray, direction: np.ndarray, top: float) -> int | None:
    """Finds the first voxel below `top` on a ray, or None.

    Args:
        scan: its voxels.
        origin: of the ray, [3].
        direction: of any length, [3].
        top: height of the cut.
    """
    offset = scan.centers - origin
    ahead = direction / np.linalg.norm(direction)
    along = offset @ ahead
    aside = np.linalg.norm(offset - along[:, None] * ahead, axis=1)
    is_hit = (along > 0.0) & (aside <= _SPREAD * scan.edge) & (scan.centers[:, 2] <= top)
    return int(np.argmin(np.where(is_hit, along, np.inf))) if is_hit.any() else None


def answer(scan: Scan, row: int) -> Answer:
    """Finds the pictures and the suggested views that see a voxel."""
    point = scan.centers[row]
    seen = [i for i in range(len(scan.poses)) if _shows(scan, i, scan.poses[i], point)]
    pictures = np.array(seen, dtype=np.int64)
    offset = scan.poses[pictures, :3, 3] - point
    distance = np.linalg.norm(offset, axis=1)
    toward = offset / np.maximum(distance, 1e-9)[:, None]
    widest = float((toward @ toward.T).min()) if len(pictures) else 1.0
    order = np.argsort(distance)
    views = np.zeros((0, 4, 4)) if scan.suggested is None else scan.suggested
    found = tuple(k + 1 for k, pose in enumerate(views) if _shows(scan, None, pose, point))
    angle = float(np.degrees(np.arccos(np.clip(widest, -1.0, 1.0))))
    return Answer(row, pictures[order], distance[order], angle, found)


def _shows(scan: Scan, picture: int | None, pose: np.ndarray, point: np.ndarray) -> bool:
    """Returns True if a picture (None: one taken by most of the lenses) shows a point."""
    if scan.source is None:
        return False
    camera = scan.source.camera(0 if picture is None else picture)
    if not projected(camera, pose, point[None], _NEAREST).is_in[0]:
        return False
    offset = point - pose[:3, 3]
    length = float(np.linalg.norm(offset))
    steps = np.arange(0.5 * scan.edge, length - _SHORT * scan.edge, 0.5 * scan.edge)
    if not len(steps):
        return True
    line = pose[:3, 3] + steps[:, None] / length * offset
    gap, _ = scan.tree.query(line, distance_upper_bound=_BLOCKS * scan.edge)
    return not bool(np.isfinite(gap).any())


def sentences(scan: Scan, found: Answer) -> list[str]:
    """Describes a clicked place, and how to improve it."""
    texts: list[str] = []
    if scan.facts is not None:
        fact = scan.facts[found.row]
        cause = scan.causes[int(fact["cause"])]
        if fact["standpoints"] <= 0:
            texts.append("Not visible from the places that surfaces are judged from.")
        elif cause["name"] == "fine":
            texts.append(f"Seen well enough (R {fact['renderability']:.2f}).")
        else:
            todo = cause["do"][:1].upper() + cause["do"][1:]
            value = f"R {fact['renderability']:.2f}"
            texts.append(f"Not seen well enough ({value}): {cause['meaning']}. {todo}.")
    if scan.source is not None:
        texts.append(_pictures(scan, found))
    if found.suggested:
        names = ", ".join(str(number) for number in found.suggested)
        texts.append(f"Shown by suggested picture{'s' * (len(found.suggested) > 1)} {names}.")
    return texts


def _pictures(scan: Scan, found: Answer) -> str:
    count = len(found.pictures)
    if not count:
        return "No picture shows it unhidden."
    near, far = (f"{found.distances[i] / scan.meter:.1f} {scan.unit}" for i in (0, -1))
    if count == 1:
        return f"1 picture shows it, from {near} away."
    away = near if near == far else f"{near} to {far}"
    return f"{count} pictures show it, from {away} away, within {found.angle:.0f}° of each other."


def marked(scan: Scan, picture: int, point: np.ndarray) -> bytes | None:
    """Draws a ring round a point in a picture; None: it cannot be read."""
    assert scan.source is not None
    try:
        rgb, _ = scan.source.read(picture)
    except (ValueError, OSError):
        return None
    where = projected(scan.source.camera(picture), scan.poses[picture], point[None])
    image = Image.fromarray(np.ascontiguousarray(rgb))
    x, y, size = float(where.column[0]), float(where.row[0]), max(image.size) / 25
    ImageDraw.Draw(image).ellipse(
        (x - size, y - size, x + size, y + size), outline=(255, 40, 40), width=max(2, int(size / 5))
    )
    return _small(image)


def _small(image: Image.Image) -> bytes:
    """Encodes a picture at the size in which the panel shows it."""
    image.thumbnail((_SIDE, _SIDE))
    return png(np.asarray(image))


class ScanPage:
    """A page that is being shown. Handlers run in the server's threads, one at a time."""

    def __init__(self, server: viser.ViserServer, scan: Scan):
        """Fills the page.

        Args:
            server: with an empty page.
            scan: content of the page.
        """
        self.url = url_of(server)
        self.scan = scan
        self._server, self._lock = server, threading.Lock()
        gui = server.gui
        dock_panel(server, scan.title)
        gui.add_html(self._html("head", lead=scan.lead, command=scan.command))
        low, high = np.percentile(scan.centers, [1.0, 99.0], axis=0)
        self._box = low, high
        self._aside = np.array([_ASIDE * (high[0] - low[0]) if scan.layers else 0.0, 0.0, 0.0])
        self._splats = None if scan.splats is None else splat_arrays(scan.splats)
        names = tuple(scan.layers) or ("nothing",)
        self._layer = gui.add_dropdown(
            "surfaces by", names, visible=bool(scan.layers), hint=_LAYER_HINT
        )
        self._legend = gui.add_html("", visible=bool(scan.layers))
        self._top = self._add_cut(gui)
        self._frusta = gui.add_checkbox(
            "pictures", True, visible=bool(len(scan.poses)), hint=_PICTURES_HINT
        )
        self.said = gui.add_html(self._html("hint", can_click=bool(scan.layers)))
        """Below the settings: the answer to the latest click."""
        self._cameras: list[viser.CameraFrustumHandle] = []
        self._add_pictures()
        self._add_suggested()
        self._draw()
        self._frame()

        async def change(event: Any) -> None:
            del event
            self._draw()

        for control in (self._layer, self._top, self._frusta):
            control.on_update(change)

        def click(event: Any) -> None:  # in a thread of the pool: pictures are read
            self.click(np.asarray(event.ray_origin), np.asarray(event.ray_direction))

        server.scene.on_click()(click)

    def _add_cut(self, gui: viser.GuiApi) -> viser.GuiSliderHandle[float]:
        """Adds the height above which nothing is drawn, in the capture's unit from the floor."""
        scan, floor = self.scan, float(self._box[0][2])
        highest = float(scan.centers[:, 2].max())
        top = highest
        if len(scan.poses):
            top = min(top, float(np.median(scan.poses[:, 2, 3])) + _HEADROOM)
        size = (highest - floor) / scan.meter
        step = float(f"{max(size, 1e-6) / _CUTS:.0e}")
        most = step * np.ceil(size / step)
        first = step * np.clip(np.round((top - floor) / scan.meter / step), 0.0, most / step)
        digits = max(0, 1 - int(np.floor(np.log10(step))))
        most, first = round(float(most), digits), round(float(first), digits)
        hint = f"{_CUT_HINT} {_UNITS[scan.unit]}"
        return gui.add_slider(f"hide above [{scan.unit}]", 0.0, most, step, first, hint=hint)

    @property
    def _height(self) -> float:
        """Height above which nothing is drawn [audit units]."""
        return float(self._box[0][2]) + float(self._top.value) * self.scan.meter

    def click(self, origin: np.ndarray, direction: np.ndarray) -> Answer | None:
        """Answers a click along a ray, [3] each: on the page, and to the caller."""
        scan = self.scan
        if not scan.layers:
            return None
        with self._lock:
            row = picked(scan, origin, direction, self._height)
            if row is None:
                self.said.content = self._html("hint", can_click=True)
                self._server.scene.remove_by_name("/clicked")
                return None
            found = answer(scan, row)
            point = scan.centers[row]
            self._server.scene.add_icosphere(
                "/clicked", 1.2 * scan.edge, color=(255, 40, 40), position=point
            )
            pictures: list[dict[str, str]] = []
            for picture in found.pictures[:_SHOWN].tolist():
                assert scan.source is not None
                drawn = marked(scan, picture, point)
                if drawn is not None:
                    label = scan.source.labels[picture]
                    pictures.append({"label": label, "url": data_url(drawn)})
            self.said.content = self._html(
                "place", texts=sentences(scan, found), pictures=pictures,
                more=[] if scan.source is None
                else [scan.source.labels[i] for i in found.pictures[_SHOWN:].tolist()],
            )  # fmt: skip
            return found

    @staticmethod
    def _html(macro: str, **values: Any) -> str:
        return render_macro("apps/viewer/scan_page.html", macro, r_hint=_R_HINT, **values)

    def _draw(self) -> None:
        """Draws surfaces and splat, both below the cut."""
        scan, name, scene = self.scan, self._layer.value, self._server.scene
        top = self._height
        self._legend.content = self._html("legend", **legend_of(scan, name))
        for camera in self._cameras:
            camera.visible = self._frusta.value
        if self._splats is not None:
            kept = self._splats[0][:, 2] <= top
            arrays = [values[kept] for values in self._splats]
            scene.add_gaussian_splats("/splats", *arrays, position=self._aside)
        if not scan.layers:
            return
        is_low = scan.centers[:, 2] <= top
        scene.add_point_cloud(
            "/surfaces",
            scan.centers[is_low].astype(np.float32),
            scan.layers[name][is_low],
            point_size=scan.edge,
            point_shape="square",
            precision="float32",
        )

    def _add_pictures(self) -> None:
        """Adds a small camera for each picture; a click on one shows it."""
        scan = self.scan
        if scan.source is None:
            return
        count = len(scan.poses)
        chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_FRUSTA)).round().astype(int))
        for index in chosen.tolist():
            camera = scan.source.camera(index)
            handle = self._server.scene.add_camera_frustum(
                f"/pictures/{index:06d}",
                float(2.0 * np.arctan(0.5 * camera.height / float(camera.fy))),
                camera.width / camera.height,
                scale=0.1,
                color=_PICTURE,
                wxyz=quaternion(scan.poses[index, :3, :3]),
                position=scan.poses[index, :3, 3],
            )
            handle.on_click(functools.partial(self._show_picture, index))
            self._cameras.append(handle)

    def _show_picture(self, index: int, event: Any) -> None:
        del event
        assert self.scan.source is not None
        label = self.scan.source.labels[index]
        try:
            rgb, _ = self.scan.source.read(index)
        except (ValueError, OSError) as error:
            self.said.content = self._html("place", texts=[str(error)], pictures=[], more=[])
            return
        image = Image.fromarray(np.ascontiguousarray(rgb))
        shown = [{"label": label, "url": data_url(_small(image))}]
        self.said.content = self._html("place", texts=[], pictures=shown, more=[])

    def _add_suggested(self) -> None:
        """Adds the suggested views, with their numbers."""
        if self.scan.suggested is None:
            return
        for number, pose in enumerate(self.scan.suggested, start=1):
            scene = self._server.scene
            scene.add_camera_frustum(
                f"/suggested/{number}", 1.0, 1.33, scale=0.25, color=_SUGGESTED,
                wxyz=quaternion(pose[:3, :3]), position=pose[:3, 3],
            )  # fmt: skip
            # In the image plane: several views are taken from one position.
            scene.add_label(
                f"/suggested/{number}/label", str(number), position=(0.0, 0.0, _LABEL_AHEAD)
            )

    def _frame(self) -> None:
        """Puts the eye where the whole scan is in view, and names its two halves."""
        low, high = self._box
        if self._splats is not None and self.scan.layers:
            front = np.array([0.5 * (low[0] + high[0]), low[1], low[2]])
            scene = self._server.scene
            scene.add_label("/surfaces-label", "surfaces", position=front, anchor="top-center")
            scene.add_label(
                "/splats-label", "splat trained on the pictures", position=front + self._aside,
                anchor="top-center",
            )  # fmt: skip
        high = high + (0.0 if self._splats is None else self._aside)
        high[2] = max(min(high[2], self._height), low[2])
        place_eye(self._server, low, high)


def legend_of(scan: Scan, layer: str) -> dict[str, Any]:
    """Describes the colors of a layer: a bar from 0 to 1, or a color for each cause."""
    unseen = css_color(np.array(UNSEEN, np.uint8))
    if layer == "renderability":
        stops = [css_color(color) for color in paint(np.linspace(0.0, 1.0, _STOPS), SCORES)]
        return {"stops": stops, "causes": [], "unseen": unseen, "hint": _R_HINT}
    causes: list[dict[str, str]] = []
    if layer == "cause" and scan.facts is not None:
        is_seen = scan.facts["standpoints"] > 0
        for number, cause in enumerate(scan.causes):
            rows = np.flatnonzero(is_seen & (scan.facts["cause"] == number))
            if len(rows):
                color = css_color(scan.layers[layer][rows[0]])
                hint = ". ".join(
                    part[:1].upper() + part[1:] for part in (cause["meaning"], cause["do"]) if part
                )
                causes.append(
                    {"color": color, "name": cause.get("title", cause["name"]), "hint": f"{hint}."}
                )
    return {"stops": [], "causes": causes, "unseen": unseen, "hint": ""}


@contextlib.contextmanager
def open_scan_page(
    scan: Scan, *, host: str = "127.0.0.1", port: int = 0, allow: tuple[str, ...] = ()
) -> Generator[ScanPage]:
    """Shows a scan for as long as the context lasts.

    Args:
        scan: content of the page.
        host: address to listen at.
        port: port to listen at; 0 takes any free one.
        allow: further host names under which the page may be requested.

    Raises:
        ValueError, OSError: the port is in use, or the address is not this machine's.
    """
    server = open_server(host, port, allow)
    try:
        yield ScanPage(server, scan)
    finally:
        close_server(server)
