"""Kernels on CPUs, plain JAX elsewhere: the choice that is made where a program is lowered."""

import functools
import os
import warnings
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import backend

from r3jax.native.version import WRITTEN_FOR, ffi_version


def by_platform(*, cpu: Callable[..., Any], default: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is `cpu` where a program runs on a CPU, and `default` elsewhere.

    Args:
        cpu: calls kernels. Not asked where XLA's interface is another than theirs.
        default: the same in plain JAX.
    """
    if not speaks_our_interface():
        return default
    # Both would be traced, which takes a fifth of a short run, for one that nobody can ask for.
    if is_cpu_only():
        return cpu
    return functools.partial(jax.lax.platform_dependent, cpu=cpu, default=default)


def is_cpu_only() -> bool:
    """Whether JAX has found no other device."""
    return set(backend.backends()) == {"cpu"}


def speaks_our_interface() -> bool:
    """Whether XLA can call the kernels; warns once if its interface is another."""
    if (version := ffi_version()) != WRITTEN_FOR:
        _warn(version)
        return False
    return True


@functools.cache
def _warn(version: tuple[int, int]) -> None:
    warnings.warn(
        f"the kernels for CPUs read XLA's structs as they are in version "
        f"{'.'.join(map(str, WRITTEN_FOR))} of its foreign function interface; this jaxlib has "
        f"{'.'.join(map(str, version))}: mapping and scoring in plain JAX, which is slower",
        RuntimeWarning,
        stacklevel=2,
    )


def num_cores() -> int:
    """Cores that this process may use, which a scheduler may keep below those of the machine."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS, which ties no process to cores
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
