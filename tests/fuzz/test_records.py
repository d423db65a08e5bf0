"""Damaged records of a benchmark.

All 2,000 cases: `pytest -m slow tests/fuzz/test_records.py`.
"""

import io
import json
from pathlib import Path

import pytest

from r3jax.apps.benchmark.record import read_records
from r3jax.cli.commands.benchmark import print_results
from r3jax.cli.console import Console
from tests.evaluation.records import record
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    files = {}
    for policy, snapshot in (("ours", 30), ("ours", 60), ("random", 60)):
        plain = record(policy, snapshot=snapshot)
        path = f"cells/flat-{policy}-seed0/snapshot-views-{snapshot}.json"
        files[path] = json.dumps(plain, separators=(",", ":")).encode() + b"\n"
    return [files]


def read(folder: Path) -> None:
    records = read_records(folder)
    if not records:
        return
    # What is accepted can be shown: nothing breaks later.
    print_results(Console(file=io.StringIO(), width=200), records)


READER = Reader(seeds, read, (ValueError, FileNotFoundError))


def test_damaged_records_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_records(harness):
    """`pytest -m slow tests/fuzz/test_records.py`."""
    harness.check(__name__, CASES_SLOW)
