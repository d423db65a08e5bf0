"""The passes as XLA custom calls."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels.mapping.add import add_pass
from r3jax.kernels.mapping.look import look_pass, mark_pass
from r3jax.kernels.native.ffi import (
    ARGUMENTS,
    RESULTS,
    answers_metadata,
    bytes1,
    floats1,
    floats2,
    floats3,
    ints1,
    ints2,
    register_handlers,
    words2,
)

ADD, LOOK, MARK = "r3jax_mapping_add", "r3jax_mapping_look", "r3jax_mapping_mark"


def _add(frame):
    """Arguments: table (6), camera, depth, colors, numbers, tables of bins (2), workers.

    Results: the table, in the place of the arguments, and how many voxels found no row.
    """
    if answers_metadata(frame):
        return 0
    add_pass(
        (
            words2(frame, RESULTS, 0), words2(frame, RESULTS, 1), floats1(frame, RESULTS, 2),
            floats2(frame, RESULTS, 3), floats1(frame, RESULTS, 4), floats1(frame, RESULTS, 5),
        ),
        floats1(frame, ARGUMENTS, 6),
        floats2(frame, ARGUMENTS, 7),
        floats3(frame, ARGUMENTS, 8),
        floats1(frame, ARGUMENTS, 9),
        ints2(frame, ARGUMENTS, 10),
        floats2(frame, ARGUMENTS, 11),
        np.int64(ints1(frame, ARGUMENTS, 12)[0]),
        ints1(frame, RESULTS, 6),
    )  # fmt: skip
    return 0


def _look(frame):
    """Arguments: key, numbers, depth, workers. Results: codes, and if there are holes."""
    if answers_metadata(frame):
        return 0
    look_pass(
        words2(frame, ARGUMENTS, 0),
        floats1(frame, ARGUMENTS, 1),
        floats2(frame, ARGUMENTS, 2),
        np.int64(ints1(frame, ARGUMENTS, 3)[0]),
        bytes1(frame, RESULTS, 0),
        ints1(frame, RESULTS, 1),
    )
    return 0


def _mark(frame):
    """Arguments: visited, resolution, key, camera, codes, shown in holes, tables (2), workers.

    Results: visited and resolution, in the place of the arguments.
    """
    if answers_metadata(frame):
        return 0
    mark_pass(
        words2(frame, RESULTS, 0),
        floats1(frame, RESULTS, 1),
        words2(frame, ARGUMENTS, 2),
        floats1(frame, ARGUMENTS, 3),
        bytes1(frame, ARGUMENTS, 4),
        bytes1(frame, ARGUMENTS, 5),
        ints2(frame, ARGUMENTS, 6),
        floats2(frame, ARGUMENTS, 7),
        np.int64(ints1(frame, ARGUMENTS, 8)[0]),
    )
    return 0


_HANDLERS = {ADD: _add, LOOK: _look, MARK: _mark}


def register(name: str) -> None:
    """Compiles a handler (or takes it from the disk) and tells XLA of it, once."""
    register_handlers({name: _HANDLERS[name]})
