"""Scene files: what is written is read again, and other programs' files are read as they are."""

import hashlib
import re
import struct

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.splatting import ply
from r3jax.splatting.errors import SceneFileError
from r3jax.splatting.ply import read_scene, write_scene
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene

COUNT = 5

FIELDS = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
"""What a file must have; degree 0."""


def numbers(*shape: int) -> st.SearchStrategy[np.ndarray]:
    """All finite float32, tiny and negative zero included."""
    elements = st.floats(width=32, allow_nan=False, allow_infinity=False)
    return hnp.arrays(np.float32, shape, elements=elements)


@st.composite
def scenes(draw: st.DrawFn) -> GaussianScene:
    k = draw(st.sampled_from([1, 4, 9, 16]))
    quats = draw(numbers(COUNT, 4).filter(lambda q: q.any(axis=1).all()))
    logits = draw(hnp.arrays(np.float32, COUNT, elements=st.floats(-49.0, 50.0, width=32)))
    fields = (draw(numbers(COUNT, 3)), quats, draw(numbers(COUNT, 3)), logits)
    return GaussianScene(*map(jnp.asarray, fields), sh=jnp.asarray(draw(numbers(COUNT, k, 3))))


def simple_scene(sh_degree: int = 1) -> GaussianScene:
    rng = np.random.default_rng(sh_degree)
    shapes = ((COUNT, 3), (COUNT, 4), (COUNT, 3), (COUNT,), (COUNT, (sh_degree + 1) ** 2, 3))
    return GaussianScene(*(jnp.asarray(rng.normal(size=s), dtype=jnp.float32) for s in shapes))


def assert_same_bits(first: GaussianScene, second: GaussianScene) -> None:
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert a.dtype == b.dtype == np.float32
        assert a.shape == b.shape
        np.testing.assert_array_equal(np.asarray(a).view(np.int32), np.asarray(b).view(np.int32))


def law_round_trip(path) -> None:
    @given(scenes())
    def check(scene):
        ply.write_scene(path, scene)
        assert_same_bits(ply.read_scene(path), scene)

    check()


def law_layout(path) -> None:
    """One Gaussian of degree 1, its bytes written down by hand."""
    scene = GaussianScene(
        means=jnp.asarray([[1.0, 2.0, 3.0]]),
        quats=jnp.asarray([[0.5, 0.25, -0.5, 2.0]]),
        log_scales=jnp.asarray([[-1.0, -2.0, -3.0]]),
        opacity_logits=jnp.asarray([0.75]),
        # red: 10 11 12 13, green: 20 ..., blue: 30 ...
        sh=jnp.asarray([[[10.0 * (c + 1) + k for c in range(3)] for k in range(4)]]),
    )
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in names)
    values = [1, 2, 3, 0, 0, 0, 10, 20, 30, 11, 12, 13, 21, 22, 23, 31, 32, 33, 0.75]
    values += [-1, -2, -3, 0.5, 0.25, -0.5, 2]
    rest = b"end_header\n" + struct.pack("<26f", *values)
    sha256 = hashlib.sha256(header.encode() + rest).hexdigest()
    expected = header.encode() + f"comment sha256 {sha256}\n".encode() + rest
    ply.write_scene(path, scene)
    assert path.read_bytes() == expected


def test_what_is_written_is_read_again(tmp_path):
    law_round_trip(tmp_path / "scene.ply")


def test_the_bytes_are_those_of_the_layout(tmp_path):
    law_layout(tmp_path / "scene.ply")


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_every_degree(tmp_path, sh_degree):
    scene = simple_scene(sh_degree)
    write_scene(tmp_path / "scene.ply", scene)
    assert_same_bits(read_scene(str(tmp_path / "scene.ply")), scene)


def test_unused_rows_are_left_out(tmp_path):
    scene = simple_scene()
    logits = scene.opacity_logits.at[jnp.array([0, 3])].set(DEAD_LOGIT)
    write_scene(tmp_path / "scene.ply", eqx.tree_at(lambda s: s.opacity_logits, scene, logits))
    kept = jax.tree.map(lambda x: x[jnp.array([1, 2, 4])], scene)
    assert_same_bits(read_scene(tmp_path / "scene.ply"), kept)


# Files as other programs write them.


def columns_of(scene: GaussianScene) -> dict[str, np.ndarray]:
    """The fields of a file, taken from a scene one by one."""
    sh = np.asarray(scene.sh)
    columns = {name: np.asarray(scene.means)[:, i] for i, name in enumerate("xyz")}
    columns |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    num = sh.shape[1] - 1
    columns |= {f"f_rest_{c * num + k}": sh[:, k + 1, c] for c in range(3) for k in range(num)}
    columns |= {"opacity": np.asarray(scene.opacity_logits)}
    columns |= {f"scale_{i}": np.asarray(scene.log_scales)[:, i] for i in range(3)}
    return columns | {f"rot_{i}": np.asarray(scene.quats)[:, i] for i in range(4)}


