"""The tables that a benchmark ends with: methods x metrics by scenes, one for each set of terms.

Fields have ranks, lines their seeds; notes tell the terms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from r3jax.errors import InputError
from r3jax.evaluation.comparison import (
    Cell,
    Estimate,
    Scores,
    check_equal_terms,
    differing,
    mean_over_scenes,
    method_name,
    methods_of,
    paired_difference,
    scenes_of,
    scores_by_method,
    seeds_by_method,
    shared_settings,
    snapshots_of,
    terms_in_scene,
    terms_of,
    with_short_names,
)
from r3jax.evaluation.scores import METRICS, POOR_PSNR, Metric

FEWEST_SEEDS = 3
"""Seeds per cell of a table that the protocol requires."""


_LONGEST = 24
"""Maximum length of a value in a heading; longer ones, such as a hash, are cut."""


@dataclass(frozen=True)
class Entry:
    """One field of a table."""

    value: float | None
    """With all digits; None if there is none, which is never shown as a number."""

    text: str = ""
    """Formatted value."""

    rank: int = 0
    """1 for the best of its column, 2 for the second best, 0 for others."""

    extra: Mapping[str, float | str] = field(default_factory=dict[str, float | str])
    """Other content of the text (interval, name of a scene), by name, for machines."""


MISSING = Entry(None)


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    labels: tuple[str, ...]
    """Method and, where the table has several, metric."""

    seeds: str
    """Seeds per cell: `3`, or `2-3` if they differ; `0` counts as missing."""

    entries: tuple[Entry, ...]
    """One per column."""


@dataclass(frozen=True)
class Table:
    """A table without a format; `table_formats` writes it as text."""

    title: str
    heads: tuple[str, ...]
    """Names of the labels."""

    columns: tuple[str, ...]
    """Names of the entries."""

    rows: tuple[Row, ...]
    """Lines of one method follow each other."""

    notes: tuple[str, ...]
    """Sentences below the table: terms, seeds, missing cells."""


def metric_named(name: str) -> Metric:
    """Looks up a metric of `scores.METRICS` by name.

    Raises:
        ValueError: there is none of that name.
    """
    for metric in METRICS:
        if metric.name == name:
            return metric
    known = ", ".join(metric.name for metric in METRICS)
    raise InputError(f"no metric {name!r}; there are {known}")


def full_title(metric: Metric) -> str:
    """Returns the metric's title for use on its own, where no title of PSNR stands above it."""
    return "PSNR [dB], holes left out" if metric.name == "psnr_measured" else metric.title


def ranked(values: Sequence[float | None], metric: Metric) -> list[Entry]:
    """Ranks the entries of one column.

    All that *read* the same as the best are best, second likewise. With one value there is nothing
    to compare, so nothing is marked.
    """
    texts = [MISSING.text if v is None else f"{v:.{metric.decimals}f}" for v in values]
    sign = 1.0 if metric.lower_is_better else -1.0
    read = sorted({sign * float(text) for text in texts if text})
    ranks = dict(zip(read, (1, 2), strict=False)) if sum(map(bool, texts)) > 1 else {}
    return [
        MISSING if v is None else Entry(v, text, ranks.get(sign * float(text), 0))
        for v, text in zip(values, texts, strict=True)
    ]


def with_bounds(entry: Entry, found: Estimate, metric: Metric, sign: str = "") -> Entry:
    """Adds the 95 % interval to an entry; `sign` as in format strings."""
    low, high = (f"{end:{sign}.{metric.decimals}f}" for end in (found.low, found.high))
    extra = {"low": found.low, "high": found.high}
    return Entry(entry.value, f"{entry.text} [{low}, {high}]", entry.rank, extra)


def with_name(entry: Entry, name: str) -> Entry:
    """Adds to an entry the name that it belongs to."""
    return Entry(entry.value, f"{entry.text} ({name})", entry.rank, {"name": name})


def seed_text(seeds: Sequence[Sequence[int]]) -> str:
    """Writes the fewest and most seeds of some cells: `3`, `2-3`."""
    counts = sorted({len(found) for found in seeds})
    return f"{counts[0]}" if len(counts) == 1 else f"{counts[0]}-{counts[-1]}"


def seed_texts(cells: Sequence[Cell]) -> dict[str, str]:
    """Writes the fewest and most seeds of each method over all scenes of the table."""
    found = seeds_by_method(cells)
    return {method: seed_text(list(scenes.values())) for method, scenes in found.items()}


