"""Videos, frame by frame."""

import io
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from r3jax.formats.errors import FormatError
from r3jax.validation.errors import why_not_imported
from r3jax.validation.images import MAX_PIXELS

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Of files that are taken for videos."""


def is_video(path: Path) -> bool:
    """Returns True for a file whose name is that of a video."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


_AHEAD = 90
"""Gap between requested frames up to which frames are decoded rather than skipped by a seek."""


class Video:
    """A video that is read frame by frame, fastest in order."""

    def __init__(self, path: Path, source: Path | bytes):
        """Opens it and counts its frames without decoding them.

        Args:
            path: its name, for messages.
            source: the file, or what it holds.

        Raises:
            FormatError: PyAV is not installed, or this is no video.
        """
        self._path = path
        self._av = _load_av(path)
        opened = io.BytesIO(source) if isinstance(source, bytes) else str(source)
        try:
            self._container: Any = self._av.open(opened)
            self._stream: Any = self._container.streams.video[0]
            self.size: tuple[int, int] = self._stream.width, self._stream.height
            times = [packet.pts for packet in self._container.demux(self._stream)]
        except Exception as error:  # whatever FFmpeg says of what is no video
            raise FormatError(path, f"the video cannot be read ({error!s:.200})") from None
        if not 0 < self.size[0] * self.size[1] <= MAX_PIXELS:
            raise FormatError(path, f"the video has {self.size[0]} x {self.size[1]} pixels")
        self._times = sorted(time for time in times if time is not None)
        self._next, self._frames = len(self._times), iter(())

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self._times)

    def frame(self, number: int) -> np.ndarray:
        """Decodes a frame, [H, W, 3] uint8.

        Raises:
            FormatError: there is none of this number, or the video is damaged.
        """
        if not 0 <= number < len(self._times):
            raise FormatError(
                self._path, f"the video has {len(self)} frames, but no frame {number}"
            )
        if not self._next <= number < self._next + _AHEAD:
            self._frames = self._from(number)
        try:
            for frame in self._frames:
                if frame.pts is not None and frame.pts >= self._times[number]:
                    self._next = number + 1
                    return self._pixels(frame)
        except FormatError:
            raise
        except Exception as error:
            raise FormatError(self._path, f"frame {number} is damaged ({error!s:.200})") from None
        raise FormatError(self._path, f"the video ends before frame {number}")

    def _from(self, number: int) -> Iterator[Any]:
        """Yields frames, from the last key frame before a frame on."""
        self._container.seek(self._times[number], stream=self._stream)
        yield from self._container.decode(self._stream)

    def _pixels(self, frame: Any) -> np.ndarray:
        if (frame.width, frame.height) != self.size:
            raise FormatError(self._path, f"a frame has {frame.width} x {frame.height} pixels")
        return frame.to_ndarray(format="rgb24")


def _load_av(path: Path) -> ModuleType:
    try:
        import av
    except ImportError as error:
        reason = why_not_imported(error, "av", "videos are decoded by PyAV,", "video")
        raise FormatError(path, reason) from None
    return av
