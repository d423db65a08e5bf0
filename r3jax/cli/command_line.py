"""Reads the command line, and runs the command that it names."""

import importlib
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import r3jax
from r3jax.cli.options.audit import AuditOptions
from r3jax.cli.options.benchmark import BenchmarkOptions
from r3jax.cli.options.explore import DemoOptions, ExploreOptions, TeamOptions
from r3jax.cli.options.models import EvaluateOptions, TrainOptions
from r3jax.cli.options.runs import (
    ExportOptions,
    ForecastOptions,
    InfoOptions,
    MergeOptions,
    PoliciesOptions,
    ReplayOptions,
    ViewOptions,
)
from r3jax.cli.options.select import SelectOptions
from r3jax.cli.parsing import parse
from r3jax.errors import InputError
from r3jax.kernels.native.ahead import cache_folder, compile_ahead
from r3jax.validation.errors import did_you_mean

COMMANDS = {
    "demo": DemoOptions,
    "explore": ExploreOptions,
    "team": TeamOptions,
    "train": TrainOptions,
    "evaluate": EvaluateOptions,
    "benchmark": BenchmarkOptions,
    "replay": ReplayOptions,
    "merge": MergeOptions,
    "export": ExportOptions,
    "forecast": ForecastOptions,
    "audit": AuditOptions,
    "select": SelectOptions,
    "view": ViewOptions,
    "policies": PoliciesOptions,
    "info": InfoOptions,
}

_DESCRIPTION = """Where to look next for 3D Gaussian splatting: explores a scene with an RGB-D
camera, chooses every view by closed-form renderability, and leaves a data set. --version prints the
version."""

_DECIDES = ("demo", "explore", "team", "benchmark")
"""Commands that decide, and may train afterwards: they need the kernels."""


def run_command(args: Sequence[str]) -> int:
    """Runs the command that the words after `r3jax` name, and returns its exit code.

    The command is `run_NAME` in the module of `r3jax.cli.commands` that is called as the module of
    its options, and is imported once the options are valid: neither `--help` nor a mistyped option
    waits for JAX.

    Raises:
        InputError: wrong input.
    """
    words = list(args)
    if odd := [word for word in words if "\0" in word]:
        raise InputError(f"{odd[0]!r} contains a null byte, which names and paths cannot")
    if words == ["--version"]:
        print(f"r3jax {r3jax.__version__}")
        return 0
    if words and not words[0].startswith("-") and words[0] not in COMMANDS:
        hint = did_you_mean(words[0], COMMANDS)
        raise InputError(f"there is no command {words[0]!r}{hint}; `r3jax --help` lists them")
    options = parse(COMMANDS, words, _DESCRIPTION)
    (name,) = (name for name, kind in COMMANDS.items() if isinstance(options, kind))
    _keep_compilations()
    warnings.formatwarning = _format_warning
    if name in _DECIDES:
        compile_ahead()
    return find_command(name)(options)


def find_command(name: str) -> Callable[[Any], int]:
    """Imports the function that runs a command."""
    home = COMMANDS[name].__module__.replace(".options.", ".commands.")
    return getattr(importlib.import_module(home), f"run_{name}")


def _format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Prints our own warnings as a sentence; those of libraries with their line, as usual."""
    if Path(filename).is_relative_to(Path(r3jax.__file__).parent):
        return f"r3jax: {message}\n"
    return _usual_format(message, category, filename, lineno, line)


_usual_format = warnings.formatwarning


def _keep_compilations() -> None:
    """Enables the compilation cache, unless JAX is configured otherwise."""
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_folder() / "jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
