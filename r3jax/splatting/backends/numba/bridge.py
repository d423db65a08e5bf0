"""The passes as XLA custom calls: machine code that XLA calls with its own buffers.

The handlers speak XLA's foreign function interface (`xla/ffi/api/c_api.h`, which jaxlib ships):
a handler is a C function of one pointer, the call frame, from which it reads the addresses and
shapes of the arrays. Compared with `jax.pure_callback` nothing is copied, no Python runs inside
a computation, and nothing can wait for a thread of XLA's pool while it occupies the only one.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# Code generators get what llvmlite makes, which has no types.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import functools
import inspect
import os
import threading
from typing import Any

import jax
import numpy as np
from llvmlite import ir
from numba import cfunc, get_num_threads, prange, types
from numba.np.numpy_support import carray
from numba.np.ufunc.parallel import threading_layer

from r3jax.splatting.backends.numba.compiled import inlined, intrinsic, parallel_kernel
from r3jax.splatting.backends.numba.passes import backward_pass, forward_pass

FORWARD, BACKWARD = "r3jax_splatting_forward", "r3jax_splatting_backward"

# Offsets in bytes in the structs of XLA's FFI, API version `splatting.backend.WRITTEN_FOR`.
_EXTENSION, _API = 8, 16
_API_MINOR = 36  # in XLA_FFI_Api
_ARGUMENTS, _RESULTS = 72, 112  # in XLA_FFI_CallFrame: arrays of pointers to buffers
_DATA, _DIMENSIONS = 24, 40  # in XLA_FFI_Buffer
_EXTENSION_TYPE, _EXTENSION_METADATA = 8, 24
_METADATA_MAJOR, _METADATA_MINOR = 24, 28  # in XLA_FFI_Metadata
_IS_METADATA = 1


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


@intrinsic
def _write_int32(typingctx, address, value):
    def codegen(context, builder, sig, args):
        builder.store(args[1], builder.inttoptr(args[0], ir.IntType(32).as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int32), codegen


@inlined
def _answers_metadata(frame):
    """XLA asks first which version of the interface a handler speaks; True if this is that call.

    The major version is ours; within it the structs only grow at their ends, so any minor one,
    that is, the caller's, will do.
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
    """Address of the index-th argument or result of a call."""
    return _int64_at(_int64_at(frame + kind) + 8 * index)


@inlined
def _length(buffer, axis):
    return _int64_at(_int64_at(buffer + _DIMENSIONS) + 8 * axis)


@inlined
def _floats1(frame, kind, index):
    buffer = _buffer(frame, kind, index)
    return carray(_floats(_int64_at(buffer + _DATA)), (_length(buffer, 0),))


@inlined
def _floats2(frame, kind, index):
    buffer = _buffer(frame, kind, index)
    shape = _length(buffer, 0), _length(buffer, 1)
    return carray(_floats(_int64_at(buffer + _DATA)), shape)


@inlined
def _floats3(frame, kind, index):
    buffer = _buffer(frame, kind, index)
    shape = _length(buffer, 0), _length(buffer, 1), _length(buffer, 2)
    return carray(_floats(_int64_at(buffer + _DATA)), shape)


@inlined
def _ints1(frame, kind, index):
    buffer = _buffer(frame, kind, index)
    return carray(_ints(_int64_at(buffer + _DATA)), (_length(buffer, 0),))


@inlined
def _bytes1(frame, kind, index):
    buffer = _buffer(frame, kind, index)
    return carray(_bytes(_int64_at(buffer + _DATA)), (_length(buffer, 0),))


@inlined
def _cloud(frame, kind):
    """Means, quats, log_scales, logits, harmonics, offsets: the first six arrays."""
    return (
        _floats2(frame, kind, 0), _floats2(frame, kind, 1), _floats2(frame, kind, 2),
        _floats1(frame, kind, 3), _floats2(frame, kind, 4), _floats2(frame, kind, 5),
    )  # fmt: skip


@inlined
def _images(frame, kind, first):
    return (
        _floats3(frame, kind, first), _floats2(frame, kind, first + 1),
        _floats2(frame, kind, first + 2),
    )  # fmt: skip


@inlined
def _lists(frame, kind, first):
    return (
        _ints1(frame, kind, first), _ints1(frame, kind, first + 1),
        _bytes1(frame, kind, first + 2),
        _ints1(frame, kind, first + 3), _ints1(frame, kind, first + 4),
    )  # fmt: skip


def _forward(frame):
    """Arguments: cloud (6), view, workers. Results: images (3), totals, records, lists (5)."""
    if _answers_metadata(frame):
        return 0
    totals = _ints1(frame, _RESULTS, 3)
    totals[0], totals[1] = 0, 1  # overflow, should the pass fail
    forward_pass(
        _cloud(frame, _ARGUMENTS), _floats1(frame, _ARGUMENTS, 6),
        np.int64(_ints1(frame, _ARGUMENTS, 7)[0]),
        _images(frame, _RESULTS, 0), totals, _floats2(frame, _RESULTS, 4),
        _lists(frame, _RESULTS, 5),
    )  # fmt: skip
    return 0


def _backward(frame):
    """Arguments: forward's, its results but the totals, gradients of the images (3).

    Results: gradients by the cloud (6) and by the view.
    """
    if _answers_metadata(frame):
        return 0
    backward_pass(
        _cloud(frame, _ARGUMENTS), _floats1(frame, _ARGUMENTS, 6),
        np.int64(_ints1(frame, _ARGUMENTS, 7)[0]),
        _images(frame, _ARGUMENTS, 8), _floats2(frame, _ARGUMENTS, 11),
        _lists(frame, _ARGUMENTS, 12), _images(frame, _ARGUMENTS, 17),
        _cloud(frame, _RESULTS), _floats1(frame, _RESULTS, 6),
    )  # fmt: skip
    return 0


@parallel_kernel
def _wake_up(x):
    for i in prange(x.shape[0]):
        x[i] = i


def require_threads() -> None:
    """Starts Numba's threads.

    Raises:
        RuntimeError: its threading layer cannot serve two renderings at once.
    """
    _wake_up(np.zeros(8))
    layer = threading_layer()
    if layer == "workqueue":
        raise RuntimeError(
            "the numba rasterizer needs Numba's threading layer `omp` or `tbb`, but only "
            "`workqueue` is there, which aborts the process when two renderings run at once. "
            "Install OpenMP (libgomp) or `pip install tbb`, or render with backend='xla'."
        )


def num_workers() -> int:
    """Threads that share the work: one for each core that the process may use."""
    return min(get_num_threads(), len(os.sched_getaffinity(0)))


_lock = threading.Lock()


def register() -> None:
    """Compiles the handlers (or takes them from the disk) and tells XLA of them, once."""
    with _lock:
        _register()


@functools.cache
def _register() -> tuple[Any, Any]:
    require_threads()
    handler = cfunc(types.int64(types.int64), cache=True)
    handlers = handler(inspect.unwrap(_forward)), handler(inspect.unwrap(_backward))
    for name, compiled in zip((FORWARD, BACKWARD), handlers, strict=True):
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(compiled.address), platform="cpu")
    return handlers  # kept: XLA holds their addresses
