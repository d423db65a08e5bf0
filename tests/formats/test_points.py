"""Points of PLY files: ours, other programs', damaged ones."""

import numpy as np
import pytest
import trimesh

from r3jax.formats.errors import FormatError
from r3jax.formats.points import read_points, write_points

TEXT = """ply
format ascii 1.0
comment made by hand
element vertex 2
property double x
property double y
property double z
property float nx
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
0.1 -2 3e2 0 255 0 51
1 2 3 0 1 2 3
3 0 1 1
"""


def cloud() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(9, 3)).astype(np.float32), rng.integers(0, 256, (9, 3), dtype=np.uint8)


def test_what_we_write_is_read_exactly(tmp_path):
    points, colors = cloud()
    write_points(tmp_path / "p.ply", points, colors)
    xyz, rgb = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(xyz, points)
    np.testing.assert_array_equal(rgb, colors)


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_what_trimesh_writes_is_read(tmp_path, encoding):
    points, colors = cloud()
    data = trimesh.PointCloud(points, colors=colors).export(file_type="ply", encoding=encoding)
    (tmp_path / "p.ply").write_bytes(data)
    xyz, rgb = read_points(tmp_path / "p.ply")
    np.testing.assert_allclose(xyz, points, atol=1e-6)
    np.testing.assert_array_equal(rgb, colors)


def test_text_with_other_properties_and_elements(tmp_path):
    (tmp_path / "p.ply").write_text(TEXT)
    xyz, rgb = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(xyz, [[0.1, -2, 300], [1, 2, 3]])
    np.testing.assert_array_equal(rgb, [[255, 0, 51], [1, 2, 3]])


def test_big_endian_fractions_and_no_colors(tmp_path):
    head = TEXT.replace("ascii", "binary_big_endian").partition("end_header\n")
    fields = [(name, ">f8") for name in "xyz"] + [("nx", ">f4")]
    fields += [(name, ">f4") for name in ("red", "green", "blue")]
    table = np.array([(1, 2, 3, 0, 0.2, 1.0, 0.0), (4, 5, 6, 0, 2.0, -1.0, 0.5)], fields)
    header = head[0].replace("uchar red", "float red").replace("uchar green", "float green")
    header = header.replace("uchar blue", "float blue") + head[1]
    (tmp_path / "p.ply").write_bytes(header.encode() + table.tobytes())
    xyz, rgb = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(xyz, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(rgb, [[51, 255, 0], [255, 0, 128]])
    (tmp_path / "p.ply").write_text(TEXT.replace("green", "leaf"))
    assert (read_points(tmp_path / "p.ply")[1] == 128).all()


def test_a_binary_file_that_is_cut_off_is_refused(tmp_path):
    write_points(tmp_path / "p.ply", *cloud())
    data = (tmp_path / "p.ply").read_bytes()
    for length in range(len(data)):
        (tmp_path / "p.ply").write_bytes(data[:length])
        with pytest.raises(FormatError, match=r"p\.ply"):
            read_points(tmp_path / "p.ply")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FormatError, match=r"p\.ply"):
        read_points(tmp_path / "p.ply")


def test_points_and_colors_must_fit(tmp_path):
    with pytest.raises(ValueError, match=r"both be \[n, 3\]"):
        write_points(tmp_path / "p.ply", np.zeros((2, 3)), np.zeros((3, 3), np.uint8))
