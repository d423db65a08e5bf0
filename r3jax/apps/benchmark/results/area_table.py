"""The table of areas: one number for a whole curve of quality against a budget."""

from collections.abc import Sequence

import numpy as np

from r3jax.apps.benchmark.results.areas import area_under, common_range
from r3jax.apps.benchmark.results.table_parts import (
    Row,
    Table,
    full_title,
    metric_named,
    notes,
    ranked,
    seed_texts,
)
from r3jax.evaluation.comparison import (
    EXPLORATION,
    Cell,
    check_equal_terms,
    method_name,
    methods_of,
    scenes_of,
    snapshot_kind,
    values_by_seed,
    with_short_names,
)

Curve = tuple[np.ndarray, np.ndarray]


def area_table(
    cells: Sequence[Cell], title: str = "", *, x: str = "views", metric: str = "psnr"
) -> Table:
    """Mean height of quality against a budget, per scene, and the mean of the scenes.

    Each seed has a curve through its snapshots; its area is taken over the widest range of x that
    all curves of the scene span, whatever the method, and divided by that range (so dB stay dB);
    then seeds are averaged. A method of which a seed has fewer than two points is missing.

    Args:
        cells: records of several snapshots of one kind.
        title: of the table; none given: what is shown.
        x: of `EXPLORATION`: views, seconds, meters.
        metric: column of the test views.

    Raises:
        ValueError: records not on equal terms, snapshots of several kinds, names that are not
            known, or a scene where the curves share no range.
    """
    shown = metric_named(metric)
    check_equal_terms(cells, one_snapshot=False)
    snapshot_kind(cells)
    told, cells = notes(cells), with_short_names(cells)
    if x not in EXPLORATION:
        raise ValueError(f"no budget {x!r}; there are {', '.join(EXPLORATION)}")
    scenes, methods, seeds = scenes_of(cells), methods_of(cells), seed_texts(cells)
    columns: list[list[float | None]] = []
    ranges: list[str] = []
    for scene in scenes:
        here = [cell for cell in cells if cell["scene"] == scene]
        curves = {method: _curves(here, method, x, metric) for method in methods}
        known = [curve for found in curves.values() for curve in found]
        if not known:
            columns.append([None] * len(methods))
            continue
        try:
            start, end = common_range([budget for budget, _ in known])
        except ValueError as error:
            raise ValueError(f"{scene}: {error}") from error
        ranges.append(f"{scene} {start:.4g} to {end:.4g}")
        columns.append([
            float(np.mean([area_under(*curve, start=start, end=end) for curve in curves[method]]))
            if curves[method]
            else None
            for method in methods
        ])  # fmt: skip
    lines = list(zip(*columns, strict=True))
    means = [None if None in line else float(np.mean(line)) for line in lines]
    entries = zip(*(ranked(column, shown) for column in [*columns, means]), strict=True)
    return Table(
        title=title or f"{full_title(shown)}: area under the curve over {EXPLORATION[x]}",
        heads=("method",),
        columns=(*scenes, "mean"),
        rows=tuple(Row((m,), seeds[m], line) for m, line in zip(methods, entries, strict=True)),
        notes=(*told, f"Range of {EXPLORATION[x]}: {', '.join(ranges)}."),
    )


def _curves(cells: Sequence[Cell], method: str, x: str, metric: str) -> list[Curve]:
    """The curve of every seed; none at all if one of them has fewer than two points."""
    chosen = [cell for cell in cells if method_name(cell) == method]
    curves: list[Curve] = []
    for budget, quality in zip(
        values_by_seed(chosen, x), values_by_seed(chosen, metric), strict=True
    ):
        known = ~np.isnan(budget + quality)
        # A run that ended early has the same views at two snapshots: one point.
        budget, first = np.unique(budget[known], return_index=True)
        if len(budget) < 2:
            return []
        curves.append((budget, quality[known][first]))
    return curves
