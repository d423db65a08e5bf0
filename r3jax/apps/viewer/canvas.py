"""The three dimensions of the page: what stands where. It knows viser, and nothing of maps.

Shape symbols: n points; s segments; H W picture size.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from r3jax.apps.viewer.pictures import linear_light, pose_of, quaternion, to_bytes
from r3jax.geometry.cameras import Camera, look_at

_VIEW_COLOR = (120, 124, 134)
_NOW_COLOR = (37, 99, 235)
_CAMERA_COLOR = (15, 118, 110)
_STALE_COLOR = (156, 163, 175)
_SUGGESTED = (239, 68, 68)
_GRID_COLOR, _INK = (214, 217, 222), (75, 85, 99)

_FIELD_OF_VIEW = 35.0
"""Vertical, of the eye that looks at the page [deg]: walls lean little."""

_ASPECT = 1.1
"""Width over height that the scene is framed for where no window is known."""

_PHONE = 576
"""Windows no wider than this have the panel below the scene [px]."""

_AZIMUTH, _ELEVATION = -105.0, 50.0
"""From where the page is first seen [deg]."""

_FILLED = 0.94
"""Share of the window that the scene fills then."""

_NEAREST = 0.05
"""Least distance of the eye [m]."""

_GRID_MARGIN = 1.0
"""How far the grid goes beyond the scene [m]."""

Color = tuple[int, int, int]


class Canvas:
    """Everything in space, by what it shows. Methods may be called from any thread."""

    def __init__(self, server: viser.ViserServer, camera: Camera):
        """Puts the camera that can be dragged on the canvas.

        Args:
            server: with nothing on its page.
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
        """The handles by which the camera is dragged."""
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
        """`T_world_camera` of the camera that is dragged, [4, 4] float64."""
        return pose_of(np.asarray(self.gizmo.wxyz), np.asarray(self.gizmo.position))

    def place_camera(self, T_world_camera: np.ndarray) -> None:
        """Puts the camera that is dragged somewhere."""
        with self._server.atomic():
            self.gizmo.wxyz = quaternion(T_world_camera[:3, :3])
            self.gizmo.position = T_world_camera[:3, 3]

    def place_eye(self, low: np.ndarray, high: np.ndarray, panel: int) -> None:
        """Frames a box as the page is first seen, in whatever window.

        Args:
            low: lower corner [3] [m].
            high: upper corner.
            panel: width of what stands beside the scene [px].
        """
        corners = np.stack(np.meshgrid(*np.stack([low, high]).T), axis=-1).reshape(-1, 3)
        eye = self._server.initial_camera
        eye.fov = float(np.deg2rad(_FIELD_OF_VIEW))
        eye.position, eye.look_at = framing(corners, _ASPECT)

        async def frame(client: viser.ClientHandle) -> None:
            camera = client.camera
            # A browser tells of its window first, and puts the panel in afterwards.
            width = camera.image_width - (panel if camera.image_width > _PHONE else 0)
            camera.position, camera.look_at = framing(corners, width / camera.image_height)

        self._server.on_client_connect(frame)

    def show_grid(self, low: np.ndarray, high: np.ndarray, floor: float) -> None:
        """Squares of 1 m on the floor below a box, given by its corners [3] [m], and a scale.

        Args:
            low: lower corner.
            high: upper corner.
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
        """Forgets the dragged camera's pose."""
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
        """Shows those before one of them; 0 shows none."""
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
        """Lines of a thickness [m]: ends [s, 2, 3] [m], colors [s, 2, 3] uint8; none: nothing."""
        if len(segments):
            # What viser takes the colors of lines for: encoded ones would be washed out.
            light = to_bytes(linear_light(colors / 255.0))
            self._server.scene.add_line_segments(name, segments, light, thickness=thickness)
        else:
            self._server.scene.remove_by_name(name)

    def show_points(self, name: str, points: np.ndarray, colors: np.ndarray, edge: float) -> None:
        """Squares of an edge [m] at points [n, 3] [m] in colors [n, 3] uint8; none: nothing."""
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
        """Gaussians, as `overlays.splat_arrays` gives them."""
        self._server.scene.add_gaussian_splats(name, *arrays)

    def show_mesh(self, name: str, glb: bytes) -> None:
        """Shows the scene's own triangles."""
        self._server.scene.add_glb(name, glb, cast_shadow=False, receive_shadow=False)

    def show_only(self, name: str, names: Sequence[str], *, is_splats: bool = False) -> None:
        """Leaves only one of the nodes called `names` visible; those not there stay away."""
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
        """Takes the arrow away."""
        self._server.scene.remove_by_name("/suggestion")


def framing(points: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns a position and a target [m] from which points [n, 3] [m] fill a window.

    Args:
        points: what is to be in view.
        aspect: width of the window over its height.
    """
    a, e = np.deg2rad(_AZIMUTH), np.deg2rad(_ELEVATION)
    outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    slopes = _FILLED * np.tan(0.5 * np.deg2rad(_FIELD_OF_VIEW)) * np.array([aspect, 1.0])
    axes = np.asarray(look_at(outward, np.zeros(3)), np.float64)[:3, :3]
    target = 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64)
    offset = (points - target) @ axes
    fitting = lambda: float((np.abs(offset[:, :2]) / slopes - offset[:, 2:]).max())
    for _ in range(4):  # what is in the middle of the picture depends on the distance
        distance = max(fitting(), _NEAREST)
        seen = offset[:, :2] / (offset[:, 2:] + distance)
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance
        offset[:, :2] -= middle
        target = target + axes[:, :2] @ middle
    position = target + fitting() * outward
    return position, position + float((position - points.mean(axis=0)) @ outward) * -outward
