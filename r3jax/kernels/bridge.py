"""The kernels as XLA's custom calls, which read their arguments and run a kernel."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

from typing import Any

import numpy as np

from r3jax.kernels.adam import adam_pass
from r3jax.kernels.calls import Cells, FrameArrays, Layout, MapRows, Views
from r3jax.kernels.image_loss import loss_pass
from r3jax.kernels.mapping.add import map_add
from r3jax.kernels.mapping.cells import grid_depth
from r3jax.kernels.mapping.mark import map_look
from r3jax.kernels.native.compiled import inlined
from r3jax.kernels.native.ffi import (
    ARGUMENTS,
    RESULTS,
    answers_metadata,
    bytes1,
    bytes2,
    float0,
    floats1,
    floats2,
    floats3,
    floats_flat,
    ints1,
    ints2,
    register_handlers,
    words2,
)
from r3jax.kernels.scoring.changes import changes
from r3jax.kernels.scoring.pixels import pixels
from r3jax.kernels.scoring.sums import Sums, Tables, sums
from r3jax.kernels.scoring.terms import Choices
from r3jax.kernels.splatting.passes import backward_pass, forward_pass
from r3jax.kernels.splatting.squares import squares_pass, tallies_pass

# Indices of arguments are literals, so that LLVM can inline all of this.


@inlined
def _map(frame, first):
    return MapRows(
        words2(frame, ARGUMENTS, first), words2(frame, ARGUMENTS, first + 1),
        floats1(frame, ARGUMENTS, first + 2), floats1(frame, ARGUMENTS, first + 3),
        floats1(frame, ARGUMENTS, first + 4), float0(frame, ARGUMENTS, first + 5),
    )  # fmt: skip


@inlined
def _cells(frame, first):
    return Cells(
        floats1(frame, ARGUMENTS, first), floats1(frame, ARGUMENTS, first + 1),
        floats1(frame, ARGUMENTS, first + 2), bytes1(frame, ARGUMENTS, first + 3),
    )  # fmt: skip


@inlined
def _views(frame, first):
    return Views(
        floats2(frame, ARGUMENTS, first), floats2(frame, ARGUMENTS, first + 1),
        floats1(frame, ARGUMENTS, first + 2), floats1(frame, ARGUMENTS, first + 3),
        floats1(frame, ARGUMENTS, first + 4), floats1(frame, ARGUMENTS, first + 5),
        floats1(frame, ARGUMENTS, first + 6), floats1(frame, ARGUMENTS, first + 7),
        floats1(frame, ARGUMENTS, first + 8), floats1(frame, ARGUMENTS, first + 9),
    )  # fmt: skip


@inlined
def _image(frame, first):
    return FrameArrays(
        floats2(frame, ARGUMENTS, first), floats3(frame, ARGUMENTS, first + 1),
        floats2(frame, ARGUMENTS, first + 2), floats2(frame, ARGUMENTS, first + 3),
        float0(frame, ARGUMENTS, first + 4), float0(frame, ARGUMENTS, first + 5),
        float0(frame, ARGUMENTS, first + 6), float0(frame, ARGUMENTS, first + 7),
        float0(frame, ARGUMENTS, first + 8), float0(frame, ARGUMENTS, first + 9),
        float0(frame, ARGUMENTS, first + 10),
    )  # fmt: skip


@inlined
def _tables(frame, first):
    """Views directions of a voxel's bins, then candidates and directions of the panorama's."""
    return Tables(
        floats2(frame, ARGUMENTS, first), ints2(frame, ARGUMENTS, first + 1),
        floats2(frame, ARGUMENTS, first + 2),
    )  # fmt: skip


@inlined
def _layout(options):
    height: Any = np.int64(options[1])
    width: Any = np.int64(options[2])
    return Layout(options[0] != 0, height, width)


def _map_add(frame):
    """Arguments: rows and mean (6), voxel size, frame (11), bins (2), workers."""
    if answers_metadata(frame):
        return 0
    map_add(
        MapRows(
            words2(frame, RESULTS, 0), words2(frame, RESULTS, 1), floats1(frame, RESULTS, 2),
            floats1(frame, RESULTS, 3), floats1(frame, RESULTS, 4), float0(frame, ARGUMENTS, 6),
        ),
        floats2(frame, RESULTS, 5),
        _image(frame, 7),
        ints2(frame, ARGUMENTS, 18),
        floats2(frame, ARGUMENTS, 19),
        np.int64(ints1(frame, ARGUMENTS, 20)[0]),
        ints1(frame, RESULTS, 6),
    )  # fmt: skip
    return 0


def _map_look(frame):
    """Arguments: rows, mean, misses (7), voxel size, frame (11), visible, bins (2), workers."""
    if answers_metadata(frame):
        return 0
    map_look(
        MapRows(
            words2(frame, RESULTS, 0), words2(frame, RESULTS, 1), floats1(frame, RESULTS, 2),
            floats1(frame, RESULTS, 3), floats1(frame, RESULTS, 4), float0(frame, ARGUMENTS, 7),
        ),
        floats2(frame, RESULTS, 5),
        bytes1(frame, RESULTS, 6),
        _image(frame, 8),
        bytes1(frame, ARGUMENTS, 19),
        ints2(frame, ARGUMENTS, 20),
        floats2(frame, ARGUMENTS, 21),
        np.int64(ints1(frame, ARGUMENTS, 22)[0]),
    )  # fmt: skip
    return 0


def _grid_depth(frame):
    """Arguments: log-odds, origin, cell size, frame (11)."""
    if answers_metadata(frame):
        return 0
    grid_depth(
        floats3(frame, RESULTS, 0),
        floats1(frame, ARGUMENTS, 1),
        float0(frame, ARGUMENTS, 2),
        _image(frame, 3),
    )
    return 0


def _sums(frame):
    """Arguments: map (6), cells (4), views (10), options, tables (3)."""
    if answers_metadata(frame):
        return 0
    options = ints1(frame, ARGUMENTS, 20)
    sums(
        _map(frame, 0),
        _cells(frame, 6),
        _views(frame, 10),
        _layout(options),
        Choices(options[3] != 0, options[4] != 0),
        _tables(frame, 21),
        np.int64(options[5]),
        Sums(
            floats2(frame, RESULTS, 0), floats2(frame, RESULTS, 1),
            bytes2(frame, RESULTS, 2), bytes2(frame, RESULTS, 3),
        ),
    )  # fmt: skip
    return 0


def _pixels(frame):
    """Arguments: map (6), views (10), options, directions of a voxel's bins."""
    if answers_metadata(frame):
        return 0
    options = ints1(frame, ARGUMENTS, 16)
    pixels(
        _map(frame, 0),
        _views(frame, 6),
        _layout(options),
        Choices(options[3] != 0, options[4] != 0),
        floats2(frame, ARGUMENTS, 17),
        np.int64(options[5]),
        floats1(frame, RESULTS, 0),
        ints2(frame, RESULTS, 1),
    )
    return 0


