"""The pinhole camera and its pose.

World: right-handed, z up, meters. Camera: OpenCV axes (x right, y down, z forward). A pose is
the 4x4 matrix `T_world_camera` that takes points from the camera to the world. Pixel centers
lie at +0.5.

Shape symbols: H, W image size; n points; V views.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Num

from r3jax.errors import InputError
from r3jax.geometry.numerics import safe_norm

LOOKS = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Names of the directions."""


def _as_float32(value: ArrayLike) -> Float[Array, "..."]:
    return jnp.asarray(value, dtype=jnp.float32)


class Camera(eqx.Module):
    """Intrinsics of a pinhole camera. The image size is static, the rest is traced.

    Raises:
        ValueError: an image without pixels; a focal length that is not positive or a principal
            point that is not finite (where they are known, that is outside jit).
    """

    width: int = eqx.field(static=True)
    """Columns [px]."""

    height: int = eqx.field(static=True)
    """Rows [px]."""

    fx: Float[Array, ""] = eqx.field(converter=_as_float32)
    """Horizontal focal length [px]."""

    fy: Float[Array, ""] = eqx.field(converter=_as_float32)
    """Vertical focal length [px]."""

    cx: Float[Array, ""] = eqx.field(converter=_as_float32)
    """Principal point, column [px]; the left edge of the image is 0."""

    cy: Float[Array, ""] = eqx.field(converter=_as_float32)
    """Principal point, row [px]; the top edge of the image is 0."""

    def __check_init__(self) -> None:
        """Refuses intrinsics whose rays would be infinite or NaN."""
        if self.width < 1 or self.height < 1:
            raise InputError(f"a camera's image needs pixels, got {self.width} x {self.height}")
        # Under jit values are not known; `nan_unless_valid` then makes scores NaN.
        if is_traced(self.fx, self.fy, self.cx, self.cy):
            return
        for name, value in (("fx", float(self.fx)), ("fy", float(self.fy))):
            # Written as a condition that NaN fails, too.
            if not 0.0 < value < np.inf:
                raise InputError(f"{name} must be positive and finite [px], got {value}")
        for name, value in (("cx", float(self.cx)), ("cy", float(self.cy))):
            if not np.isfinite(value):
                raise InputError(f"{name} must be finite [px], got {value}")

    @staticmethod
    def from_fov(width: int, height: int, horizontal_fov_deg: float | int = 60.0) -> "Camera":
        """Makes a camera with square pixels, centered, from its horizontal field of view [deg]."""
        if not 0.0 < horizontal_fov_deg < 180.0:
            raise InputError(
                f"horizontal_fov_deg must lie between 0 and 180, got {horizontal_fov_deg}"
            )
        # The angle spans the image's edges; the outermost pixel centers lie half a pixel inside.
        focal = 0.5 * width / np.tan(0.5 * np.deg2rad(horizontal_fov_deg))
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)

    @property
    def focal(self) -> Float[Array, ""]:
        """Geometric mean of the two focal lengths [px]."""
        # The geometric mean keeps the solid angle of a pixel, 1 / (fx fy).
        return jnp.sqrt(self.fx * self.fy)

    def resized(self, width: int, height: int) -> "Camera":
        """Returns a camera of the same field of view with another number of pixels."""
        # Edges lie at 0 and at the size, so the principal point scales without half-pixel shifts.
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)


