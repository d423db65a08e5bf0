"""A run as pictures and as a film that browsers play, without a browser.

viser renders in a connected browser only, so matplotlib draws: blocks as squares, the nearest last,
and the path and the cameras over them.

Shape symbols: H W picture size.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

from r3jax.apps.viewer.drawing import (
    QUANTITIES,
    SCORES,
    UNSEEN,
    Known,
    block_colors,
    css_color,
    frustum_segments,
    known_at,
    path_segments,
)
from r3jax.apps.viewer.facts import facts_of_view
from r3jax.apps.viewer.story import Timeline, cut_height, scoring_of, title_of
from r3jax.exploration.taken_views import unit_of
from r3jax.files import check_vacant, make_folder, whole_folder, write_atomic
from r3jax.formats.errors import FormatError
from r3jax.plots import style
from r3jax.runs.reader import Run
from r3jax.validation.errors import why_not_imported

ENCODERS = ("libx264", "libopenh264", "h264_videotoolbox", "mpeg4")
"""Tried in this order: H.264 by three programs, and what every FFmpeg has."""


def load_av() -> ModuleType:
    """Imports PyAV.

    Raises:
        ImportError: it is not installed; the message names the extra.
    """
    try:
        import av
    except ImportError as error:
        raise ImportError(
            why_not_imported(error, "av", "films are written by PyAV,", "viewer")
        ) from None
    return av


WIDTH, HEIGHT = 1280, 720
"""Size of every picture [px]; even numbers, which H.264 wants."""

BUDGET = 200_000
"""Blocks in a picture at most."""

SCENE = (0.0, 0.08, 0.74, 0.80)
"""Position of the map in a picture: left, bottom, width, height, as shares of it."""

_RIGHT, _SIDE = 0.76, 0.22
"""Left edge and width of the column beside it."""

_DPI = 100
_TURN = 24.0
"""Angle by which the film circles the place [deg]."""

_LAST_FOR = 2.0
"""Duration of the last picture [s]."""

_COVER = 1.3
"""Width of a drawn block over its edge: seen at an angle a cube covers more than one side."""

_OUTLINE = 0.8
"""Lightness of the edges of blocks beside that of their faces."""

_TITLES = {
    "renderability": "Renderability R, mean over places that see the voxel",
    "bias": "Angle term b: how near to a direction it was seen from",
    "noise": "Consistency term: do its colors agree?",
    "resolution": "Resolution term: was it seen from close enough?",
    "color": "Mean color of the voxels",
}


class Film:
    """Draws the moments of one run, all from the same place and on the same terms."""

    def __init__(self, run: Run, timeline: Timeline):
        """Frames the last map."""
        self.run, self._timeline = run, timeline
        self._config = scoring_of(run.header)
        self._last = self._known(len(run.rows) - 1)
        centers = self._last.blocks.centers
        self._cut = cut_height(run.rows, centers)
        shown = centers[centers[:, 2] < self._cut]
        positions = np.stack([row.pose[:3, 3] for row in run.rows])
        self._extent = np.concatenate([shown, positions]) if len(shown) else positions

    def still(self, quantity: str, *, from_above: bool) -> bytes:
        """Draws the last map as PNG.

        Args:
            quantity: one of `QUANTITIES`.
            from_above: straight down, or at an angle.
        """
        return self._drawn(self._last, quantity, -90.0, 90.0 if from_above else 48.0)

    def picture(self, step: int, quantity: str = "renderability") -> bytes:
        """Draws the map after one view as PNG; the film circles the place as views go by."""
        share = step / max(len(self.run.rows) - 1, 1)
        return self._drawn(self._known(step), quantity, -90.0 + _TURN * (share - 0.5), 48.0)

    def _known(self, step: int) -> Known:
        return known_at(self._timeline.at(step), self.run.camera, self._config, BUDGET)

    def _drawn(self, known: Known, quantity: str, azimuth: float, elevation: float) -> bytes:
        figure = Figure((WIDTH / _DPI, HEIGHT / _DPI), dpi=_DPI, facecolor="white")
        figure.text(0.016, 0.94, title_of(self.run.header)[:60], fontsize=17, color=style.INK)
        figure.text(0.016, 0.90, _TITLES[quantity], fontsize=11, color=style.MUTED)
        self._draw_scene(figure, known, quantity, azimuth, elevation)
        if quantity != "color":
            _draw_scale(figure)
        self._draw_column(figure, known.moment.step)
        return style.to_png(figure)

    def _draw_scene(
        self, figure: Figure, known: Known, quantity: str, azimuth: float, elevation: float
    ) -> None:
        """Draws blocks, path and frusta, seen along a direction without perspective."""
        across, outward = _view_axes(azimuth, elevation)
        axes = figure.add_axes(SCENE)
        axes.axis("off")
        extent = self._extent @ across
        middle, size = 0.5 * (extent.min(axis=0) + extent.max(axis=0)), np.ptp(extent, axis=0) + 0.2
        room = np.array([SCENE[2] * WIDTH, SCENE[3] * HEIGHT])
        meters = float((size / room).max())  # of a pixel
        axes.set_xlim(middle[0] - 0.5 * meters * room[0], middle[0] + 0.5 * meters * room[0])
        axes.set_ylim(middle[1] - 0.5 * meters * room[1], middle[1] + 0.5 * meters * room[1])
        blocks = known.blocks
        low = np.flatnonzero(blocks.centers[:, 2] < self._cut)
        low = low[np.argsort(blocks.centers[low] @ outward, kind="stable")]  # the nearest last
        colors = block_colors(blocks, known.moment.map_state, known.terms, quantity)[low] / 255.0
        side = 72.0 / _DPI * _COVER * blocks.edge / meters
        axes.scatter(
            *(blocks.centers[low] @ across).T, s=side**2, c=colors, marker="s", linewidths=0.3,
            edgecolors=(_OUTLINE * colors).tolist(),
        )  # fmt: skip
        rows = self.run.rows[: known.moment.step + 1]
        segments, order = path_segments(rows, len(self.run.rows))
        sizes = [0.05 if row.captured else 0.14 for row in rows]
        frusta = [
            frustum_segments(self.run.camera, row.pose, size)
            for row, size in zip(rows, sizes, strict=True)
        ]
        newest = frustum_segments(self.run.camera, rows[-1].pose, 0.45)
        for ends, color, width in (
            (segments, order[:, 0] / 255.0, 2.0),
            (np.concatenate(frusta), style.INK, 0.7),
            (newest, style.INCONSISTENT, 1.8),
        ):
            axes.add_collection(LineCollection(list(ends @ across), colors=color, linewidths=width))

    def _draw_column(self, figure: Figure, step: int) -> None:
        """Draws the photo of a view, its numbers, and mean renderability over the views so far."""
        run = self.run
        photo = style.blank(figure.add_axes((_RIGHT, 0.56, _SIDE, 0.40)))
        photo.imshow(run.images(step)[0])
        number = f"{step + 1} of {len(run.rows)}"
        facts = {unit_of(run.rows)[:-1]: number, **facts_of_view(run.rows[step])}
        for line, (name, value) in enumerate(facts.items()):
            y = 0.52 - 0.031 * line
            figure.text(_RIGHT, y, name, fontsize=10, color=style.MUTED)
            figure.text(_RIGHT + _SIDE, y, value, fontsize=10, color=style.INK, ha="right")
        curve = style.dress(figure.add_axes((_RIGHT + 0.02, 0.07, _SIDE - 0.02, 0.21)))
        curve.set_title("mean renderability over views", fontsize=9, color=style.MUTED, loc="left")
        mean = [r.coverage.mean_renderability for r in run.rows[: step + 1]]
        curve.plot(np.arange(1, step + 2), mean, color=style.ACCENT, linewidth=2.0)
        curve.plot(step + 1, mean[-1], color=style.INCONSISTENT, marker="o")
        curve.set_xlim(0.5, len(run.rows) + 0.5)
        curve.set_ylim(0.0, 1.0)


def _view_axes(azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the right and up of a picture [3, 2], and the direction towards the eye [3].

    Both angles are in degrees.
    """
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.stack([right, np.cross(outward, right)], axis=1), outward


