"""Lays out the page of a run: the scene in space, the panel beside it, and the legend over it.

The panel's words are HTML of `facts`. Its content belongs to one view and one pose. While that of
the newest query is computed, the old content stays, faint and marked.

Shape symbols: n points; s segments; H W picture size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from r3jax.apps.viewer.drawing import linear_light, pose_of, quaternion, to_bytes
from r3jax.apps.viewer.facts import (
    PLACES,
    Layer,
    busy_html,
    head_html,
    note_html,
    pending_html,
    stale_html,
)
from r3jax.geometry.cameras import Camera, look_at

_VIEW_COLOR = (120, 124, 134)
_NOW_COLOR = (37, 99, 235)
_CAMERA_COLOR = (15, 118, 110)
_STALE_COLOR = (156, 163, 175)
_SUGGESTED = (239, 68, 68)
_GRID_COLOR, _INK = (214, 217, 222), (75, 85, 99)

_FIELD_OF_VIEW = 35.0
"""Vertical field of view of the page [deg]: narrow, so that walls lean little."""

_ASPECT = 1.1
"""Width over height of the window, as long as its size is not known."""

_PHONE = 576
"""Up to this width of the window the panel is below the scene [px]."""

_AZIMUTH, _ELEVATION = -105.0, 50.0
"""Direction of the initial viewpoint [deg]."""

_FILLED = 0.94
"""Share of the window that the scene fills at first."""

_NEAREST = 0.05
"""Minimum distance of the viewpoint [m]."""

_GRID_MARGIN = 1.0
"""Margin of the grid around the scene [m]."""

Color = tuple[int, int, int]


class Canvas:
    """The 3D scene of the page. Methods may be called from any thread."""

    def __init__(self, server: viser.ViserServer, camera: Camera):
        """Adds the camera that the user can drag.

        Args:
            server: server of an empty page.
            camera: shape of all frusta.
        """
        self._server, scene = server, server.scene
        self._fov = float(2.0 * np.arctan(0.5 * camera.height / float(camera.fy)))
        self._aspect = camera.width / camera.height
        self._views: dict[int, viser.CameraFrustumHandle] = {}
        self._shown_before = 0
        scene.configure_default_lights(cast_shadow=False)
        self.gizmo = scene.add_transform_controls(
            "/camera", scale=0.6, line_width=3.5, depth_test=False
        )
        """Handles for dragging the camera."""
        self._body = scene.add_camera_frustum(
            "/camera/body",
            self._fov,
            self._aspect,
            scale=0.45,
            thickness=0.02,
            color=_CAMERA_COLOR,
            cast_shadow=False,
            receive_shadow=False,
        )

    def on_drag(self, handler: Callable[[], None]) -> None:
        """Calls the handler, in the server's thread, whenever the camera is dragged."""

        # A coroutine: threads of a pool would mix up the order of a drag.
        async def drag(event: Any) -> None:
            del event
            handler()

        self.gizmo.on_update(drag)

    @property
    def pose(self) -> np.ndarray:
        """`T_world_camera` of the draggable camera, [4, 4] float64."""
        return pose_of(np.asarray(self.gizmo.wxyz), np.asarray(self.gizmo.position))

    def place_camera(self, T_world_camera: np.ndarray) -> None:
        """Moves the draggable camera to a pose [4, 4]."""
        with self._server.atomic():
            self.gizmo.wxyz = quaternion(T_world_camera[:3, :3])
            self.gizmo.position = T_world_camera[:3, 3]

    def show_grid(self, low: np.ndarray, high: np.ndarray, floor: float) -> None:
        """Draws squares of 1 m on the floor below a box, and a scale bar.

        Args:
            low: lower corner of the box, [3] [m].
            high: upper corner, [3] [m].
            floor: height of the floor [m].
        """
        first = np.floor(low[:2] - _GRID_MARGIN)
        last = np.ceil(high[:2] + _GRID_MARGIN)
        size = last - first + (last - first) % 2  # even, so that lines are at whole meters
        middle = first + 0.5 * size
        below = floor - 0.01  # voxels of the floor hide it
        self._server.scene.add_grid(
            "/grid",
            float(size[0]),
            float(size[1]),
            plane="xy",
            cell_size=1.0,
            cell_color=_GRID_COLOR,
            section_size=5.0,
            section_color=_GRID_COLOR,
            shadow_opacity=0.0,
            position=(float(middle[0]), float(middle[1]), below),
        )
        start = np.array([np.ceil(low[0]), np.floor(low[1]), below])  # right before the scene
        ends = np.stack([start, start + np.array([1.0, 0.0, 0.0])])[None].astype(np.float32)
        self.show_lines("/scale", ends, np.full((1, 2, 3), _INK, np.uint8), 0.04)
        self._server.scene.add_label(
            "/scale/label", "1 m", position=start + np.array([0.5, -0.1, 0.0]), anchor="top-center"
        )

    def paint_camera(self, color: Color) -> None:
        """Sets the color of the dragged camera's frustum."""
        self._body.color = color

    def fill_camera(self, image: np.ndarray) -> None:
        """Shows the picture in the dragged camera's frustum, [H, W, 3] uint8."""
        self._body.image = image

    def mark_camera_stale(self) -> None:
        """Marks the picture and the suggestion of the draggable camera as out of date."""
        self.hide_suggestion()
        self._body.color, self._body.image = _STALE_COLOR, None

    def add_view(
        self,
        step: int,
        T_world_camera: np.ndarray,
        thumbnail: np.ndarray,
        on_click: Callable[[], None],
        *,
        small: bool = False,
    ) -> None:
        """Adds a view along the path with its picture [H, W, 3] uint8; it can be clicked."""
        scale = 0.05 if small else 0.1
        handle = self._add_frustum(
            f"/views/{step:06d}", T_world_camera, scale, 0.004, _VIEW_COLOR, thumbnail
        )
        self._views[step] = handle

        async def click(event: Any) -> None:
            del event
            on_click()

        handle.visible = step < self._shown_before
        handle.on_click(click)

    def show_views(self, before: int) -> None:
        """Shows only the views before a step; 0 shows none."""
        self._shown_before = before
        for step, handle in list(self._views.items()):
            handle.visible = step < before

    def show_view(self, T_world_camera: np.ndarray, image: np.ndarray) -> None:
        """Marks the view on the slider, larger than the others."""
        self._add_frustum("/view", T_world_camera, 0.26, 0.012, _NOW_COLOR, image)

    def _add_frustum(
        self,
        name: str,
        T_world_camera: np.ndarray,
        scale: float,
        thickness: float,
        color: Color,
        image: np.ndarray,
    ) -> viser.CameraFrustumHandle:
        return self._server.scene.add_camera_frustum(
            name,
            self._fov,
            self._aspect,
            scale=scale,
            thickness=thickness,
            color=color,
            image=image,
            wxyz=quaternion(T_world_camera[:3, :3]),
            position=T_world_camera[:3, 3],
            cast_shadow=False,
            receive_shadow=False,
        )

    def show_lines(
        self, name: str, segments: np.ndarray, colors: np.ndarray, thickness: float
    ) -> None:
        """Draws line segments.

        Args:
            name: name of the node; it is removed if there are no segments.
            segments: ends, [s, 2, 3] [m].
            colors: [s, 2, 3] uint8.
            thickness: [m].
        """
        if len(segments):
            # viser expects linear colors for lines; sRGB-encoded ones would look pale.
            light = to_bytes(linear_light(colors / 255.0))
            self._server.scene.add_line_segments(name, segments, light, thickness=thickness)
        else:
            self._server.scene.remove_by_name(name)

    def show_points(self, name: str, points: np.ndarray, colors: np.ndarray, edge: float) -> None:
        """Draws points as squares.

        Args:
            name: name of the node; it is removed if there are no points.
            points: [n, 3] [m].
            colors: [n, 3] uint8.
            edge: side of the squares [m].
        """
        if not len(points):
            self._server.scene.remove_by_name(name)
            return
        self._server.scene.add_point_cloud(
            name,
            points,
            colors,
            point_size=edge,
            point_shape="square",
            point_shading="gradient",
            precision="float32",
        )

    def show_splats(
        self, name: str, arrays: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    ) -> None:
        """Draws Gaussians, given as arrays of `drawing.splat_arrays`."""
        self._server.scene.add_gaussian_splats(name, *arrays)

    def show_mesh(self, name: str, glb: bytes) -> None:
        """Draws the mesh of the scene."""
        self._server.scene.add_glb(name, glb, cast_shadow=False, receive_shadow=False)

    def show_only(self, name: str, names: Sequence[str], *, is_splats: bool = False) -> None:
        """Makes one of the nodes `names` visible and hides the others."""
        # Splats are drawn last, over all that leaves no depth; before all else, no test is best.
        self.gizmo.depth_test = is_splats
        for other in names:
            handle = self._server.scene.get_handle_by_name(other)
            if handle is not None:
                handle.visible = other == name

    def show_suggestion(self, position: np.ndarray, direction: np.ndarray) -> None:
        """Shows an arrow from a position [m] along a direction."""
        self._server.scene.add_arrows(
            "/suggestion",
            np.stack([position, position + 0.9 * direction])[None].astype(np.float32),
            _SUGGESTED,
            shaft_radius=0.018,
            head_radius=0.05,
            head_length=0.12,
        )

    def hide_suggestion(self) -> None:
        """Removes the arrow."""
        self._server.scene.remove_by_name("/suggestion")


