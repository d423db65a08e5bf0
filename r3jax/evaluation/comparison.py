"""Checks which records of the benchmark are comparable, and collects their scores by method.

A record (`Cell`) is one line of `cells.jsonl`: scene x policy x seed at one snapshot of a budget.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from r3jax.errors import InputError

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
