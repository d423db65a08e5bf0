"""Cells: what makes another one, what does not, and which conditions are refused."""

import dataclasses
import hashlib
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.benchmark import plan
from r3jax.apps.benchmark.cells import (
    Cell,
    Conditions,
    identity,
    paths_of,
    snapshots_left,
    sources_of,
)
from r3jax.evaluation.test_views import ViewSet
from r3jax.planning.policies import REGISTERED
from r3jax.planning.registry import policy_names
from r3jax.planning.robot.motion import MOTIONS, Motion
from tests.apps.benchmark.tiny import CONDITIONS, SETTINGS

CELL = Cell("flat", "a" * 64, "r3", 0, CONDITIONS, "b" * 64, 100, SETTINGS)

CHANGES = {
    "scene_hash": "c" * 64,
    "policy": "r3-pano",
    "seed": 1,
    "test_views_hash": "d" * 64,
    "num_test_views": 99,
    "settings": SETTINGS | {"lambda2": 0.25},
    "submission": "e" * 64,
    "sources": {"my_policy.py": "f" * 64},
}

CONDITION_CHANGES = {
    "budget": "views:4",
    "clock": "wall",
    "resolution": 49,
    "fov": 80.0,
    "noise": 0.0,
    "max_range": 4.0,
    "voxel_size": 0.05,
    "cell_size": 0.3,
    "map_capacity": 1 << 12,
    "train_resolution": 16,
    "iterations": 31,
    "gaussians": 201,
    "capacity": 401,
    "backend": "xla",
    "lpips": "alex",
    "loop": {"num_bins": 32},
    "trainer": {"sh_degree": 1},
}


def test_every_field_is_either_changed_here_or_does_not_matter():
    assert CHANGES.keys() | {"scene", "up", "scale", "cull_backfaces", "conditions"} == {
        field.name for field in dataclasses.fields(Cell)
    }
    assert CONDITION_CHANGES.keys() | {"snapshots"} == {
        field.name for field in dataclasses.fields(Conditions)
    }


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_field_makes_another_cell(name):
    other = dataclasses.replace(CELL, **{name: CHANGES[name]})
    assert other.name != CELL.name


@pytest.mark.parametrize("name", CONDITION_CHANGES)
def test_a_changed_condition_makes_another_cell(name):
    changed = dataclasses.replace(CONDITIONS, **{name: CONDITION_CHANGES[name]})
    assert dataclasses.replace(CELL, conditions=changed).name != CELL.name


def test_the_identity_holds_every_setting_of_the_policy():
    """The settings count as they act, not as they are given."""
    before = identity(CELL)["planner"]
    assert before["num_candidates"] == SETTINGS["num_candidates"]
    assert before["radius"] == 0.5
    given = dataclasses.replace(CELL, settings=SETTINGS | {"radius": 0.75})
    assert identity(given)["planner"] == before | {"radius": 0.75}


def test_where_a_mesh_lies_and_which_snapshots_are_asked_for_do_not_matter():
    moved = dataclasses.replace(CELL, scene="mesh:/somewhere/house.glb", up="z")
    assert moved.identity_hash == CELL.identity_hash
    assert moved.name.startswith("house-r3-seed0-")
    asked = dataclasses.replace(CONDITIONS, snapshots=("views:1",))
    assert dataclasses.replace(CELL, conditions=asked).name == CELL.name


def test_a_name_is_a_plain_folder_name():
    odd = dataclasses.replace(CELL, scene="mesh:/a b/c:d é*.glb")
    assert "/" not in odd.name
    assert not set(odd.name) & set(" :*")


def test_a_snapshot_is_left_until_its_record_is_there(tmp_path):
    assert snapshots_left(tmp_path, CELL) == ("views:2", "views:3")
    record = paths_of(tmp_path, CELL).record("views:2")
    record.parent.mkdir(parents=True)
    record.touch()
    assert snapshots_left(tmp_path, CELL) == ("views:3",)
    assert record == paths_of(tmp_path, CELL).record("views:2.0")


@pytest.mark.parametrize("name", policy_names())
def test_every_policy_sees_as_far_as_the_sensor_and_draws_as_many_candidates(name):
    conditions = dataclasses.replace(CONDITIONS, max_range=3.5)
    config = conditions.policy(name, {"num_candidates": 40, "scoring.lambda1": 8.0}).config
    assert float(config.scoring.max_range) == 3.5
    assert float(config.scoring.lambda1) == 8.0
    assert config.num_candidates == 40


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"budget": "minutes:3"}, "minutes:3"),
        ({"snapshots": ("views:4",)}, "views:4.*views:3"),
        ({"snapshots": ("views:2", "views:2.0")}, "twice"),
        ({"resolution": 8}, "resolution.*4096"),
        ({"train_resolution": 64}, "more than the images have"),
        ({"capacity": 100}, "capacity 100"),
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"loop": {"num_bins": 0}}, "num_bins"),
        ({"loop": {"bins": 32}}, "bins.*num_"),
        ({"loop": {"voxel_size": 0.1}}, "voxel_size"),
        ({"trainer": {"sh_degree": 4}}, "sh_degree"),
        ({"trainer": {"seed": 1}}, "seed"),
    ],
)
def test_conditions_that_cannot_work_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONDITIONS, **changes)


