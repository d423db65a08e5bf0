"""A run as pictures and as a film that browsers play, without a browser.

Shape symbols: n blocks; H W picture size.
"""

import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image

from r3jax.apps.viewer.blocks import (
    QUANTITIES,
    Known,
    block_colors,
    cut_height,
    known_at,
    scoring_of,
)
from r3jax.apps.viewer.overlays import frustum_segments, path_segments
from r3jax.apps.viewer.stills import Sheet, Squares, compose, draw, lines, overview
from r3jax.apps.viewer.story import Timeline
from r3jax.files import check_vacant, make_folder, whole_folder, write_atomic
from r3jax.formats.errors import FormatError
from r3jax.trace.reader import Run
from r3jax.validation.packages import why_not_imported

ENCODERS = ("libx264", "libopenh264", "h264_videotoolbox", "mpeg4")
"""Tried in this order: H.264 by three programs, and what every FFmpeg has."""


def write_video(path: Path, pictures: Iterable[np.ndarray], rate: int) -> str:
    """Writes an MP4.

    Args:
        path: the file.
        pictures: [H, W, 3] uint8 each, of one size; H and W even.
        rate: pictures a second.

    Returns:
        The encoder that was used.

    Raises:
        ImportError: PyAV is not installed; the message names the extra.
        ValueError: no picture, or odd sizes.
        OSError: the disk is full, not writable, ...
    """
    av = load_av()
    name = next(encoder for encoder in ENCODERS if _is_known(encoder))
    stream = None
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        for picture in pictures:
            height, width = picture.shape[:2]
            if stream is None:
                if width % 2 or height % 2:
                    raise ValueError(f"a film needs even sizes, got {width} x {height}")
                stream = container.add_stream(name, rate=rate)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                if name == "libx264":
                    stream.options = {"crf": "18"}
                else:
                    stream.bit_rate = 4_000_000
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        if stream is None:
            raise ValueError("a film needs at least one picture")
        container.mux(stream.encode(None))
    return name


def load_av() -> ModuleType:
    """PyAV.

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


def _is_known(encoder: str) -> bool:
    av = load_av()
    try:
        av.Codec(encoder, "w")
    except ValueError:  # how PyAV says that FFmpeg was built without it
        return False
    return True


WIDTH, HEIGHT = 1280, 720
"""Size of every picture [px]; even numbers, which H.264 wants."""

BUDGET = 400_000
"""Blocks in a picture at most."""

_TURN = 24.0
"""How far the film's camera goes round the place [deg]."""

_LAST_FOR = 2.0
"""How long the film stays on its last picture [s]."""

_INK = np.array((31, 41, 55), np.uint8)
_NOW = np.array((220, 38, 38), np.uint8)


class Film:
    """Draws the moments of one run, all from the same place and on the same terms."""

    def __init__(self, run: Run, timeline: Timeline):
        """Places the camera by the last map."""
        self.run, self._timeline = run, timeline
        self._config = scoring_of(run.header)
        self._last = self._known(len(run.rows) - 1)
        centers = self._last.blocks.centers
        self._cut = cut_height(run.rows, centers)
        shown = centers[centers[:, 2] < self._cut]
        positions = np.stack([row.pose[:3, 3] for row in run.rows])
        self._extent = np.concatenate([shown, positions]) if len(shown) else positions

    def still(self, quantity: str, *, from_above: bool) -> np.ndarray:
        """The last map, [H, W, 3] uint8.

        Args:
            quantity: one of `QUANTITIES`.
            from_above: straight down, or at an angle.
        """
        elevation = 89.0 if from_above else 48.0
        picture = self._scene(self._last, quantity, elevation=elevation, azimuth=-90.0, fine=2)
        return compose(picture, self._sheet(self._last.moment.step, quantity))

    def picture(self, step: int, quantity: str = "renderability") -> np.ndarray:
        """The map after one view, [H, W, 3] uint8; the camera goes round as views go by."""
        known = self._known(step)
        share = step / max(len(self.run.rows) - 1, 1)
        azimuth = -90.0 + _TURN * (share - 0.5)
        picture = self._scene(known, quantity, elevation=48.0, azimuth=azimuth, fine=1)
        return compose(picture, self._sheet(step, quantity))

    def _known(self, step: int) -> Known:
        return known_at(self._timeline.at(step), self.run.camera, self._config, BUDGET)

    def _scene(
        self, known: Known, quantity: str, *, elevation: float, azimuth: float, fine: int
    ) -> np.ndarray:
        """Blocks, path and frusta; drawn `fine` times as large and made smaller again."""
        width, height = fine * Sheet.scene_width(WIDTH), fine * HEIGHT
        narrow = 12.0 if elevation > 80.0 else 32.0  # from above, walls should not lean
        camera, pose = overview(self._extent, width, height, azimuth, elevation, narrow)
        blocks, step = known.blocks, known.moment.step
        colors = block_colors(blocks, known.moment.map_state, known.terms, quantity)
        low = blocks.centers[:, 2] < self._cut
        layers = [Squares(blocks.centers[low], colors[low], blocks.edge)]
        layers += self._lines(step, least=2.0 * fine)
        picture = draw(camera, pose, layers)
        image = Image.fromarray(picture)
        return np.asarray(image.resize((width // fine, HEIGHT), Image.Resampling.BOX))

    def _lines(self, step: int, least: float) -> list[Squares]:
        """The path so far, the views along it, and the newest one larger."""
        rows = self.run.rows[: step + 1]
        segments, colors = path_segments(rows, len(self.run.rows))
        frusta = [
            frustum_segments(self.run.camera, row.pose, 0.05 if row.captured else 0.14)
            for row in rows
        ]
        newest = frustum_segments(self.run.camera, rows[-1].pose, 0.45)
        return [
            lines(segments, colors[:, 0], 0.02, 1.5 * least),
            lines(np.concatenate(frusta), _INK, 0.006, 0.6 * least),
            lines(newest, _NOW, 0.02, 1.2 * least, lift=0.3),
        ]

    def _sheet(self, step: int, quantity: str) -> Sheet:
        image, _ = self.run.images(step)
        return Sheet.of_run(self.run, step, image, quantity)


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
        on_picture: told how many pictures are done, and how many there will be.

    Returns:
        What was written: the stills, the folder of the pictures, the film.

    Raises:
        FormatError: `out` is no name of a folder.
        RunError: the run has no view, or a frame is missing or broken.
        ImportError: a film is asked for, and PyAV is not installed.
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
        _save(pictures / f"{step:06d}.png", film.picture(step))
        on_picture(step + 1, total)
    written = [pictures]
    for number, (name, above) in enumerate(stills, start=1):
        path = folder / f"{'above' if above else 'oblique'}-{name}.png"
        _save(path, film.still(name, from_above=above))
        written.append(path)
        on_picture(num_views + number, total)
    if video:
        path = folder / "run.mp4"
        rate = int(np.clip(num_views / 12.0, 2, 12))
        write_video(path, _read_back(pictures, num_views, round(_LAST_FOR * rate)), rate)
        written.append(path)
    return written


def _save(path: Path, picture: np.ndarray) -> None:
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "png", compress_level=6)
    write_atomic(path, data.getvalue())


def _read_back(folder: Path, num_views: int, last_for: int) -> Iterator[np.ndarray]:
    """The pictures in order; the last one stays for a while."""
    for step in [*range(num_views), *[num_views - 1] * last_for]:
        yield np.asarray(Image.open(folder / f"{step:06d}.png").convert("RGB"))
