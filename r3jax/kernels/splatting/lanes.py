"""Vectors of 16 floats in Numba: one row of a tile each.

LLVM's loop vectorizer gives up on the masked, aliased loops of compositing, so the kernels say
what a vector is. LLVM splits 16 lanes into what the machine has (AVX-512, AVX2, NEON, SSE).
Operators work lane by lane and take scalars as well; nothing is reassociated.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# Code generators get what llvmlite makes, which has no types.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import operator

from llvmlite import ir
from numba import types
from numba.extending import models, overload, register_model

from r3jax.kernels.native.compiled import inlined, intrinsic

WIDTH = 16
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, WIDTH)
_INTEGERS = ir.VectorType(ir.IntType(32), WIDTH)


class Lanes(types.Type):
    """Numba type of 16 floats."""

    def __init__(self):
        super().__init__(name="Lanes")


LANES = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _VECTOR)


def _constant(value):
    return ir.Constant(_VECTOR, [float(value)] * WIDTH)


def _vector(context, builder, value, ty):
    """Returns a vector as it is, and a scalar in every lane."""
    if isinstance(ty, Lanes):
        return value
    scalar = context.cast(builder, value, ty, types.float32)
    first = builder.insert_element(
        ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0)
    )
    return builder.shuffle_vector(
        first, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTEGERS, [0] * WIDTH)
    )


def _code(emit):
    """Makes the code generator of a function of vectors or scalars whose result is a vector."""

    def codegen(context, builder, sig, args):
        vectors = [_vector(context, builder, a, t) for a, t in zip(args, sig.args, strict=True)]
        return emit(builder, *vectors)

    return codegen


def _call(builder, name, *vectors):
    """Calls an LLVM intrinsic that works lane by lane."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(vectors))
    full = f"llvm.{name}.v{WIDTH}f32"
    function = builder.module.globals.get(full) or ir.Function(builder.module, kind, full)
    return builder.call(function, vectors)


def _unary(emit):
    @intrinsic
    def operation(typingctx, a):
        return LANES(a), _code(emit)

    return operation


def _binary(emit):
    @intrinsic
    def operation(typingctx, a, b):
        return LANES(a, b), _code(emit)

    return operation


def _ternary(emit):
    @intrinsic
    def operation(typingctx, a, b, c):
        return LANES(a, b, c), _code(emit)

    return operation


def _keep(comparison):
    def emit(builder, x, a, b):
        return builder.select(builder.fcmp_ordered(comparison, a, b), x, _constant(0.0))

    return emit


def _pick(comparison):
    def emit(builder, a, b):
        return builder.select(builder.fcmp_ordered(comparison, a, b), a, b)

    return emit


_add = _binary(lambda builder, a, b: builder.fadd(a, b))
_sub = _binary(lambda builder, a, b: builder.fsub(a, b))
_mul = _binary(lambda builder, a, b: builder.fmul(a, b))
quotient = _binary(lambda builder, a, b: builder.fdiv(a, b, flags=("arcp",)))
fma = _ternary(lambda builder, a, b, c: _call(builder, "fmuladd", a, b, c))
"""a b + c, in one instruction where the machine has it."""
root = _unary(lambda builder, a: _call(builder, "sqrt", a))
"""Square root."""
keep_gt = _ternary(_keep(">"))
"""x where a > b, else 0: also where one of them is NaN."""
keep_ge = _ternary(_keep(">="))
"""x where a >= b, else 0: also where one of them is NaN."""
larger = _binary(_pick(">"))
"""The larger of the two; b where a is NaN."""
smaller = _binary(_pick("<"))
"""The smaller of the two; b where a is NaN."""


def _overload_operator(function, implementation):
    @overload(function)
    def operation(a, b):
        if isinstance(a, Lanes) or isinstance(b, Lanes):
            return lambda a, b: implementation(a, b)
        return None


_overload_operator(operator.add, _add)
_overload_operator(operator.sub, _sub)
_overload_operator(operator.mul, _mul)


@intrinsic
def splat(typingctx, value):
    """Puts a scalar in every lane."""
    return LANES(value), _code(lambda builder, a: a)


