"""One finished benchmark of two cells, shared by all files here."""

import pytest

from r3jax.apps.benchmark.run_cell import run_cell
from tests.apps.benchmark.tiny import make_cells
from tests.box_room import write_room


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """`mesh:<file>`."""
    return write_room(tmp_path_factory.mktemp("room") / "room.ply")


@pytest.fixture(scope="session")
def finished(room, tmp_path_factory):
    """Its folder and its cells: seeds 0 and 1, done in this process without a break."""
    root = tmp_path_factory.mktemp("finished")
    cells = make_cells(room, root, seeds=(0, 1))
    for cell in cells:
        run_cell(cell, root)
    return root, cells
