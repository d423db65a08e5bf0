"""Small faults put into the package on purpose: a law that notices none of them proves little.

A mutant is a snippet of a module's source and what to write in its place. The module and those
that build on it are then loaded a second time, beside the real ones, and a law is run on them.

Every plant compiles anew, so mutants run on demand (`make mutants`). Only then is a snippet that
has left the source an error: renaming a variable must not stop `make test`.
"""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from unittest import mock

import pytest

ROOT = Path(__file__).resolve().parents[1]

Modules = dict[str, ModuleType]
"""Loaded modules by the last part of their names."""


class Mutant(NamedTuple):
    """One fault, and the law that must notice it."""

    module: str
    """Last part of the module's name, such as `join`."""

    original: str
    """Source as it stands; occurs exactly once."""

    mutated: str
    """Source with the fault."""

    law: Callable[[Modules], None]
    """Raises AssertionError when it does not hold."""


def load(chain: tuple[str, ...], mutant: Mutant | None = None) -> Modules:
    """Loads the modules of `chain` afresh, in this order, each seeing the earlier ones.

    Args:
        chain: full module names, imported modules before those that import them.
        mutant: the fault to put in, if any.

    Raises:
        LookupError: the mutant's module or snippet is not there (any more), or not unique.
    """
    loaded: Modules = {}
    with mock.patch.dict(sys.modules):
        for name in chain:
            short = name.rpartition(".")[2]
            path, source = _source(name)
            if mutant is not None and mutant.module == short:
                source = _replaced(source, mutant, path)
            module = ModuleType(name)
            module.__file__ = str(path)
            sys.modules[name] = loaded[short] = module
            exec(compile(source, str(path), "exec"), module.__dict__)
    if mutant is not None and mutant.module not in loaded:
        raise LookupError(f"no module {mutant.module!r} among {sorted(loaded)}")
    return loaded


def _source(name: str) -> tuple[Path, str]:
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:
        raise LookupError(f"no source for module {name!r}")
    return Path(spec.origin), Path(spec.origin).read_text(encoding="utf-8")


def _replaced(source: str, mutant: Mutant, path: Path) -> str:
    found = source.count(mutant.original)
    if found != 1:
        raise LookupError(
            f"the mutant's snippet occurs {found} times in {path.name}, not once: "
            f"{mutant.original!r}. Bring the list of mutants up to date."
        )
    return source.replace(mutant.original, mutant.mutated)


def assert_caught(chain: tuple[str, ...], mutant: Mutant) -> None:
    """Fails unless the mutant breaks its law."""
    modules = load(chain, mutant)
    with pytest.raises(AssertionError):
        mutant.law(modules)


def each(mutants: list[Mutant]) -> pytest.MarkDecorator:
    """Runs a test for each mutant with `make mutants`, named by the module and the fault."""
    cases: list[Any] = [
        pytest.param(
            mutant,
            id=f"{mutant.module}: {' '.join(mutant.mutated.split())}",
            marks=pytest.mark.mutant,
        )
        for mutant in mutants
    ]
    return pytest.mark.parametrize("mutant", cases)
