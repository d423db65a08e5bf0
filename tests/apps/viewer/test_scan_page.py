"""An audit, a recording and a splat open on the page of a scan; a click says who sees a place."""

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")

from r3jax.apps.audit.audit import audit
from r3jax.apps.audit.outputs import write_outputs
from r3jax.apps.audit.settings import AuditSettings
from r3jax.apps.viewer.scan_page import answer, open_scan_page, picked, scan_of, sentences
from r3jax.captures import capture_maps
from r3jax.captures.source import source_of
from r3jax.errors import InputError
from r3jax.formats.recordings import read_recording
from r3jax.splatting.ply import write_scene
from r3jax.splatting.scene import GaussianScene
from tests.apps.audit.room import FOCAL, HEIGHT, SIZE, WIDTH, round_poses, write_recording

MIDDLE = SIZE / 2


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_recording(tmp_path_factory.mktemp("captures") / "room", round_poses(8))


@pytest.fixture(scope="module")
def folder(capture, tmp_path_factory) -> Path:
    """The folder of an audit, without its page."""
    out = tmp_path_factory.mktemp("audits") / "room"
    out.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture_maps, "_CAPACITY", 1 << 13)
        settings = AuditSettings(
            voxel_size=0.15, views=2, folds=2, num_places=8, num_standpoints=4, up="z"
        )
        found = audit(source_of(read_recording(capture, "z"), "room"), settings)
    write_outputs(found, out, capture)
    return out


def showing(point: np.ndarray) -> set[int]:
    """Pictures that have a point in them; in an empty convex room nothing hides it."""
    found = set()
    for index, pose in enumerate(round_poses(8)):
        x, y, z = (point - pose[:3, 3]) @ pose[:3, :3]
        u, v = FOCAL * x / max(z, 1e-9) + WIDTH / 2, FOCAL * y / max(z, 1e-9) + HEIGHT / 2
        if z > 0 and 0 <= u < WIDTH and 0 <= v < HEIGHT:
            found.add(index)
    return found


@pytest.mark.parametrize("heading", range(0, 360, 45))
def test_a_click_says_which_pictures_see_the_place_and_what_it_needs(folder, heading):
    scan = scan_of(folder)
    ahead = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), -0.1])
    row = picked(scan, MIDDLE, ahead, np.inf)
    assert row is not None
    point = scan.centers[row]
    aside = np.cross(point - MIDDLE, ahead / np.linalg.norm(ahead))
    assert np.linalg.norm(aside) <= 0.75 * scan.edge + 1e-9
    found = answer(scan, row)
    assert set(found.pictures.tolist()) == showing(point)
    assert (np.diff(found.distances) >= 0).all()
    assert scan.facts is not None
    cause = scan.causes[int(scan.facts[row]["cause"])]
    if scan.facts[row]["standpoints"] > 0 and cause["name"] != "fine":
        assert cause["meaning"] in " ".join(sentences(scan, found))


def test_the_page_of_an_audit_answers_clicks_and_misses(folder):
    with open_scan_page(scan_of(folder)) as page:
        before = page.said.content
        found = page.click(MIDDLE, np.array([1.0, 0.3, -0.1]))
        assert found is not None
        text = page.said.content
        assert text != before
        for index in found.pictures[:3].tolist():
            assert f"{index:03d}.png" in text
        assert text.count("<img") == min(3, len(found.pictures))
        assert page.click(50.0 * SIZE, np.array([0.0, 0.0, 1.0])) is None
        assert page.said.content == before


def test_what_hides_a_place_counts(folder):
    scan = scan_of(folder)
    row = picked(scan, MIDDLE, np.array([1.0, 0.0, 0.0]), np.inf)
    assert row is not None
    seen = answer(scan, row).pictures
    assert len(seen)
    point = scan.centers[row]
    eye = scan.poses[int(seen[0]), :3, 3]
    across = np.array([[0, y, z] for y in (-0.2, 0, 0.2) for z in (-0.2, 0, 0.2)]) * scan.edge * 4
    wall = 0.5 * (eye + point) + across
    walled = dataclasses.replace(scan, centers=np.concatenate([scan.centers, wall]))
    assert int(seen[0]) not in answer(walled, row).pictures


def test_an_audit_whose_capture_is_gone_shows_its_surfaces(folder, tmp_path):
    record = json.loads((folder / "audit.json").read_text())
    record["capture_path"] = str(tmp_path / "gone")
    (tmp_path / "audit.json").write_text(json.dumps(record))
    (tmp_path / "causes.ply").write_bytes((folder / "causes.ply").read_bytes())
    scan = scan_of(tmp_path)
    assert scan.source is None
    assert str(tmp_path / "gone") in scan.lead
    with open_scan_page(scan) as page:
        found = page.click(MIDDLE, np.array([1.0, 0.3, -0.1]))
    assert found is not None
    assert len(found.pictures) == 0


def test_an_audit_of_another_version_is_refused_by_name(folder, tmp_path):
    record = json.loads((folder / "audit.json").read_text())
    del record["alignment"]
    (tmp_path / "audit.json").write_text(json.dumps(record))
    (tmp_path / "causes.ply").write_bytes((folder / "causes.ply").read_bytes())
    with pytest.raises(InputError, match=r"audit\.json"):
        scan_of(tmp_path)


def test_a_recording_opens_without_an_audit(capture):
    scan = scan_of(capture)
    assert len(scan.poses) == 8
    walls = np.abs(scan.centers[:, None] - np.stack([np.zeros(3), SIZE])).min(axis=(1, 2))
    assert walls.max() <= scan.edge
    with open_scan_page(scan) as page:
        found = page.click(MIDDLE, np.array([1.0, 0.3, -0.1]))
        assert found is not None
        assert set(found.pictures.tolist()) == showing(scan.centers[found.row])


def test_a_splat_opens_alone(tmp_path):
    n = 5
    scene = GaussianScene(
        means=jnp.asarray(np.random.default_rng(0).normal(size=(n, 3)), jnp.float32),
        quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (n, 1)),
        log_scales=jnp.full((n, 3), -3.0),
        opacity_logits=jnp.zeros(n),
        sh=jnp.zeros((n, 1, 3)),
    )
    write_scene(tmp_path / "scene.ply", scene)
    with open_scan_page(scan_of(tmp_path / "scene.ply")) as page:
        assert page.click(MIDDLE, np.array([1.0, 0.0, 0.0])) is None
