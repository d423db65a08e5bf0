"""Views as rows of numbers: what a batched backend takes of each.

Shape symbols: P views.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

from r3jax.geometry.cameras import Camera
from r3jax.scoring.config import ScoringConfig
from r3jax.visibility.views import PanoramaView, PinholeView, View

VIEW_SIZE = 20
"""Numbers of a view: position [m] (3), rotation row by row (9), fx fy cx cy of the buffer [px],
range [m], tolerance [voxels], focal length of R [px], angle of a pixel [rad]."""


class BufferLayout(NamedTuple):
    """What all views of a batch have in common."""

    wraps: bool
    """True for an octahedral map of all directions."""

    height: int
    """Rows of the depth buffer [px]."""

    width: int
    """Columns of the depth buffer [px]."""


def layout_of(view: View) -> BufferLayout:
    """Finds the part of a view that is static."""
    return BufferLayout(view.wraps, *view.shape)


def row_of(view: View, focal: Float[Array, ""], config: ScoringConfig) -> Float[Array, " 20"]:
    """Packs the other part of a view into a row."""
    if isinstance(view, PinholeView):
        camera = view.camera
        position, rotation = view.T_world_camera[:3, 3], view.T_world_camera[:3, :3].ravel()
        lens = jnp.stack([camera.fx, camera.fy, camera.cx, camera.cy])
    else:
        position, rotation, lens = view.position, jnp.zeros(9), jnp.ones(4)
    angle = jnp.asarray(view.pixel_angle, dtype=jnp.float32)
    rest = jnp.stack([view.max_range, config.tolerance, focal, angle])
    return jnp.concatenate([position, rotation, lens, rest])


def view_of(row: Float[Array, " 20"], layout: BufferLayout) -> View:
    """Unpacks a row: the inverse of `row_of`."""
    position, far = row[:3], row[16]
    if layout.wraps:
        return PanoramaView(position, far, layout.width)
    top = jnp.concatenate([row[3:12].reshape(3, 3), position[:, None]], axis=1)
    T_world_camera = jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]])], axis=0)
    camera = Camera(layout.width, layout.height, row[12], row[13], row[14], row[15])
    return PinholeView(camera, T_world_camera, far)


def over_views(score: Callable[[Any, Any], Any], shared: Any, views: Any) -> Any:
    """`score(shared, views)`, so that `vmap` over views is one call of all of them.

    Where what is shared differs as well, one call follows the other.

    Args:
        score: of a batch; gives arrays whose first axis is that of the views.
        shared: the same for all of them, such as the map.
        views: one a row, [P, k] each; an array or several.
    """
    batched = custom_vmap(score)

    @batched.def_vmap
    def rule(axis_size: int, in_batched: Any, shared: Any, views: Any) -> tuple[Any, Any]:
        shared_batched, views_batched = in_batched
        if any(jax.tree.leaves(shared_batched)):
            leaves, treedef = jax.tree.flatten((shared, views))
            flags = jax.tree.leaves((shared_batched, views_batched))
            mapped = [x for x, is_mapped in zip(leaves, flags, strict=True) if is_mapped]

            def one(part: list[Array]) -> Any:
                own = iter(part)
                whole = [
                    next(own) if is_mapped else x
                    for x, is_mapped in zip(leaves, flags, strict=True)
                ]
                return over_views(score, *jax.tree.unflatten(treedef, whole))

            scores = jax.lax.map(one, mapped)
        else:
            leading = jax.tree.leaves(views)[0].shape[:-1]
            rows = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), views)
            flat = over_views(score, shared, rows)
            scores = jax.tree.map(lambda x: x.reshape(*leading, *x.shape[1:]), flat)
        return scores, jax.tree.map(lambda _: True, scores)

    return batched(shared, views)
