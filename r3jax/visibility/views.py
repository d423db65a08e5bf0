"""Projects points of the world into a view: pinhole, or all directions around a position.

The panoramic view is an octahedral map of the sphere: no poles, and its borders wrap in closed
form.

Besides its position every point gets scales: the sum of the absolute derivatives of a pixel
coordinate along the world's three axes. Half of it times the edge of a voxel is the extent of the
voxel's projection from its center, exact to first order for any orientation.

Settings are traced, so that a sweep over them compiles once.

Shape symbols: n points; h w size of the view.
"""

import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels import calls


def as_float32(value: ArrayLike) -> Float[Array, "..."]:
    """Converts a setting, so that Python numbers and arrays compile to the same program."""
    return jnp.asarray(value, dtype=jnp.float32)


class VisibilityConfig(eqx.Module):
    """Range of a camera and resolution of the depth buffers."""

    max_range: Float[Array, ""] = eqx.field(default=5.0, converter=as_float32)
    """Range of the sensor: nothing farther away counts as visible [m]."""

    tolerance: Float[Array, ""] = eqx.field(default=2.0, converter=as_float32)
    """A voxel this far behind the depth buffer, across the surface in it, still counts as
    visible [voxels]. Centers lie up to 1.7 voxels apart along a ray that crosses a single
    surface; 2 agrees best with ray casting."""

    zbuffer_size: int = eqx.field(default=128, static=True)
    """Longest side of the pinhole depth buffer [px]; never more than the image's."""

    panorama_size: int = eqx.field(default=256, static=True)
    """Side of the octahedral depth buffer round a position [px]; a power of two."""

    def __check_init__(self) -> None:
        """Refuses a side that the octahedral map cannot have."""
        # Powers of two halve exactly, so that the borders of every level of the pyramid wrap alike.
        if self.panorama_size < 2 or self.panorama_size & (self.panorama_size - 1):
            raise InputError(f"panorama_size must be a power of two, got {self.panorama_size}")


Coordinates = Float[Array, "3 n"] | tuple[Array, Array, Array]
"""x, y and z of points [m], as one array or three."""


class Placement(eqx.Module):
    """Projections of points in a buffer."""

    column: Float[Array, " n"]
    """Continuous column [px]."""

    row: Float[Array, " n"]
    """Continuous row [px]."""

    column_scale: Float[Array, " n"]
    """Columns per meter [px/m]: the sum over the world's axes of |d column / d axis|."""

    row_scale: Float[Array, " n"]
    """The same for the row."""

    sum_scale: Float[Array, " n"]
    """The same for column + row."""

    difference_scale: Float[Array, " n"]
    """The same for column - row."""

    distance: Float[Array, " n"]
    """Distance from the camera [m]."""

    ahead: Bool[Array, " n"]
    """False behind the camera, where the other fields are meaningless."""


