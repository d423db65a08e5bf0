"""A frame joins the map in machine code on CPUs: what `update.integrate` says, in two passes.

Shape symbol: N rows of the map.
"""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from r3jax.frame import Frame
from r3jax.geometry.cameras import invert_pose
from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin_table
from r3jax.kernels import visibility as visibility_kernels
from r3jax.kernels.mapping.bridge import ADD, LOOK, MARK, register
from r3jax.kernels.native.compiled import forget_outdated_code
from r3jax.kernels.native.ffi import num_workers
from r3jax.mapping.state import MapState

forget_outdated_code(Path(__file__).parent, Path(visibility_kernels.__file__).parent)


@functools.cache
def _tables(num_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Candidates of every octahedral cell [S^2, K] and directions of the bins [B, 3]."""
    table = np.ascontiguousarray(nearest_bin_table(num_bins).T, dtype=np.int32)
    return table, fibonacci_lattice(num_bins).astype(np.float32)


def _camera(
    state: MapState, position: Float[Array, " 3"], focal: Float[Array, ""]
) -> Float[Array, " 5"]:
    """Voxel size, position and focal length, as the passes take them."""
    return jnp.concatenate([jnp.stack([state.voxel_size, focal]), position])


def _options() -> np.ndarray:
    return np.array([num_workers()], dtype=np.int32)


def _numbers(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> Float[Array, " 19"]:
    """Voxel size, range, 1 to leave out edges, camera and pose, as `group_pixels` takes them."""
    camera = frame.camera
    numbers = [state.voxel_size, max_range, drop_edges.astype(jnp.float32)]
    numbers = jnp.stack([*numbers, camera.fx, camera.fy, camera.cx, camera.cy])
    return jnp.concatenate([numbers, frame.T_world_camera[:3].reshape(-1)])


def join_pixels(
    state: MapState, frame: Frame, max_range: Float[Array, ""], drop_edges: Bool[Array, ""]
) -> MapState:
    """One observation per voxel that a measured pixel falls into joins the map.

    What `update.integrate_pixels` says: the same rows, and the same numbers beyond rounding.

    Args:
        state: the map before.
        frame: the frame.
        max_range: measurements beyond this z-depth are ignored; NaN ignores all [m].
        drop_edges: True leaves out pixels on depth edges.
    """
    register(ADD)
    table = (state.key, state.visited, state.count, state.mean, state.m2, state.resolution)
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in table]
    lost = jax.ShapeDtypeStruct((1,), jnp.int32)
    *after, dropped = jax.ffi.ffi_call(
        ADD,
        [*shapes, lost],
        input_output_aliases={i: i for i in range(len(table))},
        vmap_method="sequential",
    )(
        *table, _camera(state, frame.position, frame.camera.focal), frame.depth, frame.rgb,
        _numbers(state, frame, max_range, drop_edges), *_tables(state.num_bins), _options(),
    )  # fmt: skip
    key, visited, count, mean, m2, resolution = after
    return MapState(
        key=key,
        visited=visited,
        count=count,
        mean=mean,
        m2=m2,
        resolution=resolution,
        voxel_size=state.voxel_size,
        dropped=state.dropped + dropped[0],
        num_bins=state.num_bins,
    )


def codes_of_rows(
    state: MapState, frame: Frame, max_range: Float[Array, ""]
) -> tuple[UInt8[Array, " N"], Bool[Array, ""]]:
    """What a frame says of every row: nothing (0), that it `SHOWS` it, or that a `HOLE` does.

    The first part of `seen.rows_in_view`, before the map is asked what hides what.

    Returns:
        The codes, and whether any is `HOLE`.
    """
    register(LOOK)
    camera, T = frame.camera, invert_pose(frame.T_world_camera)
    numbers = jnp.stack([state.voxel_size, max_range, camera.fx, camera.fy, camera.cx, camera.cy])
    codes = jax.ShapeDtypeStruct((state.capacity,), jnp.uint8)
    has_holes = jax.ShapeDtypeStruct((1,), jnp.int32)
    codes, has_holes = jax.ffi.ffi_call(LOOK, [codes, has_holes], vmap_method="sequential")(
        state.key, jnp.concatenate([numbers, T[:3].reshape(-1)]), frame.depth, _options()
    )
    return codes, has_holes[0] > 0


def mark(
    state: MapState,
    codes: UInt8[Array, " N"],
    shown_in_holes: UInt8[Array, " N"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
) -> MapState:
    """Sets the direction bin of the rows that a frame shows, and raises their resolution.

    Args:
        state: the map before.
        codes: of `codes_of_rows`.
        shown_in_holes: 1 where no other voxel hides a row.
        position: of the camera [m].
        focal: its focal length [px].
    """
    register(MARK)
    marks = state.visited, state.resolution
    visited, resolution = jax.ffi.ffi_call(
        MARK,
        [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in marks],
        input_output_aliases={0: 0, 1: 1},
        vmap_method="sequential",
    )(
        *marks, state.key, _camera(state, position, focal), codes, shown_in_holes,
        *_tables(state.num_bins), _options(),
    )  # fmt: skip
    return eqx.tree_at(lambda m: (m.visited, m.resolution), state, (visited, resolution))