def header_of(kind: str, elements: list[str], newline: str = "\n") -> bytes:
    return newline.join(["ply", f"format {kind} 1.0", *elements, "end_header", ""]).encode()


def binary_file(
    columns: dict[str, np.ndarray],
    *,
    order: str = "<",
    types: dict[str, str] | None = None,
    before: tuple[list[str], bytes] = ([], b""),
    after: tuple[list[str], bytes] = ([], b""),
    newline: str = "\n",
) -> bytes:
    codes = {"float": "f", "double": "d", "float32": "f", "float64": "d", "int": "i", "uchar": "B"}
    types = {name: (types or {}).get(name, "float") for name in columns}
    count = len(next(iter(columns.values())))
    lines = [f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in types.items()]
    pack = struct.Struct(order + "".join(codes[kind] for kind in types.values()))
    rows = b"".join(pack.pack(*(columns[name][i] for name in types)) for i in range(count))
    kind = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = header_of(kind, [*before[0], *lines, *after[0]], newline)
    return header + before[1] + rows + after[1]


def read_bytes(tmp_path, data: bytes) -> GaussianScene:
    path = tmp_path / "theirs.ply"
    path.write_bytes(data)
    return read_scene(path)


@given(st.permutations(range(23)), st.sampled_from("<>"))
def test_fields_in_any_order(tmp_path_factory, order, byte_order):
    scene = simple_scene(1)
    columns = columns_of(scene)
    names = [list(columns)[i] for i in order]
    data = binary_file({name: columns[name] for name in names}, order=byte_order)
    assert_same_bits(read_bytes(tmp_path_factory.mktemp("ply"), data), scene)


def test_other_number_types_extra_fields_comments_and_elements(tmp_path):
    scene = simple_scene(2)
    columns = columns_of(scene)
    extra = {"red": np.arange(COUNT), "filter_3D": np.full(COUNT, np.nan), "level": np.ones(COUNT)}
    types = {"red": "uchar", "filter_3D": "float32", "level": "int"} | {
        name: "double" for name in columns
    }
    before = (
        ["comment Vertical Axis: z", "obj_info by hand", "element camera 2", "property short a"],
        b"\1\2\3\4",
    )
    after = (
        ["comment", "element face 1", "property list uchar int vertex_indices"],
        b"\3" + bytes(12),
    )
    interleaved = {"red": extra["red"], **columns, "filter_3D": extra["filter_3D"]}
    data = binary_file(
        interleaved | {"level": extra["level"].astype(int)},
        types=types,
        before=before,
        after=after,
    )
    assert_same_bits(read_bytes(tmp_path, data), scene)


def test_windows_line_ends(tmp_path):
    scene = simple_scene(0)
    data = binary_file(columns_of(scene), newline="\r\n")
    assert_same_bits(read_bytes(tmp_path, data), scene)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_text(tmp_path, newline):
    scene = simple_scene(1)
    columns = columns_of(scene)
    lines = ["element camera 1", "property float f", "property uchar g"]
    lines += [f"element vertex {COUNT}", *(f"property float {name}" for name in columns)]
    rows = ["3.5 7"] + [" ".join(f"{columns[n][i]:.9g}" for n in columns) for i in range(COUNT)]
    data = header_of("ascii", lines, newline) + newline.join([*rows, ""]).encode()
    assert_same_bits(read_bytes(tmp_path, data), scene)


# Bad files. Each error names the file, what is wrong, and where.


def refused(tmp_path, data: bytes) -> str:
    with pytest.raises(SceneFileError) as caught:
        read_bytes(tmp_path, data)
    assert str(tmp_path / "theirs.ply") in str(caught.value)
    return caught.value.reason


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not a PLY"),
        (b"\x1f\x8b\x08 a gzip", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 3\n", "no end"),
        (b"ply\nelement vertex 3\nend_header\n", "no format"),
        (b"ply\nformat binary_middle_endian 1.0\nend_header\n", "binary_middle_endian"),
        (b"ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "element vertex -3"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "vertex many"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "property float x"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", "half x"),
        (b"ply\nformat ascii 1.0\nnonsense\nend_header\n", "nonsense"),
        (b"ply\nformat ascii 1.0\nelement face 3\nend_header\n", "'face'"),
    ],
)  # fmt: skip
def test_broken_headers(tmp_path, data, reason):
    assert reason in refused(tmp_path, data)


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(SceneFileError, match=r"absent\.ply"):
        read_scene(tmp_path / "absent.ply")
    with pytest.raises(SceneFileError):
        read_scene(tmp_path)


