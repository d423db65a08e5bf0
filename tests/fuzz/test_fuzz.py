"""Damaged files and odd words for every reader: each is read or refused by the reader's own error.

All 2,000 cases of each: `pytest -m slow tests/fuzz`.
"""

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from r3jax.apps.benchmark.reference_images import read_reference_images
from tests.fuzz.harness import Harness
from tests.fuzz.mutations import Payload, npy, pickled, zipped
from tests.fuzz.readers import CRAFTED, READERS, reference_images, written

pytestmark = pytest.mark.full


@pytest.fixture(scope="session")
def harness(tmp_path_factory):
    """One worker for all readers: importing JAX once is enough."""
    with Harness(tmp_path_factory.mktemp("fuzz")) as harness:
        yield harness


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_or_read(harness, name):
    harness.check(name)


@pytest.mark.parametrize("name", CRAFTED)
def test_hostile_files_are_refused_or_read(harness, name):
    harness.check_all("CRAFTED", name)


def test_a_mesh_that_is_a_bomb_is_read_or_refused_in_little_memory(harness):
    harness.check_all("BOMBS", "mesh")


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files(harness, name):
    harness.check(name, 2000)


def test_a_pickle_in_an_array_does_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickled())
    assert Path("pickle-ran").is_dir(), "the payload must be able to run, or this proves nothing"
    Path("pickle-ran").rmdir()
    with zipfile.ZipFile(io.BytesIO(written(reference_images)["views.npz"])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name in members:
        for planted in (npy(np.array([Payload()], dtype=object)), pickled()):
            Path("views.npz").write_bytes(zipped(members | {name: planted}))
            with pytest.raises(ValueError, match=r"views\.npz"):
                read_reference_images(Path("views.npz"))
    assert not Path("pickle-ran").exists()
