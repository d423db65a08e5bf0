"""Kernels for CPUs as plain Python, held to the formulas: nothing is compiled."""

import contextlib
import importlib.util
import sys
from collections.abc import Generator
from pathlib import Path
from types import ModuleType
from unittest import mock

import numpy as np

Modules = dict[str, ModuleType]
"""Loaded modules by the last part of their names."""


def load(chain: tuple[str, ...]) -> Modules:
    """Loads modules a second time, in this order, each of which sees the earlier ones."""
    loaded: Modules = {}
    with mock.patch.dict(sys.modules):
        for name in chain:
            spec = importlib.util.find_spec(name)
            if spec is None or spec.origin is None:
                raise LookupError(f"no source for module {name!r}")
            module = ModuleType(name)
            module.__file__ = spec.origin
            sys.modules[name] = loaded[name.rpartition(".")[2]] = module
            source = Path(spec.origin).read_text(encoding="utf-8")
            exec(compile(source, spec.origin, "exec"), module.__dict__)
    return loaded


@contextlib.contextmanager
def kernels_as_python() -> Generator[None]:
    """Modules of kernels that are loaded meanwhile stay Python."""
    doubles = _python_compiler(), _numpy_arithmetic(), _numpy_lanes()
    before = dict(sys.modules)
    sys.modules |= {double.__name__: double for double in doubles}
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        # Ours only: parts of Numba that were first imported meanwhile cannot be imported twice.
        for name in [name for name in sys.modules if name.startswith("r3jax.")]:
            del sys.modules[name]
        sys.modules |= {name: before[name] for name in before if name.startswith("r3jax.")}


def _python_compiler() -> ModuleType:
    """Stands for `compiled.py`: kernels stay Python, the counter needs no atomics."""
    module = ModuleType("r3jax.kernels.native.compiled")
    for name in ("kernel", "inlined", "inlined_fast", "inlined_fused", "parallel_kernel"):
        setattr(module, name, lambda function: function)

    def claim(counter):
        counter[0] += 1
        return int(counter[0]) - 1

    module.__dict__.update(
        claim=claim,
        in_wide_vectors=lambda: None,
        flush_denormals=lambda: None,
        prefetch=lambda array, index: None,
        intrinsic=lambda function: _plain_lowest_bit,
    )
    return module


def _plain_lowest_bit(word) -> int:
    return (int(word) & -int(word)).bit_length() - 1


def _numpy_arithmetic() -> ModuleType:
    """Stands for `arithmetic.py`."""
    single, module = np.float32, ModuleType("r3jax.kernels.native.arithmetic")
    bits_of = lambda value: single(value).view(np.uint32)
    # NaN becomes any number in machine code.
    biased = lambda index: int(np.nan_to_num(index)) + (1 << 20)
    module.__dict__.update(
        floor=lambda x: single(np.floor(x)),
        ceil_log2=lambda x: single(np.ceil(np.log2(x))),
        power_of_two=np.exp2,
        whole=np.int32,
        count_bits=lambda word: int(word).bit_count(),
        middle_of=lambda word, other: int(word) >> 21 | (int(other) & 1023) << 11,
        end_of=lambda word: int(word) >> 10,
        low_word=lambda x, y: np.uint32((biased(x) | biased(y) << 21) & 0xFFFFFFFF),
        high_word=lambda y, z: np.uint32(biased(y) >> 11 | biased(z) << 10),
        signed_of=lambda word: single((int(word) & (1 << 21) - 1) - (1 << 20)),
        bits_of=bits_of,
        float_of=lambda word: np.uint32(word).view(single),
        key_of=lambda distance, row: np.int64(int(bits_of(distance)) << 32 | int(row)),
        exp2=lambda power: np.exp2(max(power, single(-126.0))),
        log2=np.log2,
    )
    return module


def _numpy_lanes() -> ModuleType:
    """Stands for `lanes.py`: vectors of 16 floats are arrays."""
    single, module = np.float32, ModuleType("r3jax.kernels.splatting.lanes")

    def store(array, index, value, count=16):
        array[index : index + count] = value[:count]

    module.__dict__.update(
        load=lambda array, index: array[index : index + 16].copy(),
        store=store,
        store12=lambda array, index, value: store(array, index, value, 12),
        splat=lambda value: np.full(16, value, single),
        lane_numbers=lambda: np.arange(16, dtype=single),
        any_above=lambda vector, level: bool((vector > level).any()),
        fma=lambda a, b, c: single(1) * a * b + c,
        quotient=lambda a, b: a / b,
        root=np.sqrt,
        keep_gt=lambda x, a, b: np.where(a > b, x, single(0)),
        keep_ge=lambda x, a, b: np.where(a >= b, x, single(0)),
        larger=lambda a, b: np.where(a > b, a, b),
        smaller=lambda a, b: np.where(a < b, a, b),
        exp2=np.exp2,
        sums_of_10=lambda *v: np.array([x.sum() for x in v] + [0.0] * 6, single),
    )
    return module