def place_eye(server: viser.ViserServer, low: np.ndarray, high: np.ndarray) -> None:
    """Frames a box as the page is first seen, in a window of any size.

    Args:
        server: of the page.
        low: lower corner, [3] [m].
        high: upper corner, [3] [m].
    """
    corners = np.stack(np.meshgrid(*np.stack([low, high]).T), axis=-1).reshape(-1, 3)
    eye = server.initial_camera
    eye.fov = float(np.deg2rad(_FIELD_OF_VIEW))
    eye.position, eye.look_at = framing(corners, _ASPECT)

    async def frame(client: viser.ClientHandle) -> None:
        camera = client.camera
        # A browser reports the size of its window before the panel takes a part of it.
        width = camera.image_width - (PANEL_WIDTH if camera.image_width > _PHONE else 0)
        camera.position, camera.look_at = framing(corners, width / camera.image_height)

    server.on_client_connect(frame)


def dock_panel(server: viser.ViserServer, title: str) -> None:
    """Puts the panel beside the scene, which is never under it."""
    gui = server.gui
    gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(15, 118, 110))
    gui.set_panel_label(title)
    gui.main_panel.dock_right()
    gui.main_panel.set_width(PANEL_WIDTH)


def framing(points: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns a position and a target [m] from which points [n, 3] [m] fill a window.

    Args:
        points: points that must be in view.
        aspect: width of the window over its height.
    """
    a, e = np.deg2rad(_AZIMUTH), np.deg2rad(_ELEVATION)
    outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    slopes = _FILLED * np.tan(0.5 * np.deg2rad(_FIELD_OF_VIEW)) * np.array([aspect, 1.0])
    axes = np.asarray(look_at(outward, np.zeros(3)), np.float64)[:3, :3]
    target = 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64)
    offset = (points - target) @ axes
    fitting = lambda: float((np.abs(offset[:, :2]) / slopes - offset[:, 2:]).max())
    for _ in range(4):  # the middle of the picture depends on the distance
        distance = max(fitting(), _NEAREST)
        seen = offset[:, :2] / (offset[:, 2:] + distance)
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance
        offset[:, :2] -= middle
        target = target + axes[:, :2] @ middle
    position = target + fitting() * outward
    return position, position + float((position - points.mean(axis=0)) @ outward) * -outward


_SHOW_HINT = (
    "Content of the drawing. Splats, measured points and the scene mesh belong to the whole run; "
    "everything else to the view on the slider."
)
_SEEN_FROM_HINT = (
    "Renderability depends on where the camera is: the mean over places in free space, or from "
    "the camera that you drag."
)
_CUT_HINT = "Nothing above this height is drawn, so that you look into the rooms from above."
_VIEW_HINT = "Goes through the run view by view. You can also click a camera on the path."
_FOLLOW_HINT = "Goes to the newest view whenever there is one."
_TURN_HINT = (
    "Turns the camera along the red arrow: the direction of largest utility from its position."
)
_RETURN_HINT = "Puts the camera back to where the view on the slider was taken."
_TRUTH_HINT = (
    "Compares with a photo from the scene that the run was recorded in. The scene is opened for "
    "it, which takes some seconds and half a gigabyte of memory, more for large ones."
)
_CANDIDATES_HINT = (
    "Draws the poses that the planner could choose from, yellow best. They are computed "
    "again, which takes as long as planning took."
)
_FRUSTA_HINT = "Draws a small camera for every view up to the one on the slider."

PANEL_WIDTH = 360
"""Width of the panel beside the scene [px]."""

_LEGEND_WIDTH = 300
"""Width of the legend over the scene [px]."""

_EDGE = 14
"""Distance of the legend from the edges of the scene [px]."""


@dataclass(frozen=True)
class DisplaySettings:
    """Settings of the panel."""

    step: int
    """Index of the view on the slider, from 0."""

    layer: Layer
    """Layer that is drawn."""

    place: str
    """Position from which the map is scored: one of `PLACES`."""

    cut: float
    """Height above which nothing is drawn [m]."""

    shows_candidates: bool
    shows_views: bool
    """True if the views before the one on the slider are drawn."""

    shows_truth: bool
    """True if the true image of the draggable camera is shown."""

    @property
    def scene(self) -> tuple[object, ...]:
        """Settings on which the drawing of the place depends."""
        return self.step, self.layer, self.place, self.cut


@dataclass(frozen=True)
class Menu:
    """Choices of the panel; the first layer is selected at first."""

    title: str
    num_views: int
    layers: tuple[Layer, ...]

    heights: tuple[float, float, float]
    """Minimum, maximum and initial height of the cut [m]."""

    is_live: bool
    """True if views are being added; the newest one is then followed."""

    has_truth: bool
    """True if true images can be rendered."""


class _Section:
    """HTML of one view and pose. It becomes faint when another one is selected."""

    def __init__(self, handle: viser.GuiHtmlHandle):
        """Takes over the content of the handle."""
        self._handle, self._shown = handle, handle.content

    @property
    def content(self) -> str:
        """Content on the page."""
        return self._handle.content

    def show(self, content: str) -> None:
        """Shows the result of the newest query."""
        self._shown, self._handle.content = content, content

    def mark(self, text: str) -> None:
        """Marks the content as out of date, with a note on the current computation."""
        stale = stale_html(self._shown, text)
        if self._handle.content != stale:
            self._handle.content = stale


class Controls:
    """The panel and the legend. Methods may be called from any thread."""

    def __init__(self, server: viser.ViserServer, head: str, menu: Menu):
        """Lays out the panel and the legend.

        Args:
            server: server of an empty page.
            head: text below the title.
            menu: choices of the panel.
        """
        gui = server.gui
        self._server, self._layers = server, {layer.name: layer for layer in menu.layers}
        self._caption = ""
        dock_panel(server, menu.title)
        gui.add_html(head_html(head))
        self._note = gui.add_html("", visible=False)
        self._add_choices(gui, menu)
        self._add_view(gui, menu)
        self._add_camera(gui, menu)
        self._add_legend(gui)

    def _add_choices(self, gui: viser.GuiApi, menu: Menu) -> None:
        """Adds the menus that select the drawing."""
        names = tuple(self._layers)
        self._layer = gui.add_dropdown("show", names, hint=_SHOW_HINT)
        self._place = gui.add_dropdown("seen from", PLACES, hint=_SEEN_FROM_HINT)
        low, high, first = menu.heights
        self._cut = gui.add_slider("hide above [m]", low, high, 0.05, first, hint=_CUT_HINT)
        self._place.visible = self._layers[names[0]].has_score

    def _add_view(self, gui: viser.GuiApi, menu: Menu) -> None:
        """Adds the slider and the section about its view."""
        last, is_live = max(menu.num_views, 1), menu.is_live
        self._step = gui.add_slider("view", 1, max(last, 2), 1, last, hint=_VIEW_HINT)
        self._follow = gui.add_checkbox(
            "follow newest", is_live, visible=is_live, hint=_FOLLOW_HINT
        )
        with gui.add_folder("View on the slider"):
            self._facts = _Section(gui.add_html(""))
            self._candidates = gui.add_checkbox("candidates", False, hint=_CANDIDATES_HINT)
            self._frusta = gui.add_checkbox("earlier views", True, hint=_FRUSTA_HINT)

    def _add_camera(self, gui: viser.GuiApi, menu: Menu) -> None:
        """Adds the numbers and pictures of the dragged camera."""
        with gui.add_folder("Camera that you drag"):
            self._numbers = _Section(gui.add_html(pending_html()))
            self._pictures = _Section(gui.add_html(""))
            self._truth = gui.add_checkbox(
                "true image", False, visible=menu.has_truth, hint=_TRUTH_HINT
            )
            self._turn = gui.add_button("Look along the suggested direction", hint=_TURN_HINT)
            self._return = gui.add_button("Go to the view on the slider", hint=_RETURN_HINT)

    def _add_legend(self, gui: viser.GuiApi) -> None:
        """Adds the legend over the scene, with a progress bar."""
        window = gui.add_panel()
        with window.add_tab("Legend"):
            self._legend = gui.add_html("")
            self._bar = gui.add_progress_bar(0.0, visible=False)
        window.float(x=_EDGE, y=_EDGE, width=_LEGEND_WIDTH)

    def listen(
        self,
        on_wish: Callable[[], None],
        on_turn: Callable[[], None],
        on_return: Callable[[], None],
    ) -> None:
        """Registers handlers of the user's actions; they run in the server's thread.

        Args:
            on_wish: a setting was changed.
            on_turn: the button for the suggested direction was clicked.
            on_return: the button for the view on the slider was clicked.
        """

        # Coroutines run one after the other; threads of a pool would mix up their order.
        async def change(event: Any) -> None:
            del event
            self._place.visible = self._layers[self._layer.value].has_score
            on_wish()

        async def turn(event: Any) -> None:
            del event
            on_turn()

        async def go_back(event: Any) -> None:
            del event
            on_return()

        for control in (self._step, self._cut, self._layer, self._place):
            control.on_update(change)
        for box in (self._candidates, self._frusta, self._truth):
            box.on_update(change)
        self._turn.on_click(turn)
        self._return.on_click(go_back)

    @property
    def settings(self) -> DisplaySettings:
        """Current settings."""
        return DisplaySettings(
            step=int(self._step.value) - 1,
            layer=self._layers[self._layer.value],
            place=self._place.value,
            cut=float(self._cut.value),
            shows_candidates=self._candidates.value,
            shows_views=self._frusta.value,
            shows_truth=self._truth.value,
        )

    @property
    def is_following(self) -> bool:
        """True if the newest view is followed."""
        return self._follow.value

    def set_step(self, step: int, num_views: int) -> None:
        """Moves the slider and extends its range."""
        self._step.max = max(num_views, 2)
        self._step.value = step + 1

    def show_view(self, content: str) -> None:
        """Shows the view on the slider."""
        self._facts.show(content)

    def show_numbers(self, content: str) -> None:
        """Shows the dragged camera's numbers."""
        self._numbers.show(content)

    def show_pictures(self, content: str) -> None:
        """Shows the dragged camera's pictures."""
        self._pictures.show(content)

    def mark_camera_stale(self) -> None:
        """Marks the numbers of the draggable camera as out of date."""
        self._numbers.mark("")
        self._pictures.mark("being computed …")

    def mark_view_stale(self, step: int) -> None:
        """Marks the facts as out of date: another view was selected."""
        self._facts.mark(f"opening view {step + 1} …")

    def show_busy(self, text: str, share: float) -> None:
        """Shows a note on the current computation, and its progress in [0, 1]."""
        with self._server.atomic():
            self._legend.content = busy_html(text, self._caption)
            self._bar.value, self._bar.visible = 100.0 * share, True

    def show_legend(self, content: str) -> None:
        """Replaces the legend."""
        self._caption = content
        with self._server.atomic():
            self._legend.content, self._bar.visible = content, False

    def show_ready(self) -> None:
        """Shows the legend without a progress bar: everything is up to date."""
        self.show_legend(self._caption)

    def show_note(self, text: str) -> None:
        """Shows a problem; an empty text removes the line."""
        with self._server.atomic():
            self._note.content, self._note.visible = note_html(text), bool(text)
