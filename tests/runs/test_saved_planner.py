"""A planner that was saved goes on as if it had not been; damage is refused by name."""

import json
from dataclasses import fields, replace

import jax
import numpy as np
import pytest

import r3jax
from r3jax.exploration.config import ExplorationConfig
from r3jax.files import NotOursError
from r3jax.mapping.config import MappingConfig
from r3jax.planning.robot.motion import make_motion
from r3jax.runs.header import RunError
from r3jax.validation.json_text import sealed, unsealed

CAMERA = r3jax.Camera.from_fov(48, 36, 70.0)
BOUNDS = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]])
EYE = np.array([1.0, 1.5, 1.0])


def frame_at(pose):
    depth = np.full((36, 48), 2.0, np.float32)
    rgb = np.full((36, 48, 3), 0.5, np.float32)
    return r3jax.Frame.from_arrays(rgb, depth, pose, CAMERA)


@pytest.fixture(scope="module")
def planner():
    motion = make_motion("ground", body=r3jax.Body(0.2, unknown_below="never"))
    policy = r3jax.make_policy("r3-pano", num_candidates=12, num_frontier=4, motion=motion)
    pose = np.asarray(r3jax.look_at(EYE, EYE + np.array([1.0, 0.0, 0.0])), float)
    planner = r3jax.start(CAMERA, BOUNDS, policy, starts=[pose],
                          config=r3jax.MappingConfig(capacity=1 << 12))  # fmt: skip
    planner = r3jax.observe(planner, frame_at(pose))
    planner = r3jax.keep_out(planner, [[[3.0, 0.0], [4.0, 0.0], [4.0, 1.0]]])
    return r3jax.decide(planner, pose, jax.random.key(0))[1], pose


def test_it_decides_as_before(planner, tmp_path):
    planner, pose = planner
    r3jax.save(planner, tmp_path / "saved")
    again = r3jax.load(tmp_path / "saved")
    same = jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True),
                        (planner.map_state, planner.grid, planner.policy_state),
                        (again.map_state, again.grid, again.policy_state))  # fmt: skip
    assert all(jax.tree.leaves(same))
    assert (again.policy, again.config) == (planner.policy, planner.config)
    key = jax.random.key(5)
    (a, _, info), (b, _, _) = (r3jax.decide(p, pose, key) for p in (planner, again))
    assert (a is None) == (b is None), info
    if a is not None:
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_the_planner_of_an_exploration_is_stored_without_its_loop(planner, tmp_path):
    planner, pose = planner
    of_a_loop = ExplorationConfig(capacity=planner.config.capacity, capture_every=0.5)
    r3jax.save(replace(planner, config=of_a_loop), tmp_path)
    again = r3jax.load(tmp_path)
    stored = {field.name: getattr(of_a_loop, field.name) for field in fields(MappingConfig)}
    assert again.config == MappingConfig(**stored)
    assert r3jax.decide(again, pose, jax.random.key(5))[2].outcome


def test_it_replaces_its_own_and_nothing_else(planner, tmp_path):
    planner, _ = planner
    for _ in range(3):
        r3jax.save(planner, tmp_path / "saved")
    assert len(list((tmp_path / "saved").glob("0*"))) == 1
    r3jax.load(tmp_path / "saved")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("words")
    with pytest.raises(NotOursError, match="mine"):
        r3jax.save(planner, tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_damage_is_refused_by_name(planner, tmp_path):
    planner, _ = planner
    folder = tmp_path / "saved"
    r3jax.save(planner, folder)
    text = (folder / "planner.json").read_text()
    for change, name in (
        (lambda t: t.replace('"version": 2', '"version": 9'), "version"),
        (lambda t: t.replace('"cell_size": 0.2', '"cell_size": 0.3'), "planner.json"),
        (lambda t: t[: len(t) // 2], "planner.json"),
        (lambda t: json.dumps({"format": "other"}), "planner.json"),
    ):
        (folder / "planner.json").write_text(change(text))
        with pytest.raises(RunError, match=name):
            r3jax.load(folder)
    (folder / "planner.json").write_text(text)
    largest = max(
        (folder / "000000").rglob("*"), key=lambda p: p.stat().st_size if p.is_file() else 0
    )
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 0xFF
    largest.write_bytes(data)
    with pytest.raises(RunError, match="000000"):
        r3jax.load(folder)
    with pytest.raises(RunError, match="missing"):
        r3jax.load(tmp_path / "nowhere")


def test_the_first_version_is_still_read(planner, tmp_path):
    planner, _ = planner
    r3jax.save(planner, tmp_path)
    plain = unsealed(json.loads((tmp_path / "planner.json").read_text()))
    (tmp_path / "planner.json").write_text(json.dumps(sealed(plain | {"version": 1})))
    again = r3jax.load(tmp_path)
    assert int(again.map_state.num_present) == int(planner.map_state.num_present) > 0
