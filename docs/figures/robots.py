"""Plans of the paths of robots, before and after they had a footprint, and the table of them all.

python -m experiments.robots --settings before --out experiments/results/robots/drives.jsonl
python -m experiments.robots --out experiments/results/robots/drives.jsonl
python -m docs.figures.robots
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from experiments.robots import PIXEL, Robot, plan_of, scene_world

RESULTS = Path("experiments/results/robots/drives.jsonl")
IMAGE = Path("docs/images/robots.png")
SHOWN = ({"height": 0.3}, {"height": 0.9, "tilt": -20.0})


def rows() -> list[dict]:
    """All drives."""
    return [json.loads(line) for line in RESULTS.read_text().splitlines()]


def table(found: list[dict]) -> str:
    """One line for each robot: what it visited of each scene, before and after."""
    scenes = sorted({row["scene"] for row in found})
    key = lambda row: json.dumps(row["robot"], sort_keys=True)
    by = {(key(row), row["scene"], row["settings"]): row for row in found}
    lines = ["| camera: height, tilt, lens | body | " + " | ".join(scenes) + " |",
             "|---" * (len(scenes) + 2) + "|"]  # fmt: skip
    order = {key(row): Robot(**row["robot"]) for row in found}
    for name, robot in sorted(
        order.items(), key=lambda item: (item[1].height, item[1].tilt, item[1].lens)
    ):
        cells = []
        for scene in scenes:
            pair = [by.get((name, scene, which)) for which in ("before", "after")]
            cells.append(" → ".join("·" if row is None else _cell(row) for row in pair))
        body = "to the floor" if robot.body is None else f"{robot.body:g} m down"
        label = f"{robot.height:g} m, {robot.tilt:+.0f}°, {robot.lens}°"
        lines.append(f"| {label} | {body} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(row: dict) -> str:
    mark = " **touches**" if row["collides"] else ""
    shut = " shut in" if row["outcome"] == "shut-in" else ""
    return f"{100 * row['visited']:.0f} %{shut}{mark}"


def main() -> None:
    """Draws the plans of some robots, and prints the table."""
    found = rows()
    scenes = [
        name for name in ("flat", "office", "house") if any(r["scene"] == name for r in found)
    ]
    size = 4.6 * len(scenes), 3.1 * len(SHOWN)
    figure, axes = plt.subplots(len(SHOWN), len(scenes), figsize=size, squeeze=False)
    for column, scene in enumerate(scenes):
        world = scene_world(scene)
        for line, change in enumerate(SHOWN):
            robot, axis = Robot(**change), axes[line, column]
            plan = plan_of(world, 0.0, robot.low, robot.height)
            mine = [r for r in found if r["scene"] == scene and Robot(**r["robot"]) == robot]
            reach = plan.reachable(robot.footprint, np.array(mine[0]["track"][0])) if mine else None
            low, size = plan.origin, np.array(plan.distance.shape) * PIXEL
            extent = (low[0], low[0] + size[0], low[1], low[1] + size[1])
            image = np.where(plan.distance <= 0.0, 0.25, 1.0)
            if reach is not None:
                image = np.where(reach, 0.86, image)
            axis.imshow(image.T, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1)
            for which, color in (("after", "#1f77b4"), ("before", "#d62728")):
                for row in (r for r in mine if r["settings"] == which):
                    track = np.array(row["track"])
                    axis.plot(track[:, 0], track[:, 1], color=color, lw=0.9, label=which)
                    if row["views"]:
                        views = np.array(row["views"])
                        axis.plot(views[:, 0], views[:, 1], "o", color=color, ms=2.5)
            axis.set_title(f"{scene}: camera at {robot.height:g} m, {robot.tilt:+.0f}°", fontsize=9)
            axis.set_xticks([]), axis.set_yticks([])
    names = {"after": "with a footprint", "before": "ball of free cells"}
    handles = {names[line.get_label()]: line for axis in axes.flat for line in axis.get_lines()
               if line.get_label() in names}  # fmt: skip
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=2, fontsize=9)
    figure.tight_layout(rect=(0.0, 0.04, 1.0, 1.0))
    figure.savefig(IMAGE, dpi=90)
    print(table(found))


if __name__ == "__main__":
    main()
