"""ROS bags with damaged records, indices, databases and metadata.

All 2,000 cases of each: `pytest -m slow tests/fuzz/test_bags.py`.
"""

import tempfile
from pathlib import Path

import pytest

from r3jax.formats.errors import FormatError
from r3jax.formats.ros.bag_reader import read_bag
from tests.formats.bags import write_bag
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.test_sequences import checked
from tests.fuzz.tree import Files, pick_up
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 100
"""Of each, in the normal suite."""


def bag(kind: str) -> list[Files]:
    """The tree of a bag."""
    with tempfile.TemporaryDirectory() as folder:
        write_bag(Path(folder) / ("drive.bag" if kind == "bag" else "drive"), kind=kind)
        return [pick_up(Path(folder))]


MCAP = Reader(lambda: bag("mcap"), checked(lambda path: read_bag(path / "drive")), (FormatError,))
DB3 = Reader(lambda: bag("db3"), checked(lambda path: read_bag(path / "drive")), (FormatError,))
BAG = Reader(lambda: bag("bag"), checked(read_bag), (FormatError,))
NAMES = ("MCAP", "DB3", "BAG")


@pytest.mark.parametrize("name", NAMES)
def test_damaged_bags_are_refused_or_read(harness, name):
    harness.check(f"{__name__}:{name}", CASES)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_bags(harness, name):
    """`pytest -m slow tests/fuzz/test_bags.py`."""
    harness.check(f"{__name__}:{name}", CASES_SLOW)
