"""Collects scores of comparable benchmark records by method, with means, differences and intervals.

A record (`Cell`) is one line of `cells.jsonl`: scene x policy x seed at one snapshot of a budget.

Intervals are percentile bootstraps (Efron 1979) at 95 %. Scenes are the fixed set that a table
names: views and seeds are resampled, scenes never.

Shape symbols used throughout:
    S  seeds      V  test views of a scene      R  resamples
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from r3jax.errors import InputError

RESAMPLES = 1000
"""Default number of draws for an interval."""

LEVEL = (2.5, 97.5)
"""Percentiles of the resamples that bound an interval."""

Scores = Mapping[str, np.ndarray]
"""Per scene the values [S, V] of one method: row by seed, column by view of the scene's test set,
the same views in the same order for all methods."""


@dataclass(frozen=True)
class Estimate:
    """An estimate from a sample, with its interval."""

    value: float
    """Value of the sample itself; NaN where it is not defined (a constant column, ...)."""

    low: float
    """Lower end of the 95 % interval."""

    high: float
    """Upper end of the 95 % interval."""

    count: int
    """Views (pairs of values) that entered."""


Cell = Mapping[str, Any]
"""One record: the parsed JSON object."""

POLICIES = (
    "random", "frontier", "cover", "gavis", "active-gamer", "gauss-mi", "fisherrf", "active-gs",
    "active-gs-online", "r3con", "r3", "r3-pano", "r3-ahead",
)  # fmt: skip
"""Order of rows in tables and legends: baselines first, `r3` and its variants last."""


def method_name(cell: Cell) -> str:
    """Names a policy with its settings: `active-gs`, `r3 (lambda1=0.3)`."""
    settings = ", ".join(f"{name}={value}" for name, value in sorted(cell["settings"].items()))
    return f"{cell['policy']} ({settings})" if settings else cell["policy"]


def policy_of(method: str) -> str:
    """Returns the policy of a method, as `method_name` writes it."""
    return method.partition(" (")[0]


def shared_settings(cells: Sequence[Cell]) -> dict[str, Any]:
    """Returns the settings that all records have in common, by name."""
    first = cells[0]["settings"]
    missing = object()
    return {
        name: value
        for name, value in sorted(first.items())
        if all(cell["settings"].get(name, missing) == value for cell in cells)
    }


def with_short_names(cells: Sequence[Cell]) -> list[Cell]:
    """Shortens the names in records as far as they stay distinct.

    Settings that all share leave the methods' names, and a scene from a file is called by the
    file's name without folder and suffix, unless two scenes would then be called the same.
    """
    shared = shared_settings(cells)
    titles = {scene: scene_title(scene) for scene in scenes_of(cells)}
    if len(set(titles.values())) < len(titles):
        titles = {scene: scene for scene in titles}
    return [
        {
            **cell,
            "scene": titles[cell["scene"]],
            "settings": {k: v for k, v in cell["settings"].items() if k not in shared},
        }
        for cell in cells
    ]


def scene_title(scene: str) -> str:
    """Returns the name of a scene; of a file, without its folder and suffix."""
    kind, colon, path = scene.partition(":")
    return PurePath(path).stem if colon and kind == "mesh" else scene


def check_equal_terms(cells: Sequence[Cell], *, one_snapshot: bool = True) -> None:
    """Refuses records that were not made on equal terms.

    All must share the format, the clock, the resolutions of exploration and test views, the sensor
    and the size of voxels and cells, the network of LPIPS, and all settings of training but its
    seed; those of one scene also the scene itself and its test
    views; and each scene, method, seed and snapshot may occur once.

    Args:
        cells: to stand in one table or figure.
        one_snapshot: whether they must also be of the same snapshot.

    Raises:
        ValueError: there are no records, or two of them differ; names both and what differs.
    """
    if not cells:
        raise InputError("there are no records")
    _check_same(cells, terms_of, () if one_snapshot else ("the snapshot",))
    for scene in scenes_of(cells):
        _check_same([cell for cell in cells if cell["scene"] == scene], terms_in_scene)
    seen: set[str] = set()
    for cell in cells:
        if (name := _describe(cell)) in seen:
            raise InputError(f"{name} occurs twice: leave one of the records out")
        seen.add(name)


def terms_of(cell: Cell) -> dict[str, object]:
    """Lists the terms of a record that a table's must share, by the names that errors use."""
    sensing, training = (dict(sorted(cell[name].items())) for name in ("sensing", "training"))
    training.pop("seed", None)
    return {
        "the format": cell["format"],
        "the clock": cell["clock"],
        "the resolution of exploration": cell["resolution"],
        "the resolution of the test views": cell["test_views"]["resolution"],
        "the network of LPIPS": cell["lpips_network"],
        **{f"the exploration's {name}": value for name, value in sensing.items()},
        "the snapshot": cell["snapshot"],
        **{f"training {name}": value for name, value in training.items()},
    }


