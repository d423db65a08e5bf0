"""Damaged files for every reader: each is read or refused by the reader's own error.

All 2,000 cases of each: `pytest -m slow tests/fuzz`.
"""

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from r3jax.apps.benchmark.reference_images import read_reference_images
from tests.fuzz.mutations import Payload, npy, pickled, zipped
from tests.fuzz.readers import CRAFTED, READERS, reference_images, written

pytestmark = pytest.mark.full


ROOT = Path(__file__).resolve().parents[2]
SHOWN = 8
"""Failures that a message quotes."""


@pytest.fixture(scope="session")
def check(tmp_path_factory):
    """Has a worker read the cases of a reader; one for all, as it imports JAX, until one dies."""
    scratch, workers = tmp_path_factory.mktemp("fuzz"), []
    log = scratch / "stderr.txt"
    command = [sys.executable, "-X", "faulthandler", "-m", "tests.fuzz.worker", str(scratch)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MALLOC_ARENA_MAX": "2"}
    pipe = subprocess.PIPE

    def check(table, name, count=None):
        if not workers:
            with log.open("wb") as errors:
                workers.append(
                    subprocess.Popen(
                        command, stdin=pipe, stdout=pipe, stderr=errors, cwd=ROOT,
                        env=environment, text=True,
                    )
                )  # fmt: skip
        (worker,) = workers
        print(json.dumps({"table": table, "reader": name, "count": count}), file=worker.stdin)
        worker.stdin.flush()
        if not (line := worker.stdout.readline()):
            workers.clear()
            worker.communicate()
            pytest.fail(f"the process died: {log.read_text(errors='replace')[-1500:]}")
        found = json.loads(line)
        assert not found["failures"], "\n\n".join(found["failures"][:SHOWN])
        return found

    yield check
    for worker in workers:
        worker.communicate()


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_or_read(check, name):
    found = check("READERS", name)
    assert found["read"], "no case was harmless"
    assert found["refused"], "no case was refused"


@pytest.mark.parametrize("name", CRAFTED)
def test_hostile_files_are_refused_or_read(check, name):
    check("CRAFTED", name)


def test_a_mesh_that_is_a_bomb_is_read_or_refused_in_little_memory(check):
    check("BOMBS", "mesh")


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_files(check, name):
    check("READERS", name, 2000)


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
