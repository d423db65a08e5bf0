"""Images that lie elsewhere than a capture's file says.

Programs that train splats keep the originals in `input` and smaller copies in `images_2`,
`images_4` and `images_8`; others leave them beside the model.
"""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from r3jax.formats.lenses import Lens
from r3jax.formats.posed_images import IMAGE_FORMATS
from r3jax.validation.errors import ForeignFileError
from r3jax.validation.images import first_size

COPIES = ("_2", "_4", "_8")
"""What the names of folders of smaller copies end with."""

FOLDERS = ("images", "input", *(f"images{copy}" for copy in COPIES), ".")
"""Where images lie, beside a model or above it."""


def find_images(places: Iterable[Path], names: Mapping[str, Lens]) -> Path | None:
    """Finds the folder that holds most of the images; None: none of them is anywhere.

    Args:
        places: folders that hold it, under one of the usual names; the first goes first.
        names: of the images, and the lens of each. Images of another shape than their lenses' were
            undistorted since, and go last.
    """
    best, most = None, (False, 0)
    for folder in (place / name for place in places for name in FOLDERS):
        # os.path: a name of a foreign file may be longer than a file's can be.
        there = [name for name in names if os.path.isfile(folder / name)]
        if there and (found := (_fits(folder, there, names), len(there))) > most:
            best, most = folder, found
    return best


def _fits(folder: Path, there: list[str], names: Mapping[str, Lens]) -> bool:
    """True if the first image that can be opened has the shape of its lens."""
    with suppress(ForeignFileError, OSError):
        size = first_size((folder / name for name in there), IMAGE_FORMATS)
        return names[there[0]].has_shape(*size)
    return False
