"""The referee's tables: the paper's two, the tails, and differences on the same views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from r3jax.apps.benchmark.results.table_parts import (
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
    Cell,
    check_equal_terms,
    methods_of,
    scenes_of,
    scores_by_method,
    seeds_by_method,
    with_short_names,
)
from r3jax.evaluation.scores import POOR_PSNR, Metric
from r3jax.evaluation.statistics import RESAMPLES, Scores, mean_over_scenes, paired_difference

PAPER_METRICS = ("ssim", "psnr", "lpips")
"""Lines of a method in the paper's tables."""


def quality_table(cells: Sequence[Cell], title: str = "") -> Table:
    """The paper's table: methods x (SSIM, PSNR, LPIPS) by scenes and their mean.

    A field is the mean over seeds of the mean over the scene's test views. The last column is the
    mean of the scenes, and missing for a method that lacks one: means over other scenes are not
    comparable.

    Args:
        cells: records of one snapshot; rows go in the order of `equal_terms.POLICIES`.
        title: of the table; none given: the snapshot.

    Raises:
        ValueError: the records were not made on equal terms (`check_equal_terms`).
    """
    check_equal_terms(cells)
    told, cells = notes(cells), with_short_names(cells)
    scenes, methods, seeds = scenes_of(cells), methods_of(cells), seed_texts(cells)
    rows: dict[tuple[str, str], Row] = {}
    for name in PAPER_METRICS:
        metric, scores = metric_named(name), scores_by_method(cells, name)
        columns: list[list[Entry]] = []
        for scene in [*scenes, None]:
            means = [_mean(scores.get(method, {}), scene, scenes) for method in methods]
            columns.append(ranked(means, metric))
        for method, entries in zip(methods, zip(*columns, strict=True), strict=True):
            rows[method, name] = Row((method, metric.title), seeds[method], entries)
    return Table(
        title=title or cells[0]["snapshot"],
        heads=("method", "metric"),
        columns=(*scenes, "mean"),
        rows=tuple(rows[method, name] for method in methods for name in PAPER_METRICS),
        notes=told,
    )


def _mean(scores: Scores, scene: str | None, scenes: Sequence[str]) -> float | None:
    """Of one scene, or (None) of all if there are values for all."""
    if scene is not None:
        return float(np.nanmean(scores[scene])) if scene in scores else None
    if set(scores) != set(scenes):
        return None
    return float(np.mean([np.nanmean(values) for values in scores.values()]))


def tail_table(
    cells: Sequence[Cell],
    title: str = "",
    *,
    metric: str = "psnr",
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Table:
    """What a mean hides: one line per method with the bad tail of its views.

    Columns: mean over scenes with its 95 % interval (`statistics.mean_over_scenes`), the worst
    scene, then median, 5th percentile, worst view and the share of views under 20 dB of all test
    views of all scenes and seeds together. For LPIPS the tail is the upper one (95th percentile),
    and there is no share. A method that lacks a scene has no numbers here.

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
    lines = zip(methods, zip(*columns.values(), strict=True), strict=True)
    return Table(
        title=title or f"{cells[0]['snapshot']}, {full_title(shown)}",
        heads=("method",),
        columns=tuple(columns),
        rows=tuple(Row((method,), seeds[method], entries) for method, entries in lines),
        notes=told,
    )


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
