"""Arithmetic of single floats that LLVM turns into vectors: no calls, no branches, no int64.

Numba's own integers are 64 bits wide, which halves the vectors; what needs the bits of a float
is therefore written in LLVM's instructions.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# Code generators get what llvmlite makes, which has no types.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from llvmlite import ir
from numba import types

from r3jax.kernels.native.compiled import inlined_fused, intrinsic

_INT, _FLOAT = ir.IntType(32), ir.FloatType()


def _of_float(emit):
    """Makes a function of one float32 that gives a float32."""

    def typed(typingctx, value):
        def codegen(context, builder, sig, args):
            x = context.cast(builder, args[0], sig.args[0], types.float32)
            return emit(builder, x)

        return types.float32(value), codegen

    return intrinsic(typed)


def _bits(builder, x):
    return builder.bitcast(x, _INT)


def _int(value):
    return ir.Constant(_INT, value)


def _emit_floor(builder, x):
    kind = ir.FunctionType(_FLOAT, [_FLOAT])
    name = "llvm.floor.f32"
    function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
    return builder.call(function, [x])


def _emit_ceil_log2(builder, x):
    # One below the next power of two still has the lower exponent: rounds up but at powers.
    rounded = builder.ashr(builder.add(_bits(builder, x), _int((1 << 23) - 1)), _int(23))
    return builder.sitofp(builder.sub(rounded, _int(127)), _FLOAT)


def _emit_power_of_two(builder, x):
    exponent = builder.add(builder.fptosi(x, _INT), _int(127))
    return builder.bitcast(builder.shl(exponent, _int(23)), _FLOAT)


_SQRT_HALF = 0x3F3504F3  # bits of sqrt(1/2): mantissas then lie in [sqrt(1/2), sqrt(2))


def _exponent(builder, x):
    return builder.ashr(builder.sub(_bits(builder, x), _int(_SQRT_HALF)), _int(23))


def _emit_mantissa(builder, x):
    shifted = builder.shl(_exponent(builder, x), _int(23))
    return builder.bitcast(builder.sub(_bits(builder, x), shifted), _FLOAT)


def _emit_shift_exponent(builder, x):
    return builder.bitcast(builder.shl(_bits(builder, x), _int(23)), _FLOAT)


floor = _of_float(_emit_floor)
"""The largest whole number that is not larger."""

ceil_log2 = _of_float(_emit_ceil_log2)
"""The least whole n with x <= 2^n, for normal x > 0."""

power_of_two = _of_float(_emit_power_of_two)
"""2^n for whole n in -126 .. 127."""

_exponent_of = _of_float(lambda builder, x: builder.sitofp(_exponent(builder, x), _FLOAT))
_mantissa_of = _of_float(_emit_mantissa)
_low_bits_to_exponent = _of_float(_emit_shift_exponent)


@intrinsic
def whole(typingctx, value):
    """Converts a whole number in a float to int32; Numba's own conversion goes through int64."""

    def codegen(context, builder, sig, args):
        return builder.fptosi(args[0], _INT)

    return types.int32(types.float32), codegen


@intrinsic
def middle_of(typingctx, word, other):
    """Extracts the middle bits of two words.

    They are bits 21 to 31 of the first, then 0 to 9 of the second.
    """

    def codegen(context, builder, sig, args):
        low = builder.lshr(args[0], _int(21))
        return builder.or_(low, builder.shl(builder.and_(args[1], _int(1023)), _int(11)))

    return types.uint32(types.uint32, types.uint32), codegen


@intrinsic
def end_of(typingctx, word):
    """Extracts bits 10 to 30 of a word."""
    return types.uint32(types.uint32), lambda context, builder, sig, args: builder.lshr(
        args[0], _int(10)
    )


@intrinsic
def signed_of(typingctx, word):
    """Converts the lowest 21 bits of a word to a number from -2^20 on, in a float."""

    def codegen(context, builder, sig, args):
        bits = builder.and_(args[0], _int((1 << 21) - 1))
        return builder.sitofp(builder.sub(bits, _int(1 << 20)), _FLOAT)

    return types.float32(types.uint32), codegen


def _biased(builder, index):
    """Converts a whole number from -2^20 on, in a float, to 21 bits; inverse of `signed_of`."""
    return builder.add(builder.fptosi(index, _INT), _int(1 << 20))


