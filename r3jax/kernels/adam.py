"""Adam in machine code: `training.optimizer.adam_update`, every array read and written once.

All arrays are flat. What differs along them, the learning rate and whether a harmonic takes part
yet, repeats: a pattern of whole vectors says it.
"""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np
from numba import prange

from r3jax.kernels.constants import BETA1, BETA2, EPSILON
from r3jax.kernels.native.compiled import claim, flush_denormals, inlined, kernel, parallel_kernel
from r3jax.kernels.splatting.lanes import fma, load, quotient, root, splat, store

CHUNK = 1 << 16
"""Floats that one thread takes at a time."""

KINDS = 5
"""Arrays of a scene: means, quats, log scales, opacity logits, harmonics."""

_BETA1, _BETA2, _EPSILON = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON)
_REST1, _REST2 = np.float32(1.0 - BETA1), np.float32(1.0 - BETA2)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inlined
def _patterns(rates, num_harmonics, num_open):
    """Repeats the learning rates and shares of the gradient to [5, p].

    A run of p floats consists of whole vectors and of whole rows of harmonics.

    Args:
        rates: of the five arrays, and of the harmonics above the constant one [6].
        num_harmonics: floats in a row of harmonics.
        num_open: how many of them take part.
    """
    rate = np.empty((KINDS, 16 * num_harmonics), np.float32)
    share = np.ones((KINDS, 16 * num_harmonics), np.float32)
    for kind in range(KINDS):
        rate[kind] = rates[kind]
    for k in range(rate.shape[1]):
        harmonic = k % num_harmonics
        rate[KINDS - 1, k] = rates[KINDS - 1 if harmonic < 3 else KINDS]
        share[KINDS - 1, k] = _ONE if harmonic < num_open else _ZERO
    return rate, share


@inlined
def _step(k, at, x, g, m, v, rate, share, corrections):
    """Moves 16 numbers; `at` is their place in the pattern."""
    slope = load(g, k) * load(share, at)
    mean = fma(load(m, k), _BETA1, slope * _REST1)
    square = fma(load(v, k), _BETA2, slope * slope * _REST2)
    store(m, k, mean)
    store(v, k, square)
    size = root(square * corrections[1]) + _EPSILON
    store(x, k, load(x, k) - quotient(mean * corrections[0] * load(rate, at), size))


@kernel
def _steps(first, last, x, g, m, v, rate, share, corrections):
    """Copies a range of numbers; a partial vector is copied through a spare one."""
    period, at = rate.shape[0], first % rate.shape[0]
    whole = first + (last - first) // 16 * 16
    for k in range(first, whole, 16):
        _step(k, at, x, g, m, v, rate, share, corrections)
        at = at + 16 if at + 16 < period else 0
    rest = last - whole
    if rest > 0:
        spare = np.zeros((4, 16), np.float32)
        for k in range(rest):
            spare[0, k], spare[1, k] = x[whole + k], g[whole + k]
            spare[2, k], spare[3, k] = m[whole + k], v[whole + k]
        _step(0, at, spare[0], spare[1], spare[2], spare[3], rate, share, corrections)
        for k in range(rest):
            x[whole + k], m[whole + k], v[whole + k] = spare[0, k], spare[2, k], spare[3, k]


@kernel
def _squares(first, last, x, g):
    """Sums the squares of a range of numbers and their gradients.

    The sum is infinite if it overflows.
    """
    total, whole = splat(_ZERO), first + (last - first) // 16 * 16
    for k in range(first, whole, 16):
        a, b = load(x, k), load(g, k)
        total = fma(b, b, fma(a, a, total))
    lanes, rest = np.empty(16, np.float32), _ZERO
    store(lanes, 0, total)
    for lane in range(16):
        rest += lanes[lane]
    for k in range(whole, last):
        rest += x[k] * x[k] + g[k] * g[k]
    return rest


@inlined
def _chunk(number, arrays):
    """Finds the array and the range of the chunk of a number.

    The kind of a number after the last chunk is `KINDS`.
    """
    kind = 0
    while kind < KINDS:
        size = arrays[kind].shape[0]
        chunks = -(-size // CHUNK)
        if number < chunks:
            return kind, number * CHUNK, min((number + 1) * CHUNK, size)
        number -= chunks
        kind += 1
    return kind, 0, 0


@parallel_kernel
def adam_pass(scene, gradient, means, squares, rates, corrections, options, applied):
    """Takes one step, unless a number or its gradient is not finite, or the square of one is not.

    Args:
        scene: the five arrays, each flat; written.
        gradient: of each.
        means: moments of first order; written.
        squares: moments of second order; written.
        rates: of the five, and of the harmonics above the constant one [6].
        corrections: what each moment is multiplied by [2].
        options: floats in a row of harmonics, how many of them take part, whether a step is
            wanted at all, and threads to share the work [4].
        applied: written; 1 if the step was done.
    """
    workers = np.int64(options[3])
    next_chunk, good = np.zeros(2, np.int64), np.ones(workers, np.int64)
    for worker in prange(workers):
        flush_denormals()
        kind, first, last = _chunk(claim(next_chunk[:1]), scene)
        while kind < KINDS:
            if not np.isfinite(_squares(first, last, scene[kind], gradient[kind])):
                good[worker] = 0
            kind, first, last = _chunk(claim(next_chunk[:1]), scene)
    applied[0] = options[2] * good.min()
    if applied[0] == 0:
        return
    rate, share = _patterns(rates, options[0], options[1])
    for _ in prange(workers):
        kind, first, last = _chunk(claim(next_chunk[1:]), scene)
        while kind < KINDS:
            _steps(
                first, last, scene[kind], gradient[kind], means[kind], squares[kind],
                rate[kind], share[kind], corrections,
            )  # fmt: skip
            kind, first, last = _chunk(claim(next_chunk[1:]), scene)
