"""Scores candidates on several devices at once: each has the whole map and an equal share of them.

A share is a loop over its candidates. The partitioner of jit would run all of it on every device;
`shard_map` runs each share on its own device.

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
            return rows  # not copied: caches of a hundred panoramas take megabytes
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

    Each candidate's score is computed as on one device: the numbers are equal, except for the last
    bits if a share is a single candidate, whose loop XLA unrolls and fuses differently.

    Args:
        score: a module-level function of `known` and of any number of candidates, so that it
            compiles once; gives fields of shape [C, ...].
        known: the same for all candidates, copied to each device; other values than numbers and
            arrays, such as functions, are passed unchanged.
        candidates: the candidates.
        devices: of JAX, all of one kind.

    Returns:
        Fields of shape [P, ...], D shards along the first axis; rows from C on are padding.
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
    # The loops inside start from replicated constants and end in values that vary by device.
    spread = jax.shard_map(
        own, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
    )
    return spread(arrays, candidates)
