"""Which pixels of a test view show a surface that a training frame has looked at.

Decided by the true depth of the test view and the recorded depth of the frames, not by the map
whose predictions are evaluated with it. The rule is that of the map's update: a point is seen by a
frame if it is within range and projects onto a measurement that is no nearer.

Shape symbols: n frames; h w their size; H W size of the test view.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, invert_pose, transform, unproject
from r3jax.splatting.views import PosedImage


class Recorded(eqx.Module):
    """The depth of the training frames."""

    limit: Float[Array, "n h w"]
    """Farthest z-depth that each pixel or a neighbor has measured [m]; 0 where none has."""

    T_camera_world: Float[Array, "n 4 4"]
    """World to camera."""

    camera: Camera
    """Intrinsics of all frames."""


@jax.jit
def _limit(depth: Float[Array, "h w"]) -> Float[Array, "h w"]:
    # On a slope the depth changes within a pixel: the farthest of its neighbors limits.
    return jax.lax.reduce_window(depth, 0.0, jax.lax.max, (3, 3), (1, 1), "SAME")


def recorded(frames: Sequence[Frame]) -> Recorded:
    """Returns what decides, from frames of one camera."""
    return Recorded(
        limit=jnp.stack([jnp.where(f.depth > 0.0, _limit(f.depth), 0.0) for f in frames]),
        T_camera_world=jnp.stack([invert_pose(f.T_world_camera) for f in frames]),
        camera=frames[0].camera,
    )


@jax.jit
def seen_pixels(
    view: PosedImage, frames: Recorded, max_range: Float[Array, ""], tolerance: Float[Array, ""]
) -> Bool[Array, "H W"]:
    """Returns True where a test view shows what at least one frame has looked at.

    Args:
        view: with its true depth; pixels without (holes of the scan) are never seen.
        frames: the training frames.
        max_range: of the sensor [m].
        tolerance: a point this far behind a measurement counts as measured: the edge of a voxel,
            which also covers the sensor's noise [m].
    """
    known = (view.depth > 0.0) & jnp.isfinite(view.depth)
    depth = jnp.where(known, view.depth, 1.0)
    points = transform(view.T_world_camera, unproject(view.camera, depth))
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    camera = frames.camera

    def look(seen, frame):
        limit, T = frame
        # Coordinate by coordinate: on a CPU XLA then makes one loop, in a quarter of the time.
        right, down, ahead = (T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3] for i in range(3))
        per_z = 1.0 / jnp.maximum(ahead, 1e-3)
        column, row = camera.fx * right * per_z + camera.cx, camera.fy * down * per_z + camera.cy
        inside = (ahead > 1e-3) & (column >= 0.0) & (column < camera.width)
        inside &= (row >= 0.0) & (row < camera.height)
        inside &= right * right + down * down + ahead * ahead <= max_range * max_range
        index = lambda x, size: jnp.clip(x, 0.0, size - 1.0).astype(jnp.int32)
        measured = limit[index(row, camera.height), index(column, camera.width)]
        return seen | (inside & (measured > 0.0) & (ahead <= measured + tolerance)), None

    nothing = jnp.zeros(known.shape, dtype=bool)
    seen, _ = jax.lax.scan(look, nothing, (frames.limit, frames.T_camera_world))
    return known & seen