def project(
    camera: Camera, points_camera: Float[Array, "*n 3"]
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Projects points in the camera's frame.

    Args:
        camera: the intrinsics.
        points_camera: points in the camera's frame [m].

    Returns:
        Pixel coordinates (column, row) and z-depth [m]. Points with depth <= 0 are behind the
        camera; their pixel coordinates are finite but undefined.
    """
    x, y, z = points_camera[..., 0], points_camera[..., 1], points_camera[..., 2]
    # Divided by a safe number before the choice: the gradient of 1 / 0 would be NaN.
    z_safe = jnp.where(z > 0.0, z, 1.0)
    pixels = jnp.stack(
        [camera.fx * x / z_safe + camera.cx, camera.fy * y / z_safe + camera.cy], axis=-1
    )
    return pixels, z


def pixel_rays(camera: Camera) -> Float[Array, "H W 3"]:
    """Computes rays through the pixel centers in the camera's frame, with z = 1 (not length 1)."""
    u = (jnp.arange(camera.width, dtype=jnp.float32) + 0.5 - camera.cx) / camera.fx
    v = (jnp.arange(camera.height, dtype=jnp.float32) + 0.5 - camera.cy) / camera.fy
    # At z = 1 a ray times the z-depth is the point, without a square root.
    shape = (camera.height, camera.width)
    return jnp.stack(
        [
            jnp.broadcast_to(u[None, :], shape),
            jnp.broadcast_to(v[:, None], shape),
            jnp.ones(shape, dtype=jnp.float32),
        ],
        axis=-1,
    )


def unproject(camera: Camera, depth: Float[Array, "H W"]) -> Float[Array, "H W 3"]:
    """Computes points in the camera's frame [m] from a z-depth image [m]."""
    return pixel_rays(camera) * depth[..., None]


def transform(T: Float[Array, "4 4"], points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Applies a rigid transform to points."""
    # Reshaped, not broadcast: the tests let JAX raise on implicit rank promotion.
    return jnp.einsum("ij,...j->...i", T[:3, :3], points) + T[:3, 3].reshape(
        (1,) * (points.ndim - 1) + (3,)
    )


def invert_pose(T: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """Inverts a rigid transform by transposing its rotation."""
    # The transpose, not a solver: exact for rotations, and no pivots under vmap.
    R_inverse = T[:3, :3].T
    t_inverse = -R_inverse @ T[:3, 3]
    top = jnp.concatenate([R_inverse, t_inverse[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]], dtype=T.dtype)], axis=0)


def pose_along(
    position: Num[Array | np.ndarray, " 3"], direction: Num[Array | np.ndarray, " 3"]
) -> Float[Array, "4 4"]:
    """Makes the roll-free pose at `position` that looks along `direction`.

    The image's x axis stays level. Looking straight up or down, level is ambiguous: the x axis
    is then the world's x axis.

    Args:
        position: camera center in the world [m].
        direction: viewing direction in the world, any length but 0.

    Returns:
        `T_world_camera`; not rigid if the direction is 0 (possible only under jit).

    Raises:
        ValueError: shapes other than [3], values that are not finite, a direction without length.
    """
    position, direction = _point("position", position), _point("direction", direction)
    if not is_traced(direction) and not np.any(np.asarray(direction)):
        raise InputError("direction has no length: give a vector that is not zero")
    # Only jit lets a zero direction pass: its pose is finite but not rigid, which
    # `nan_unless_valid` notices.
    forward = direction / jnp.maximum(safe_norm(direction), 1e-12)
    # The product of forward and up, so that its z is 0 exactly: level at every pitch.
    right = jnp.stack([forward[1], -forward[0], jnp.zeros_like(forward[0])])
    length = safe_norm(right)
    # Below this, float32 cannot resolve the level direction.
    is_vertical = length < 1e-6
    # Replaced before the division: the gradient of the branch not taken must be finite, too.
    length_safe = jnp.where(is_vertical, 1.0, length)
    right = jnp.where(is_vertical, jnp.array([1.0, 0.0, 0.0]), right / length_safe)
    # In this order the axes are right-handed: x right, y down, z forward.
    down = jnp.cross(forward, right)
    R = jnp.stack([right, down, forward], axis=1)
    top = jnp.concatenate([R, position[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]])], axis=0)


def look_at(
    position: Num[Array | np.ndarray, " 3"], target: Num[Array | np.ndarray, " 3"]
) -> Float[Array, "4 4"]:
    """Makes the roll-free pose at `position` that looks at `target` (both [m], world).

    Raises:
        ValueError: shapes other than [3], values that are not finite, or two equal points.
    """
    position, target = _point("position", position), _point("target", target)
    # Refused here, where the error can name both points: `pose_along` only gets a zero direction.
    if not is_traced(position, target) and np.array_equal(position, target):
        raise InputError("position and target are the same point: no viewing direction")
    return pose_along(position, target - position)


def _point(name: str, value: ArrayLike) -> Float[Array, " 3"]:
    point = _as_float32(value)
    if point.shape != (3,):
        several = ": use jax.vmap over several" if point.shape[1:] == (3,) else ""
        raise InputError(f"{name} must have shape [3], got {point.shape}{several}")
    if not is_traced(point) and not np.isfinite(np.asarray(point)).all():
        raise InputError(f"{name} is not finite: {np.asarray(point).tolist()}")
    return point


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Computes the angle of the rotation between two poses, [4, 4] each [rad]. On the host."""
    # Clipped below: rounding may put the cosine of no turn above 1.
    cosine = 0.5 * (np.trace(first[:3, :3].T @ second[:3, :3]) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


RIGID_TOLERANCE = 1e-3
"""Largest deviation of R R^T from the identity. Rounding to half precision makes at most 9e-4 of
it, a scale of 1 % makes 2e-2."""

_LAST_ROW_TOLERANCE = 1e-5


def rigid_error(T: np.ndarray) -> str | None:
    """Describes the mistake in a 4x4 pose; None if it is rigid and finite. On the host."""
    if T.shape != (4, 4):
        return f"a pose is a 4x4 matrix, got shape {T.shape}"
    # First: every comparison below is False for NaN, and the pose would pass.
    if not np.all(np.isfinite(T)):
        return "the pose has entries that are not finite"
    # In double precision the product's own rounding stays far below the tolerance.
    R = T[:3, :3].astype(np.float64)
    deviation = float(np.abs(R @ R.T - np.eye(3)).max())
    if deviation > RIGID_TOLERANCE:
        scale = float(np.sqrt(np.trace(R @ R.T) / 3.0))
        is_scaled = np.abs(R @ R.T - scale**2 * np.eye(3)).max() <= RIGID_TOLERANCE * scale**2
        why = f"it is scaled by {scale:.4g}: divide the rotation, not the position, by that"
        return (
            f"the pose is not rigid: its rotation deviates from orthonormal by {deviation:.3g} "
            f"({why if is_scaled and scale > 0.0 else 'is a shear mixed in, or is it transposed?'})"
        )
    # Checked after orthonormality: only then is a negative determinant a mirror.
    if np.linalg.det(R) < 0:
        return (
            "the pose mirrors (its rotation has determinant -1): reverse one axis, or exchange "
            "two; a camera's axes are x right, y down, z ahead (OpenCV) or x right, y up, z back "
            "(OpenGL), and worlds are right-handed (Unity's is not)"
        )
    if np.abs(T[3] - np.array([0.0, 0.0, 0.0, 1.0])).max() > _LAST_ROW_TOLERANCE:
        return f"the pose's last row must be 0 0 0 1, got {T[3].tolist()}"
    return None


@jax.jit
def nan_unless_valid(
    camera: Camera, T_world_camera: Float[Array, "4 4"], *lengths: Float[Array, ""]
) -> Float[Array, ""]:
    """Returns 1 for a valid view and NaN otherwise: a factor of scores under jit.

    Nothing can be raised there, and the score of a pose that is not rigid would be 0. `rigid_error`
    is the check outside jit.

    Args:
        camera: whose intrinsics must be finite, and its focal lengths positive.
        T_world_camera: must be rigid and finite.
        lengths: of maps and grids, which must be positive and finite.
    """
    positive = jnp.stack([camera.fx, camera.fy, *lengths])
    is_valid = jnp.all((positive > 0.0) & jnp.isfinite(positive))
    is_valid &= jnp.isfinite(camera.cx) & jnp.isfinite(camera.cy) & is_rigid(T_world_camera)
    # A factor, not a branch: times 1 a score keeps its bits and its gradient.
    return jnp.where(is_valid, 1.0, jnp.nan)


def is_rigid(T: Float[Array, "4 4"]) -> Bool[Array, ""]:
    """Checks that `rigid_error` finds nothing wrong with a pose."""
    R = T[:3, :3].astype(jnp.float32)
    # Not a matrix product, which some devices compute with 10-bit mantissas.
    deviation = jnp.sum(R[:, None, :] * R[None, :, :], axis=2) - jnp.eye(3)
    last = T[3].astype(jnp.float32) - jnp.array([0.0, 0.0, 0.0, 1.0])
    return (
        jnp.all(jnp.isfinite(T))
        & jnp.all(jnp.abs(deviation) <= RIGID_TOLERANCE)
        # The triple product is the determinant, without the pivots of a solver.
        & (jnp.dot(R[:, 0], jnp.cross(R[:, 1], R[:, 2])) > 0.0)
        & jnp.all(jnp.abs(last) <= _LAST_ROW_TOLERANCE)
    )


def is_traced(*arrays: object) -> bool:
    """Returns True if any of the arrays is a tracer, whose values cannot be read."""
    return any(isinstance(x, Tracer) for x in arrays)


_pose_along = jax.jit(pose_along)


def poses_at(positions: np.ndarray, looks: Sequence[str] | np.ndarray) -> np.ndarray:
    """Makes poses without roll, [V, 4, 4] float64, at positions [V, 3] [m] along "+x", "-x", ..."""
    # Six poses, copied below: `pose_along` would dispatch to JAX once per view.
    axes: dict[str, np.ndarray] = {}
    for look in LOOKS:
        direction = np.zeros(3, np.float32)
        direction["xyz".index(look[1])] = 1.0 if look[0] == "+" else -1.0
        # Entries are 0 or 1 up to rounding; adding 0 turns -0.0 into 0.0.
        axes[look] = np.rint(_pose_along(np.zeros(3, np.float32), direction)) + 0.0
    poses = np.zeros((len(looks), 4, 4))
    for i, look in enumerate(looks):
        poses[i] = axes[str(look)]
    poses[:, :3, 3] = positions
    return poses