def notes(cells: Sequence[Cell]) -> tuple[str, ...]:
    """Lists the terms that all records share, seeds, authors, and missing cells.

    Args:
        cells: of the whole table, with their full names.
    """
    cell, training = cells[0], cells[0]["training"]
    sentences = [
        f"{', '.join(snapshots_of(cells))} on the {cell['clock']} clock, "
        f"images of {cell['resolution']} px; "
        f"{training['iterations']} iterations of training at {training['resolution']} px; "
        f"test views of {cell['test_views']['resolution']} px."
    ]
    if shared := shared_settings(cells):
        given = ", ".join(f"{name}={value}" for name, value in shared.items())
        sentences.append(f"Settings of all policies: {given}.")
    seeds = seeds_by_method(with_short_names(cells))
    counts = [len(found) for scenes in seeds.values() for found in scenes.values() if found]
    fewest, most = min(counts), max(counts)
    count = f"{most}" if fewest == most else f"{fewest} to {most}"
    short = f", fewer than the {FEWEST_SEEDS} of the protocol" if fewest < FEWEST_SEEDS else ""
    sentences.append(f"{count} seed{'s' * (most > 1)} per cell{short}.")
    absent = [f"{m} in {s}" for m, by_scene in seeds.items() for s, n in by_scene.items() if not n]
    if absent:
        sentences.append(f"No record of {', '.join(absent)}.")
    machines = ", ".join(sorted({cell["machine"] or "an unknown machine" for cell in cells}))
    sources = ", ".join(sorted({_source(cell) for cell in cells}))
    return (*sentences, f"Made on {machines} from {sources}.")


def _source(cell: Cell) -> str:
    """Names the commit by ten digits and the mark of a changed source; else the version."""
    if cell["commit"] is None:
        return f"version {cell['packages'].get('r3jax', 'unknown')}"
    digits, hyphen, changed = cell["commit"].partition("-")
    return f"commit {digits[:10]}{hyphen}{changed}"


PAPER_METRICS = ("ssim", "psnr", "lpips")
"""Lines of a method in the paper's tables."""


def quality_table(cells: Sequence[Cell], title: str = "", *, with_intervals: bool = False) -> Table:
    """Makes the paper's table: methods x (SSIM, PSNR, LPIPS) by scenes and their mean.

    A field is the mean over seeds of the mean over the scene's test views. The last column is the
    mean of the scenes, and missing for a method without one of them: means over other scenes are
    not comparable.

    Args:
        cells: records of one snapshot; rows go in the order of `equal_terms.POLICIES`.
        title: of the table; none given: the snapshot.
        with_intervals: also gives each field its 95 % interval over views and seeds.

    Raises:
        ValueError: the records were not made on equal terms (`check_equal_terms`).
    """
    check_equal_terms(cells)
    below, cells = notes(cells), with_short_names(cells)
    scenes, methods, seeds = scenes_of(cells), methods_of(cells), seed_texts(cells)
    rows: dict[tuple[str, str], Row] = {}
    for name in PAPER_METRICS:
        metric, scores = metric_named(name), scores_by_method(cells, name)
        columns: list[list[Entry]] = []
        for scene in [*scenes, None]:
            parts = [_part(scores.get(method, {}), scene, scenes) for method in methods]
            entries = ranked([_mean(part) if part else None for part in parts], metric)
            if with_intervals:
                pairs = zip(entries, parts, strict=True)
                entries = [
                    with_bounds(entry, mean_over_scenes(part), metric) if part else entry
                    for entry, part in pairs
                ]
            columns.append(entries)
        for method, entries in zip(methods, zip(*columns, strict=True), strict=True):
            rows[method, name] = Row((method, metric.title), seeds[method], entries)
    return Table(
        title=title or cells[0]["snapshot"],
        heads=("method", "metric"),
        columns=(*scenes, "mean"),
        rows=tuple(rows[method, name] for method in methods for name in PAPER_METRICS),
        notes=below,
    )


_COSTS = {
    "path [m]": ("metres", 1.0, 1),
    "clock [s]": ("seconds", 1.0, 0),
    "views": ("views", 1.0, 0),
    "decision [ms]": ("decision_ms", 1.0, 0),
    "map [MB]": ("map_bytes", 1e-6, 0),
}
"""Columns of what the views cost: field of a record's `exploration` or `measured`, factor,
decimals."""