@pytest.mark.parametrize("settings", [{"scoring.lambda9": 1}, {"scoring": 1}, {"lambda9": 1}])
def test_settings_that_nobody_knows_are_refused(settings):
    with pytest.raises(ValueError, match=r"lambda9|scoring\.NAME"):
        CONDITIONS.policy("r3", settings)


def test_further_settings_reach_the_loop_and_the_trainer():
    given = {"loop": {"num_bins": 96, "drop_edges": False}, "trainer": {"lambda_dssim": 0.5}}
    changed = dataclasses.replace(CONDITIONS, **given)
    loop, trainer = changed.exploration_config(), changed.train_config(3)
    assert (loop.num_bins, loop.drop_edges, loop.voxel_size) == (96, False, 0.1)
    assert (trainer.lambda_dssim, trainer.seed, trainer.iterations) == (0.5, 3, 30)


def test_a_setting_at_its_default_is_the_same_cell_as_one_that_was_not_given():
    given = {"loop": {"num_bins": 64, "drop_edges": True}, "trainer": {"sh_degree": 3}}
    same = dataclasses.replace(CONDITIONS, **given)
    assert same == CONDITIONS
    assert dataclasses.replace(CELL, conditions=same).name == CELL.name


def test_cells_from_before_the_edge_filter_could_be_left_out_keep_their_names():
    assert "drop_edges" not in identity(CELL)["exploration"]
    kept = dataclasses.replace(CONDITIONS, loop={"drop_edges": False})
    without = identity(dataclasses.replace(CELL, conditions=kept))
    assert without["exploration"] == identity(CELL)["exploration"] | {"drop_edges": False}
    assert without["conditions"] == identity(CELL)["conditions"]


def test_a_motion_is_another_cell_and_a_camera_that_flies_is_not():
    assert "motion" not in identity(CELL)["planner"]
    ground = identity(dataclasses.replace(CELL, settings=SETTINGS | {"motion": "ground"}))
    assert ground["planner"]["motion"]["elevations"] == [0.0, 0.0]
    slow = MOTIONS["ground"].speed
    record = {"speed": slow, "heights": [0.0, 0.0]}
    policy = CONDITIONS.policy("random", {"motion": record})
    assert policy.config.motion == Motion(speed=slow, heights=(0.0, 0.0))
    with pytest.raises(ValueError, match="unknown motion 'boat'"):
        CONDITIONS.policy("random", {"motion": "boat"})


def test_without_snapshots_the_budget_is_one():
    assert Conditions(budget="metres:5").snapshots == ("metres:5",)


@pytest.mark.parametrize("name", policy_names())
def test_cells_of_policies_of_this_package_keep_their_names(name):
    assert sources_of(name) == {}
    assert "sources" not in identity(CELL)


def sha256(text):
    return hashlib.sha256(text.encode()).hexdigest()


@given(rules=st.lists(st.text("ab"), min_size=2, max_size=2, unique=True))
def test_an_edited_program_is_another_policy(tmp_path_factory, rules):
    script = tmp_path_factory.mktemp("policy") / "mine.py"
    command = f"exec:{sys.executable} -u {script} --gain 2 {'x' * 300}"
    found = []
    for rule in rules:
        script.write_text(rule)
        found.append(sources_of(command))
        assert found[-1][str(script)] == sha256(rule)
        assert set(found[-1]) == {sys.executable, str(script)}
    assert found[0] != found[1]


def test_an_edited_module_is_another_policy(tmp_path, monkeypatch):
    path = tmp_path / "policy_of_mine.py"
    path.write_text("class Mine:\n    name = 'mine'\n")
    monkeypatch.syspath_prepend(tmp_path)
    found = sources_of("policy_of_mine:Mine")
    assert found == {"policy_of_mine": sha256(path.read_text())}
    path.write_text("class Mine:\n    name = 'mine'  # edited\n")
    assert sources_of("policy_of_mine:Mine") != found
    monkeypatch.setitem(REGISTERED, "mine", sys.modules["policy_of_mine"].Mine)
    assert sources_of("mine") == sources_of("policy_of_mine:Mine")
    assert sources_of("r3jax.planning.policies.random:Random") == {}


def test_a_benchmark_with_an_edited_program_has_other_cells(tmp_path, monkeypatch):
    views = ViewSet("flat", "a" * 64, (1.0, 1.0, 1.0), 0.1, None, np.zeros((1, 3)), ("+x",))
    monkeypatch.setattr(plan, "prepare_scene", lambda *_: views)
    script = tmp_path / "mine.py"
    request = plan.Request(
        ("flat",), (f"exec:{sys.executable} {script}", "random"), (0,), CONDITIONS
    )
    names = []
    for rule in ("left", "right"):
        script.write_text(rule)
        names.append([cell.name for cell in plan.make_plan(request, tmp_path)])
    (left, random), (right, same) = names
    assert left != right
    assert random == same
