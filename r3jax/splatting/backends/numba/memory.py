"""Large fresh arrays in large pages: else the first write to 38 MB costs 10 000 page faults."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import sys

from numba import types

from r3jax.splatting.backends.numba.compiled import inlined

_ON_LINUX = sys.platform == "linux"
_MADV_HUGEPAGE = 14
_PAGE = 4096
_WORTH_IT = 1 << 22  # bytes

_madvise = types.ExternalFunction("madvise", types.int32(types.intp, types.uintp, types.int32))


@inlined
def expect_writes(array):
    """Asks Linux for huge pages below a large array that is about to be written as a whole.

    XLA and Numba allocate it anew for every call; only advice, so failure means nothing.
    """
    size = array.size * array.itemsize
    if _ON_LINUX and size >= _WORTH_IT:
        first = -(-array.ctypes.data // _PAGE) * _PAGE
        _madvise(first, (array.ctypes.data + size) // _PAGE * _PAGE - first, _MADV_HUGEPAGE)