class PinholeView(eqx.Module):
    """One view, at the size of its depth buffer."""

    camera: Camera
    """Intrinsics of the buffer."""

    T_world_camera: Float[Array, "4 4"]
    """Pose."""

    max_range: Float[Array, ""]
    """Nothing farther is visible [m]."""

    wraps: ClassVar[bool] = False

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the buffer [px]."""
        return self.camera.height, self.camera.width

    @property
    def pixel_angle(self) -> Float[Array, ""]:
        """Angle that a pixel covers on the axis [rad]."""
        return 1.0 / self.camera.focal

    def in_camera(self, points: Coordinates) -> tuple[Array, Array, Array]:
        """Computes coordinates in the camera's frame [m]."""
        # Coordinates apart, as long vectors: no [n, 3] array, and R's transpose is its inverse.
        R, t = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        offset = [points[i] - t[i] for i in range(3)]

        def along(j: int) -> Array:
            return R[0, j] * offset[0] + R[1, j] * offset[1] + R[2, j] * offset[2]

        return along(0), along(1), along(2)

    def may_see(self, points: Coordinates, margin: Float[Array, ""]) -> Bool[Array, " n"]:
        """Returns False only for points that lie outside the frustum by more than `margin` [m]."""
        x, y, z = self.in_camera(points)
        camera = self.camera
        reach = self.max_range + margin
        # Slopes of the image's borders, which differ where the principal point is off center.
        low_x, high_x = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
        low_y, high_y = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
        # Distance to a side plane x = k z is |x - k z| / sqrt(1 + k^2).
        slack: Callable[[Array], Array] = lambda k: margin * jnp.sqrt(1.0 + k * k)
        is_in = (x >= low_x * z - slack(low_x)) & (x <= high_x * z + slack(high_x))
        is_in &= (y >= low_y * z - slack(low_y)) & (y <= high_y * z + slack(high_y))
        return is_in & (z > -margin) & (x * x + y * y + z * z <= reach * reach)

    def place(self, points: Float[Array, "3 n"]) -> Placement:
        """Projects points of the world."""
        x, y, z = self.in_camera(points)
        # Not z > 0: right at the camera's plane the scales would grow without bound.
        is_ahead = z > 1e-3
        # Behind the camera any finite number will do: those points are masked.
        inverse = 1.0 / jnp.where(is_ahead, z, 1.0)
        R = self.T_world_camera[:3, :3]

        # Quotient rule along each world axis, with the slope x / z or y / z that is at hand.
        def gradient(f: Array, j: int, slope: Array) -> list[Array]:
            return [f * inverse * (R[i, j] - slope * R[i, 2]) for i in range(3)]

        along_column = gradient(self.camera.fx, 0, x * inverse)
        along_row = gradient(self.camera.fy, 1, y * inverse)

        def total(parts: list[Array]) -> Array:
            return jnp.abs(parts[0]) + jnp.abs(parts[1]) + jnp.abs(parts[2])

        # Added with their signs, before the absolute value: the sum of both scales is a bound only.
        both = list(zip(along_column, along_row, strict=True))
        return Placement(
            column=self.camera.fx * x * inverse + self.camera.cx,
            row=self.camera.fy * y * inverse + self.camera.cy,
            column_scale=total(along_column),
            row_scale=total(along_row),
            sum_scale=total([a + b for a, b in both]),
            difference_scale=total([a - b for a, b in both]),
            distance=jnp.sqrt(x * x + y * y + z * z),
            ahead=is_ahead,
        )


