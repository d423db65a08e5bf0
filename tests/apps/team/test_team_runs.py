"""What a team leaves on disk: runs that replay, and a team that goes on as if never cut off."""

import json
import shutil

import pytest

from r3jax.apps.team.team import Member, explore_team
from r3jax.exploration.state import StopReason
from r3jax.runs.header import RunError, camera_fields, plain_settings
from r3jax.runs.reader import read_run
from r3jax.runs.replay import check_decided_alone, differences
from r3jax.runs.writer import RunWriter
from tests.apps.team.test_team import WIDE, room
from tests.exploration.killed_run import CONFIG, small_policy
from tests.exploration.test_resume import assert_same_run
from tests.exploration.toys import LOWER, UPPER, Wander
from tests.runs.runs import make_header

pytestmark = pytest.mark.full

VIEWS, MEET_EVERY = 4, 1.5


def members(name):
    """Two cameras with different lenses."""
    policies = [Wander(reach=0.8) if name == "wander" else small_policy(name) for _ in range(2)]
    rooms = room(1.2), room(1.9, WIDE)
    return [Member(world, policy) for world, policy in zip(rooms, policies, strict=True)]


def fly(folder, name, views=VIEWS, resume=False, order=None):
    crew = members(name)
    if resume:
        recorders, runs = zip(*(RunWriter.resume(folder / str(i)) for i in range(2)), strict=True)
    else:
        runs = None
        recorders = [
            RunWriter(
                folder / str(i),
                make_header(
                    camera=camera_fields(member.simulator.camera),
                    bounds=[LOWER.tolist(), UPPER.tolist()],
                    config=plain_settings(CONFIG),
                    parent={"team": ["0", "1"], "member": i, "meet_every": MEET_EVERY},
                ),
            )
            for i, member in enumerate(crew)
        ]
    try:
        result = explore_team(
            crew,
            budget=f"views:{views}",
            config=CONFIG,
            meet_every=MEET_EVERY,
            recorders=recorders,
            resume=runs,
            on_row=lambda number, row: None if order is None else order.append(number),
        )
    finally:
        for recorder in recorders:
            recorder.close()
    return crew, result


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Teams that were never cut off, by policy, and whose turn it was."""
    folder, done = tmp_path_factory.mktemp("whole"), {}

    def team_of(name):
        if name not in done:
            order = []
            fly(folder / name, name, order=order)
            done[name] = order
        return folder / name, done[name]

    return team_of


def cut_off(folder, order, steps):
    """As a kill after so many steps leaves it: no end, no checkpoint."""
    for number in range(2):
        path = folder / str(number)
        kept = order[:steps].count(number)
        lines = (path / "trace.jsonl").read_bytes().splitlines(keepends=True)
        (path / "trace.jsonl").write_bytes(b"".join(lines[:kept]))
        shutil.rmtree(path / "checkpoints")
        for step in range(kept, VIEWS):
            for suffix in ("png", "depth.png"):
                (path / "frames" / f"{step:06d}.{suffix}").unlink()
    return [order[:steps].count(number) for number in range(2)]


@pytest.mark.parametrize(
    ("name", "steps"),
    [("wander", 1), ("wander", 5), pytest.param("active-gs", 5, marks=pytest.mark.slow)],
)
def test_a_team_that_was_cut_off_is_the_team_that_was_not(tmp_path, whole, name, steps):
    source, order = whole(name)
    shutil.copytree(source, tmp_path / "team")
    kept = cut_off(tmp_path / "team", order, steps)
    crew, result = fly(tmp_path / "team", name, resume=True)
    for number, member in enumerate(result.members):
        assert member.reason is StopReason.BUDGET
        assert len(crew[number].simulator.rendered) == VIEWS - kept[number]
        assert_same_run(tmp_path / "team" / str(number), source / str(number))


def test_a_replay_of_any_member_rebuilds_what_all_knew(whole):
    folder, _ = whole("wander")
    for number in range(2):
        assert differences(read_run(folder / str(number))) == (2 * VIEWS, [])


def test_a_replay_notices_that_another_member_saw_something_else(tmp_path, whole):
    source, _ = whole("wander")
    shutil.copytree(source, tmp_path / "team")
    path = tmp_path / "team" / "1" / "trace.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[: VIEWS - 1], lines[-1]]))  # its last view is gone
    views, found = differences(read_run(tmp_path / "team" / "0"))
    assert views == 2 * VIEWS - 1
    assert "map.count" in {difference.name for difference in found}


def test_a_member_of_a_team_that_was_cut_off_says_so(tmp_path, whole):
    source, _ = whole("wander")
    shutil.copytree(source, tmp_path / "team")
    trace = tmp_path / "team" / "1" / "trace.jsonl"
    trace.write_bytes(b"".join(trace.read_bytes().splitlines(keepends=True)[:VIEWS]))
    with pytest.raises(RunError, match="r3jax team"):
        differences(read_run(tmp_path / "team" / "0"))


def test_decisions_of_a_team_are_not_explained_from_one_run(whole):
    folder, _ = whole("wander")
    with pytest.raises(RunError):
        check_decided_alone(read_run(folder / "0"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"team": [3]}, "`parent.team`"),
        ({"team": []}, "without members"),
        ({"team": ["../elsewhere"]}, "leads out of the folder"),
        ({"meet_every": "often"}, "`parent.meet_every`"),
        ({"meet_every": -1.0}, "negative interval"),
    ],
)
def test_a_header_that_names_no_team_is_refused(tmp_path, whole, change, message):
    source, _ = whole("wander")
    header = json.loads((source / "0" / "run.json").read_text())
    header["parent"] |= change
    del header["seal"]
    (tmp_path / "run.json").write_text(json.dumps(header))
    with pytest.raises(RunError, match=message):
        read_run(tmp_path)
