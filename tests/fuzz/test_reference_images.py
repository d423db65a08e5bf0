"""Damaged images of test views: NPZ with other arrays, bombs and pickles.

All 2,000 cases: `pytest -m slow tests/fuzz/test_reference_images.py`.
"""

import io
import pickle
import tempfile
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.apps.benchmark.reference_images import (
    ReferenceImages,
    read_reference_images,
    save_reference_images,
)
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.splatting.views import Views
from tests.fuzz.containers import Payload, npy, pickled, zipped
from tests.fuzz.harness import CASES_SLOW
from tests.fuzz.tree import Files, pick_up
from tests.fuzz.worker import Reader

pytestmark = pytest.mark.full

CASES = 150
"""In the normal suite."""


def seeds() -> list[Files]:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    depth = rng.uniform(0.0, 4.0, (2, 4, 6)).astype(np.float32)
    depth[0, 0, 0] = np.inf
    views = Views(
        rgb=jnp.asarray(rng.integers(0, 256, (2, 4, 6, 3), dtype=np.uint8)),
        depth=jnp.asarray(depth),
        T_world_camera=jnp.asarray(poses),
        cameras=jax.tree.map(lambda x: jnp.stack([x, x]), Camera(6, 4, 8.0, 8.0, 3.0, 2.0)),
    )
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "views.npz"
        save_reference_images(path, ReferenceImages("ab" * 32, poses, views))
        return [pick_up(Path(name))]


def read(folder: Path) -> None:
    reference = read_reference_images(folder / "views.npz")
    views = reference.views
    assert isinstance(reference.hash, str)
    assert len(views) == len(reference.poses) > 0
    assert views.depth.shape == (len(views), views.height, views.width)
    assert (np.asarray(views.depth) >= 0.0).all()
    for pose in [*reference.poses, *np.asarray(views.T_world_camera)]:
        assert rigid_error(pose) is None
    for x in (views.cameras.fx, views.cameras.fy, views.cameras.cx, views.cameras.cy):
        assert np.isfinite(x).all()


READER = Reader(seeds, read, (ValueError, FileNotFoundError))


def test_damaged_reference_images_are_refused_or_read(harness):
    harness.check(__name__, CASES)


@pytest.mark.slow
def test_many_damaged_reference_images(harness):
    """`pytest -m slow tests/fuzz/test_reference_images.py`."""
    harness.check(__name__, CASES_SLOW)


def test_a_pickle_in_an_array_does_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickled())
    assert Path("pickle-ran").is_dir(), "the payload must be able to run, or this proves nothing"
    Path("pickle-ran").rmdir()
    (files,) = seeds()
    with zipfile.ZipFile(io.BytesIO(files["views.npz"])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name in members:
        for planted in (npy(np.array([Payload()], dtype=object)), pickled()):
            Path("views.npz").write_bytes(zipped(members | {name: planted}))
            with pytest.raises(ValueError, match="does not hold test views"):
                read_reference_images(Path("views.npz"))
    assert not Path("pickle-ran").exists()
