"""Pictures as a film that browsers play."""

from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

import numpy as np

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
    except ImportError:
        raise ImportError(
            "films are written by PyAV, which is not installed: pip install 'r3jax[viewer]'"
        ) from None
    return av


def _is_known(encoder: str) -> bool:
    av = load_av()
    try:
        av.Codec(encoder, "w")
    except ValueError:  # how PyAV says that FFmpeg was built without it
        return False
    return True
