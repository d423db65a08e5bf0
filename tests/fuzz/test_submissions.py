"""Damaged submissions.

All 2,000 cases: `pytest -m slow tests/fuzz/test_submissions.py`.
"""

import contextlib
from pathlib import Path

import pytest

from r3jax.apps.benchmark.conditions import Conditions
from r3jax.apps.benchmark.submitted import conditions_of
from r3jax.formats.errors import FormatError
from r3jax.formats.submissions import (
    content_hash,
    parse_submission,
    read_submission,
    submission_text,
)
from tests.formats.test_submissions import make_submission
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    robot = {"heights": [-0.1, 0.4], "speed": 0.5, "turn_rate": 45.0}
    given = make_submission(3, motion=robot, exploration={"clock": "model", "voxel_size": 0.1})
    return [{"theirs.jsonl": submission_text(s).encode()} for s in (make_submission(2), given)]


def read(folder: Path) -> None:
    submission = read_submission(folder / "theirs.jsonl")
    # What is accepted can be written again, and its terms are told or refused in words.
    again = parse_submission(submission_text(submission).encode())
    assert content_hash(again) == content_hash(submission)
    assert len(submission.paths()) == len(submission.frames)
    with contextlib.suppress(ValueError):
        conditions_of(submission, Conditions(train_resolution=16))


READER = Reader(seeds, read, (FormatError,))


def test_damaged_submissions_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_submissions(harness):
    """`pytest -m slow tests/fuzz/test_submissions.py`."""
    harness.check(__name__, CASES_SLOW)
