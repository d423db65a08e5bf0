"""Writes the page of a selection: one self-contained HTML file that opens from disk."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from r3jax.apps.select.outputs import Written
from r3jax.apps.select.select import Selected
from r3jax.apps.select.settings import DEFAULT_GAIN, FRAMES, STAND
from r3jax.files import write_atomic
from r3jax.plots import style
from r3jax.plots.page import render
from r3jax.plots.pictures import small_png

_SHOWN = 12
"""Maximum number of thumbnails for a reason."""

_SIDE = 230
"""Longer side of a thumbnail [px]."""

_KNEE = DEFAULT_GAIN
"""Share of the renderability with all frames that defines the knee of the curve."""

_HEADROOM = 0.35
"""Anything higher than this above the cameras is left out of the plan [audit units]."""

_NUMBERED = 40
"""Maximum number of numbered frames, so that the numbers do not overlap."""

_GROUPS = (("blurred", "Blurred"), ("twin", "Near-duplicates of a kept frame"),
           ("adds", "Not chosen, with what each would add"), ("", "Left out"))  # fmt: skip
"""Beginning of a reason, and the heading of its frames; the first match counts."""

_SURFACES = {
    "depth": "Surfaces come from the depth images.",
    "stereo": "Surfaces come from COLMAP's stereo depth maps; where these have holes, the surface "
    "is not known.",
    "sweep": "There are no depth images: depth was computed by comparing the photos with each "
    "other (plane sweep); where they do not agree, the surface is not known.",
    "model": "Surfaces come from the trained splat; parts that two images contradict are not "
    "known.",
    "tracks": "There are no depth images: surfaces are the points of the structure from motion, "
    "each visible in the pictures of its track. Surfaces without points count as not shown.",
    "cloud": "There are no depth images: surfaces are a point cloud, in which nearer points hide "
    "those behind them. Surfaces without points count as not shown.",
}


def write_page(found: Selected, folder: Path, written: Written) -> Path:
    """Writes `selection.html`.

    Args:
        found: the selection.
        folder: an existing folder.
        written: the data set.

    Raises:
        OSError: for example, the disk is full or not writable.
    """
    page = render(
        "apps/select/selection_page.html",
        kind="selection",
        title=f"Frames of {found.source.name} to keep",
        lead=lead(found),
        cards=_cards(found),
        notes=list(found.notes),
        curve=style.to_png(_curve(found)),
        curve_note=_curve_note(found),
        plan=style.to_png(_plan(found)),
        dropped=_dropped(found),
        dropped_note="Shares refer to the mean renderability with all frames.",
        commands=commands(written),
        method=_method(found),
    )
    path = folder / "selection.html"
    write_atomic(path, page.encode())
    return path


def lead(found: Selected) -> list[str]:
    """Summarizes the selection in a sentence."""
    kept, total = len(found.choice.order), len(found.used)
    share = 100.0 * float(found.choice.share[-1])
    verb = "reaches" if kept == 1 else "reach"
    sentence = (
        f"{kept} of {total} frames ({100 * kept / total:.0f} %) {verb} {share:.0f} % of the mean "
        "renderability with all frames."
    )
    return [sentence]


def commands(written: Written) -> list[str]:
    """Writes commands that train on the data set."""
    folder = written.record.parent
    if written.data_set.suffix == ".json":
        return [
            f"ns-train splatfacto --data {folder}",
            f"r3jax train {folder}",
            f"r3jax audit {folder}",
        ]
    return [
        f"python examples/simple_trainer.py default --data_dir {folder} --data_factor 1",
        f"ns-train splatfacto --data {folder} colmap --colmap-path sparse/0",
        f"r3jax audit {folder}",
    ]


def _cards(found: Selected) -> dict[str, str]:
    choice = found.choice
    cards = {
        f"of {len(found.used)} frames kept": str(len(choice.order)),
        "of the mean R with all frames": f"{100 * float(choice.share[-1]):.0f} %",
        "mean R of the targets": f"{float(choice.renderability[-1]):.2f}",
    }
    blurred = int(found.quality.is_blurred.sum())
    if found.quality.is_compared.any():
        cards["frames are blurred"] = str(blurred)
    return cards


def knee(found: Selected) -> int | None:
    """Returns the number of frames that reach 99 % of the mean R with all; None if not reached."""
    reached = np.flatnonzero(found.choice.share >= _KNEE)
    return int(reached[0]) + 1 if len(reached) else None


def _curve_note(found: Selected) -> str:
    number = knee(found)
    if number is None:
        return "The frames kept reach less than 99 % of the mean R with all frames."
    return f"{number} frames reach 99 % of the mean R with all frames."


def _curve(found: Selected) -> Figure:
    """Draws the objective over the number of frames, with its knee and the value of all frames."""
    choice = found.choice
    figure = style.new_figure(10.0, 3.6)
    axes = style.dress(figure.subplots(), x="frames kept", y="mean renderability of the targets")
    number = np.arange(1, len(choice.order) + 1)
    axes.plot(
        np.append(0, number), np.append(0.0, choice.renderability), color=style.ACCENT, linewidth=2
    )
    if len(number) <= _NUMBERED:
        axes.plot(number, choice.renderability, "o", color=style.ACCENT, markersize=4)
    of_all = float(choice.of_all.mean())
    axes.axhline(of_all, color=style.MUTED, linewidth=1, linestyle="--")
    axes.annotate(f"all {len(found.used)} frames", (0, of_all), (4, 4), color=style.MUTED,
                  textcoords="offset points", fontsize=9)  # fmt: skip
    if (at := knee(found)) is not None:
        value = float(choice.renderability[at - 1])
        axes.plot([at], [value], "o", color=style.SECOND, markersize=8)
        axes.annotate(f"{at} frames: 99 %", (at, value), (8, -14), color=style.SECOND,
                      textcoords="offset points", fontsize=9, fontweight="bold")  # fmt: skip
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0, None)
    axes.set_ylim(0, 1.12 * max(of_all, float(choice.renderability.max())))
    return figure


def _plan(found: Selected) -> Figure:
    """Draws voxels from above, and all cameras."""
    alignment, used = found.survey.alignment, found.used
    poses = alignment.poses(found.source.poses[used])
    places, ahead = poses[:, :2, 3], poses[:, :2, 2]
    picture, extent = _from_above(found, float(np.median(poses[:, 2, 3])))
    low = np.minimum(np.array(extent[::2]), places.min(axis=0)) - 0.3
    high = np.maximum(np.array(extent[1::2]), places.max(axis=0)) + 0.3
    aspect = float(np.clip((high[1] - low[1]) / (high[0] - low[0]), 0.25, 1.6))
    figure = style.new_figure(10.0, 0.4 + 9.4 * aspect if aspect < 0.9 else 8.5)
    axes = style.blank(figure.subplots())
    axes.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    order = found.choice.order
    rest = np.setdiff1d(np.arange(len(used)), order)
    for numbers, color, fill in ((rest, style.MUTED, "white"), (order, style.INK, style.ACCENT)):
        axes.quiver(
            *places[numbers].T, *(0.25 * ahead[numbers].T), angles="xy", scale_units="xy",
            scale=1.0, width=0.0022, color=color, headwidth=0, headlength=0, headaxislength=0,
        )  # fmt: skip
        axes.scatter(*places[numbers].T, s=34, facecolors=fill, edgecolors=color, linewidths=0.8,
                     zorder=3)  # fmt: skip
    if len(order) <= _NUMBERED:
        for number, i in enumerate(order.tolist(), start=1):
            axes.annotate(
                str(number), tuple(places[i]), (5, 4), textcoords="offset points", fontsize=8,
                color=style.INK, zorder=4,
                path_effects=[withStroke(linewidth=2.0, foreground="white")],
            )  # fmt: skip
    return figure


def _from_above(
    found: Selected, height: float
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Returns pale colors of the highest voxels below the cut above the cameras, and the extent."""
    state = found.whole
    there = np.asarray(state.occupied)
    center = np.asarray(state.center).T[there]
    color = np.asarray(state.mean).T[there]
    below = center[:, 2] < height + _HEADROOM
    if not below.any():
        below[:] = True
    center, color = center[below], color[below]
    low, high = np.percentile(center[:, :2], [0.5, 99.5], axis=0)
    size = float(state.voxel_size)
    size *= max(1, round(float((high - low).max()) / 600.0 / size))
    low = np.floor(low / size) * size  # align pixels with voxels, so that rounding misses none
    shape = np.maximum(np.ceil((high - low) / size).astype(int), 1)
    order = np.argsort(center[:, 2], kind="stable")  # the highest is painted last
    pixel = np.floor((center[order, :2] - low) / size).astype(int)
    inside = np.all((pixel >= 0) & (pixel < shape), axis=1)
    picture = np.full((shape[1], shape[0], 3), 0.95)
    x, y = pixel[inside].T
    picture[y, x] = 0.45 + 0.55 * color[order][inside].clip(0.0, 1.0)
    end = low + shape * size
    return picture, (float(low[0]), float(end[0]), float(low[1]), float(end[1]))