def _draw_scale(figure: Figure) -> None:
    """Draws the colors from 0 to 1, and that of surfaces that no place sees."""
    scale = figure.add_axes((0.016, 0.045, 0.17, 0.016))
    mapped = ScalarMappable(Normalize(0.0, 1.0), SCORES)
    bar = figure.colorbar(mapped, cax=scale, orientation="horizontal", ticks=[0.0, 0.5, 1.0])
    bar.outline.set_visible(False)
    scale.tick_params(labelsize=8, colors=style.MUTED, length=2)
    unseen = Patch(facecolor=css_color(UNSEEN), label="seen from none of the places")
    figure.legend(handles=[unseen], loc=(0.2, 0.03), fontsize=9, frameon=False,
                  labelcolor=style.MUTED)  # fmt: skip


def export_film(
    run: Run,
    out: Path,
    *,
    video: bool,
    on_picture: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Writes pictures of the last map, one picture per view, and a film of them.

    Args:
        run: with at least one view.
        out: a folder that does not exist yet, or is empty. It is complete or not there.
        video: write `run.mp4` too.
        on_picture: called with the number of pictures done and in total.

    Returns:
        What was written: the stills, the folder of the pictures, the film.

    Raises:
        FormatError: `out` is no name of a folder.
        RunError: the run has no view, or a frame is missing or broken.
        ImportError: a film needs PyAV, which is not installed.
        OSError: `out` holds something; the disk is full, not writable, ...
    """
    if "\0" in str(out):
        raise FormatError(Path(repr(out.name)), "this cannot be the name of a folder")
    out = out.absolute()
    check_vacant(out)
    film = Film(run, Timeline(run))
    with whole_folder(out) as partial:
        written = _fill(partial, film, video, on_picture)
    return [out / path.relative_to(partial) for path in written]


def _fill(
    folder: Path, film: Film, video: bool, on_picture: Callable[[int, int], None]
) -> list[Path]:
    stills = [(name, above) for above in (False, True) for name in QUANTITIES]
    num_views = len(film.run.rows)
    total = num_views + len(stills)
    pictures = folder / "views"
    make_folder(pictures)
    for step in range(num_views):
        write_atomic(pictures / f"{step:06d}.png", film.picture(step))
        on_picture(step + 1, total)
    written = [pictures]
    for number, (name, above) in enumerate(stills, start=1):
        path = folder / f"{'above' if above else 'oblique'}-{name}.png"
        write_atomic(path, film.still(name, from_above=above))
        written.append(path)
        on_picture(num_views + number, total)
    if video:
        path = folder / "run.mp4"
        rate = int(np.clip(num_views / 12.0, 2, 12))
        steps = [*range(num_views), *[num_views - 1] * round(_LAST_FOR * rate)]
        _write_video(path, [pictures / f"{step:06d}.png" for step in steps], rate)
        written.append(path)
    return written


def _write_video(path: Path, pictures: Iterable[Path], rate: int) -> None:
    """Writes an MP4 of pictures of `WIDTH` x `HEIGHT`, at a fixed frame rate."""
    av = load_av()
    encoder = next(name for name in ENCODERS if _is_known(name))
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(encoder, rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        if encoder == "libx264":
            stream.options = {"crf": "18"}
        else:
            stream.bit_rate = 4_000_000
        for picture in pictures:
            with Image.open(picture) as image:
                container.mux(stream.encode(av.VideoFrame.from_image(image.convert("RGB"))))
        container.mux(stream.encode(None))


def _is_known(encoder: str) -> bool:
    av = load_av()
    try:
        av.Codec(encoder, "w")
    except ValueError:  # how PyAV says that FFmpeg was built without it
        return False
    return True
