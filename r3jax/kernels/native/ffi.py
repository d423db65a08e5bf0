"""Machine code that XLA calls with its own buffers: custom calls whose handlers Numba compiles.

A handler speaks XLA's foreign function interface (`xla/ffi/api/c_api.h`, which jaxlib ships): it
is a C function of one pointer, the call frame, from which it reads the addresses and shapes of the
arrays. Compared with `jax.pure_callback` nothing is copied, no Python runs inside a computation,
and nothing can wait for a thread of XLA's pool while it occupies the only one.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# Code generators get what llvmlite makes, which has no types.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import contextlib
import functools
import hashlib
import inspect
import os
import tempfile
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from llvmlite import ir
from numba import cfunc, get_num_threads, prange, types
from numba.np.numpy_support import carray
from numba.np.ufunc.parallel import threading_layer

from r3jax.files import lock_file
from r3jax.kernels.native.compiled import called_from_python, inlined, intrinsic, kept_on_disk
from r3jax.kernels.native.one_piece import in_one_piece
from r3jax.kernels.native.platform import num_cores
from r3jax.kernels.native.structs import OFFSETS, VALUES
from r3jax.kernels.native.threads import use_own_threads

# Bytes in structs; the names say whose, where it is not the call frame.
_EXTENSION, _API = OFFSETS["CallFrame.extension_start"], OFFSETS["CallFrame.api"]
_API_MINOR = OFFSETS["Api.api_version.minor_version"]
# Arrays of pointers to buffers.
ARGUMENTS, RESULTS = OFFSETS["CallFrame.args.args"], OFFSETS["CallFrame.rets.rets"]
_DATA, _RANK, _DIMENSIONS = (OFFSETS[f"Buffer.{field}"] for field in ("data", "rank", "dims"))
_EXTENSION_TYPE = OFFSETS["Metadata_Extension.extension_base.type"]
_EXTENSION_METADATA = OFFSETS["Metadata_Extension.metadata"]
_METADATA_MAJOR = OFFSETS["Metadata.api_version.major_version"]
_METADATA_MINOR = OFFSETS["Metadata.api_version.minor_version"]
_IS_METADATA = VALUES["XLA_FFI_Extension_Metadata"]


def _reader(numba_type, llvm_type):
    @intrinsic
    def read(typingctx, address):
        def codegen(context, builder, sig, args):
            return builder.load(builder.inttoptr(args[0], llvm_type.as_pointer()))

        return numba_type(types.int64), codegen

    return read


def _caster(numba_type):
    @intrinsic
    def cast(typingctx, address):
        def codegen(context, builder, sig, args):
            return builder.inttoptr(args[0], context.get_value_type(sig.return_type))

        return types.CPointer(numba_type)(types.int64), codegen

    return cast


_int64_at, _int32_at = _reader(types.int64, ir.IntType(64)), _reader(types.int32, ir.IntType(32))
_floats, _ints, _bytes = _caster(types.float32), _caster(types.int32), _caster(types.uint8)
_words = _caster(types.uint32)


@intrinsic
def _write_int32(typingctx, address, value):
    def codegen(context, builder, sig, args):
        builder.store(args[1], builder.inttoptr(args[0], ir.IntType(32).as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int32), codegen


@inlined
def answers_metadata(frame):
    """Answers XLA's first call, which requests the version of the interface.

    Returns True if this is that call.

    The major version is ours; within it all fields that are read lie where they were (`structs`),
    so any minor one, that is, the caller's, will do.
    """
    extension = _int64_at(frame + _EXTENSION)
    if extension == 0 or _int32_at(extension + _EXTENSION_TYPE) != _IS_METADATA:
        return False
    metadata = _int64_at(extension + _EXTENSION_METADATA)
    _write_int32(metadata + _METADATA_MAJOR, np.int32(0))
    _write_int32(metadata + _METADATA_MINOR, _int32_at(_int64_at(frame + _API) + _API_MINOR))
    return True


@inlined
def _buffer(frame, kind, index):
    """Returns the address of the index-th argument or result of a call."""
    return _int64_at(_int64_at(frame + kind) + 8 * index)


@inlined
def _length(buffer, axis):
    return _int64_at(_int64_at(buffer + _DIMENSIONS) + 8 * axis)


@inlined
def float0(frame, kind, index):
    """Reads the index-th argument, a float32 without axes."""
    return carray(_floats(_int64_at(_buffer(frame, kind, index) + _DATA)), (1,))[0]


def _viewers(cast):
    """Makes functions that view the index-th argument or result of a call, with 1, 2 or 3 axes."""

    @inlined
    def view1(frame, kind, index):
        buffer = _buffer(frame, kind, index)
        return carray(cast(_int64_at(buffer + _DATA)), (_length(buffer, 0),))

    @inlined
    def view2(frame, kind, index):
        buffer = _buffer(frame, kind, index)
        shape = _length(buffer, 0), _length(buffer, 1)
        return carray(cast(_int64_at(buffer + _DATA)), shape)

    @inlined
    def view3(frame, kind, index):
        buffer = _buffer(frame, kind, index)
        shape = _length(buffer, 0), _length(buffer, 1), _length(buffer, 2)
        return carray(cast(_int64_at(buffer + _DATA)), shape)

    return view1, view2, view3


floats1, floats2, floats3 = _viewers(_floats)
ints1, ints2, _ = _viewers(_ints)
bytes1, bytes2, _ = _viewers(_bytes)
_, words2, _ = _viewers(_words)


@inlined
def floats_flat(frame, kind, index):
    """Views the index-th argument or result, of any shape, as float32 with one axis."""
    buffer = _buffer(frame, kind, index)
    size = 1
    for axis in range(_int64_at(buffer + _RANK)):
        size *= _length(buffer, axis)
    return carray(_floats(_int64_at(buffer + _DATA)), (size,))


@called_from_python(parallel=True)
def _wake_up(x):
    for i in prange(x.shape[0]):
        x[i] = i


_starting = threading.Lock()


def require_threads() -> str:
    """Starts the threads that share loops, the first time that it is called.

    Returns:
        Numba's threading layer; with `workqueue` the threads are ours.

    Raises:
        ValueError: the requested threading layer is not installed.
    """
    with _starting:
        return _start_threads()


@functools.cache
def _start_threads() -> str:
    _wake_up(np.zeros(8))
    layer = threading_layer()
    if layer == "workqueue":
        use_own_threads(get_num_threads() - 1)
    return layer


def num_workers() -> int:
    """Returns the number of threads: one for each core that the process may use."""
    return min(get_num_threads(), num_cores())


@contextlib.contextmanager
def _one_process_at_a_time(name: str) -> Generator[None]:
    """Waits for other processes that compile the same: what they leave on the disk is found."""
    user = os.getuid() if hasattr(os, "getuid") else ""  # on Windows the folder is the user's own
    # Another checkout finds nothing of what this one leaves.
    here = hashlib.sha256(__file__.encode()).hexdigest()[:8]
    path = Path(tempfile.gettempdir()) / f"r3jax-{user}-{here}-{name}.lock"
    with contextlib.ExitStack() as held:
        # A file that cannot be written, or is a link: both compile.
        with contextlib.suppress(OSError):
            held.enter_context(lock_file(path, wait=True))
        yield


_lock = threading.Lock()
_compiled: dict[str, Any] = {}
"""Handlers by name, kept alive: XLA holds their addresses."""


def register_handlers(handlers: dict[str, Callable[[Any], int]]) -> None:
    """Compiles handlers (or takes them from the disk) and tells XLA of them by their names, once.

    Args:
        handlers: by their names.
    """
    with _lock:
        missing = {name: handlers[name] for name in handlers if name not in _compiled}
        if missing:
            _register(missing)


def _register(handlers: dict[str, Callable[[Any], int]]) -> None:
    require_threads()
    compiler = lambda handler: kept_on_disk(
        lambda cache: cfunc(types.int64(types.int64), cache=cache)(inspect.unwrap(handler))
    )
    with _one_process_at_a_time("-".join(handlers)), in_one_piece():
        compiled = tuple(map(compiler, handlers.values()))
    for name, handler in zip(handlers, compiled, strict=True):
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler.address), platform="cpu")
        _compiled[name] = handler