class PanoramaView(eqx.Module):
    """All directions round a position, on an octahedral map."""

    position: Float[Array, " 3"]
    """[m], world."""

    max_range: Float[Array, ""]
    """Nothing farther is visible [m]."""

    size: int = eqx.field(static=True)
    """Side of the map [px]."""

    wraps: ClassVar[bool] = True

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the buffer [px]."""
        return self.size, self.size

    @property
    def pixel_angle(self) -> float:
        """Angle that a pixel covers on average [rad]."""
        # The whole sphere, 4 pi, over size^2 pixels, and of that the root.
        return math.sqrt(4.0 * math.pi) / self.size

    def may_see(self, points: Coordinates, margin: Float[Array, ""]) -> Bool[Array, " n"]:
        """Returns False only for points out of range by more than `margin` [m]."""
        x, y, z = (points[i] - self.position[i] for i in range(3))
        reach = self.max_range + margin
        return x * x + y * y + z * z <= reach * reach

    def place(self, points: Float[Array, "3 n"]) -> Placement:
        """Projects points of the world on the map.

        With L = |x| + |y| + |z| and u = x / L, the derivatives of u along the three axes sum to
        (1 + |u|) / L; on the lower half of the sphere u and v swap.
        """
        x, y, z = (points[i] - self.position[i] for i in range(3))
        # At the position itself there is no direction: the floors keep both quotients finite.
        distance = jnp.maximum(jnp.sqrt(x * x + y * y + z * z), 1e-6)
        inverse = 1.0 / jnp.maximum(jnp.abs(x) + jnp.abs(y) + jnp.abs(z), 1e-6)
        u, v = x * inverse, y * inverse
        a, b = jnp.abs(u), jnp.abs(v)
        # Not `jnp.sign`: its 0 at 0 would put the lower pole on the upper one.
        sign: Callable[[Array], Array] = lambda value: jnp.where(value >= 0.0, 1.0, -1.0)
        half = 0.5 * self.size
        is_lower = z < 0.0
        # On the lower half of the map u and v swap places, and so do their slopes.
        p, q = jnp.where(is_lower, b, a), jnp.where(is_lower, a, b)

        # w = u + k v has the derivatives (1 - w sign x) / L, (k - w sign y) / L, -w sign z / L.
        # Folding the lower half only flips the signs of u + v and u - v: no choice is needed.
        def diagonal(w: Array, k: float) -> Array:
            return jnp.abs(1.0 - w * sign(x)) + jnp.abs(k - w * sign(y)) + jnp.abs(w)

        return Placement(
            column=jnp.where(is_lower, (1.0 - b) * sign(u), u) * half + half,
            row=jnp.where(is_lower, (1.0 - a) * sign(v), v) * half + half,
            column_scale=half * inverse * (1.0 + p),
            row_scale=half * inverse * (1.0 + q),
            sum_scale=half * inverse * diagonal(u + v, 1.0),
            difference_scale=half * inverse * diagonal(u - v, -1.0),
            distance=distance,
            ahead=jnp.ones(distance.shape, dtype=bool),
        )


View = PinholeView | PanoramaView


def layout_of(view: View) -> calls.Layout:
    """Returns the static properties of a view that kernels need while tracing."""
    return calls.Layout(view.wraps, *view.shape)


def for_kernels(view: View, tolerance: Float[Array, ""], focal: Float[Array, ""]) -> calls.Views:
    """Converts one view to the kernels' layout; under `jax.vmap` it gives `calls.Views` of many."""
    angle = jnp.asarray(view.pixel_angle, dtype=jnp.float32)
    rest = (view.max_range, tolerance, angle, focal)
    if isinstance(view, PanoramaView):
        one = jnp.ones(())
        return calls.Views(view.position, jnp.zeros(9), one, one, one, one, *rest)
    camera, T = view.camera, view.T_world_camera
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    return calls.Views(T[:3, 3], T[:3, :3].ravel(), *lens, *rest)


def pinhole_view(
    camera: Camera, T_world_camera: Float[Array, "4 4"], config: VisibilityConfig
) -> PinholeView:
    """Makes the view of a camera, its longest side at most `VisibilityConfig.zbuffer_size` pixels.

    Visibility is piecewise constant, so no derivative passes through the pose.
    """
    longest = max(camera.width, camera.height)
    # Never enlarged: more pixels than the camera has show nothing more.
    scale = min(1.0, config.zbuffer_size / longest)
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    pose = jax.lax.stop_gradient(T_world_camera)
    return PinholeView(camera.resized(*size), pose, config.max_range)


def panorama_view(position: Float[Array, " 3"], config: VisibilityConfig) -> PanoramaView:
    """Makes the view of all directions from a position; no derivative passes through it."""
    still = jax.lax.stop_gradient(position)
    return PanoramaView(still, config.max_range, config.panorama_size)


def wrap(
    row: Int[Array, " n"], column: Int[Array, " n"], size: Int[Array, " n"]
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """Maps pixels one step outside the octahedral map to the pixels they continue at.

    The borders of the map are glued to themselves, turned.
    """
    crosses_column = (column < 0) | (column >= size)
    crosses_row = (row < 0) | (row >= size)
    # Crossing one border mirrors the other coordinate: the square's edges are folded in half.
    turned_row = jnp.where(crosses_column, size - 1 - row, row)
    turned_column = jnp.where(crosses_row, size - 1 - column, column)
    # A corner crosses both borders and is turned out again; points to be left out lie anywhere.
    return jnp.clip(turned_row, 0, size - 1), jnp.clip(turned_column, 0, size - 1)
