"""Compiles a kernel and all that it calls once, into one piece of machine code.

Left to itself Numba optimizes every function, makes machine code of it and links it into its
callers, which are optimized together with it once more: what stands at the end of a chain of six
calls is compiled six times. The functions of a kernel are called by each other only. Here each is
optimized once, together with the small ones that it calls. Large ones stand apart, and are joined
to what calls them when the address of the whole is needed.
"""

# Numba's compiler has no types, and its private parts may change with its version.
# pyright: reportPrivateUsage=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false

import contextlib
import itertools
from collections.abc import Generator
from typing import Any, ClassVar

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

WRITTEN_FOR = "0.68."
"""Versions of Numba whose compiler this relies on; others compile as they always do, slower."""

LARGE = 400
"""A function of more instructions, before it is optimized, stands apart from its callers."""


class _Library(JITCodeLibrary):
    """Code of a function, which becomes machine code when an address in it is needed."""

    _is_native = _is_apart = False
    environments: ClassVar[dict[str, Any]] = {}
    """Numba's data of functions that have no address yet, by the names of their places."""

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._apart: dict[_Library, None] = {}  # what it calls, after what that calls

    def finalize(self) -> None:
        """Takes in the small functions that it calls, and is optimized together with them."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._apart.update(getattr(library, "_apart", {}))
            if getattr(library, "_is_apart", False):
                self._apart[library] = None
            else:
                self._take_in(library)
        self._is_apart = _is_large(self._final_module)
        self._optimize_final_module()
        self._finalize_dynamic_globals()
        self._finalized = True

    def _take_in(self, library: JITCodeLibrary) -> None:
        module = JITCodeLibrary._get_module_for_linking(library)
        self._final_module.link_in(module, preserve=True)

    def _get_module_for_linking(self) -> Any:
        """Links a function with all that it calls, for what Numba compiles in its own way."""
        module = super()._get_module_for_linking().clone()
        # Callers first: LLVM leaves out functions that have no caller yet.
        for library in reversed(self._apart):
            module.link_in(JITCodeLibrary._get_module_for_linking(library), preserve=True)
        return module

    def get_pointer_to_function(self, name: str) -> int:
        """Returns the address of a function; 0 if it is not defined here, as is usual."""
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
        JITCodeLibrary._get_module_for_linking(self)  # callers take in what stands here now
        for library in reversed(self._apart):
            self._take_in(library)
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


def _is_large(module: Any) -> bool:
    """Checks whether a function is large, other than those that callers always take in."""
    return any(
        _is_long(function)
        for function in module.functions
        if not function.is_declaration
        and not any(b"alwaysinline" in kept for kept in function.attributes)
    )


def _is_long(function: Any) -> bool:
    """Checks whether a function has more than `LARGE` instructions; no more are counted."""
    instructions = (one for block in function.blocks for one in block.instructions)
    return next(itertools.islice(instructions, LARGE, None), None) is not None


@contextlib.contextmanager
def in_one_piece() -> Generator[None]:
    """Compiles kernels inside of the block into machine code once, as a whole; calls stay the same.

    Other threads compile before or after. It may be entered again inside: kernels compile kernels.
    """
    codegen = cpu_target.target_context.codegen()
    with global_compiler_lock, contextlib.ExitStack() as changes:
        if numba.__version__.startswith(WRITTEN_FOR) and codegen._library_class is not _Library:
            changes.enter_context(_whole_libraries(codegen))
        yield


@contextlib.contextmanager
def _whole_libraries(codegen: Any) -> Generator[None]:
    """Lets Numba's code generator make libraries of the class above."""

    def set_environment(name: str, environment: Any) -> None:
        if codegen._engine.is_symbol_defined(name):
            type(codegen).set_env(codegen, name, environment)
        else:
            _Library.environments[name] = environment

    codegen._library_class, codegen.set_env = _Library, set_environment
    try:
        yield
    finally:
        del codegen._library_class, codegen.set_env  # the class has Numba's own
