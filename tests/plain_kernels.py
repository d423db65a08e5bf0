"""Kernels for CPUs as plain Python, for tests that plant faults in them: nothing is compiled."""

import contextlib
import sys
from collections.abc import Generator
from types import ModuleType
from unittest import mock

import numpy as np


@contextlib.contextmanager
def kernels_as_python() -> Generator[None]:
    """Modules of kernels that are loaded meanwhile stay Python."""
    doubles = _python_compiler(), _numpy_arithmetic()
    with (
        mock.patch.dict(sys.modules, {double.__name__: double for double in doubles}),
        np.errstate(all="ignore"),
    ):
        yield


def _python_compiler() -> ModuleType:
    """Stands for `compiled.py`: kernels stay Python, the counter needs no atomics."""
    module = ModuleType("r3jax.native.compiled")
    for name in ("kernel", "inlined", "inlined_fused", "parallel_kernel"):
        setattr(module, name, lambda function: function)

    def claim(counter):
        counter[0] += 1
        return int(counter[0]) - 1

    module.__dict__.update(
        claim=claim, in_wide_vectors=lambda: None, intrinsic=lambda function: _plain_lowest_bit
    )
    return module


def _plain_lowest_bit(word) -> int:
    return (int(word) & -int(word)).bit_length() - 1


def _numpy_arithmetic() -> ModuleType:
    """Stands for `arithmetic.py`."""
    single, module = np.float32, ModuleType("r3jax.native.arithmetic")
    bits_of = lambda value: single(value).view(np.uint32)
    module.__dict__.update(
        floor=lambda x: single(np.floor(x)),
        ceil_log2=lambda x: single(np.ceil(np.log2(x))),
        power_of_two=np.exp2,
        whole=np.int32,
        count_bits=lambda word: int(word).bit_count(),
        middle_of=lambda word, other: int(word) >> 21 | (int(other) & 1023) << 11,
        end_of=lambda word: int(word) >> 10,
        signed_of=lambda word: single((int(word) & (1 << 21) - 1) - (1 << 20)),
        bits_of=bits_of,
        float_of=lambda word: np.uint32(word).view(single),
        key_of=lambda distance, row: np.int64(int(bits_of(distance)) << 32 | int(row)),
        exp2=lambda power: np.exp2(max(power, single(-126.0))),
        log2=np.log2,
    )
    return module