def comparison_table(
    cells: Sequence[Cell],
    title: str = "",
    *,
    reference: str | None = None,
    scenes: Sequence[str] | None = None,
) -> Table:
    """Makes the table that a comparison is read from: a line per method, means over the scenes.

    PSNR with its interval, its difference to a reference on the same test views and seeds
    (`statistics.paired_difference`; above 0: better than the reference), the other metrics, the
    share of views under 20 dB, and what the views cost: path, mission clock, views, the median
    decision as it was measured, and the memory of the map. A method without one of the scenes has
    no numbers, since means over other scenes are not comparable.

    Args:
        cells: as in `quality_table`.
        title: of the table; none given: the snapshot.
        reference: a method as the tables call it; None: the last in the order of tables.
        scenes: only these, by the names that tables use; None: all.

    Raises:
        ValueError: records not on equal terms, or a reference that is not there.
    """
    check_equal_terms(cells)
    below, cells = notes(cells), with_short_names(cells)
    chosen = list(scenes or scenes_of(cells))
    cells = [cell for cell in cells if cell["scene"] in chosen]
    methods, seeds = methods_of(cells), seed_texts(cells)
    reference = reference_in(cells, None) if reference is None else reference
    if reference not in methods:
        raise InputError(f"there is no record of {reference!r}; there are {', '.join(methods)}")
    columns: dict[str, list[Entry]] = {}
    for name in ("psnr", "ssim", "lpips"):
        metric, scores = metric_named(name), scores_by_method(cells, name)
        complete = {m: scores[m] for m in methods if set(scores.get(m, ())) == set(chosen)}
        entries = ranked([_mean(complete[m]) if m in complete else None for m in methods], metric)
        if name != "psnr":
            columns[metric.title] = entries
            continue
        columns[metric.title] = [
            with_bounds(entry, mean_over_scenes(complete[m]), metric) if m in complete else entry
            for m, entry in zip(methods, entries, strict=True)
        ]
        columns[f"minus {reference}"] = [
            _entry_of_difference(difference_of(cells, m, reference), metric) for m in methods
        ]
        poor = {m: _mean({s: 100.0 * (v < POOR_PSNR) for s, v in complete[m].items()})
                for m in complete}  # fmt: skip
        share = Metric("", "", 0, lower_is_better=True)
        columns[f"< {POOR_PSNR:g} dB [%]"] = ranked([poor.get(m) for m in methods], share)
    for column, (name, factor, decimals) in _COSTS.items():
        values = [_cost(cells, m, name, chosen) for m in methods]
        columns[column] = [
            MISSING if v is None else Entry(v * factor, f"{v * factor:.{decimals}f}")
            for v in values
        ]
    lines = zip(methods, zip(*columns.values(), strict=True), strict=True)
    return Table(
        title=title or cells[0]["snapshot"],
        heads=("method",),
        columns=tuple(columns),
        rows=tuple(Row((method,), seeds[method], entries) for method, entries in lines),
        notes=below,
    )


def tables_of_group(
    group: Sequence[Cell], heading: str, reference: str | None, *, with_intervals: bool = False
) -> tuple[Table, Table]:
    """Makes the tables of a group of `headed_groups`: `quality_table`, and `comparison_table`.

    The second one has no columns without a value; `reference` is as in `reference_in`.
    """
    costs = comparison_table(group, heading, reference=reference_in(group, reference))
    quality = quality_table(group, heading, with_intervals=with_intervals)
    return quality, without_empty_columns(costs)


def without_empty_columns(table: Table) -> Table:
    """Leaves out the columns in which no line has a value."""
    has_value = [
        any(r.entries[i].value is not None for r in table.rows) for i in range(len(table.columns))
    ]
    kept = [i for i, known in enumerate(has_value) if known]
    rows = [replace(row, entries=tuple(row.entries[i] for i in kept)) for row in table.rows]
    return replace(table, columns=tuple(table.columns[i] for i in kept), rows=tuple(rows))


def by_scene_table(records: Sequence[Cell], reference: str | None = None) -> Table:
    """Makes one table for machines: a line per set of terms, scene and method.

    The lines of `comparison_table` for every scene by itself, and for `all` where there are
    several, of every group of `headed_groups`; `reference` is the method that is subtracted.
    """
    rows: list[Row] = []
    columns: tuple[str, ...] = ()
    for heading, group in headed_groups(records):
        chosen = reference_in(group, reference)
        scenes = scenes_of(with_short_names(group))
        parts = {scene: [scene] for scene in scenes} | ({"all": scenes} if scenes[1:] else {})
        for name, part in parts.items():
            table = comparison_table(group, reference=chosen, scenes=part)
            columns = tuple(
                "minus reference" if c.startswith("minus ") else c for c in table.columns
            )
            rows += [
                Row((heading, name, *row.labels, chosen), row.seeds, row.entries)
                for row in table.rows
            ]
    return Table("", ("terms", "scene", "method", "reference"), columns, tuple(rows), ())


def reference_in(group: Sequence[Cell], reference: str | None) -> str:
    """Returns the reference if the group has it, else the last method in the order of tables."""
    methods = methods_of(with_short_names(group))
    return reference if reference in methods else methods[-1]


