"""Threads for parallel loops, where Numba's threading layer serves one loop at a time.

Numba's own layer `workqueue` is all that there is without OpenMP and TBB, and it aborts the process
when two loops run at once; XLA calls kernels from several threads. Every parallel loop is started
through one symbol, `numba_parallel_for`. Here a function takes its place that shares a loop with
threads of our own. It is machine code, since XLA's threads must not wait for Python's lock.

The caller works on its loop, too, and takes over the parts that sleeping threads have not begun.
"""

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils

_SYMBOL = "numba_parallel_for"

_PATIENCE = 100_000
"""How long a loop waits for the threads [us]. Then its caller does all of it: one that started
inside of another loop, whose turn would never come, or in a process that was forked meanwhile."""

_VOID, _INT, _LONG = ir.VoidType(), ir.IntType(32), ir.IntType(64)
_WORK = ir.FunctionType(_VOID, [])
_WORKER = ir.FunctionType(_VOID, [_LONG, _LONG])
_SHARE = ir.FunctionType(_VOID, [_LONG] * 4)
_LOOP = ir.FunctionType(_VOID, [_LONG] * 8)
"""The function that does items, addresses of its arguments, of the numbers of items and of steps
between arguments, its data, the number of inner axes and of arguments, and the threads wanted."""

_alive: list[Any] = []
"""The machine code."""


def use_own_threads(workers: int) -> None:
    """Makes parallel loops that are linked from now on share threads of our own.

    Args:
        workers: threads beside the one that starts a loop.

    Raises:
        RuntimeError: this version of Numba starts its loops in another way.
    """
    if not llvm.address_of_symbol(_SYMBOL):
        raise RuntimeError(f"this version of Numba has no `{_SYMBOL}`, which starts its loops")
    locks = [(_new_lock(), _new_lock()) for _ in range(workers)]
    module = llvm.parse_assembly(str(_Threads(locks).module))
    target = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(module, target)
    engine.finalize_object()
    _alive.append(engine)
    # Called without Python's lock, for as long as the process lives.
    worker = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)(
        engine.get_function_address("worker")
    )
    for pair in locks:
        threading.Thread(target=worker, args=pair, daemon=True).start()
    llvm.add_symbol(_SYMBOL, engine.get_function_address("loop"))


# Python's own locks: on every platform, and to be used without Python's lock and by any thread.
_python = ctypes.pythonapi
_python.PyThread_allocate_lock.restype = ctypes.c_void_p
_python.PyThread_acquire_lock_timed.argtypes = [ctypes.c_void_p, ctypes.c_longlong, ctypes.c_int]


def _new_lock(*, is_free: bool = False) -> int:
    lock = _python.PyThread_allocate_lock()
    if not is_free:
        _python.PyThread_acquire_lock_timed(lock, 0, 0)
    return lock


