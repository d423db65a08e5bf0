"""Quads with vertex colors, as in Replica's mesh.ply, against what can be worked out on paper.

The wall is x = 3 + y / 4 and its color an affine function of the place: both are the same
whichever diagonal cuts a quad in two.
"""

import numpy as np
import pytest

from r3jax.geometry.cameras import Camera
from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.simulators.rooms import facing_x

CAMERA = Camera.from_fov(64, 64, 60.0)
COLUMNS, ROWS = 6, 5
"""Quads along y and z, a meter each; the wall spans y from -3 to 3 and z from -2.5 to 2.5."""


def color_at(y, z):
    """Bytes, not rounded; whole at the corners of the quads."""
    return np.stack([20.0 + 30.0 * (y + 3.0), 240.0 - 40.0 * (z + 2.5), 77.0 + 0.0 * y], axis=-1)


def write_wall(
    path, *, kind="binary_little_endian", index="int", name="vertex_indices", alpha=False
):
    """The wall as a PLY file; `kind` is its format, `index` the type of the corners."""
    y, z = np.meshgrid(np.arange(COLUMNS + 1) - 3.0, np.arange(ROWS + 1) - 2.5)
    y, z = y.ravel(), z.ravel()
    floats, bytes_ = ["x", "y", "z", "nx", "ny", "nz"], ["red", "green", "blue"]
    if alpha:
        bytes_.append("alpha")
    order = ">" if kind == "binary_big_endian" else "<"
    corners = np.zeros(len(y), [(n, f"{order}f4") for n in floats] + [(n, "u1") for n in bytes_])
    corners["x"], corners["y"], corners["z"], corners["nx"] = 3.0 + 0.25 * y, y, z, -1.0
    for channel, values in zip(bytes_, color_at(y, z).T, strict=False):
        corners[channel] = values
    first = (np.arange(ROWS)[:, None] * (COLUMNS + 1) + np.arange(COLUMNS)).ravel()
    quads = np.stack([first, first + COLUMNS + 1, first + COLUMNS + 2, first + 1], axis=1)
    faces = np.zeros(len(quads), [("n", "u1"), ("corners", f"{order}i4", 4)])
    faces["n"], faces["corners"] = 4, quads
    header = [
        "ply",
        f"format {kind} 1.0",
        f"element vertex {len(corners)}",
        *(f"property float {n}" for n in floats),
        *(f"property uchar {n}" for n in bytes_),
        f"element face {len(faces)}",
        f"property list uchar {index} {name}",
        "end_header\n",
    ]
    if kind == "ascii":
        lines = [" ".join(str(value) for value in corner) for corner in corners.tolist()]
        lines += [" ".join(str(value) for value in [4, *quad]) for quad in quads.tolist()]
        body = ("\n".join(lines) + "\n").encode()
    else:
        body = corners.tobytes() + faces.tobytes()
    path.write_bytes("\n".join(header).encode() + body)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"kind": "binary_big_endian"},
        {"kind": "ascii"},
        {"index": "uint", "name": "vertex_index"},
        {"alpha": True},
        {"kind": "ascii", "alpha": True},
    ],
    ids=str,
)
def test_depth_and_color_of_a_wall_of_quads(tmp_path, options):
    path = tmp_path / "mesh.ply"
    write_wall(path, **options)
    world = load_world(path)
    assert len(world.faces) == 2 * COLUMNS * ROWS
    assert len(world.vertices) == (COLUMNS + 1) * (ROWS + 1)
    simulator = RaycastSimulator(world, CAMERA, max_range=None, supersample=0)
    frame = simulator.render(facing_x(0.0, 0.0, 0.0))
    ray = (np.arange(64) + 0.5 - 32.0) / float(CAMERA.fx)
    across, down = np.meshgrid(ray, ray)  # to the right is -y, down is -z
    depth = 3.0 / (1.0 + 0.25 * across)
    np.testing.assert_allclose(frame.depth, depth, rtol=1e-5)
    expected = color_at(-across * depth, -down * depth) / 255.0
    np.testing.assert_allclose(frame.rgb, expected, atol=1e-3)


def test_the_front_of_a_quad_is_the_front_of_its_triangles(tmp_path):
    path = tmp_path / "mesh.ply"
    write_wall(path)
    simulator = RaycastSimulator(load_world(path), CAMERA, cull_back_faces=True, supersample=0)
    assert np.isfinite(simulator.render(facing_x(0.0, 0.0, 0.0)).depth).all()
    pose = facing_x(6.0, 0.0, 0.0)
    pose[:2, :3] *= -1.0  # looks back along -x
    assert np.isinf(simulator.render(pose).depth).all()
