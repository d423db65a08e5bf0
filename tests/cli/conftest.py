"""One small room: as a mesh to explore, and in the formats that audits and selections read."""

import pytest

from r3jax.captures import capture_maps
from tests.apps.audit.room import round_poses, write_colmap, write_nerfstudio, write_recording
from tests.box_room import write_room


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """`mesh:<file>`."""
    return write_room(tmp_path_factory.mktemp("room") / "room.ply")


@pytest.fixture(scope="session")
def captures(tmp_path_factory):
    """The same room as a recording, with depth for nerfstudio, and as a COLMAP model."""
    folder = tmp_path_factory.mktemp("captures")
    write_recording(folder / "recording", round_poses())
    write_nerfstudio(folder / "nerfstudio", round_poses(), depth=True)
    write_colmap(folder / "colmap", round_poses(), scale=3.0)
    return folder


@pytest.fixture(scope="module")
def small_maps():
    """Maps of the size of the room."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture_maps, "_CAPACITY", 1 << 13)
        yield
