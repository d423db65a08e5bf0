"""First hits of rays on a triangle mesh: embree's packets of sixteen rays, on all cores.

embree (Wald et al., "Embree: A kernel framework for efficient CPU ray tracing", 2014) comes as a
shared library inside the `embreex` package, whose own Python interface traces one ray at a time.
Here machine code calls the library itself: rays beside each other go down the search tree
together, which is several times faster for an image.

Shape symbols: V vertices; F faces; n rays; W workers.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# Code generators get what llvmlite makes, which has no types.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import ctypes
import functools
import weakref
from ctypes import CDLL
from pathlib import Path

import numpy as np
from llvmlite import ir
from numba import prange, types

from r3jax.kernels.native.compiled import called_from_python, inlined, intrinsic
from r3jax.kernels.native.ffi import num_workers, require_threads
from r3jax.simulators.raycast.rays import MAX_LAYERS

_LANES = 16
_PACKET_BYTES = 2048
"""Room for one `RTCRayHit16`, which ends with what only instances have."""

# Rows of `RTCRayHit16`, each of one value per lane.
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
_NORMAL, _U, _V, _FACE, _GEOMETRY = 12, 15, 16, 17, 18

# Values of embree's enumerations, rtcore_*.h of version 4.
_TRIANGLES, _INDEX_BUFFER, _VERTEX_BUFFER = 0, 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_ROBUST, _COHERENT, _ALL_FEATURES, _VERSION_PROPERTY = 1 << 2, 1 << 16, 0xFFFFFFFF, 0

_PACKETS_PER_BLOCK = 16
"""Packets that a worker traces before it takes the next block: a row of 256 pixels."""


@functools.cache
def library() -> CDLL | None:
    """Loads version 4 of embree, which `embreex` contains.

    It is None if the package contains no such library.
    """
    import embreex

    package = Path(embreex.__file__).parent
    folders = (package.with_name("embreex.libs"), package / ".dylibs", package)
    found = [path for folder in folders for path in sorted(folder.glob("*embree4*"))]
    if not found:
        return None
    try:
        embree = CDLL(str(found[0]))
        _declare(embree)
    except (OSError, AttributeError):
        return None
    device = embree.rtcNewDevice(None)
    version = embree.rtcGetDeviceProperty(device, _VERSION_PROPERTY)
    embree.rtcReleaseDevice(device)
    return embree if version // 10_000 == 4 else None


def _declare(embree: CDLL) -> None:
    """Names the types of the functions that are used."""
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    for name, result, arguments in (
        ("rtcNewDevice", pointer, [ctypes.c_char_p]),
        ("rtcReleaseDevice", None, [pointer]),
        ("rtcGetDeviceProperty", ctypes.c_ssize_t, [pointer, integer]),
        ("rtcGetDeviceError", integer, [pointer]),
        ("rtcNewScene", pointer, [pointer]),
        ("rtcReleaseScene", None, [pointer]),
        ("rtcSetSceneFlags", None, [pointer, integer]),
        ("rtcCommitScene", None, [pointer]),
        ("rtcNewGeometry", pointer, [pointer, integer]),
        ("rtcReleaseGeometry", None, [pointer]),
        (
            "rtcSetNewGeometryBuffer",
            pointer,
            [pointer, integer, ctypes.c_uint, integer, ctypes.c_size_t, ctypes.c_size_t],
        ),
        ("rtcCommitGeometry", None, [pointer]),
        ("rtcAttachGeometry", ctypes.c_uint, [pointer, pointer]),
        ("rtcIntersect16", None, [pointer, pointer, pointer, pointer]),
    ):
        function = getattr(embree, name)
        function.restype, function.argtypes = result, arguments


class PacketScene:
    """A mesh whose faces are hit from both sides unless culled."""

    def __init__(self, embree: CDLL, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Builds the search tree over `vertices` [V, 3] [m] and `faces` [F, 3].

        Raises:
            MemoryError: embree could not build it.
        """
        device = embree.rtcNewDevice(None)
        scene = embree.rtcNewScene(device)
        weakref.finalize(self, _release, embree, device, scene)
        # A ray through an edge that two faces share must hit one of them.
        embree.rtcSetSceneFlags(scene, _ROBUST)
        mesh = embree.rtcNewGeometry(device, _TRIANGLES)
        for kind, layout, rows in (
            (_VERTEX_BUFFER, _FLOAT3, np.ascontiguousarray(vertices, np.float32)),
            (_INDEX_BUFFER, _UINT3, np.ascontiguousarray(faces, np.uint32)),
        ):
            buffer = embree.rtcSetNewGeometryBuffer(mesh, kind, 0, layout, 12, len(rows))
            if rows.size:
                ctypes.memmove(buffer, rows.ctypes.data, rows.nbytes)
        embree.rtcCommitGeometry(mesh)
        embree.rtcAttachGeometry(scene, mesh)
        embree.rtcReleaseGeometry(mesh)
        embree.rtcCommitScene(scene)
        error = embree.rtcGetDeviceError(device)
        if error:
            raise MemoryError(f"embree built no search tree for {len(faces)} faces: error {error}")
        self._scene = scene
        self._intersect = ctypes.cast(embree.rtcIntersect16, ctypes.c_void_p).value

    def cast(
        self, origins: np.ndarray, directions: np.ndarray, *, cull: bool, coherent: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Traces rays from `origins` ([n, 3], or [1, 3] if all start there) along `directions`.

        Args:
            origins: float32 [m].
            directions: float32 of any length but 0, [n, 3].
            cull: rays pass through faces seen from behind.
            coherent: rays that follow each other are neighbors: faster, same distances.

        Returns:
            Face (-1 where none), barycentric u and v, distance (inf where none) and whether the
            face is seen from behind, [n] each.
        """
        require_threads()
        workers, n = num_workers(), len(directions)
        packets, lanes = _aligned(workers * _PACKET_BYTES), _aligned(workers * 4 * _LANES)
        # RTCIntersectArguments: flags and features, then pointers that stay null.
        arguments = np.zeros(16, np.uint32)
        arguments[:2] = _COHERENT if coherent else 0, _ALL_FEATURES
        hits = (
            np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32),
            np.empty(n, np.float32), np.empty(n, bool),
        )  # fmt: skip
        _cast_all(
            self._intersect, self._scene, arguments.ctypes.data,
            packets.view(np.float32).reshape(workers, -1, _LANES),
            lanes.view(np.int32).reshape(workers, _LANES), packets.ctypes.data, lanes.ctypes.data,
            np.require(origins, np.float32, ("C", "W")),
            np.require(directions, np.float32, ("C", "W")), cull, *hits,
        )  # fmt: skip
        return hits


def _release(embree: CDLL, device: int, scene: int) -> None:
    embree.rtcReleaseScene(scene)
    embree.rtcReleaseDevice(device)


def _aligned(num_bytes: int) -> np.ndarray:
    """Allocates zeros on a boundary of 64 bytes, as embree's packets must be, uint8."""
    room = np.zeros(num_bytes + 64, np.uint8)
    start = -room.ctypes.data % 64
    return room[start : start + num_bytes]


@intrinsic
def _call(typingctx, function, lanes, scene, packet, arguments):
    """Calls `rtcIntersect16`, all arguments being addresses."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 4)
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), codegen


@inlined
def _load(packet, marks, lanes, origins, directions, first):
    """Fills a packet with the rays from `first` on."""
    for lane in range(_LANES):
        ray = first + lane
        lanes[lane] = -1 if ray < directions.shape[0] else 0
        ray = min(ray, directions.shape[0] - 1)
        start = min(ray, origins.shape[0] - 1)
        for axis in range(3):
            packet[_ORIGIN + axis, lane] = origins[start, axis]
            packet[_DIRECTION + axis, lane] = directions[ray, axis]
        packet[_NEAR, lane] = packet[_TIME, lane] = np.float32(0.0)
        packet[_FAR, lane] = np.float32(np.inf)
        marks[_MASK, lane] = marks[_GEOMETRY, lane] = -1
        marks[_ID, lane] = marks[_FLAGS, lane] = 0


@inlined
def _store(packet, marks, lanes, first, face, u, v, distance, is_back):
    """Writes the hits of a packet's active lanes."""
    for lane in range(_LANES):
        if lanes[lane] != 0:
            ray = first + lane
            if marks[_GEOMETRY, lane] == -1:
                face[ray], u[ray], v[ray] = -1, np.float32(0.0), np.float32(0.0)
                distance[ray], is_back[ray] = np.float32(np.inf), False
            else:
                face[ray], distance[ray] = marks[_FACE, lane], packet[_FAR, lane]
                u[ray], v[ray] = packet[_U, lane], packet[_V, lane]
                along = packet[_NORMAL, lane] * packet[_DIRECTION, lane]
                along += packet[_NORMAL + 1, lane] * packet[_DIRECTION + 1, lane]
                along += packet[_NORMAL + 2, lane] * packet[_DIRECTION + 2, lane]
                is_back[ray] = along > np.float32(0.0)


@inlined
def _send_on(packet, marks, lanes, first, is_back):
    """Sends the rays that hit a back face on from there; True if there are any."""
    any_left = False
    for lane in range(_LANES):
        goes_on = lanes[lane] != 0 and is_back[first + lane]
        lanes[lane] = -1 if goes_on else 0
        if goes_on:
            any_left = True
            reached = packet[_FAR, lane]
            packet[_NEAR, lane] = reached * np.float32(1.0 + 1e-6) + np.float32(1e-5)
            packet[_FAR, lane] = np.float32(np.inf)
            marks[_GEOMETRY, lane] = -1
    return any_left


@inlined
def _forget(lanes, first, face, distance, is_back):
    """Counts the lanes that are still active as misses."""
    for lane in range(_LANES):
        if lanes[lane] != 0:
            face[first + lane], distance[first + lane] = -1, np.float32(np.inf)
            is_back[first + lane] = False


@called_from_python(parallel=True)
def _cast_all(
    function, scene, arguments, packets, lanes, packet_address, lane_address,
    origins, directions, cull, face, u, v, distance, is_back,
):  # fmt: skip
    """Traces all rays, packet by packet; see `PacketScene.cast`."""
    num, workers = directions.shape[0], packets.shape[0]
    rays_per_block = _PACKETS_PER_BLOCK * _LANES
    blocks = (num + rays_per_block - 1) // rays_per_block
    for worker in prange(workers):
        packet, active = packets[worker], lanes[worker]
        marks = packet.view(np.int32)
        here = packet_address + worker * _PACKET_BYTES
        lanes_here = lane_address + worker * 4 * _LANES
        # Every `workers`-th block, so that each thread gets of all parts of the image.
        for block in range(worker, blocks, workers):
            end = min((block + 1) * rays_per_block, num)
            for first in range(block * rays_per_block, end, _LANES):
                _load(packet, marks, active, origins, directions, first)
                goes_on, layers = True, 0
                while goes_on and layers < MAX_LAYERS:
                    _call(function, lanes_here, scene, here, arguments)
                    _store(packet, marks, active, first, face, u, v, distance, is_back)
                    goes_on = cull and _send_on(packet, marks, active, first, is_back)
                    layers += 1
                if goes_on:
                    _forget(active, first, face, distance, is_back)
