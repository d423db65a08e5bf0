"""The tables of `pool_selection`: means with their intervals, and what `ours` gains."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from r3jax.evaluation.statistics import Estimate, mean_over_scenes, paired_difference

Records = Sequence[Mapping[str, Any]]

_OURS = "ours"
_BY_VIEW = "psnr_by_view"


def result_rows(records: Records) -> list[dict[str, Any]]:
    """A row per scene, seed, policy and snapshot."""
    return [
        {name: record["flight"][name] for name in ("scene", "seed", "policy")}
        | {"views": int(views)}
        | {name: round(value, 4) for name, value in scores.items() if name != _BY_VIEW}
        for record in records
        for views, scores in record["scores"].items()
    ]


def mean_rows(records: Records) -> list[dict[str, Any]]:
    """A row per policy, the best one first: means over scenes and seeds at each snapshot."""
    snapshots = sorted({int(views) for record in records for views in record["scores"]})
    table = []
    for policy in policies_of(records):
        line: dict[str, Any] = {"policy": policy}
        for views in snapshots:
            own = [record["scores"][str(views)] for record in of_policy(records, policy)]
            mean = lambda name, own=own: float(np.mean([scores[name] for scores in own]))
            line[f"PSNR at {views}"] = text_of(mean_over_scenes(by_scene(records, policy, views)))
            line[f"5th percentile at {views}"] = f"{mean('psnr_p5'):.2f}"
            line[f"under 20 dB at {views}"] = f"{100 * mean('poor_share'):.0f} %"
            line[f"SSIM at {views}"] = f"{mean('ssim'):.3f}"
        table.append((mean("psnr"), line))
    return [line for _, line in sorted(table, key=lambda entry: -entry[0])]


def gain_rows(records: Records) -> list[dict[str, Any]]:
    """What `ours` has over each other policy on the same test views [dB]; empty without it."""
    policies = policies_of(records)
    if _OURS not in policies:
        return []
    snapshots = sorted({int(views) for record in records for views in record["scores"]})
    scenes = list(dict.fromkeys(record["flight"]["scene"] for record in records))
    table = []
    for policy in policies:
        if policy == _OURS:
            continue
        line: dict[str, Any] = {"ours minus": policy}
        for views in snapshots:
            ours, its = (by_scene(records, name, views) for name in (_OURS, policy))
            parts = {scene: ([scene], scene) for scene in scenes} if len(scenes) > 1 else {}
            for keys, title in (*parts.values(), (scenes, "all")):
                difference = paired_difference(
                    {scene: ours[scene] for scene in keys}, {scene: its[scene] for scene in keys}
                )
                line[f"{title} at {views}"] = text_of(difference, signed=True)
        table.append(line)
    return table


def policies_of(records: Records) -> list[str]:
    """In the order of their first records."""
    return list(dict.fromkeys(record["flight"]["policy"] for record in records))


def of_policy(records: Records, policy: str) -> list[Mapping[str, Any]]:
    """The records of one policy."""
    return [record for record in records if record["flight"]["policy"] == policy]


def by_scene(records: Records, policy: str, views: int) -> dict[str, np.ndarray]:
    """PSNR [seeds, test views] of a policy's models in each scene, seeds in increasing order."""
    found: dict[str, dict[int, list[float]]] = {}
    for record in of_policy(records, policy):
        flight = record["flight"]
        seeds = found.setdefault(flight["scene"], {})
        seeds[flight["seed"]] = record["scores"][str(views)][_BY_VIEW]
    return {
        scene: np.array([seeds[seed] for seed in sorted(seeds)], dtype=np.float64)
        for scene, seeds in found.items()
    }


def text_of(estimate: Estimate, *, signed: bool = False) -> str:
    """A number with its interval, two digits."""
    sign = "+" if signed else ""
    value, low, high = (f"{x:{sign}.2f}" for x in (estimate.value, estimate.low, estimate.high))
    return f"{value} [{low}, {high}]"