def terms_in_scene(cell: Cell) -> dict[str, object]:
    """Returns the terms that only records of one scene must share."""
    return {
        "the scene's hash": cell["scene_hash"],
        "the hash of the test views": cell["test_views"]["hash"],
        "the list of test views": list(cell["views"]["view"]),
    }


def differing(first: Mapping[str, object], other: Mapping[str, object]) -> list[str]:
    """Lists the terms that are not the same; one missing from an old record counts as None."""
    names = dict.fromkeys((*first, *other))
    return [name for name in names if first.get(name) != other.get(name)]


def _check_same(
    cells: Sequence[Cell],
    terms: Callable[[Cell], Mapping[str, object]],
    left_out: Sequence[str] = (),
) -> None:
    first = terms(cells[0])
    for cell in cells[1:]:
        other = terms(cell)
        for name in differing(first, other):
            if name not in left_out:
                raise InputError(
                    f"records cannot be compared: {name} is {_short(first.get(name))} for "
                    f"{_describe(cells[0])}, but {_short(other.get(name))} for {_describe(cell)}. "
                    "Make one table for each, or run the cells again on equal terms."
                )


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _describe(cell: Cell) -> str:
    return f"{cell['scene']}, {method_name(cell)}, seed {cell['seed']}, {cell['snapshot']}"


def scenes_of(cells: Sequence[Cell]) -> list[str]:
    """Lists the scenes in alphabetical order."""
    return sorted({cell["scene"] for cell in cells})


def methods_of(cells: Sequence[Cell]) -> list[str]:
    """Lists the methods in the order of tables, whatever the order of the records.

    Policies have the order of `POLICIES`, unknown ones first; their settings are in alphabetical
    order.
    """
    known = {policy: rank for rank, policy in enumerate(POLICIES)}
    names = {method_name(cell) for cell in cells}
    methods = {name: known.get(policy_of(name), -1) for name in names}
    return sorted(methods, key=lambda method: (methods[method], method))


def snapshots_of(cells: Sequence[Cell]) -> list[str]:
    """Lists the snapshots (`views:30`, `seconds:120.5`, ...) by kind and size."""

    def key(snapshot: str) -> tuple[str, float]:
        kind, _, size = snapshot.partition(":")
        return kind, float(size)

    return sorted({cell["snapshot"] for cell in cells}, key=key)


def view_values(cell: Cell, metric: str) -> np.ndarray | None:
    """Returns one column of the record's test views, [V], with NaN for null.

    Returns None if the whole column is null.
    """
    column = cell["views"].get(metric)
    return None if column is None else np.array(column, dtype=np.float64)


def scores_by_method(cells: Sequence[Cell], metric: str) -> dict[str, dict[str, np.ndarray]]:
    """Collects a metric's values by method and scene, [seeds, views], seeds ascending.

    Records without the metric are left out, and so are scenes and methods without records.

    Args:
        cells: of one snapshot, checked by `check_equal_terms`.
        metric: column of `views`: psnr, psnr_measured, ssim, lpips.
    """
    rows: dict[str, dict[str, list[np.ndarray]]] = defaultdict(lambda: defaultdict(list))
    for cell in sorted(cells, key=lambda cell: cell["seed"]):
        values = view_values(cell, metric)
        if values is not None and not np.isnan(values).all():
            rows[method_name(cell)][cell["scene"]].append(values)
    return {
        method: {scene: np.stack(found) for scene, found in scenes.items()}
        for method, scenes in rows.items()
    }