class _Threads:
    """The module of `worker`, which a thread runs, and `loop`, which shares a loop with them."""

    def __init__(self, locks: list[tuple[int, int]]) -> None:
        self.module = ir.Module("threads")
        fields = ("function", "arguments", "sizes", "steps", "data", "axes", "count", "next")
        self._task = [self._zero(name) for name in fields]
        self._work = self._define("work", _WORK, self._emit_work)
        self._define("worker", _WORKER, self._emit_worker)
        self._define("loop", _LOOP, lambda builder: self._emit_loop(builder, locks))

    def _zero(self, name: str) -> Any:
        variable: Any = ir.GlobalVariable(self.module, _LONG, name)
        variable.initializer = ir.Constant(_LONG, 0)
        return variable

    def _define(self, name: str, kind: Any, emit: Callable[[Any], None]) -> ir.Function:
        function = ir.Function(self.module, kind, name)
        emit(ir.IRBuilder(function.append_basic_block()))
        return function

    def _emit_work(self, builder: Any) -> None:
        """Does items of the task until all are taken."""
        *task, following = self._task
        function, arguments, sizes, steps, data, axes, count = map(builder.load, task)
        # As if there were one item: Numba's function counts them itself.
        num, one = _load(builder, sizes, 0), ir.Constant(_LONG, 1)
        own_sizes = builder.alloca(_LONG, builder.add(axes, one))
        with cgutils.for_range(builder, builder.add(axes, one)) as loop:
            size = _load(builder, sizes, loop.index)
            is_first = builder.icmp_signed("==", loop.index, ir.Constant(_LONG, 0))
            builder.store(builder.select(is_first, one, size), builder.gep(own_sizes, [loop.index]))
        own_arguments = builder.alloca(_LONG, count)
        claim, do, end = (builder.append_basic_block() for _ in range(3))
        builder.branch(claim)
        builder.position_at_end(claim)
        item = builder.atomic_rmw("add", following, one, "seq_cst")
        builder.cbranch(builder.icmp_signed("<", item, num), do, end)
        builder.position_at_end(do)
        with cgutils.for_range(builder, count) as loop:
            offset = builder.mul(item, _load(builder, steps, loop.index))
            place = builder.add(_load(builder, arguments, loop.index), offset)
            builder.store(place, builder.gep(own_arguments, [loop.index]))
        own = [builder.ptrtoint(pointer, _LONG) for pointer in (own_arguments, own_sizes)]
        builder.call(_at(builder, function, _SHARE), [*own, steps, data])
        builder.branch(claim)
        builder.position_at_end(end)
        builder.ret_void()

    def _emit_worker(self, builder: Any) -> None:
        """Waits for a task, works on it, says so, and waits for the next one."""
        again = builder.append_basic_block()
        builder.branch(again)
        builder.position_at_end(again)
        wake, done = builder.function.args
        _acquire(builder, wake, -1)
        builder.call(self._work, [])
        _release(builder, done)
        builder.branch(again)

    def _emit_loop(self, builder: Any, locks: list[tuple[int, int]]) -> None:
        """Shares a loop with the threads, or does all of it while they are busy."""
        turn = ir.Constant(_LONG, _new_lock(is_free=True))
        function, arguments, sizes, steps, data, _, _, threads = builder.function.args
        with builder.if_else(_acquire(builder, turn, _PATIENCE)) as (together, alone):
            with together:
                values = (*builder.function.args[:7], ir.Constant(_LONG, 0))
                for field, value in zip(self._task, values, strict=True):
                    builder.store(value, field)
                num = _load(builder, sizes, 0)
                is_less = builder.icmp_signed("<", num, threads)
                wanted = builder.select(is_less, num, threads)
                # The caller is the first of them.
                helps = [
                    builder.icmp_signed(">", wanted, ir.Constant(_LONG, i + 1))
                    for i in range(len(locks))
                ]
                for is_wanted, (wake, _) in zip(helps, locks, strict=True):
                    with builder.if_then(is_wanted):
                        _release(builder, ir.Constant(_LONG, wake))
                builder.call(self._work, [])
                for is_wanted, (wake, done) in zip(helps, locks, strict=True):
                    with builder.if_then(is_wanted):
                        self._wait(builder, ir.Constant(_LONG, wake), ir.Constant(_LONG, done))
                _release(builder, turn)
            with alone:
                share = [arguments, sizes, steps, data]
                builder.call(_at(builder, function, _SHARE), share)
        builder.ret_void()

    def _wait(self, builder: Any, wake: Any, done: Any) -> None:
        """Waits for a thread that works; one that is not awake yet sleeps on."""
        is_asleep = _acquire(builder, wake, 0)
        with builder.if_then(builder.not_(is_asleep)):
            _acquire(builder, done, -1)


def _load(builder: Any, array: Any, index: Any) -> Any:
    """Loads an element of an array of words at an address."""
    first = builder.inttoptr(array, _LONG.as_pointer())
    index = ir.Constant(_LONG, index) if isinstance(index, int) else index
    return builder.load(builder.gep(first, [index]))


def _at(builder: Any, address: Any, kind: Any) -> Any:
    return builder.inttoptr(address, kind.as_pointer())


def _acquire(builder: Any, lock: Any, microseconds: int) -> Any:
    """Takes a lock, with a wait of so long at most (-1: without end); True where it was taken."""
    kind = ir.FunctionType(_INT, [_LONG, _LONG, _INT])
    function = _at(builder, _address(_python.PyThread_acquire_lock_timed), kind)
    wait, uninterrupted = ir.Constant(_LONG, microseconds), ir.Constant(_INT, 0)
    taken = builder.call(function, [lock, wait, uninterrupted])
    return builder.icmp_signed("==", taken, ir.Constant(_INT, 1))


def _release(builder: Any, lock: Any) -> None:
    kind = ir.FunctionType(_VOID, [_LONG])
    builder.call(_at(builder, _address(_python.PyThread_release_lock), kind), [lock])


def _address(function: Any) -> ir.Constant:
    return ir.Constant(_LONG, ctypes.cast(function, ctypes.c_void_p).value)