def difference_of(
    cells: Sequence[Cell], method: str, reference: str, metric: str = "psnr"
) -> Estimate | None:
    """Computes a method minus a reference over the seeds and test views that both have.

    Returns None for the reference itself, and where one of the two has no values in a scene.
    """
    seeds, scenes = seeds_by_method(cells), scenes_of(cells)
    if method == reference:
        return None
    shared = {s: {*seeds[reference][s]} & {*seeds[method][s]} for s in scenes}
    kept = [cell for cell in cells if cell["seed"] in shared[cell["scene"]]]
    scores = scores_by_method(kept, metric)
    first, second = scores.get(method, {}), scores.get(reference, {})
    if set(first) != set(scenes) or set(second) != set(scenes):
        return None
    return paired_difference(first, second)


def _entry_of_difference(found: Estimate | None, metric: Metric) -> Entry:
    if found is None:
        return MISSING
    text = f"{found.value:+.{metric.decimals}f}"
    return with_bounds(Entry(found.value, text), found, metric, "+")


def _cost(cells: Sequence[Cell], method: str, name: str, scenes: Sequence[str]) -> float | None:
    """Returns the mean over scenes of the mean over seeds; None where a record has no value."""
    means: list[float] = []
    for scene in scenes:
        own = [c for c in cells if c["scene"] == scene and method_name(c) == method]
        values = [(cell["exploration"] | cell.get("measured", {})).get(name) for cell in own]
        if not values or None in values:
            return None
        means.append(float(np.mean(values)))
    return float(np.mean(means))


def _part(scores: Scores, scene: str | None, scenes: Sequence[str]) -> Scores:
    """Selects the scores of one scene, or (None) of all if no scene is missing; empty otherwise."""
    if scene is not None:
        return {scene: scores[scene]} if scene in scores else {}
    return scores if set(scores) == set(scenes) else {}


def _mean(scores: Scores) -> float:
    return float(np.mean([np.nanmean(values) for values in scores.values()]))


def on_equal_terms(first: Cell, second: Cell) -> bool:
    """Returns True if two records of one scene were made on equal terms."""
    return not (
        differing(terms_of(first), terms_of(second))
        or differing(terms_in_scene(first), terms_in_scene(second))
    )


def headed_groups(records: Sequence[Cell]) -> list[tuple[str, list[Cell]]]:
    """Groups records that may share a table, snapshot by snapshot, each with a heading."""
    found: list[tuple[str, list[Cell]]] = []
    for snapshot in snapshots_of(records):
        groups = groups_on_equal_terms([r for r in records if r["snapshot"] == snapshot])
        found += zip(headings_of(groups), groups, strict=True)
    return found


def groups_on_equal_terms(
    records: Sequence[Cell], *, one_snapshot: bool = True
) -> list[list[Cell]]:
    """Groups records that may share a table, each group as large as possible.

    A second record of the same method, scene, seed and snapshot begins a group of its own.

    Args:
        records: to be grouped.
        one_snapshot: whether those of a group must be of the same snapshot.
    """
    groups: list[list[Cell]] = []
    for record in records:
        for group in groups:
            try:
                check_equal_terms([*group, record], one_snapshot=one_snapshot)
            except ValueError:
                continue
            group.append(record)
            break
        else:
            groups.append([record])
    return groups


def headings_of(groups: Sequence[Sequence[Cell]]) -> list[str]:
    """Heads the table of each group: the snapshot, and its terms that are not those of the others.

    Args:
        groups: as `groups_on_equal_terms` makes them.
    """
    texts: list[list[str]] = [[] for _ in groups]
    for name, values in _terms_of_groups(groups).items():
        if len({repr(value) for value in values.values()}) > 1:
            for number, value in values.items():
                text = str(value)
                text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
                texts[number].append(f"{name}: {text}")
    headings: list[str] = []
    met: list[str] = []
    for group, parts in zip(groups, texts, strict=True):
        heading = ", ".join([group[0]["snapshot"], *parts])
        met.append(heading)
        if (count := met.count(heading)) > 1:
            heading += f", table {count} on the same terms: it has a record of the same name"
        headings.append(heading)
    return headings


def _terms_of_groups(groups: Sequence[Sequence[Cell]]) -> dict[str, dict[int, object]]:
    """Collects each term's values by the number of the group."""
    found = [terms_of(group[0]) for group in groups]
    names = dict.fromkeys(name for terms in found for name in terms)
    values = {name: {n: terms.get(name) for n, terms in enumerate(found)} for name in names}
    for number, group in enumerate(groups):
        for scene in scenes_of(group):
            first = next(cell for cell in group if cell["scene"] == scene)
            for name, value in terms_in_scene(first).items():
                values.setdefault(f"{name} in {scene}", {})[number] = value
    return values
