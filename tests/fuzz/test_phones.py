"""Exports of phone apps and ScanNet's scenes with damaged poses, cameras, images and archives.

All 2,000 cases of each: `pytest -m slow tests/fuzz/test_phones.py`.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from r3jax.formats.errors import FormatError
from r3jax.formats.phones.arkit_scenes import read_arkit_scenes
from r3jax.formats.phones.polycam import read_polycam
from r3jax.formats.phones.record3d import read_record3d
from r3jax.formats.phones.stray_scanner import read_stray_scanner
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.sequences.scannet import read_scannet
from r3jax.formats.sequences.scannet_sens import read_sens
from tests.formats import phones
from tests.fuzz import mutate
from tests.fuzz.containers import zipped
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.test_sequences import checked
from tests.fuzz.tree import Entry, Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 50
"""Of each, in the normal suite."""


def of_folder(make: Callable[[], dict[str, bytes]], read: Callable[[Path], PosedImages]) -> Reader:
    """The reader of a folder, as the app writes it."""
    return Reader(lambda: [make()], checked(read), (FormatError,))


def of_archive(
    make: Callable[[], dict[str, bytes]], read: Callable[[Path], PosedImages], name: str
) -> Reader:
    """The same in an archive: half of the cases damage a member, the others the archive."""

    def damaged(rng: np.random.Generator, files: Files) -> tuple[dict[str, Entry], str]:
        if rng.random() < 0.5:
            return mutate.mutate(rng, files)
        members, what = mutate.mutate(rng, make())
        plain = {key: data for key, data in members.items() if isinstance(data, bytes)}
        return {name: zipped(plain)}, what

    return Reader(
        lambda: [{name: zipped(make())}],
        checked(lambda folder: read(folder / name)),
        (FormatError,),
        make=damaged,
    )


POLYCAM = of_folder(phones.polycam, read_polycam)
POLYCAM_ZIP = of_archive(phones.polycam, read_polycam, "scan.zip")
RECORD3D = of_folder(phones.record3d, read_record3d)
RECORD3D_ARCHIVE = of_archive(phones.record3d, read_record3d, "scan.r3d")
RECORD3D_EXPORT = of_folder(phones.record3d_export, read_record3d)
STRAY_SCANNER = of_folder(phones.stray_scanner, read_stray_scanner)
ARKIT_SCENES = of_folder(phones.arkit_scenes, read_arkit_scenes)
SCANNET = of_folder(phones.scannet, read_scannet)
SENS = of_folder(lambda: {"scene.sens": phones.sens()}, read_sens)
NAMES = (
    "POLYCAM",
    "POLYCAM_ZIP",
    "RECORD3D",
    "RECORD3D_ARCHIVE",
    "RECORD3D_EXPORT",
    "STRAY_SCANNER",
    "ARKIT_SCENES",
    "SCANNET",
    "SENS",
)


@pytest.mark.parametrize("name", NAMES)
def test_damaged_exports_are_refused_or_read(harness, name):
    harness.check(f"{__name__}:{name}", CASES)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_exports(harness, name):
    """`pytest -m slow tests/fuzz/test_phones.py`."""
    harness.check(f"{__name__}:{name}", CASES_SLOW)