@intrinsic
def lane_numbers(typingctx):
    """Returns 0, 1, ..., 15."""
    numbers = ir.Constant(_VECTOR, [float(i) for i in range(WIDTH)])
    return LANES(), lambda context, builder, sig, args: numbers


def _address(context, builder, sig, args, element):
    array = context.make_array(sig.args[0])(context, builder, args[0])
    pointer = builder.gep(array.data, [args[1]])
    return builder.bitcast(pointer, element.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Loads 16 floats of a flat float32 array from `index` on."""

    def codegen(context, builder, sig, args):
        return builder.load(_address(context, builder, sig, args, _VECTOR), align=4)

    return LANES(array, types.int64), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Writes 16 floats to a flat float32 array from `index` on."""

    def codegen(context, builder, sig, args):
        builder.store(args[2], _address(context, builder, sig, args, _VECTOR), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, value), codegen


@intrinsic
def store12(typingctx, array, index, value):
    """Writes the first 12 lanes to a flat float32 array from `index` on."""

    def codegen(context, builder, sig, args):
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        for start, count in ((0, 8), (8, 4)):
            order = ir.Constant(
                ir.VectorType(ir.IntType(32), count), [start + i for i in range(count)]
            )
            part = builder.shuffle_vector(args[2], undefined, order)
            index = builder.add(args[1], ir.Constant(args[1].type, start))
            kind = ir.VectorType(_FLOAT, count)
            pointer = _address(context, builder, sig, [args[0], index], kind)
            builder.store(part, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, value), codegen


@intrinsic
def any_above(typingctx, vector, threshold):
    """Checks whether any lane is above a scalar."""

    def codegen(context, builder, sig, args):
        level = _vector(context, builder, args[1], sig.args[1])
        mask = builder.fcmp_ordered(">", args[0], level)
        bits = builder.bitcast(mask, ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(vector, threshold), codegen


def _fold(group):
    """Adds the halves of every group of lanes of a and b; a's groups come first."""
    first = [g * 2 * group + i for g in range(WIDTH // group) for i in range(group)]
    second = [i + group for i in first]

    def emit(builder, a, b):
        halves = [
            builder.shuffle_vector(a, b, ir.Constant(_INTEGERS, order)) for order in (first, second)
        ]
        return builder.fadd(*halves)

    return emit


_fold8, _fold4, _fold2, _fold1 = (_binary(_fold(group)) for group in (8, 4, 2, 1))


@inlined
def sums_of_10(a, b, c, d, e, f, g, h, i, j):
    """Sums each of ten vectors over its lanes: lane k of the result is the sum of vector k.

    A tree of 11 additions for all of them together, in one fixed order.
    """
    abcd = _fold4(_fold8(a, b), _fold8(c, d))
    efgh = _fold4(_fold8(e, f), _fold8(g, h))
    ij = _fold8(i, j)
    ijij = _fold2(_fold4(ij, ij), _fold4(ij, ij))
    return _fold1(_fold2(abcd, efgh), ijij)


@intrinsic
def _times_power_of_two(typingctx, value, shifted):
    """Computes value 2^n, where n is in the low bits of the float `shifted`."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[1], _INTEGERS)
        exponent = builder.shl(bits, ir.Constant(_INTEGERS, [23] * WIDTH))
        total = builder.add(builder.bitcast(args[0], _INTEGERS), exponent)
        return builder.bitcast(total, _VECTOR)

    return LANES(value, shifted), codegen


_ROUND = 12582912.0  # 1.5 * 2^23: adding it leaves the rounded integer in the low bits


@inlined
def exp2(power):
    """Computes 2^power to 1e-7, for powers of at least -126.

    2^n p(f) with n the nearest integer and p of degree 5, the best on [-1/2, 1/2] (fitted by
    Lawson's reweighted least squares).
    """
    shifted = power + _ROUND
    f = power - (shifted - _ROUND)
    p = fma(f, 1.3276472454890609e-3, 9.675541892647743e-3)
    p = fma(p, f, 5.550713092088699e-2)
    p = fma(p, f, 2.4022120237350464e-1)
    p = fma(p, f, 6.931469440460205e-1)
    p = fma(p, f, 1.0000001192092896)
    return _times_power_of_two(p, shifted)
