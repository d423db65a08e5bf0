"""Compiles a kernel and all that it calls in one piece, once.

Left to itself Numba optimizes every function, makes machine code of it and links it into its
callers, which are optimized together with it once more: what stands at the end of a chain of six
calls is compiled six times. The functions of a kernel are called by each other only. Here each
stays as it was written until its address is asked for, and what it calls becomes part of it.
"""

# Numba's compiler has no types, and what is private in it may change with its version.
# pyright: reportPrivateUsage=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false

import contextlib
from collections.abc import Generator
from typing import Any, ClassVar

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target

WRITTEN_FOR = "0.68."
"""Versions of Numba whose compiler this relies on; others compile as they always do, slower."""


class _Library(JITCodeLibrary):
    """Code of a function, which becomes machine code when an address in it is asked for."""

    part_by_part = False
    """Whether functions are optimized before their callers take them in."""

    _is_native = False
    environments: ClassVar[dict[str, Any]] = {}
    """Numba's data of functions that have no address yet, by the names of their places."""

    def finalize(self) -> None:
        """Takes in what the function calls; from now on callers may take it in."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        if self.part_by_part:
            self._optimize_final_module()
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """The address of a function; 0 if it is not defined here, as is usual."""
        self._ensure_finalized()
        if not self._is_native and not self._defines(name):
            return 0
        self._make_native()
        return super().get_pointer_to_function(name)

    def _defines(self, name: str) -> bool:
        try:
            return not self._final_module.get_function(name).is_declaration
        except NameError:
            return False

    def _make_native(self) -> None:
        if self._is_native:
            return
        if not self.part_by_part:
            self._get_module_for_linking()  # callers optimize it as a part of themselves
            self._optimize_final_module()
        self._final_module.verify()
        places = [place.name for place in self._final_module.global_variables]
        self._finalize_final_module()
        for name in self.environments.keys() & set(places):
            self._codegen.set_env(name, self.environments.pop(name))

    def _finalize_final_module(self) -> None:
        self._is_native = True  # also what comes from the disk
        super()._finalize_final_module()

    def _get_compiled_object(self) -> Any:
        self._make_native()  # for the disk
        return super()._get_compiled_object()


class _PartByPart(_Library):
    part_by_part = True


@contextlib.contextmanager
def in_one_piece(*, part_by_part: bool = False) -> Generator[None]:
    """What Numba compiles meanwhile becomes machine code once; used as always afterwards.

    Args:
        part_by_part: optimizes every function before its callers take it in, as Numba does by
            itself. Takes longer, and rounds as it always has.
    """
    if not numba.__version__.startswith(WRITTEN_FOR):
        yield
        return
    codegen = cpu_target.target_context.codegen()

    def set_environment(name: str, environment: Any) -> None:
        if codegen._engine.is_symbol_defined(name):
            type(codegen).set_env(codegen, name, environment)
        else:
            _Library.environments[name] = environment

    library = _PartByPart if part_by_part else _Library
    codegen._library_class, codegen.set_env = library, set_environment
    try:
        yield
    finally:
        del codegen._library_class, codegen.set_env  # the class has Numba's own