def seeds_by_method(cells: Sequence[Cell]) -> dict[str, dict[str, list[int]]]:
    """Collects the seeds by method and scene, ascending; an empty list where there are none."""
    scenes = scenes_of(cells)
    seeds: dict[str, dict[str, list[int]]] = {
        method: {scene: [] for scene in scenes} for method in methods_of(cells)
    }
    for cell in sorted(cells, key=lambda cell: cell["seed"]):
        known = seeds[method_name(cell)][cell["scene"]]
        if cell["seed"] not in known:  # it has other snapshots too
            known.append(cell["seed"])
    return seeds


def mean_over_scenes(scores: Scores, *, seed: int = 0, resamples: int = RESAMPLES) -> Estimate:
    """Computes the mean over scenes, seeds and views, with a hierarchical interval.

    Every scene weighs the same, whatever its number of views. A resample draws, in each scene, its
    seeds and (independently) its views with replacement; all drawn seeds share the same drawn
    views, as in truth (the pigeonhole bootstrap, Owen 2007, over rows and columns). With few seeds
    the interval is too narrow: it includes (S - 1) / S of the variance of seeds, and none of it
    with one seed.

    Args:
        scores: per scene [S, V]. Views that are NaN for all seeds do not count.
        seed: of the bootstrap.
        resamples: R.

    Raises:
        ValueError: no scene, a scene without values, or a view that only some seeds have.
    """
    if not scores:
        raise InputError("there is no scene to average over")
    rng = np.random.default_rng(seed)
    means: list[float] = []
    drawn, count = np.zeros(resamples), 0
    for scene in sorted(scores):  # so that the order of the mapping does not matter
        values = _known_views(scene, scores[scene])
        num_seeds, num_views = values.shape
        # How often a resample holds each seed and each view, as weights: [R, S] and [R, V].
        seeds = rng.multinomial(num_seeds, np.full(num_seeds, 1 / num_seeds), resamples)
        views = rng.multinomial(num_views, np.full(num_views, 1 / num_views), resamples)
        drawn += ((seeds @ values) * views).sum(axis=1) / values.size / len(scores)
        means.append(values.mean())
        count += num_views
    low, high = np.percentile(drawn, LEVEL)
    return Estimate(float(np.mean(means)), float(low), float(high), count)


def paired_difference(
    first: Scores, second: Scores, *, seed: int = 0, resamples: int = RESAMPLES
) -> Estimate:
    """Computes the first minus second, as `mean_over_scenes` of the differences view by view.

    All methods are evaluated on the same test views, so that differences in difficulty cancel and
    the interval is much narrower than that of either mean. Seeds are paired row by row.

    Raises:
        ValueError: other scenes, seeds or views in one than in the other.
    """
    if set(first) != set(second):
        raise InputError(f"the methods were run in {sorted(first)} and in {sorted(second)}")
    for scene in first:
        if first[scene].shape != second[scene].shape:
            raise InputError(
                f"{scene}: [seeds, views] is {first[scene].shape} for one method and "
                f"{second[scene].shape} for the other; compare the seeds and views both have"
            )
    differences = {scene: first[scene] - second[scene] for scene in first}
    return mean_over_scenes(differences, seed=seed, resamples=resamples)


def _known_views(scene: str, values: np.ndarray) -> np.ndarray:
    unknown = np.isnan(values)
    if values.ndim != 2 or unknown.all():
        raise InputError(f"{scene}: needs values [seeds, views], got shape {values.shape}")
    if np.any(unknown.any(axis=0) != unknown.all(axis=0)):
        raise InputError(f"{scene}: a view has a value for some seeds only")
    return values[:, ~unknown.any(axis=0)]
