"""What is compiled in one piece computes what it computes otherwise, and can be called from all."""

import numba
import numpy as np
import pytest
from numba import cfunc, njit, types

from r3jax.kernels.native import one_piece
from r3jax.kernels.native.compiled import kernel
from r3jax.kernels.native.one_piece import WRITTEN_FOR, in_one_piece

pytestmark = pytest.mark.skipif(
    not numba.__version__.startswith(WRITTEN_FOR),
    reason="another Numba compiles its own way",
)

INTEGER = types.int64(types.int64)


@pytest.fixture(params=[0, one_piece.LARGE], ids=["all stand apart", "small ones are taken in"])
def _sizes(request, monkeypatch):
    monkeypatch.setattr(one_piece, "LARGE", request.param)


@pytest.mark.usefixtures("_sizes")
def test_a_chain_of_kernels_gives_what_python_gives():
    @kernel
    def leaf(x):
        if x > 5:
            raise ValueError("too large")
        return x * x

    @kernel
    def middle(x):
        return leaf(x) + leaf(x + 1)

    def handler(x):
        return middle(x) + np.array([x, 1]).sum()

    with in_one_piece():
        compiled = cfunc(INTEGER)(handler)
    assert [compiled.ctypes(x) for x in range(3)] == [1 + 1, 5 + 2, 13 + 3]
    (overload,) = leaf.overloads.values()
    assert not overload.library._is_native  # nobody asked for its address


@pytest.mark.usefixtures("_sizes")
def test_what_was_compiled_in_between_can_be_called_from_python_and_others():
    @njit
    def shared(x):
        return x + 1

    def handler(x):
        return 2 * shared(x)

    with in_one_piece():
        compiled = cfunc(INTEGER)(handler)

    @njit
    def later(x):
        return 3 * shared(x)

    assert compiled.ctypes(4) == 10
    assert shared(4) == 5
    assert later(4) == 15


def test_afterwards_numba_compiles_as_always():
    with in_one_piece():
        pass

    @njit
    def alone(x):
        return x - 1

    assert alone(3) == 2
    (overload,) = alone.overloads.values()
    assert not hasattr(overload.library, "_is_native")


def test_another_numba_compiles_its_own_way(monkeypatch):
    monkeypatch.setattr(numba, "__version__", "0.99.0")

    def handler(x):
        return x + 2

    with in_one_piece():
        compiled = cfunc(INTEGER)(handler)
    assert compiled.ctypes(1) == 3
    assert not hasattr(compiled._library, "_is_native")
