"""Lets a kernel use the arrays that it is given without counting references to them.

Numba counts who uses an array: each row that a loop takes out of one (`means[i]`) costs two calls,
which is more than what many kernels do with it. Who calls a kernel holds its arrays until it
returns, so there is nothing to count.
"""

# Numba's compiler has no types.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportUnknownParameterType=false

from typing import Any

from llvmlite import ir as llvm
from numba import types
from numba.core import ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.untyped_passes import IRProcessing
from numba.extending import intrinsic

_types: Any = types


@intrinsic
def borrowed(typingctx: Any, value: Any) -> Any:
    """Returns a view of each array in `value`, tuples included, without reference counting."""

    def without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
        if isinstance(kind, _types.BaseTuple):
            for i, inner in enumerate(kind):
                part = builder.extract_value(value, i)
                value = builder.insert_value(value, without_owner(context, builder, inner, part), i)
        elif isinstance(kind, _types.Array):
            array = context.make_array(kind)(context, builder, value=value)
            array.meminfo = llvm.Constant(array.meminfo.type, None)
            array.parent = llvm.Constant(array.parent.type, None)
            return array._getvalue()
        return value

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return without_owner(context, builder, sig.return_type, args[0])

    return value(value), codegen


@register_pass(mutates_CFG=False, analysis_only=False)
class _BorrowArguments(FunctionPass):
    """Begins a function with `x = borrowed(x)` for every argument."""

    _name = "borrow_arguments"

    def __init__(self) -> None:  # abstract in Numba's class
        super().__init__()

    def run_pass(self, state: Any) -> Any:
        blocks = state.func_ir.blocks
        first = blocks[min(blocks)]
        statements = list[Any]()
        for statement in first.body:
            is_argument = isinstance(statement, ir.Assign) and isinstance(statement.value, ir.Arg)
            statements += _borrow(statement, first.scope) if is_argument else [statement]
        first.body = statements
        return True


def _borrow(statement: Any, scope: Any) -> list[Any]:
    """Rewrites the assignment of an argument in three steps."""
    loc = statement.loc
    given, function = scope.redefine("$given", loc), scope.redefine("$borrowed", loc)
    return [
        ir.Assign(statement.value, given, loc),
        ir.Assign(ir.Global("borrowed", borrowed, loc), function, loc),
        ir.Assign(ir.Expr.call(function, [given], (), loc), statement.target, loc),
    ]


class Borrowing(CompilerBase):
    """Numba's own compiler with the pass above."""

    def define_pipelines(self) -> list[Any]:
        """Defines all passes, in order."""
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.add_pass_after(_BorrowArguments, IRProcessing)
        manager.finalize()
        return [manager]
