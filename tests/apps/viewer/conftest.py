"""One small run for all tests of the viewer."""

import pytest

from r3jax.runs.reader import read_run
from tests.box_room import write_room
from tests.cli.small_runs import explore

VIEWS = 5


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """Five views of a box room; every decision is known to the trace."""
    folder = tmp_path_factory.mktemp("viewer")
    room = write_room(folder / "room.ply")
    assert explore(room, folder, "--budget", f"views:{VIEWS}") == 0
    return read_run(folder / "box")
