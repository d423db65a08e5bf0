"""The scores of views by kernels on CPUs, and by the formulas elsewhere.

The choice is made where a program is lowered, so that `jit`, `vmap`, `lax.map` and `grad` of the
public verbs all get it. Derivatives are those of the formulas.

Shape symbols: n voxels; c cells; B bins of the panorama; p q bytes that hold a bit for every voxel
and every cell; h w pixels of a depth buffer.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from r3jax.kernels import calls
from r3jax.kernels.calls import Cells, Forms
from r3jax.kernels.native.platform import call_of_many, warn_once
from r3jax.mapping.state import MapState
from r3jax.scoring import formulas
from r3jax.scoring.config import Score, ScoringConfig
from r3jax.visibility.views import View, VisibilityConfig, for_kernels, layout_of


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
    """Computes `formulas.sums_in_view`."""
    del position  # that of the view; it only carries the derivative
    deficits, unexplored = _sums(voxels, cells, view, focal, config, num_bins, keep=False)
    return deficits, unexplored


@sums_in_view.defjvp
def _sums_in_view_jvp(num_bins: int, primals: Any, tangents: Any) -> Any:
    score = functools.partial(formulas.sums_in_view, num_bins=num_bins)
    return jax.jvp(score, primals, tangents)


def sums_and_seen(
    voxels: MapState,
    cells: Cells,
    view: View,
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"], UInt8[Array, " p"], UInt8[Array, " q"]]:
    """Computes `sums_in_view`, and marks the voxels and cells that are in it: bits in bytes."""
    return _sums(voxels, cells, view, focal, config, num_bins, keep=True)


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
    layout, forms = layout_of(view), config.score.forms

    def kernel(known: tuple[MapState, Cells, Score], items: Any) -> tuple[Array, ...]:
        (voxels, cells, _), views = known, jax.vmap(for_kernels)(*items)
        return calls.sums(
            voxels.rows, cells, views, layout, forms, num_bins, voxels.num_bins, keep=keep
        )

    def formula(known: tuple[MapState, Cells, Score], item: Any) -> tuple[Array, ...]:
        (voxels, cells, score), (view, tolerance, focal) = known, item
        seen = formulas.seen_in_view(voxels, cells, view, VisibilityConfig(tolerance=tolerance))
        position = for_kernels(*item).position
        sums = formulas.sums_of_seen(voxels, cells, seen, position, focal, score, num_bins)
        return (*sums, *map(jnp.packbits, seen)) if keep else sums

    item = (view, config.tolerance, focal)
    known = (voxels, cells, config.score)
    return call_of_many(_if_any(kernel, config.score), formula, known, item, voxels.capacity)


def _if_any(kernel: Callable[..., Any], score: Score) -> Callable[..., Any] | None:
    """Returns the kernel, or None where R is the caller's own, with a warning."""
    if score.has_kernel:
        return kernel
    warn_once(
        "ScoringConfig has a combination of terms or an importance of its own, for which there is "
        "no machine code: scores are computed in plain JAX, which is slower"
    )
    return None


def change_of_sums(
    before: tuple[MapState, Cells],
    after: tuple[MapState, Cells],
    kept: tuple[UInt8[Array, " p"], UInt8[Array, " q"]],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    config: ScoringConfig,
    num_bins: int,
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """Computes `formulas.change_of_sums`."""
    forms = config.score.forms

    def kernel(known: Any, items: Any) -> tuple[Array, Array]:
        (voxels, cells), (voxels_after, cells_after), _ = known
        gone = cells._replace(unexplored=cells.unexplored & ~cells_after.unexplored)
        kept, position, focal = items
        return calls.changes(
            voxels.rows, voxels_after.rows, gone, kept, position, focal, forms, num_bins,
            voxels.num_bins,
        )  # fmt: skip

    def formula(known: Any, item: Any) -> tuple[Array, Array]:
        (before, after, score), (kept, position, focal) = known, item
        return formulas.change_of_sums(before, after, kept, position, focal, score, num_bins)

    item, known = (kept, position, focal), (before, after, config.score)
    return call_of_many(_if_any(kernel, config.score), formula, known, item, before[0].capacity)


@jax.custom_jvp
def mean_in_pixels(
    voxels: MapState,
    view: View,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    config: ScoringConfig,
) -> Float[Array, ""]:
    """Computes `formulas.mean_in_pixels`."""
    del position  # that of the view; it only carries the derivative
    layout, forms = layout_of(view), config.score.forms

    def kernel(known: tuple[MapState, Score], items: Any) -> Array:
        voxels, views = known[0], jax.vmap(for_kernels)(*items)
        bins = voxels.num_bins
        return calls.pixels(voxels.rows, views, layout, forms, bins, keep=False)[0]

    def formula(known: tuple[MapState, Score], item: Any) -> Array:
        position = for_kernels(*item).position
        return formulas.mean_in_pixels(known[0], item[0], position, item[2], known[1])

    item, known = (view, config.tolerance, focal), (voxels, config.score)
    return call_of_many(_if_any(kernel, config.score), formula, known, item, voxels.capacity)


@mean_in_pixels.defjvp
def _mean_in_pixels_jvp(primals: Any, tangents: Any) -> Any:
    voxels, view, position, focal, config = primals
    rows = rows_in_pixels(voxels, view, config)

    def score(voxels: MapState, position: Array, focal: Array) -> Array:
        return formulas.mean_of_rows(voxels, rows, position, focal, config.score)

    moved = tangents[0], tangents[2], tangents[3]
    return jax.jvp(score, (voxels, position, focal), moved)


@jax.custom_jvp
def rows_in_pixels(voxels: MapState, view: View, config: ScoringConfig) -> Int[Array, "h w"]:
    """Computes `formulas.rows_in_pixels`."""
    layout = layout_of(view)

    def kernel(voxels: MapState, items: Any) -> Array:
        view, tolerance = items
        views = jax.vmap(for_kernels)(view, tolerance, jnp.ones_like(tolerance))
        bins = voxels.num_bins
        rows = calls.pixels(voxels.rows, views, layout, Forms(), bins, keep=True)[1]
        return rows.reshape(-1, layout.height, layout.width)

    def formula(voxels: MapState, item: Any) -> Array:
        return formulas.rows_in_pixels(voxels, item[0])

    return call_of_many(kernel, formula, voxels, (view, config.tolerance), voxels.capacity)


@rows_in_pixels.defjvp
def _rows_in_pixels_jvp(primals: Any, tangents: Any) -> Any:
    del tangents  # a choice has no derivative
    rows = rows_in_pixels(*primals)
    return rows, np.zeros(rows.shape, dtype=jax.dtypes.float0)
