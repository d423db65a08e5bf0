"""Which backend answers where: machine code on a CPU, dense batches on a GPU.

The choice is made where a program is lowered, so that `jit`, `vmap`, `lax.map` and `grad` of the
public verbs all get it. Derivatives are those of the reference.

Shape symbols: n voxels; c cells; B bins of the panorama; p q bytes that hold a bit for every voxel
and every cell; h w pixels of a depth buffer.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.kernels.native.platform import by_platform, can_call_kernels
from r3jax.mapping.state import MapState
from r3jax.scoring.backends import dense, reference
from r3jax.scoring.backends.views import layout_of, over_views, row_of
from r3jax.scoring.cells import Cells
from r3jax.scoring.config import PAPER, Forms, ScoringConfig
from r3jax.scoring.terms import Renderability
from r3jax.visibility.views import View

LARGEST_BUFFER = 2048
"""Edge [px] up to which the kernels' places in a buffer are exact in float32."""


def _by_platform(answer_by: Callable[[Any], Callable[..., Any]], edge: int = 1) -> Any:
    """A function that answers by `numba` on CPUs, where kernels serve, and by `dense` elsewhere.

    Args:
        answer_by: from a backend's module to the function that asks it.
        edge: of the depth buffer [px].
    """
    if edge > LARGEST_BUFFER or not can_call_kernels():
        return answer_by(dense)

    from r3jax.kernels import scoring

    return by_platform(cpu=answer_by(scoring), default=answer_by(dense))


@functools.partial(jax.custom_jvp, nondiff_argnums=(6,))
def sums_in_view(
    voxels: MapState,
    cells: Cells,
    view: View,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """`reference.sums_in_view`, by the fastest backend of the platform."""
    del position  # that of the view; it only carries the derivative
    deficits, unexplored = _sums(voxels, cells, view, focal, config, num_bins, keep=False)
    return deficits, unexplored


@sums_in_view.defjvp
def _sums_in_view_jvp(num_bins: int, primals: Any, tangents: Any) -> Any:
    score = functools.partial(reference.sums_in_view, num_bins=num_bins)
    return jax.jvp(score, primals, tangents)


def sums_and_seen(
    voxels: MapState,
    cells: Cells,
    view: View,
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"], UInt8[Array, " p"], UInt8[Array, " q"]]:
    """`sums_in_view`, and which voxels (of the sample) and cells are in it: bits in bytes."""
    return _sums(voxels, cells, view, focal, config, num_bins, keep=True)


def change_of_sums(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    kept: tuple[UInt8[Array, " p"], UInt8[Array, " q"]],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """`reference.change_of_sums`, by the fastest backend of the platform."""
    forms = config.forms

    def score_by(backend: Any) -> Callable[..., Any]:
        def score(known: tuple[Any, Any], places: Any) -> Any:
            return backend.changes_of_sums(*known, places, forms, num_bins)

        return lambda known, places: over_views(score, known, places)

    place = (jnp.concatenate([position, focal[None]]), *kept)
    results = _by_platform(score_by)((before, after), jax.tree.map(lambda x: x[None], place))
    return jax.tree.map(lambda of_all: of_all[0], results)


def seen_in_view(
    voxels: MapState, cells: Cells, view: View, config: ScoringConfig
) -> tuple[Bool[Array, " n"], Bool[Array, " c"]]:
    """`reference.seen_in_view`: the voxels and the unexplored cells that a view sees."""
    config = dataclasses.replace(config, sample=1)
    *_, seen, empty = sums_and_seen(voxels, cells, view, jnp.ones(()), config, 1)
    return (
        jnp.unpackbits(seen, count=voxels.capacity).astype(bool),
        jnp.unpackbits(empty, count=cells.x.shape[0]).astype(bool),
    )


def _sums(
    voxels: MapState,
    cells: Cells,
    view: View,
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
    *,
    keep: bool,
) -> Any:
    layout, forms = layout_of(view), config.forms

    def score_by(backend: Any) -> Callable[..., Any]:
        def score(shared: tuple[MapState, Cells], views: Array) -> Any:
            return backend.sums_in_views(*shared, views, layout, forms, num_bins, keep=keep)

        return lambda shared, views: over_views(score, shared, views)

    chosen = _by_platform(score_by, max(view.shape))
    results = chosen((voxels, cells), row_of(view, focal, config)[None])
    return jax.tree.map(lambda of_all: of_all[0], results)


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def mean_in_pixels(
    voxels: MapState,
    view: View,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    config: ScoringConfig,
    forms: Forms,
) -> Float[Array, ""]:
    """`reference.mean_in_pixels`, by the fastest backend of the platform."""
    del position  # that of the view; it only carries the derivative
    layout = layout_of(view)

    def score_by(backend: Any) -> Callable[..., Any]:
        score = lambda voxels, views: backend.means_in_pixels(voxels, views, layout, forms)
        return lambda voxels, views: over_views(score, voxels, views)

    chosen = _by_platform(score_by, max(view.shape))
    return chosen(voxels, row_of(view, focal, config)[None])[0]


@mean_in_pixels.defjvp
def _mean_in_pixels_jvp(forms: Forms, primals: Any, tangents: Any) -> Any:
    voxels, view, position, focal, config = primals
    rows = rows_in_pixels(voxels, view, config)

    def score(voxels: MapState, position: Array, focal: Array) -> Array:
        return reference.mean_of_rows(voxels, rows, position, focal, forms)

    moved = tangents[0], tangents[2], tangents[3]
    return jax.jvp(score, (voxels, position, focal), moved)


@jax.custom_jvp
def rows_in_pixels(voxels: MapState, view: View, config: ScoringConfig) -> Int[Array, "h w"]:
    """`reference.rows_in_pixels`, by the fastest backend of the platform."""
    layout = layout_of(view)

    def look_by(backend: Any) -> Callable[..., Any]:
        look = lambda voxels, views: backend.rows_in_pixels(voxels, views, layout, PAPER)
        return lambda voxels, views: over_views(look, voxels, views)

    chosen = _by_platform(look_by, max(view.shape))
    return chosen(voxels, row_of(view, jnp.ones(()), config)[None])[0]


@rows_in_pixels.defjvp
def _rows_in_pixels_jvp(primals: Any, tangents: Any) -> Any:
    del tangents  # a choice has no derivative
    rows = rows_in_pixels(*primals)
    return rows, np.zeros(rows.shape, dtype=jax.dtypes.float0)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def terms_of_rows(
    voxels: MapState, position: Float[Array, " 3"], focal: Float[Array, ""], forms: Forms
) -> Renderability:
    """`reference.terms_of_rows`, by the fastest backend of the platform."""

    def score_by(backend: Any) -> Callable[..., Any]:
        score = lambda voxels, points: backend.terms_of_rows(voxels, points, forms)
        return lambda voxels, points: over_views(score, voxels, points)

    point = jnp.concatenate([position, focal[None]])
    return Renderability(*(term[0] for term in _by_platform(score_by)(voxels, point[None])))


@terms_of_rows.defjvp
def _terms_of_rows_jvp(forms: Forms, primals: Any, tangents: Any) -> Any:
    return jax.jvp(functools.partial(reference.terms_of_rows, forms=forms), primals, tangents)
