"""Small files that would unpack to gigabytes: every reader reads or refuses them in little memory.

Each case runs with a limit on the address space that it may add. Meshes are in the normal suite,
all other readers behind the marker: `pytest -m slow tests/fuzz/test_bombs.py`.
"""

import base64
import importlib
import json
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tests.fuzz import containers
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CEILING = 1 << 30
"""For files of at most two megabytes, and all that is read at once of what they unpack to."""

MODULES = (
    "calibrations",
    "camera_paths",
    "colmap",
    "reference_images",
    "models",
    "nerfstudio",
    "recordings",
    "records",
    "run_checkpoints",
    "runs",
    "splats",
    "stage_configs",
    "training_checkpoints",
    "view_sets",
    "sequences:REPLICA_SLAM",
    "sequences:TUM",
    "sequences:SEVEN_SCENES",
    "phones:POLYCAM",
    "phones:RECORD3D",
    "phones:ARKIT_SCENES",
    "phones:SCANNET",
    "rtabmap:EXPORT",
)
"""Of this folder, with the name of the reader where it is not READER."""


def __getattr__(name: str) -> Reader:
    """The reader of a module of this folder, with bombs for seeds; asked for by the worker."""
    if not name.startswith("BOMBS_"):
        raise AttributeError(name)
    module, _, attribute = name.removeprefix("BOMBS_").partition(":")
    reader: Reader = getattr(
        importlib.import_module(f"tests.fuzz.test_{module}"), attribute or "READER"
    )
    cases = [case for seed in reader.seeds() for case in bombs_of(seed)]
    if module == "meshes":
        cases = [{f"scene.{kind}": data} for kind, data in meshes()]
    return Reader(lambda: cases, reader.read, reader.errors, reader.names_file, ceiling=CEILING)


def bombs_of(files: Files) -> Iterator[Files]:
    """The tree with one file after the other replaced."""
    kinds: set[str] = set()
    for name, data in files.items():
        kind = name.rpartition(".")[2]
        if isinstance(data, bytes) and kind not in kinds:
            kinds.add(kind)  # one image stands for all
            for bomb in BOMBS.get(kind, lambda data: [])(data):
                yield files | {name: bomb}


def texts(data: bytes) -> list[bytes]:
    """Lines, columns and digits without end."""
    head = data[: data.find(b"\n") + 1]
    return [head + b"\n" * 2_000_000, head + b"0 " * 1_000_000, b"9" * 2_000_000]


def trees(data: bytes) -> list[bytes]:
    """Nesting, lists and numbers without end, alone and where numbers are expected."""
    long = [b"[" * 2_000_000, b"[" + b"[]," * 500_000 + b"[]]", b"1" * 2_000_000, b"1e9999999"]
    if data[:1] == b"{":
        first, *rest = data.split(b"\n") if data.startswith(b"{", data.find(b"\n") + 1) else [data]
        plain = json.loads(first)
        large = [plain | {name: [[0.0]] * 50_000} for name in plain]
        long += [b"\n".join([json.dumps(tree).encode(), *rest]) for tree in large]
    return long


def counted(data: bytes) -> list[bytes]:
    """Counts of nearly everything at every place of a COLMAP file's beginning."""
    return [
        data[:at] + struct.pack("<Q", count) + data[at + 8 :]
        for at in range(0, min(len(data), 96), 4)
        for count in (1 << 26, 1 << 60)
    ]


def ply_heads(data: bytes) -> list[bytes]:
    """Promises many vertices, and lists that are longer than the file."""
    end = data.find(b"end_header")
    head, rest = data[:end].splitlines(), data[end:]
    many = [
        b" ".join([*line.split()[:2], b"3000000000"]) if line.startswith(b"element") else line
        for line in head
    ]
    return [b"\n".join([*many, rest]), data + bytes(2_000_000)]


BOMBS: dict[str, Callable[[bytes], list[bytes]]] = {
    "png": lambda data: [containers.png_bomb()],
    "jpg": lambda data: [containers.png_bomb()],
    "npz": lambda data: [containers.zip_bomb()],
    "json": trees,
    "jsonl": trees,
    "txt": texts,
    "bin": counted,
    "ply": ply_heads,
}


def glb(tree: dict[str, Any], stored: bytes = b"") -> bytes:
    """A GLB of a tree and one buffer."""
    text = json.dumps({"asset": {"version": "2.0"}, **tree}).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    if stored:
        stored += bytes(-len(stored) % 4)
        body += struct.pack("<I4s", len(stored), b"BIN\0") + stored
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def one_mesh(accessors: list[dict[str, Any]], primitives: int = 1, nodes: int = 1) -> dict:
    """The tree of a mesh with one position for each primitive."""
    return {
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * primitives}],
        "nodes": [{"mesh": 0}] * nodes,
        "scenes": [{"nodes": list(range(nodes))}],
    }


