"""RTAB-Map's databases and exports, damaged.

All 2,000 cases of each: `pytest -m slow tests/fuzz/test_rtabmap.py`.
"""

import pytest

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.rtabmap_database import read_rtabmap_database
from r3jax.formats.ros.rtabmap_export import read_rtabmap_export
from tests.formats import rtabmap
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.test_sequences import checked
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 100
"""Of each, in the normal suite."""

DATABASE = Reader(
    lambda: [{"map.db": rtabmap.database()}, {"map.db": rtabmap.database(optimized=False)}],
    checked(lambda folder: read_rtabmap_database(folder / "map.db")),
    (FormatError,),
)
EXPORT = Reader(lambda: [rtabmap.export()], checked(read_rtabmap_export), (FormatError,))

NAMES = ("DATABASE", "EXPORT")


@pytest.mark.parametrize("name", NAMES)
def test_damaged_maps_are_refused_or_read(harness, name):
    harness.check(f"{__name__}:{name}", CASES)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_maps(harness, name):
    """`pytest -m slow tests/fuzz/test_rtabmap.py`."""
    harness.check(f"{__name__}:{name}", CASES_SLOW)