@intrinsic
def low_word(typingctx, x, y):
    """Packs the low word of a key (`geometry.voxels.pack`) from whole numbers in floats."""

    def codegen(context, builder, sig, args):
        x, y = _biased(builder, args[0]), _biased(builder, args[1])
        return builder.or_(x, builder.shl(y, _int(21)))

    return types.uint32(types.float32, types.float32), codegen


@intrinsic
def high_word(typingctx, y, z):
    """Packs the high word of a key from whole numbers in floats."""

    def codegen(context, builder, sig, args):
        y, z = _biased(builder, args[0]), _biased(builder, args[1])
        return builder.or_(builder.lshr(y, _int(11)), builder.shl(z, _int(10)))

    return types.uint32(types.float32, types.float32), codegen


@intrinsic
def fused(typingctx, a, b, c):
    """Multiplies two floats and adds a third with one rounding, whatever LLVM fuses by itself."""

    def codegen(context, builder, sig, args):
        return builder.fma(*args)

    return types.float32(types.float32, types.float32, types.float32), codegen


@intrinsic
def count_bits(typingctx, word):
    """Counts the set bits of a word of 32."""

    def codegen(context, builder, sig, args):
        return builder.zext(builder.ctpop(args[0]), ir.IntType(64))

    return types.int64(types.uint32), codegen


@intrinsic
def bits_of(typingctx, value):
    """Returns the bits of a float, as a word of 32."""
    return types.uint32(types.float32), lambda context, builder, sig, args: _bits(builder, args[0])


@intrinsic
def float_of(typingctx, word):
    """Returns the float whose bits are a word of 32."""

    def codegen(context, builder, sig, args):
        return builder.bitcast(args[0], _FLOAT)

    return types.float32(types.uint32), codegen


@intrinsic
def _add_bits(typingctx, value, other):
    """Adds the bits of two floats, as integers, and returns the float with these bits."""

    def codegen(context, builder, sig, args):
        return builder.bitcast(
            builder.add(_bits(builder, args[0]), _bits(builder, args[1])), _FLOAT
        )

    return types.float32(types.float32, types.float32), codegen


@intrinsic
def key_of(typingctx, distance, row):
    """Packs an int64 that sorts by distance >= 0 first, then by row.

    The nearest item has the least key.
    """
    long = ir.IntType(64)

    def codegen(context, builder, sig, args):
        high = builder.shl(builder.zext(_bits(builder, args[0]), long), ir.Constant(long, 32))
        return builder.or_(high, builder.zext(args[1], long))

    return types.int64(types.float32, types.int32), codegen


_ROUND = np.float32(12582912.0)  # 1.5 * 2^23: adding it leaves the rounded integer in the low bits
_LOWEST = np.float32(-126.0)
_E0, _E1 = np.float32(1.0), np.float32(6.931469440460205e-1)  # 2^0 is exactly 1
_E2, _E3 = np.float32(2.4022120237350464e-1), np.float32(5.550713092088699e-2)
_E4, _E5 = np.float32(9.675541892647743e-3), np.float32(1.3276472454890609e-3)


@inlined_fused
def exp2(power):
    """Computes 2^power to 2e-7, and 2^-126 for all powers below.

    2^n p(f) with n the nearest integer and p of degree 5 (as in `kernels.splatting.lanes`).
    """
    x = power if power > _LOWEST else _LOWEST
    shifted = x + _ROUND
    f = x - (shifted - _ROUND)
    p = ((((_E5 * f + _E4) * f + _E3) * f + _E2) * f + _E1) * f + _E0
    return _add_bits(p, _low_bits_to_exponent(shifted))


_ONE = np.float32(1.0)
_L1, _L3 = np.float32(2.8853900817779268), np.float32(0.9617966939259756)
_L5, _L7 = np.float32(0.5770780163555854), np.float32(0.41219858311113244)


@inlined_fused
def log2(x):
    """Computes log2 x to 1e-6, for normal x > 0.

    The series of the inverse hyperbolic tangent: log m = 2 artanh((m - 1) / (m + 1)), with the
    mantissa m in [sqrt(1/2), sqrt(2)).
    """
    m = _mantissa_of(x)
    t = (m - _ONE) / (m + _ONE)
    s = t * t
    return _exponent_of(x) + t * (_L1 + s * (_L3 + s * (_L5 + s * _L7)))