def _dropped(found: Selected) -> list[dict[str, Any]]:
    """Returns thumbnails of dropped frames by the kind of their reason."""
    groups: list[dict[str, Any]] = []
    left = dict(sorted(found.reasons.items()))
    for begins, title in _GROUPS:
        own = {index: why for index, why in left.items() if why.startswith(begins)}
        left = {index: why for index, why in left.items() if index not in own}
        if not own:
            continue
        shown = [_thumbnail(found, index, why) for index, why in list(own.items())[:_SHOWN]]
        title = f"{title} ({len(own)})"
        groups.append({"title": title, "shown": shown, "more": max(0, len(own) - _SHOWN)})
    return groups


def _thumbnail(found: Selected, index: int, reason: str) -> dict[str, Any]:
    source = found.source
    try:
        rgb, _ = source.read(index)
    except ValueError:  # the reason says why it cannot be read
        rgb = np.full((48, 64, 3), 200, np.uint8)
    up = found.survey.alignment.rotation.T @ [0.0, 0.0, 1.0]
    png = small_png(rgb, source.poses[index], up, _SIDE)
    return {"png": png, "label": source.labels[index], "reason": reason}


def _method(found: Selected) -> list[str]:
    """Explains how the selection was computed, in sentences."""
    settings = found.settings
    targets = {
        FRAMES: f"the capture's own {found.targets} frames",
        STAND: f"{found.targets} views from where people could stand",
    }.get(settings.targets, f"the {found.targets} views of {settings.targets}")
    voxel = found.survey.length(found.survey.voxel_size)
    texts = [
        _SURFACES[found.source.kind],
        f"Targets: {targets}. Each frame is chosen by its gain in their mean renderability R, on "
        "the map of the frames chosen before it (greedy; R of arXiv 2601.07484 from angle, "
        "consistency and resolution).",
        f"Voxels of {voxel:.3g} {found.survey.unit}; images of at most 640 pixels.",
    ]
    if found.source.has_images:
        texts.append(
            "Blur is measured relative to neighbors that show the same surface, and is not known "
            "where all are equally blurred: "
            f"{int(found.quality.is_compared.sum())} of {len(found.used)} "
            "frames could be compared. The resolution of a frame is divided by the width of its "
            "blur. Exposure: a gain for each channel is fitted before colors are compared."
        )
    else:
        texts.append("The pictures are missing: blur and exposure are not known.")
    return texts