@pytest.mark.parametrize("removed", FIELDS)
def test_missing_fields_are_named(tmp_path, removed):
    columns = columns_of(simple_scene(1))
    del columns[removed]
    reason = refused(tmp_path, binary_file(columns))
    assert f"missing: {removed};" in reason


def test_a_point_cloud_lacks_nearly_everything(tmp_path):
    points = {name: np.zeros(3, dtype=int) for name in ("x", "y", "z", "red")}
    reason = refused(tmp_path, binary_file(points, types={"red": "uchar"}))
    assert "f_dc_0, f_dc_1, f_dc_2, opacity, scale_0" in reason
    assert "point cloud" in reason


def test_wrong_number_of_harmonics(tmp_path):
    columns = columns_of(simple_scene(1))
    del columns["f_rest_8"]
    assert "8 fields f_rest_*" in refused(tmp_path, binary_file(columns))
    columns["f_rest_9"] = columns["x"]
    assert "f_rest_8 is missing" in refused(tmp_path, binary_file(columns))


def test_a_field_that_occurs_twice(tmp_path):
    data = binary_file(columns_of(simple_scene(0))).replace(b"float y", b"float x")
    assert "property float x" in refused(tmp_path, data)


@given(st.integers(min_value=1, max_value=COUNT * 23 * 4))
def test_a_file_that_is_cut_off(tmp_path_factory, missing):
    data = binary_file(columns_of(simple_scene(1)))
    left = (COUNT * 23 * 4 - missing) // (23 * 4)
    reason = refused(tmp_path_factory.mktemp("ply"), data[:-missing])
    assert re.findall(r"(\d+) Gaussians.* (\d+)", reason) == [(f"{COUNT}", f"{left}")]


def test_absurd_counts_are_found_before_memory_is_asked_for(tmp_path):
    data = binary_file(columns_of(simple_scene(1)))
    data = data.replace(b"vertex 5", b"vertex 999999999999999999999")
    assert "999999999999999999999" in refused(tmp_path, data)


def text_file(rows: list[str]) -> bytes:
    lines = [f"element vertex {len(rows)}", *(f"property float {name}" for name in FIELDS)]
    return header_of("ascii", lines) + "\n".join(rows).encode()


GOOD_ROW = "0 0 0 0 0 0 0 0 0 0 1 0 0 0"


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("0 0 0 0 0 0 0 0 0 0 1 0 0", "2 Gaussians"),
        ("0 0 0 0 0 0 0 0 0 0 1 0 0 zero", "no table of numbers"),
        ("0 0 nan 0 0 0 0 0 0 0 1 0 0 0", "1 of 2 Gaussians have parameters that are not finite, "
         "the first in row 1: z is nan"),
        ("0 0 0 0 0 0 0 0 -inf 0 1 0 0 0", "row 1: scale_1 is -inf"),
        ("0 0 0 0 0 0 1e39 0 0 0 1 0 0 0", "row 1: opacity is inf"),
        ("0 0 0 0 0 0 0 0 0 0 0 0 0 0", "1 of 2 Gaussians have the rotation 0 0 0 0, the first in "
         "row 1"),
    ],
)  # fmt: skip
def test_bad_rows(tmp_path, row, reason):
    assert reason in refused(tmp_path, text_file([GOOD_ROW, row]))
    assert read_bytes(tmp_path, text_file([GOOD_ROW, GOOD_ROW])).capacity == 2


def test_no_gaussians(tmp_path):
    assert "no Gaussians" in refused(tmp_path, text_file([]))


def test_compressed_files_are_named(tmp_path):
    chunks = (["element chunk 1", "property float min_x"], bytes(4))
    packed = {name: np.zeros(3, dtype=int) for name in ("packed_position", "packed_rotation")}
    data = binary_file(packed, types=dict.fromkeys(packed, "int"), before=chunks)
    reason = refused(tmp_path, data)
    assert "compressed" in reason
    assert "SuperSplat" in reason


def test_lists_are_named(tmp_path):
    lists = (["element face 1", "property list uchar int vertex_indices"], b"\0")
    assert "lists" in refused(tmp_path, binary_file(columns_of(simple_scene(0)), before=lists))


def test_nothing_is_written_that_cannot_be_read(tmp_path):
    path = tmp_path / "scene.ply"
    write_scene(path, simple_scene())
    kept = path.read_bytes()
    scene = simple_scene()
    spoilt = eqx.tree_at(lambda s: s.sh, scene, scene.sh.at[3, 2, 1].set(jnp.nan))
    with pytest.raises(SceneFileError, match="row 3: f_rest_4"):
        write_scene(path, spoilt)
    dead = eqx.tree_at(lambda s: s.opacity_logits, scene, jnp.full(COUNT, DEAD_LOGIT))
    with pytest.raises(SceneFileError, match="no Gaussians"):
        write_scene(path, dead)
    assert path.read_bytes() == kept
    assert list(tmp_path.iterdir()) == [path]
