"""Tables of the comparison beyond the means: tails, differences on the same views, areas.

An area is one number for a whole curve of quality against a budget.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.curves import area_under, common_range, sparsification
from r3jax.apps.benchmark.figures import EXPLORATION, snapshot_kind, values_by_seed
from r3jax.apps.benchmark.tables import (
    MISSING,
    Entry,
    Row,
    Table,
    full_title,
    metric_named,
    notes,
    ranked,
    seed_text,
    seed_texts,
    with_bounds,
    with_name,
)
from r3jax.evaluation.comparison import (
    RESAMPLES,
    Cell,
    Scores,
    check_equal_terms,
    mean_over_scenes,
    method_name,
    methods_of,
    paired_difference,
    scenes_of,
    scores_by_method,
    seeds_by_method,
    view_values,
    with_short_names,
)
from r3jax.evaluation.scores import POOR_PSNR, Metric


def tail_table(
    cells: Sequence[Cell],
    title: str = "",
    *,
    metric: str = "psnr",
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Table:
    """Returns what a mean hides: one line per method with the bad tail of its views.

    Columns: mean over scenes with its 95 % interval (`statistics.mean_over_scenes`), the worst
    scene, then median, 5th percentile, worst view and the share of views under 20 dB of all test
    views of all scenes and seeds together. For LPIPS the tail is the upper one (95th percentile),
    and there is no share. A method without one of the scenes has no numbers here.

    Args:
        cells: as in `quality_table`.
        title: of the table; none given: snapshot and metric.
        metric: column of the test views.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Raises:
        ValueError: records not on equal terms, or a metric that is not known.
    """
    shown = metric_named(metric)
    check_equal_terms(cells)
    told, cells = notes(cells), with_short_names(cells)
    scenes, methods, seeds = scenes_of(cells), methods_of(cells), seed_texts(cells)
    scores = scores_by_method(cells, metric)
    complete = [method for method in methods if set(scores.get(method, ())) == set(scenes)]
    means = {m: mean_over_scenes(scores[m], seed=seed, resamples=resamples) for m in complete}
    tails = {method: _Tail.of(scores[method], shown) for method in complete}

    def column(name: str) -> list[Entry]:
        values = [getattr(tails[m], name) if m in tails else None for m in methods]
        return ranked(values, shown)

    mean = ranked([means[m].value if m in means else None for m in methods], shown)
    mean = [
        with_bounds(entry, means[method], shown) if method in means else entry
        for method, entry in zip(methods, mean, strict=True)
    ]
    worst_scene = [
        with_name(entry, tails[method].scene) if method in tails else entry
        for method, entry in zip(methods, column("worst_scene"), strict=True)
    ]
    columns = {
        "mean": mean,
        "worst scene": worst_scene,
        "median": column("median"),
        f"{95 if shown.lower_is_better else 5}th percentile": column("percentile"),
        "worst view": column("worst"),
    }
    if metric.startswith("psnr"):
        shares = [tails[m].poor if m in tails else None for m in methods]
        share = Metric("", "", 1, lower_is_better=True)
        columns[f"views < {POOR_PSNR:g} dB [%]"] = ranked(shares, share)
    areas = {m: ause_of_renderability(cells, m, scenes, shown) for m in complete}
    if any(area is not None for area in areas.values()):
        ause = Metric("", "", 2, lower_is_better=True)
        columns["AUSE of R"] = ranked([areas.get(m) for m in methods], ause)
    lines = zip(methods, zip(*columns.values(), strict=True), strict=True)
    return Table(
        title=title or f"{cells[0]['snapshot']}, {full_title(shown)}",
        heads=("method",),
        columns=tuple(columns),
        rows=tuple(Row((method,), seeds[method], entries) for method, entries in lines),
        notes=told,
    )


def ause_of_renderability(
    cells: Sequence[Cell], method: str, scenes: Sequence[str], metric: Metric
) -> float | None:
    """Returns the relative AUSE of R within a model: mean over seeds, then over scenes.

    None where a scene has no model with both columns, or where all errors of its models are equal.
    """
    sign = 1.0 if metric.lower_is_better else -1.0
    by_scene: dict[str, list[float]] = {scene: [] for scene in scenes}
    for cell in cells:
        if method_name(cell) != method:
            continue
        quality, score = (view_values(cell, name) for name in ("renderability", metric.name))
        if quality is None or score is None:
            continue
        known = np.isfinite(quality) & np.isfinite(score)
        if known.any():
            found = sparsification(quality[known], sign * score[known]).relative
            by_scene[cell["scene"]].extend([found] if np.isfinite(found) else [])
    if not all(by_scene.values()):
        return None
    return float(np.mean([np.mean(found) for found in by_scene.values()]))


@dataclass(frozen=True)
class _Tail:
    """The bad views of one method."""

    worst_scene: float
    scene: str
    median: float
    percentile: float
    worst: float
    poor: float

    @staticmethod
    def of(scores: Scores, metric: Metric) -> "_Tail":
        views = np.concatenate([values.ravel() for values in scores.values()])
        views = views[~np.isnan(views)]
        worst = max if metric.lower_is_better else min
        means = {scene: float(np.nanmean(values)) for scene, values in sorted(scores.items())}
        scene = worst(means, key=lambda scene: means[scene])
        return _Tail(
            worst_scene=means[scene],
            scene=scene,
            median=float(np.median(views)),
            percentile=float(np.percentile(views, 95 if metric.lower_is_better else 5)),
            worst=float(worst(views)),
            poor=float(100.0 * np.mean(views < POOR_PSNR)),
        )


def difference_table(
    cells: Sequence[Cell],
    reference: str,
    title: str = "",
    *,
    metric: str = "psnr",
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Table:
    """The reference minus every other method on the same test views, per scene and over all.

    Each field is a mean with its 95 % interval (`statistics.paired_difference`) over the seeds
    that both have; no field is marked. An interval that holds 0 leaves open which is better.

    Args:
        cells: as in `quality_table`.
        reference: a method as the tables call it.
        title: of the table; none given: snapshot, metric and reference.
        metric: column of the test views.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Raises:
        ValueError: records not on equal terms, or a metric or reference that is not there.
    """
    shown = metric_named(metric)
    check_equal_terms(cells)
    told, cells = notes(cells), with_short_names(cells)
    methods, scenes, seeds = methods_of(cells), scenes_of(cells), seeds_by_method(cells)
    if reference not in methods:
        raise ValueError(f"no record of {reference!r}; there are {', '.join(methods)}")

    def entry(pairs: Sequence[tuple[np.ndarray, np.ndarray] | None]) -> Entry:
        found = [pair for pair in pairs if pair is not None]
        if not found or len(found) < len(pairs):
            return MISSING
        first, second = ({str(i): pair[k] for i, pair in enumerate(found)} for k in (0, 1))
        estimate = paired_difference(first, second, seed=seed, resamples=resamples)
        text = f"{estimate.value:+.{shown.decimals}f}"
        return with_bounds(Entry(estimate.value, text), estimate, shown, "+")

    rows: list[Row] = []
    for method in methods:
        if method == reference:
            continue
        shared = {s: sorted({*seeds[reference][s]} & {*seeds[method][s]}) for s in scenes}
        kept = [c for c in cells if c["seed"] in shared[c["scene"]]]
        scores = scores_by_method(kept, metric)
        ours, theirs = scores.get(reference, {}), scores.get(method, {})
        pairs = [(ours[s], theirs[s]) if s in ours and s in theirs else None for s in scenes]
        entries = (*(entry([pair]) for pair in pairs), entry(pairs))
        rows.append(Row((method,), seed_text(list(shared.values())), entries))
    return Table(
        title=title or f"{cells[0]['snapshot']}, {full_title(shown)}: {reference} minus the others",
        heads=("method",),
        columns=(*scenes, "mean"),
        rows=tuple(rows),
        notes=told,
    )


Curve = tuple[np.ndarray, np.ndarray]


def area_table(
    cells: Sequence[Cell], title: str = "", *, x: str = "views", metric: str = "psnr"
) -> Table:
    """Returns the mean height of quality against a budget, per scene, and the mean of the scenes.

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
    """Returns the curve of every seed; none at all if one of them has fewer than two points."""
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