def points(count: int, **fields: Any) -> dict[str, Any]:
    return {"componentType": 5126, "type": "VEC3", "count": count, **fields}


def meshes() -> Iterator[tuple[str, bytes]]:
    """Files that repeat what they store, or claim what they do not."""
    rng = np.random.default_rng(0)
    million = rng.normal(size=(29_997, 9)).astype("<f4").tobytes()[:1_079_892]
    count, size = len(million) // 36 * 3, len(million)
    buffer: dict[str, Any] = {"buffers": [{"byteLength": size}]}
    view = {"buffer": 0, "byteLength": size}
    one = {**buffer, "bufferViews": [view]}
    named = points(count, bufferView=0)
    yield "glb", glb(one_mesh([points(30_000_000)]) | {"bufferViews": []})
    yield "glb", glb(one_mesh([points(1 << 40)]) | one, million)
    yield "glb", glb(one_mesh([points(1 << 40, bufferView=0)]) | one, million)
    yield "glb", glb(one_mesh([named], primitives=200) | one, million)
    yield "glb", glb(one_mesh([named], primitives=30_000) | one, million)
    yield "glb", glb(one_mesh([named], nodes=2_000) | one, million)
    yield "glb", glb(one_mesh([named] * 3_000) | one, million)
    yield "glb", glb(one_mesh([named]) | buffer | {"bufferViews": [view] * 3_000}, million)
    dense = {**buffer, "bufferViews": [view | {"byteStride": 1}]}
    yield "glb", glb(one_mesh([points(size - 64, bufferView=0, type="MAT4")] * 20) | dense, million)
    indexed = one_mesh([points(3, bufferView=0), {**named, "type": "SCALAR", "count": size}])
    indexed["accessors"][1] |= {"componentType": 5121}
    indexed["meshes"][0]["primitives"] = [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]
    yield "glb", glb(indexed | one, bytes(size))
    sparse = {"count": 1, "indices": {"bufferView": 0}, "values": {"bufferView": 0}}
    yield "glb", glb(one_mesh([points(1 << 30, sparse=sparse)]) | one, million)
    yield "glb", glb(one_mesh([points(3, bufferView=0)], primitives=33_000) | one, million)
    uri = "data:application/octet-stream;base64," + base64.b64encode(million).decode()
    inline = {"buffers": [{"byteLength": size, "uri": uri}], "bufferViews": [view] * 3_000}
    yield "gltf", json.dumps({**one_mesh([named]), **inline}).encode()
    itself = {"buffers": [{"byteLength": size, "uri": "scene.gltf"}] * 2_000}
    padding = {"extras": "x" * size}
    yield (
        "gltf",
        json.dumps({**one_mesh([named]), "bufferViews": [view], **itself, **padding}).encode(),
    )
    corners = b"".join(b"v %d %d 0\n" % (i % 100, i // 100) for i in range(30_000))
    groups = b"".join(b"usemtl m%d\nf 1 2 %d\n" % (i, i + 3) for i in range(200))
    yield "obj", corners + groups
    yield "obj", corners + b"f" + b"".join(b" %d" % (i + 1) for i in range(30_000)) + b"\n"
    text = b"ply\nformat ascii 1.0\nelement vertex 3000000000\nproperty float x\nproperty float y\n"
    faces = b"element face 3000000000\nproperty list uchar int vertex_indices\nend_header\n"
    yield "ply", text + b"property float z\n" + faces + b"0 0 0\n" * 300_000
    yield "off", b"OFF\n3000000000 3000000000 0\n" + b"0 0 0\n" * 300_000
    yield "stl", bytes(80) + struct.pack("<I", 0xFFFFFFFF) + bytes(1_000_000)
    yield "stl", b"solid a\n" + b"vertex 0 0 0\n" * 150_000 + b"endsolid a\n"


def test_a_mesh_that_is_a_bomb_is_read_or_refused_in_little_memory(harness):
    harness.check_crafted(f"{__name__}:BOMBS_meshes", warm="tests.fuzz.test_meshes")


@pytest.mark.slow
@pytest.mark.parametrize("module", MODULES)
def test_a_bomb_is_read_or_refused_in_little_memory(harness, module):
    name, colon, attribute = module.partition(":")
    warm = f"tests.fuzz.test_{name}{colon}{attribute}"
    harness.check_crafted(f"{__name__}:BOMBS_{module}", warm=warm)
