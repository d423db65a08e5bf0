"""Long work on many images in equal parts: bounded memory, one compilation."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Array


def in_batches(
    call: Callable[..., Array | np.ndarray], batch: int, *arrays: Array | np.ndarray
) -> np.ndarray:
    """Applies a function to slices of arrays along their first axis and joins the results.

    All slices have one length: the last reaches back over images that are done already, because
    a shorter one would compile anew.

    Args:
        call: takes as many arrays as are given, [b, ...] each, and returns [b, ...].
        batch: length b of a slice; of arrays shorter than that, their length.
        arrays: [n, ...] each, n >= 1.
    """
    count = len(arrays[0])
    batch = min(batch, count)
    results: list[np.ndarray] = []
    for start in range(0, count, batch):
        first = min(start, count - batch)
        part = call(*(array[first : first + batch] for array in arrays))
        results.append(np.asarray(part)[start - first :])
    return np.concatenate(results)
