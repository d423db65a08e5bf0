"""How the kernels are compiled, what they ask of the processor, and the counter of their work."""

import contextlib
import inspect
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import extending, njit, types
from numba.core import cgutils

from r3jax.files import remove
from r3jax.kernels.native.borrowing import Borrowing
from r3jax.kernels.native.one_piece import in_one_piece

_Function = Callable[..., Any]

_BARE: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""No entries for callers in Python or C: kernels call each other, and XLA calls handlers. Each
entry would hold the kernel once more, to be compiled once more."""

_FAST = {"contract", "reassoc", "arcp", "nsz", "afn"}

_KERNELS = Path(__file__).parents[1]


def forget_outdated_code(folder: Path = _KERNELS) -> None:
    """Deletes machine code on the disk that is older than any source that it may come from.

    Numba compares a handler with its own file only, not with the files of what it inlines.

    Args:
        folder: with sources of kernels, also in folders in it.
    """
    sources = [*folder.rglob("*.py"), *Path(__file__).parent.glob("*.py")]
    newest = max(source.stat().st_mtime for source in sources)
    for index in folder.rglob("__pycache__/*.nbi"):
        with contextlib.suppress(OSError):
            if index.stat().st_mtime < newest:
                remove(index)


forget_outdated_code()


def intrinsic(function: _Function) -> _Function:
    """Makes a function that kernels can call of one that emits LLVM instructions."""
    return extending.intrinsic(inspect.unwrap(function))


def _compiled_by(compiler: Any, function: _Function) -> _Function:
    """Makes a kernel of a function, compiled once for all values of whole numbers.

    Numba would compile it for every constant that it is called with.
    """
    # A type checker hooked into the import may have wrapped the function; Numba needs the bare one.
    dispatcher = compiler(inspect.unwrap(function))
    with_constants = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: with_constants(
        tuple(map(types.unliteral, args)), {name: types.unliteral(kws[name]) for name in kws}
    )
    return dispatcher


def kernel(function: _Function) -> _Function:
    """Compiles a kernel to machine code, together with the handler that calls it.

    The disk keeps the handler, in which the kernel is: `ffi.register_handlers`. A kernel borrows
    the arrays that it is given (`borrowing`), so it must not return one of them.
    Floating-point operations stay as written: two passes that must take the same decisions
    (counting and listing intersections, blending and its gradient) then do.
    """
    return _compiled_by(njit(error_model="numpy", **_BARE, pipeline_class=Borrowing), function)


def kept_on_disk(compiled: Callable[[bool], Any]) -> Any:
    """Compiles with Numba's cache, or without it where no folder for it can be written.

    Args:
        compiled: compiler, with or without a cache.
    """
    try:
        return compiled(True)
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        return compiled(False)


def called_from_python(*, parallel: bool = False) -> Callable[[_Function], _Function]:
    """Compiles a kernel that Python calls, and other kernels may; the disk keeps it.

    It runs without Python's lock: other threads go on.

    Args:
        parallel: its `prange` loops share the cores that the process may use.
    """

    def decorate(function: _Function) -> _Function:
        compiler = lambda cache: njit(
            cache=cache, error_model="numpy", parallel=parallel, nogil=True
        )
        dispatcher = kept_on_disk(lambda cache: _compiled_by(compiler(cache), function))
        dispatcher.compile = in_one_piece()(dispatcher.compile)
        return dispatcher

    return decorate


def inlined(function: _Function) -> _Function:
    """Compiles a small function into its callers."""
    return _compiled_by(njit(error_model="numpy", **_BARE, forceinline=True), function)


def inlined_fast(function: _Function) -> _Function:
    """Compiles like `inlined`, with fast-math: for results that need not be reproducible.

    NaN and infinity keep their meaning.
    """
    compiler = njit(error_model="numpy", **_BARE, forceinline=True, fastmath=_FAST)
    return _compiled_by(compiler, function)


def inlined_fused(function: _Function) -> _Function:
    """Compiles like `inlined`, but lets LLVM fuse a product with a sum, and nothing else."""
    compiler = njit(error_model="numpy", **_BARE, forceinline=True, fastmath={"contract"})
    return _compiled_by(compiler, function)


def parallel_kernel(function: _Function) -> _Function:
    """Compiles a kernel whose `prange` loops share the cores that the process may use.

    Named tuples that a loop uses must be arguments of the kernel, and hold no other tuples.
    """
    return _compiled_by(njit(error_model="numpy", **_BARE, parallel=True), function)


@intrinsic
def claim(typingctx: Any, counter: Any) -> Any:
    """Takes the next number of a counter (an int64 array of length 1) that all threads share."""
    signature = types.int64(counter)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array = context.make_array(sig.args[0])(context, builder, args[0])
        one = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", array.data, one, "monotonic")

    return signature, codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Asks for the cache line of an array's element, to be read soon."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array = context.make_array(sig.args[0])(context, builder, args[0])
        byte, integer = ir.IntType(8).as_pointer(), ir.IntType(32)
        pointer = builder.bitcast(builder.gep(array.data, [args[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, integer, integer, integer])
        read, keep, data = (ir.Constant(integer, i) for i in (0, 3, 1))
        builder.call(_declared(builder, kind, "llvm.prefetch.p0"), [pointer, read, keep, data])
        return context.get_dummy_value()

    return types.void(array, types.int64), codegen


@intrinsic
def in_wide_vectors(typingctx: Any) -> Any:
    """Asks LLVM for the widest vectors of the processor in the kernel that calls this.

    Left to itself it halves them on Intel's, whose early models with AVX-512 slowed down on them.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        # llvmlite has only the attributes that are LLVM's keywords, and refuses to add this one.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), codegen


_FLUSH = 0x8040
"""In the control word of SSE: numbers below 1e-38 are 0, read or written."""


@intrinsic
def flush_denormals(typingctx: Any) -> Any:
    """Lets this thread take numbers below 1e-38 for 0, as XLA lets its own threads.

    Numba's threads do not: what a kernel computes would depend on which thread computed it. To be
    called by every worker of a kernel that XLA calls. Other processors than x86 are left alone.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if platform.machine() in ("x86_64", "AMD64"):
            word = cgutils.alloca_once(builder, ir.IntType(32))
            kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer()])
            address = builder.bitcast(word, kind.args[0])
            builder.call(_declared(builder, kind, "llvm.x86.sse.stmxcsr"), [address])
            flushing = builder.or_(builder.load(word), ir.Constant(ir.IntType(32), _FLUSH))
            builder.store(flushing, word)
            builder.call(_declared(builder, kind, "llvm.x86.sse.ldmxcsr"), [address])
        return context.get_dummy_value()

    return types.void(), codegen


def _declared(builder: Any, kind: Any, name: str) -> Any:
    return builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
