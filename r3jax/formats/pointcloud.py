"""Writes colored points as a binary PLY: what 3DGS starts from."""

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from r3jax.files import write_atomic
from r3jax.geometry.voxels import unpack, voxel_center
from r3jax.mapping.state import MapState


def voxel_points(map_state: MapState) -> tuple[np.ndarray, np.ndarray]:
    """Centers [m] and mean colors of the occupied voxels: [n, 3] float32 and [n, 3] uint8."""
    occupied = np.asarray(map_state.occupied)
    index = jnp.stack(unpack(map_state.key[0], map_state.key[1]))
    centers = np.asarray(voxel_center(index, map_state.voxel_size)).T[occupied]
    colors = np.rint(np.asarray(map_state.mean).T[occupied] * 255.0)
    return centers.astype(np.float32), colors.clip(0, 255).astype(np.uint8)


def write_points(
    path: Path,
    points: np.ndarray,
    colors: np.ndarray,
    properties: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Writes a PLY with `x y z red green blue`, and further properties behind them.

    Args:
        path: the file.
        points: [n, 3] [m].
        colors: [n, 3] uint8.
        properties: further numbers of every point by their names, [n] each; stored as float32.

    Raises:
        ValueError: shapes that differ.
        OSError: the disk is full, not writable, ...
    """
    if points.shape != colors.shape or points.shape[1:] != (3,):
        raise ValueError(f"points {points.shape} and colors {colors.shape} must both be [n, 3]")
    properties = {} if properties is None else properties
    fields = [(name, "<f4") for name in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")]
    fields += [(name, "<f4") for name in properties]
    table = np.empty(len(points), dtype=fields)
    for name, values in properties.items():
        if values.shape != (len(points),):
            raise ValueError(f"{name} has the shape {values.shape} for {len(points)} points")
        table[name] = values
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        table[name] = colors[:, channel]
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields] + ["end_header", ""]
    write_atomic(path, "\n".join(header).encode() + table.tobytes())