def _changes(frame):
    """Arguments: map twice (12), cells (4), bits (2), positions, focals, options, tables (3)."""
    if answers_metadata(frame):
        return 0
    options = ints1(frame, ARGUMENTS, 20)
    changes(
        _map(frame, 0),
        _map(frame, 6),
        _cells(frame, 12),
        (bytes2(frame, ARGUMENTS, 16), bytes2(frame, ARGUMENTS, 17)),
        floats2(frame, ARGUMENTS, 18),
        floats1(frame, ARGUMENTS, 19),
        Choices(options[0] != 0, options[1] != 0),
        _tables(frame, 21),
        (floats2(frame, RESULTS, 0), floats2(frame, RESULTS, 1)),
    )
    return 0


# Plain tuples below: loops of several threads take no named ones within others.


@inlined
def _cloud(frame, kind):
    """Views the first six arrays as `calls.Cloud`."""
    return (
        floats2(frame, kind, 0), floats2(frame, kind, 1), floats2(frame, kind, 2),
        floats1(frame, kind, 3), floats2(frame, kind, 4), floats2(frame, kind, 5),
    )  # fmt: skip


@inlined
def _images(frame, kind, first):
    """Views three arrays as `calls.Images`."""
    return (
        floats3(frame, kind, first), floats2(frame, kind, first + 1),
        floats2(frame, kind, first + 2),
    )  # fmt: skip


