"""The passes as XLA custom calls."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels.native.compiled import inlined
from r3jax.kernels.native.ffi import (
    ARGUMENTS,
    RESULTS,
    answers_metadata,
    bytes1,
    bytes2,
    floats1,
    floats2,
    ints1,
    ints2,
    register_handlers,
    words2,
)
from r3jax.kernels.scoring.changes import changes_pass
from r3jax.kernels.scoring.pixels import pixels_pass
from r3jax.kernels.scoring.rows import rows_pass
from r3jax.kernels.scoring.sums import sums_of_few, sums_of_many

SUMS, SUMS_OF_FEW = "r3jax_scoring_sums", "r3jax_scoring_sums_of_few"
PIXELS = "r3jax_scoring_pixels"
ROWS, CHANGES = "r3jax_scoring_rows", "r3jax_scoring_changes"


@inlined
def _state(frame):
    """Key, visited, count, m2, resolution and voxel size of the map: the first six arguments."""
    return (
        words2(frame, ARGUMENTS, 0), words2(frame, ARGUMENTS, 1), floats1(frame, ARGUMENTS, 2),
        floats1(frame, ARGUMENTS, 3), floats1(frame, ARGUMENTS, 4),
        floats1(frame, ARGUMENTS, 5)[0],
    )  # fmt: skip


@inlined
def _arguments_of_sums(frame):
    """State (6), views, options, directions, table, lattice, cells (4), and the results.

    Options: wraps, height, width, whether kappa is 1, whether delta is that of pairs, one of how
    many voxels is scored, workers. Results: sums of 1 - R, numbers of unexplored cells, bits of
    rows and of cells seen.
    """
    options = ints1(frame, ARGUMENTS, 7)
    return (
        _state(frame),
        (
            floats1(frame, ARGUMENTS, 11), floats1(frame, ARGUMENTS, 12),
            floats1(frame, ARGUMENTS, 13), bytes1(frame, ARGUMENTS, 14),
        ),
        floats2(frame, ARGUMENTS, 6),
        (options[0] != 0, (np.int64(options[1]), np.int64(options[2]))),
        (options[3] != 0, options[4] != 0, np.int64(options[5])),
        (floats2(frame, ARGUMENTS, 8), ints2(frame, ARGUMENTS, 9), floats2(frame, ARGUMENTS, 10)),
        np.int64(options[6]),
        (
            floats2(frame, RESULTS, 0), floats2(frame, RESULTS, 1),
            bytes2(frame, RESULTS, 2), bytes2(frame, RESULTS, 3),
        ),
    )  # fmt: skip


def _sums(frame):
    if not answers_metadata(frame):
        sums_of_many(*_arguments_of_sums(frame))
    return 0


def _sums_of_few(frame):
    if not answers_metadata(frame):
        sums_of_few(*_arguments_of_sums(frame))
    return 0


def _pixels(frame):
    """Arguments: state (6), views, options as in `_arguments_of_sums`, directions.

    Results: means of R, rows of the map in the pixels.
    """
    if answers_metadata(frame):
        return 0
    options = ints1(frame, ARGUMENTS, 7)
    pixels_pass(
        _state(frame),
        floats2(frame, ARGUMENTS, 6),
        (options[0] != 0, (np.int64(options[1]), np.int64(options[2]))),
        (options[3] != 0, options[4] != 0),
        floats2(frame, ARGUMENTS, 8),
        np.int64(options[6]),
        (floats1(frame, RESULTS, 0), ints2(frame, RESULTS, 1)),
    )  # fmt: skip
    return 0


def _rows(frame):
    """Arguments: state (6), points, options, directions.

    Options: whether kappa is 1, whether delta is that of pairs, workers. Results: terms of rows.
    """
    if answers_metadata(frame):
        return 0
    options = ints1(frame, ARGUMENTS, 7)
    rows_pass(
        _state(frame),
        floats2(frame, ARGUMENTS, 6),
        (options[0] != 0, options[1] != 0),
        floats2(frame, ARGUMENTS, 8),
        np.int64(options[2]),
        (
            floats2(frame, RESULTS, 0), floats2(frame, RESULTS, 1), floats2(frame, RESULTS, 2),
            floats2(frame, RESULTS, 3), floats2(frame, RESULTS, 4), floats2(frame, RESULTS, 5),
        ),
    )  # fmt: skip
    return 0


def _changes(frame):
    """Arguments: state (6), the same later (4), cells (4), bits (2), points, options, tables (3).

    Of the later state: visited, count, m2, resolution. Options: whether kappa is 1, whether delta
    is that of pairs. Results: changes of the sums of 1 - R, numbers of cells explored.
    """
    if answers_metadata(frame):
        return 0
    before, options = _state(frame), ints1(frame, ARGUMENTS, 17)
    changes_pass(
        before,
        (
            before[0], words2(frame, ARGUMENTS, 6), floats1(frame, ARGUMENTS, 7),
            floats1(frame, ARGUMENTS, 8), floats1(frame, ARGUMENTS, 9), before[5],
        ),
        (
            floats1(frame, ARGUMENTS, 10), floats1(frame, ARGUMENTS, 11),
            floats1(frame, ARGUMENTS, 12), bytes1(frame, ARGUMENTS, 13),
        ),
        (bytes2(frame, ARGUMENTS, 14), bytes2(frame, ARGUMENTS, 15)),
        floats2(frame, ARGUMENTS, 16),
        (options[0] != 0, options[1] != 0),
        (floats2(frame, ARGUMENTS, 18), ints2(frame, ARGUMENTS, 19), floats2(frame, ARGUMENTS, 20)),
        (floats2(frame, RESULTS, 0), floats2(frame, RESULTS, 1)),
    )  # fmt: skip
    return 0


_HANDLERS = {
    SUMS: _sums, SUMS_OF_FEW: _sums_of_few, PIXELS: _pixels, ROWS: _rows, CHANGES: _changes,
}  # fmt: skip


def register(name: str) -> None:
    """Compiles a handler (or takes it from the disk) and tells XLA of it, once."""
    register_handlers({name: _HANDLERS[name]})
