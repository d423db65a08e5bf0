"""Draws the places where an audit suggests pictures, from the side: does a person stand there?

    python -m docs.figures.standing runs/audit/kitchen docs/images/standing.png

One panel for each suggested picture: the surfaces within half a body's width of the plane through
the person, along the heading of the camera. It reads nothing but the folder of the audit.
"""

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.patches import Rectangle

from r3jax.formats.points import read_points
from r3jax.plots import style

SLICE, SIDE = 0.25, 2.0
"""Half the thickness of what is shown, and how far to both sides [m]."""

SHIN, HEAD, SHOULDERS = 0.25, 1.8, 0.25
"""The body that must meet nothing [m]."""


def main(folder: Path, out: Path) -> None:
    """Draws a panel for each suggested picture."""
    record = json.loads((folder / "audit.json").read_text())
    moved = record["alignment"]
    R, scale, origin = (np.array(moved[name]) for name in ("rotation", "scale", "origin"))
    upright = lambda points: scale * (np.asarray(points) - origin) @ R.T
    xyz, _ = read_points(folder / "causes.ply")
    centers = upright(xyz)
    views = record["suggested"]
    columns = 5
    figure = style.new_figure(12.0, 2.6 * -(-len(views) // columns))
    grid = figure.subplots(-(-len(views) // columns), columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(views) :]:
        axes.axis("off")
    for number, (axes, view) in enumerate(zip(grid.flat, views, strict=False), start=1):
        pose = np.array(view["camera_to_world_opengl"])
        eye, ahead = upright(pose[None, :3, 3])[0], -R @ pose[:3, 2]
        level = ahead[:2] / max(float(np.hypot(*ahead[:2])), 1e-9)
        feet = eye * [1, 1, 0] if view["stand_at"] is None else upright([view["stand_at"]])[0]
        offset = centers - feet
        aside = np.abs(offset[:, :2] @ [-level[1], level[0]])
        along = offset[:, :2] @ level
        near = (aside <= SLICE) & (np.abs(along) <= SIDE)
        style.dress(
            axes, f"{number}" + (", at arm's length" if view["held_out_over_something"] else "")
        )
        axes.scatter(along[near], offset[near, 2], s=5, marker="s", color="#6b7280", linewidths=0)
        axes.add_patch(
            Rectangle(
                (-SHOULDERS, SHIN), 2 * SHOULDERS, HEAD - SHIN, facecolor="#0ea5e9", alpha=0.3
            )
        )
        x, z = float((eye - feet)[:2] @ level), float(eye[2] - feet[2])
        reach = 0.6 * np.array([np.hypot(*ahead[:2]), ahead[2]])
        axes.annotate("", (x + reach[0], z + reach[1]), (x, z),
                      arrowprops={"arrowstyle": "-|>", "color": "#b91c1c"})  # fmt: skip
        axes.plot(x, z, "o", color="#b91c1c", markersize=5)
        axes.set_xlim(-SIDE, SIDE)
        axes.set_ylim(-0.3, 2.6)
        axes.set_aspect("equal")
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