@inlined
def _lists(frame, kind, first):
    """Views the arrays of `calls.Drawn`, except for the records."""
    return (
        ints1(frame, kind, first), ints1(frame, kind, first + 1), bytes1(frame, kind, first + 2),
        ints1(frame, kind, first + 3), ints1(frame, kind, first + 4),
    )  # fmt: skip


def _composite(frame):
    """Arguments: cloud (6), view, workers. Results: images (3), totals, drawn (6)."""
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


def _composite_gradient(frame):
    """Arguments: those of `_composite`, images (3), drawn (6), gradients of the images (3).

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
    """Arguments: those of `_composite`, images (3), drawn (6), background. Results: squares (5)."""
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
    """Arguments: drawn (6), workers, value, counts, least. Result: the tallies."""
    if answers_metadata(frame):
        return 0
    tallies_pass(
        floats2(frame, ARGUMENTS, 0), _lists(frame, ARGUMENTS, 1),
        np.int64(ints1(frame, ARGUMENTS, 6)[0]),
        floats2(frame, ARGUMENTS, 7), floats2(frame, ARGUMENTS, 8), floats1(frame, ARGUMENTS, 9),
        floats2(frame, RESULTS, 0),
    )  # fmt: skip
    return 0


def _image_loss(frame):
    """Arguments: image, target, weight, workers. Results: loss and error, gradient."""
    if answers_metadata(frame):
        return 0
    loss_pass(
        floats2(frame, ARGUMENTS, 0),
        floats2(frame, ARGUMENTS, 1),
        floats1(frame, ARGUMENTS, 2)[0],
        np.int64(ints1(frame, ARGUMENTS, 3)[0]),
        floats1(frame, RESULTS, 0),
        floats2(frame, RESULTS, 1),
    )
    return 0


@inlined
def _scene(frame, kind, first):
    """Views the five arrays of a scene, each flat."""
    return (
        floats_flat(frame, kind, first), floats_flat(frame, kind, first + 1),
        floats_flat(frame, kind, first + 2), floats_flat(frame, kind, first + 3),
        floats_flat(frame, kind, first + 4),
    )  # fmt: skip


def _adam(frame):
    """Arguments: scene, both moments, gradient (5 each), rates, corrections, options.

    Results: scene and moments, in the place of the arguments, and if the step was done.
    """
    if answers_metadata(frame):
        return 0
    adam_pass(
        _scene(frame, RESULTS, 0), _scene(frame, ARGUMENTS, 15),
        _scene(frame, RESULTS, 5), _scene(frame, RESULTS, 10),
        floats1(frame, ARGUMENTS, 20), floats1(frame, ARGUMENTS, 21), ints1(frame, ARGUMENTS, 22),
        ints1(frame, RESULTS, 15),
    )  # fmt: skip
    return 0


# The slowest and first needed come first: with a spare core they are compiled in this order
# (`native.ahead`).
HANDLERS = {
    "sums": _sums,
    "map_add": _map_add,
    "map_look": _map_look,
    "grid_depth": _grid_depth,
    "pixels": _pixels,
    "changes": _changes,
    "composite": _composite,
    "composite_gradient": _composite_gradient,
    "image_loss": _image_loss,
    "adam": _adam,
    "squares": _squares,
    "tallies": _tallies,
}

RARE = ("squares", "tallies")
"""Kernels of other papers' policies, which are not compiled ahead."""


def register(name: str) -> str:
    """Compiles a kernel (or loads it) and registers it with XLA, once; returns its target."""
    target = f"r3jax_{name}"
    register_handlers({target: HANDLERS[name]})
    return target
