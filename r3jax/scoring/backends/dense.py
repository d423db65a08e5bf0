"""Scores of many views as dense batches of the reference: for GPUs, and where Numba cannot serve.

Memory is bounded by the batch, not by the number of views.

Shape symbols: P views; B bins of the panorama.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from r3jax.mapping.state import MapState
from r3jax.scoring.backends import reference
from r3jax.scoring.backends.views import BufferLayout, view_of
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import Forms, ScoringConfig

_ELEMENTS = 1 << 26
"""Voxels times views at a time on a GPU; each takes some 60 bytes."""


def batch_size(num_voxels: int) -> int:
    """Views at a time."""
    return max(1, _ELEMENTS // num_voxels) if jax.default_backend() != "cpu" else 1


def _config(row: Float[Array, " 20"], forms: Forms) -> ScoringConfig:
    return ScoringConfig(max_range=row[16], tolerance=row[17], **forms._asdict())


def sums_in_views(
    voxels: MapState,
    cells: Cells,
    views: Float[Array, "P 20"],
    layout: BufferLayout,
    forms: Forms,
    num_bins: int,
    *,
    keep: bool = False,
) -> tuple[Array, ...]:
    """`reference.sums_in_view` of many views; `keep` as in `numba.sums_in_views`."""

    def one(row: Float[Array, " 20"]) -> tuple[Array, ...]:
        config, view = _config(row, forms), view_of(row, layout)
        position, focal = row[:3], row[18]
        sums = reference.sums_in_view(voxels, cells, view, position, focal, config, num_bins)
        if not keep:
            return sums
        seen, empty = reference.seen_in_view(voxels, cells, view, config)
        seen = seen & reference.is_sampled(voxels, forms.sample)
        return *sums, jnp.packbits(seen), jnp.packbits(empty)

    return jax.lax.map(one, views, batch_size=batch_size(voxels.capacity))


def changes_of_sums(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    places: tuple[Float[Array, "P 4"], UInt8[Array, "P p"], UInt8[Array, "P q"]],
    forms: Forms,
    num_bins: int,
) -> tuple[Float[Array, "P B"], Float[Array, "P B"]]:
    """`reference.change_of_sums` of many positions."""

    def one(place: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        point, *kept = place
        return reference.change_of_sums(before, after, kept, point[:3], point[3], forms, num_bins)

    return jax.lax.map(one, places, batch_size=batch_size(before[0].capacity))


def means_in_pixels(
    voxels: MapState, views: Float[Array, "P 20"], layout: BufferLayout, forms: Forms
) -> Float[Array, " P"]:
    """`reference.mean_in_pixels` of many views."""

    def one(row: Float[Array, " 20"]) -> Float[Array, ""]:
        view = view_of(row, layout)
        return reference.mean_in_pixels(voxels, view, row[:3], row[18], forms)

    return jax.lax.map(one, views, batch_size=batch_size(voxels.capacity))


def rows_in_pixels(
    voxels: MapState, views: Float[Array, "P 20"], layout: BufferLayout, forms: Forms
) -> Int[Array, "P h w"]:
    """`reference.rows_in_pixels` of many views."""
    del forms
    one = lambda row: reference.rows_in_pixels(voxels, view_of(row, layout))
    return jax.lax.map(one, views, batch_size=batch_size(voxels.capacity))


def terms_of_rows(
    voxels: MapState, points: Float[Array, "P 4"], forms: Forms
) -> tuple[Float[Array, "P n"], ...]:
    """`reference.terms_of_rows` from many points (position, focal length), field by field."""

    def one(point: Float[Array, " 4"]) -> tuple[Float[Array, " n"], ...]:
        return tuple(jax.tree.leaves(reference.terms_of_rows(voxels, point[:3], point[3], forms)))

    return jax.lax.map(one, points, batch_size=batch_size(voxels.capacity))
