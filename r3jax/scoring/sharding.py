"""Scores candidates on several devices at once: each has the whole map and an equal share of them.

The scores of a share are a loop over its candidates, which the partitioner of jit would run on
every device for all of them; `shard_map` runs each share where it lies.

Shape symbols: C candidates; D devices; P candidates padded to a multiple of D.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

_AXIS = "candidates"


Candidates = Any
"""An array with a row for each candidate, [C, ...], or a tree of such arrays."""


def padded_to(multiple: int, candidates: Candidates) -> Candidates:
    """Repeats the last candidate until their number is a multiple."""

    def pad(rows: Array) -> Array:
        missing = -rows.shape[0] % multiple
        if missing == 0:
            return rows  # not copied: the bits of a hundred panoramas are megabytes
        last = jnp.broadcast_to(rows[-1:], (missing, *rows.shape[1:]))
        return jnp.concatenate([rows, last])

    return jax.tree.map(pad, candidates)


def score_on_devices(
    score: Callable[..., Any],
    known: tuple[Any, ...],
    candidates: Candidates,
    devices: Sequence[Any],
) -> Any:
    """Computes `score(*known, candidates)` with the candidates spread over the devices.

    Each candidate's score is computed as on one device: the numbers are the same, but for last
    bits where a share is a single candidate, whose loop XLA unrolls and fuses otherwise.

    Args:
        score: a module-level function of `known` and of any number of candidates, so that it
            compiles once; gives fields of shape [C, ...].
        known: the same for all candidates, copied to each device; what is no number or array,
            such as a function, stays as it is.
        candidates: what to score.
        devices: of JAX, all of one kind.

    Returns:
        Fields of shape [P, ...], D shards along the first axis; what is behind C is padding.
    """
    mesh = Mesh(np.asarray(devices), (_AXIS,))
    apart = NamedSharding(mesh, PartitionSpec(_AXIS))
    everywhere = NamedSharding(mesh, PartitionSpec())
    # There may be a function among them (`score_pixels`), which no device can hold.
    numbers, others = eqx.partition(known, eqx.is_array_like)
    numbers = jax.device_put(numbers, everywhere)
    shares = jax.device_put(padded_to(len(devices), candidates), apart)
    return _score(score, mesh, eqx.combine(numbers, others), shares)


@eqx.filter_jit
def _score(
    score: Callable[..., Any],
    mesh: Mesh,
    known: tuple[Any, ...],
    candidates: Candidates,
) -> Any:
    arrays, others = eqx.partition(known, eqx.is_array)

    def own(arrays: Any, share: Any) -> Any:
        return score(*eqx.combine(arrays, others), share)

    split = PartitionSpec(_AXIS)
    # The loops inside start from constants, which are the same everywhere, and end in what is not.
    spread = jax.shard_map(
        own, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
    )
    return spread(arrays, candidates)
