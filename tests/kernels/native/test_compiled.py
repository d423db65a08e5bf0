"""Kernels are compiled once for all constants, and those that Python calls in one piece."""

import concurrent.futures

import numba
import numpy as np
import pytest
from numba import njit

from r3jax.kernels.native.compiled import called_from_python, inlined, kernel
from r3jax.kernels.native.one_piece import WRITTEN_FOR


def test_a_kernel_is_compiled_once_for_all_constants():
    @inlined
    def at(values, index, power=1):
        return values[index] ** power

    @kernel
    def ends(values):
        return at(values, 0) + at(values, 1) + at(values, len(values) - 1) + at(values, 1, 2)

    @njit
    def called(values):
        return ends(values)

    assert called(np.array([3.0, 5.0, 7.0])) == 3 + 5 + 7 + 25
    assert len(at.overloads) == 2  # with its default, and without


def test_constants_of_other_kinds_keep_their_types():
    @kernel
    def kinds(whole, number, truth):
        return (whole // 2, number / 2, truth)

    @njit
    def called():
        return kinds(3, 3.0, True)

    assert called() == (1, 1.5, True)


@pytest.mark.skipif(
    not numba.__version__.startswith(WRITTEN_FOR), reason="another Numba compiles its own way"
)
def test_what_python_calls_is_compiled_in_one_piece_by_any_thread():
    def triple():
        @called_from_python()
        def function(x):
            return 3 * x

        return function

    functions = [triple() for _ in range(4)]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda function: function(2.0), functions)) == [6.0] * 4
    for function in functions:
        (overload,) = function.overloads.values()
        assert overload.library._is_native
        assert function(5.0) == 15.0

    first = functions[0]

    @called_from_python()
    def outer(x):
        return first(x) + 1

    @njit
    def alone(x):
        return outer(x) - 1

    assert outer(1) == 4
    assert alone(1) == 3
    (overload,) = alone.overloads.values()
    assert not hasattr(overload.library, "_is_native")


def test_a_kernel_counts_no_references_to_what_it_is_given():
    @inlined
    def length(row, room):
        part = room[:2]
        for k in range(2):
            part[k] = row[k] * row[k]
        return np.sqrt(part[0] + part[1])

    def lengths(pair, room, found):
        points, least = pair
        for i in range(found.shape[0]):
            row = found[i]
            if row[1] > 0.5 and length(points[i], room) > least:
                row[0] = length(points[i], room)

    as_kernel, as_function = kernel(lengths), njit(lengths)

    @njit
    def called(points, weights):
        given = points * 2.0  # owned by nobody but this function
        found, other = np.zeros((2, len(points), 2))
        found[:, 1], other[:, 1] = weights, weights
        as_kernel((given, 0.5), np.empty(9), found)
        as_function((given, 0.5), np.empty(9), other)
        return given, found, other

    points, weights = np.random.default_rng(0).random((2, 50, 2))
    given, found, other = called(points, weights[:, 0])
    np.testing.assert_array_equal(given, 2.0 * points)
    np.testing.assert_array_equal(found, other)
    assert 0 < np.count_nonzero(found[:, 0]) < 50
    counts = [
        sum(code.count("call void @NRT_decref") for code in function.inspect_llvm().values())
        for function in (as_kernel, as_function)
    ]
    assert counts[0] == 0 < counts[1]
