"""Kernels on CPUs, plain JAX elsewhere: the choice that is made where a program is lowered."""

import functools
import os
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
from jax.extend import backend

from r3jax.native.structs import misread


def by_platform(*, cpu: Callable[..., Any], default: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is `cpu` where a program runs on a CPU, and `default` elsewhere.

    Args:
        cpu: calls kernels. Not asked where XLA's interface is another than theirs.
        default: the same in plain JAX.
    """
    if not can_call_kernels():
        return default
    # Both would be traced, which takes a fifth of a short run, for one that nobody can ask for.
    if is_cpu_only():
        return cpu
    return functools.partial(jax.lax.platform_dependent, cpu=cpu, default=default)


def is_cpu_only() -> bool:
    """Whether JAX has found no other device."""
    return set(backend.backends()) == {"cpu"}


def can_call_kernels(instead: str = "mapping and scoring in plain JAX") -> bool:
    """Whether XLA can call the kernels; warns once if its structs are not those that they read.

    Args:
        instead: what the caller does then.
    """
    if problem := misread():
        _warn(problem, instead)
    return not problem


@functools.cache
def _warn(problem: str, instead: str) -> None:
    warnings.warn(
        f"the kernels for CPUs cannot read the structs of jaxlib {version('jaxlib')}: {problem}; "
        f"{instead}, which is slower. jaxlib 0.10 to 0.12 have them where they are read",
        RuntimeWarning,
        stacklevel=3,
    )


def num_cores() -> int:
    """Cores that this process may use, which a scheduler may keep below those of the machine."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS, which ties no process to cores
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
