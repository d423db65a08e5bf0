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
    floats1,
    floats2,
    floats3,
    ints1,
    register_handlers,
)
from r3jax.kernels.splatting.passes import backward_pass, forward_pass
from r3jax.kernels.splatting.squares import squares_pass
from r3jax.kernels.splatting.tallies import tallies_pass

FORWARD, BACKWARD = "r3jax_splatting_forward", "r3jax_splatting_backward"
SQUARES, TALLIES = "r3jax_splatting_squares", "r3jax_splatting_tallies"


@inlined
def _cloud(frame, kind):
    """Returns means, quats, log_scales, logits, harmonics, offsets: the first six arrays."""
    return (
        floats2(frame, kind, 0), floats2(frame, kind, 1), floats2(frame, kind, 2),
        floats1(frame, kind, 3), floats2(frame, kind, 4), floats2(frame, kind, 5),
    )  # fmt: skip


@inlined
def _images(frame, kind, first):
    return (
        floats3(frame, kind, first), floats2(frame, kind, first + 1),
        floats2(frame, kind, first + 2),
    )  # fmt: skip


@inlined
def _lists(frame, kind, first):
    return (
        ints1(frame, kind, first), ints1(frame, kind, first + 1),
        bytes1(frame, kind, first + 2),
        ints1(frame, kind, first + 3), ints1(frame, kind, first + 4),
    )  # fmt: skip


def _forward(frame):
    """Arguments: cloud (6), view, workers. Results: images (3), totals, records, lists (5)."""
    if answers_metadata(frame):
        return 0
    totals = ints1(frame, RESULTS, 3)
    totals[0], totals[1] = 0, 1  # overflow, should the pass fail
    forward_pass(
        _cloud(frame, ARGUMENTS), floats1(frame, ARGUMENTS, 6),
        np.int64(ints1(frame, ARGUMENTS, 7)[0]),
        _images(frame, RESULTS, 0), totals, floats2(frame, RESULTS, 4),
        _lists(frame, RESULTS, 5),
    )  # fmt: skip
    return 0


def _backward(frame):
    """Arguments: forward's, its results but the totals, gradients of the images (3).

    Results: gradients by the cloud (6) and by the view.
    """
    if answers_metadata(frame):
        return 0
    backward_pass(
        _cloud(frame, ARGUMENTS), floats1(frame, ARGUMENTS, 6),
        np.int64(ints1(frame, ARGUMENTS, 7)[0]),
        _images(frame, ARGUMENTS, 8), floats2(frame, ARGUMENTS, 11),
        _lists(frame, ARGUMENTS, 12), _images(frame, ARGUMENTS, 17),
        _cloud(frame, RESULTS), floats1(frame, RESULTS, 6),
    )  # fmt: skip
    return 0


def _squares(frame):
    """Arguments: forward's, its results but the totals, the background's sum.

    Results: squares by means, quats, log_scales, logits, harmonics.
    """
    if answers_metadata(frame):
        return 0
    squares_pass(
        _cloud(frame, ARGUMENTS), floats1(frame, ARGUMENTS, 6),
        np.int64(ints1(frame, ARGUMENTS, 7)[0]),
        _images(frame, ARGUMENTS, 8), floats2(frame, ARGUMENTS, 11),
        _lists(frame, ARGUMENTS, 12), floats1(frame, ARGUMENTS, 17)[0],
        (
            floats2(frame, RESULTS, 0), floats2(frame, RESULTS, 1), floats2(frame, RESULTS, 2),
            floats1(frame, RESULTS, 3), floats2(frame, RESULTS, 4),
        ),
    )  # fmt: skip
    return 0


def _tallies(frame):
    """Arguments: records, lists (5), workers, value, counts, least. Result: the tallies."""
    if answers_metadata(frame):
        return 0
    tallies_pass(
        floats2(frame, ARGUMENTS, 0), _lists(frame, ARGUMENTS, 1),
        np.int64(ints1(frame, ARGUMENTS, 6)[0]),
        floats2(frame, ARGUMENTS, 7), floats2(frame, ARGUMENTS, 8), floats1(frame, ARGUMENTS, 9),
        floats2(frame, RESULTS, 0),
    )  # fmt: skip
    return 0


def register() -> None:
    """Compiles the handlers of rendering (or takes them from the disk) and tells XLA, once."""
    register_handlers({FORWARD: _forward, BACKWARD: _backward})


def register_per_gaussian() -> None:
    """Compiles the sums per Gaussian separately: rendering alone does not wait for them."""
    register()
    register_handlers({SQUARES: _squares, TALLIES: _tallies})
