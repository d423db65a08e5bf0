"""Chooses kernels on CPUs and plain JAX elsewhere when a program is lowered."""

import functools
import os
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.extend import backend

from r3jax.kernels.native.structs import misread


def by_platform(*, cpu: Callable[..., Any], default: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a function that is `cpu` where a program runs on a CPU, and `default` elsewhere.

    Args:
        cpu: calls kernels. Not used if this jaxlib's FFI version is unsupported.
        default: the same in plain JAX.
    """
    if not can_call_kernels():
        return default
    # Both would be traced, which takes a fifth of a short run, although one cannot be used.
    if is_cpu_only():
        return cpu
    return functools.partial(jax.lax.platform_dependent, cpu=cpu, default=default)


MOST_PAIRS = 1 << 24
"""Items of a call times rows of what they share that the formulas work on at once: of a map and a
view each pair takes some 60 bytes."""


def call_of_many(
    kernel: Callable[[Any, Any], Any] | None,
    formula: Callable[[Any, Any], Any],
    shared: Any,
    item: Any,
    num_rows: int,
) -> Any:
    """Computes `formula(shared, item)`, so that its `vmap` is one kernel call on CPUs.

    Elsewhere it is the formula in batches, whose memory does not grow with the number of items.
    If the shared arguments differ as well, the calls are made one after the other.

    Args:
        kernel: of many items, whose arrays have a leading axis; gives arrays with the same axis.
            None: the formula on every platform.
        formula: of one item.
        shared: such as the map.
        item: such as a view.
        num_rows: rows of the shared map.
    """

    def by_formula(shared: Any, items: Any) -> Any:
        num = jax.tree.leaves(items)[0].shape[0]
        size = min(num, max(1, MOST_PAIRS // num_rows))
        return jax.lax.map(functools.partial(formula, shared), items, batch_size=size)

    items = jax.tree.map(lambda x: jnp.asarray(x)[None], item)
    score = by_formula if kernel is None else by_platform(cpu=kernel, default=by_formula)
    results = _over_items(score, shared, items)
    return jax.tree.map(lambda x: x[0], results)


def _over_items(score: Callable[[Any, Any], Any], shared: Any, items: Any) -> Any:
    """Computes `score(shared, items)`, so that `vmap` over items is one call of all of them."""
    # Jitted, so that its constants stay inside: a branch under `vmap` would batch them, too.
    batched = custom_vmap(jax.jit(score))

    @batched.def_vmap
    def rule(axis_size: int, in_batched: Any, shared: Any, items: Any) -> tuple[Any, Any]:
        if any(jax.tree.leaves(in_batched[0])):
            flags = jax.tree.leaves(in_batched)
            leaves, treedef = jax.tree.flatten((shared, items))
            mapped = [x for x, is_mapped in zip(leaves, flags, strict=True) if is_mapped]

            def one(part: list[jax.Array]) -> Any:
                own = iter(part)
                whole = [
                    next(own) if is_mapped else x
                    for x, is_mapped in zip(leaves, flags, strict=True)
                ]
                return _over_items(score, *jax.tree.unflatten(treedef, whole))

            scores = jax.lax.map(one, mapped)
        else:

            def flattened(x: jax.Array, is_mapped: bool) -> jax.Array:
                every = x if is_mapped else jnp.broadcast_to(x[None], (axis_size, *x.shape))
                return every.reshape(-1, *every.shape[2:])

            flat = _over_items(score, shared, jax.tree.map(flattened, items, in_batched[1]))
            scores = jax.tree.map(lambda x: x.reshape(axis_size, -1, *x.shape[1:]), flat)
        return scores, jax.tree.map(lambda _: True, scores)

    return batched(shared, items)


def is_cpu_only() -> bool:
    """Returns whether JAX has found no other device."""
    return set(backend.backends()) == {"cpu"}


def can_call_kernels() -> bool:
    """Checks whether kernels run here; warns once if they do not, or only in turn."""
    problem = missing_for_kernels()
    if problem and jax.default_backend() == "cpu":
        warn_once(
            f"no machine code for CPUs, since {problem}; mapping, scoring, training and rendering "
            "(backend='xla') run in plain JAX, which is slower"
        )
    if not problem and _start()[0] == "workqueue":
        warn_once(
            "Numba finds neither OpenMP nor TBB: kernels run one after the other, which is slower "
            "where several are due at once (planning while moving). To run them side by side, "
            "install OpenMP (Debian: `apt install libgomp1`, macOS: `brew install libomp`) or "
            "`pip install tbb`"
        )
    return not problem


def missing_for_kernels() -> str:
    """Explains why XLA cannot call kernels here; empty if it can."""
    if problem := misread():
        has = "jaxlib 0.10 to 0.12 have them where they are read"
        return f"the structs of jaxlib {version('jaxlib')} cannot be read: {problem} ({has})"
    return missing_for_machine_code()


def missing_for_machine_code() -> str:
    """Explains why Numba cannot compile here; empty if it can."""
    return _start()[1]


def describe_kernels() -> str:
    """Describes how this machine maps, scores and trains on its CPU."""
    if problem := missing_for_kernels():
        return f"plain JAX, since {problem}"
    return f"machine code on {num_cores()} cores, Numba's threading layer {_start()[0]}"


@functools.cache
def _start() -> tuple[str, str]:
    """Starts the threads of kernels: Numba's layer, and what failed."""
    try:
        from r3jax.kernels.native.ffi import require_threads

        return require_threads(), ""
    # Of any kind: a Numba that does not fit its NumPy, or this processor, fails in many ways.
    except Exception as error:
        first = next(iter(str(error).splitlines()), "")
        return "", f"Numba fails with {type(error).__name__}: {first.rstrip('.')}"


@functools.cache
def warn_once(text: str) -> None:
    """Warns, the first time that it is called with a text."""
    warnings.warn(text, RuntimeWarning, stacklevel=1)


def compiled_or_plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function that Python calls; it stays Python, slow, where Numba cannot be used."""
    if missing_for_machine_code():
        return function
    from r3jax.kernels.native.compiled import called_from_python

    return called_from_python()(function)


def num_cores() -> int:
    """Number of cores that this process may use, possibly limited by a scheduler."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS, which has no CPU affinity
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
