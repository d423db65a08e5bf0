"""A recording, frame by frame: how well would the map have rendered each frame beforehand?"""

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import numpy as np
from matplotlib.figure import Figure

from r3jax.exploration.config import check_voxel_size
from r3jax.formats.posed_images import PosedImages
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.plots import style
from r3jax.scoring.renderability import renderability


@dataclass(frozen=True)
class FrameReport:
    """One frame of a recording."""

    index: int

    renderability: float
    """Mean over the frame's view, from the map before the frame joined it."""

    new_voxels: int
    """Voxels that the frame added."""

    voxels: int
    """Voxels of the map afterwards."""

    metres: float
    """Path of the camera so far [m]."""


def follow_recording(
    recording: PosedImages, *, voxel_size: float = 0.05, max_range: float = 5.0
) -> Iterator[tuple[FrameReport, MapState]]:
    """Integrates a recording and says of each frame how well it was known before.

    Args:
        recording: what to follow.
        voxel_size: edge of a voxel [m].
        max_range: depth beyond it is ignored [m].

    Yields:
        The report of a frame, and the map after it.

    Raises:
        ValueError: voxels that are no size, or larger than a fifth of the range.
    """
    check_voxel_size(voxel_size, max_range)
    score = jax.jit(renderability)
    state = empty_map(voxel_size=voxel_size)
    metres = 0.0
    for index, frame in enumerate(recording.frames()):
        before = float(score(state, frame.camera, frame.T_world_camera))
        known = int(state.num_occupied)
        state = integrate_growing(state, frame, max_range)
        if index > 0:
            step = recording.poses[index, :3, 3] - recording.poses[index - 1, :3, 3]
            metres += float(np.linalg.norm(step))
        voxels = int(state.num_occupied)
        yield FrameReport(index, before, voxels - known, voxels, metres), state


def revisit_figure(recording: PosedImages, reports: list[FrameReport]) -> Figure:
    """Returns the renderability before integration along the recording, and the path from above."""
    figure = style.new_figure(11.0, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1.0])
    index = np.array([report.index for report in reports])
    before = np.array([report.renderability for report in reports])
    new = np.array([report.new_voxels for report in reports])
    style.dress(left, "Renderability of each frame before it is mapped", "frame", "renderability")
    left.plot(index, before, color=style.ACCENT, linewidth=2.0, marker="o", markersize=3.5)
    left.fill_between(index, before, color=style.ACCENT, alpha=0.12, linewidth=0)
    left.set_ylim(0.0, 1.0)
    beside = left.twinx()
    beside.bar(index, new, color=style.SECOND, alpha=0.35, width=0.7)
    beside.set_ylabel("new voxels (bars)", fontsize=9, color=style.SECOND)
    beside.tick_params(labelsize=8, colors=style.MUTED, length=3)
    beside.set_ylim(0.0, 2.5 * max(1, int(new.max())))
    for side, spine in beside.spines.items():
        spine.set_visible(side == "right")
        spine.set_color("#9ca3af")
    style.dress(right, "Path from above", "x [m]", "y [m]")
    right.set_aspect("equal", adjustable="datalim")
    path = recording.poses[:, :3, 3]
    right.plot(path[:, 0], path[:, 1], color="#cbd5e1", linewidth=1.5, zorder=1)
    dots = right.scatter(
        path[: len(before), 0],
        path[: len(before), 1],
        c=before,
        cmap=style.SCORE_MAP,
        vmin=0.0,
        vmax=1.0,
        s=42,
        edgecolors=style.INK,
        linewidths=0.5,
        zorder=2,
    )
    right.annotate("start", path[0, :2], xytext=(6, 6), textcoords="offset points", fontsize=9)
    style.color_bar(figure, dots, right, "renderability", shrink=0.8)
    return figure
