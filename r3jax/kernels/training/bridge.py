"""The passes as XLA custom calls."""

# Kernels have the types that Numba infers where they are called; annotations it would not read.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import numpy as np

from r3jax.kernels.native.compiled import inlined
from r3jax.kernels.native.ffi import (
    ARGUMENTS,
    RESULTS,
    answers_metadata,
    floats1,
    floats2,
    floats_flat,
    ints1,
    register_handlers,
)
from r3jax.kernels.training.adam import adam_pass
from r3jax.kernels.training.image_loss import loss_pass

LOSS, ADAM = "r3jax_training_loss", "r3jax_training_adam"


def _loss(frame):
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
def _arrays(frame, kind, first):
    """Returns the five arrays of a scene, each flat."""
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
        _arrays(frame, RESULTS, 0), _arrays(frame, ARGUMENTS, 15),
        _arrays(frame, RESULTS, 5), _arrays(frame, RESULTS, 10),
        floats1(frame, ARGUMENTS, 20), floats1(frame, ARGUMENTS, 21), ints1(frame, ARGUMENTS, 22),
        ints1(frame, RESULTS, 15),
    )  # fmt: skip
    return 0


_HANDLERS = {LOSS: _loss, ADAM: _adam}


def register(name: str) -> None:
    """Compiles a handler (or takes it from the disk) and tells XLA of it, once."""
    register_handlers({name: _HANDLERS[name]})
