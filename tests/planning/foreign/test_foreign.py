"""Programs as policies: they decide what the same rule decides here, and break nothing."""

import dataclasses
import shlex
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import pytest

import r3jax
from r3jax.apps.team.team import Member, explore_team
from r3jax.exploration import explore
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import StopReason
from r3jax.geometry.cameras import Camera
from r3jax.planning.config import PlannerConfig
from r3jax.planning.planner import decide, observe, start
from r3jax.planning.policy import LivesOutside, PlansAhead, PolicyError
from r3jax.planning.registry import make_policy
from r3jax.runs.header import RunHeader, camera_fields, policy_fields
from r3jax.runs.reader import read_run
from r3jax.runs.writer import RunWriter
from tests.exploration.toys import BoxRoom
from tests.planning.foreign.children import HIGHEST, LOTS, command_of, is_running

pytestmark = pytest.mark.full

CONFIG = ExplorationConfig(clock="model", voxel_size=0.1, capacity=1 << 14, num_probes=1)
SETTINGS = {"num_candidates": 20, "num_frontier": 6}
VIEWS = 4


@dataclass(frozen=True)
class Highest(r3jax.GreedyPolicy):
    """The highest candidate, whatever the path."""

    name = "highest"
    source = "a test"

    def score(self, situation, candidates, *, key):
        return candidates, {"utility": candidates.position[:, 2]}

    def weigh(self, utilities):
        return utilities["utility"]


def exec_policy(command, **settings):
    return make_policy(f"exec:{command}", **SETTINGS | {"answer_seconds": 30.0} | settings)


def poses(result):
    return np.stack([row.pose for row in result.rows])


def fly(policy, budget=f"views:{VIEWS}", config=CONFIG, **more):
    return explore(BoxRoom(), policy, budget=budget, config=config, **more)


@pytest.fixture(scope="module")
def here():
    """The views that the rule chooses in this process."""
    return poses(fly(Highest(PlannerConfig(**SETTINGS))))


NUMPY_HIGHEST = """
import sys
sys.path.insert(0, {folder!r})
import foreign_policy as example
import numpy as np
example.receive()
example.send(kind="hello", protocol=1)
while (message := example.receive()) is not None:
    best = int(np.argmax(message[1]["position"][:, 2]))
    example.send(kind="candidate", index=best, view=message[0]["view"])
"""


def test_a_program_in_numpy_decides_as_the_rule_does_here(here):
    examples = str(Path(__file__).resolve().parents[3] / "examples")
    code = NUMPY_HIGHEST.format(folder=examples)
    result = fly(exec_policy(shlex.join([sys.executable, "-c", code])))
    np.testing.assert_array_equal(poses(result), here)
    assert result.rows[1].charged["planning"] == 0.3  # as for any policy


def test_a_program_in_an_environment_without_numpy_decides_the_same(here, tmp_path):
    venv.create(tmp_path / "env", with_pip=False)
    python = str(tmp_path / "env" / "bin" / "python")
    lacks = subprocess.run([python, "-I", "-c", "import numpy"], capture_output=True)
    assert lacks.returncode != 0, "the environment is to have no NumPy"
    result = fly(exec_policy(command_of(tmp_path, HIGHEST, python)))
    np.testing.assert_array_equal(poses(result), here)


def test_the_example_explores():
    example = Path(__file__).resolve().parents[3] / "examples" / "foreign_policy.py"
    code = [
        x for x in example.read_text().splitlines() if x.strip() and not x.startswith("    r3jax")
    ]
    assert len(code) <= 45
    result = fly(exec_policy(shlex.join([sys.executable, str(example)])))
    assert result.reason is StopReason.BUDGET
    axes = poses(result)[:, :3, 2]
    assert np.sum(axes[0] * axes[1]) < 0.0  # it looks where it has not looked


def recorded(policy, path, budget, resume=False):
    simulator = BoxRoom()
    if resume:
        recorder, run = RunWriter.resume(path)
    else:
        header = RunHeader(
            {"name": "box"}, policy_fields(policy), "views:9", 0, dataclasses.asdict(CONFIG),
            camera_fields(simulator.camera), simulator.bounds.tolist(),
        )  # fmt: skip
        recorder, run = RunWriter(path, header), None
    with recorder:
        explore(simulator, policy, budget=budget, config=CONFIG, recorder=recorder, resume=run)
    return (path / "trace.jsonl").read_bytes()


def test_a_run_that_is_gone_on_with_is_the_whole_run(tmp_path):
    """The program remembers how often it was asked: it is shown and asked all anew."""
    command = command_of(tmp_path, LOTS)
    whole = recorded(exec_policy(command), tmp_path / "whole", "views:5")
    recorded(exec_policy(command), tmp_path / "part", "views:3")
    assert recorded(exec_policy(command), tmp_path / "part", "views:5", resume=True) == whole
    policy = read_run(tmp_path / "whole").header.policy
    assert policy["name"] == f"exec:{command}"
    assert policy["settings"]["answer_seconds"] == 30.0
    again = make_policy(policy["name"], **SETTINGS | {"answer_seconds": 30.0})
    assert again == exec_policy(command)
    assert isinstance(again, LivesOutside)
    assert not isinstance(again, PlansAhead)


OWN_VIEW = """
hello_cell, hello_bounds = hello["cell_size"], hello["bounds"][0]
while True:
    question, arrays = receive()
    shape, stops = arrays["stops"]
    index = max(i for i, free in enumerate(stops) if free)
    x, rest = divmod(index, shape[1] * shape[2])
    y, z = divmod(rest, shape[2])
    place = [low + (i + 0.5) * hello_cell for low, i in zip(hello_bounds, (x, y, z))]
    send(kind="view", position=place, direction=[0.0, 2.0, 1.0])
"""


def test_a_program_may_choose_a_view_of_its_own(tmp_path):
    result = fly(exec_policy(command_of(tmp_path, OWN_VIEW)), budget="views:3")
    for row in result.rows[1:]:
        np.testing.assert_allclose(row.pose[:3, 2], np.array([0.0, 2.0, 1.0]) / 5**0.5, atol=1e-6)
        np.testing.assert_allclose(row.choice.waypoints[-1], row.pose[:3, 3], atol=1e-6)
    assert result.rows[1].metres > 0.3


def test_what_a_program_is_shown_is_what_was_seen(tmp_path):
    """Its answer tells what it got: the frames, the pose, and the camera."""
    code = """
seen = []
while True:
    question, arrays = receive()
    seen.append((question["view"], arrays["rgb"][0], arrays["depth"][0], len(arrays["path"][1])))
    pose, here = arrays["T_world_camera"][1][-16:], arrays["here"][1]
    assert max(abs(a - b) for a, b in zip(pose, here)) < 1e-6
    assert sum(arrays["rgb"][1]) > 0 and min(arrays["depth"][1]) > 0.0
    assert hello["camera"]["width"] == 48 and hello["motion"]["heights"] is None
    assert set(arrays["cells"][1]) == {0, 1, 2} and hello["max_range"] == 5.0
    assert seen == [(n + 1, [1, 48, 48, 3], [1, 48, 48], s[3]) for n, s in enumerate(seen)]
    send(kind="candidate", index=0)
"""
    assert fly(exec_policy(command_of(tmp_path, code))).reason is StopReason.BUDGET


def test_a_program_is_shown_the_frames_on_the_way_too(tmp_path):
    code = """
frames = 0
while True:
    question, arrays = receive()
    frames += arrays["rgb"][0][0]
    assert frames == question["view"] and arrays["depth"][0] == arrays["rgb"][0][:3]
    send(kind="candidate", index=0)
"""
    config = dataclasses.replace(CONFIG, capture_every=0.1, gaze="ahead")
    result = fly(exec_policy(command_of(tmp_path, code)), config=config)
    assert len(result.rows) > VIEWS


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (
            "receive(); send(kind='candidate', index=20)",
            "candidate 20",
        ),
        ("receive(); send(kind='candidate', index='best')", "`index`"),
        ("receive(); send(kind='candidate', index=True)", "`index`"),
        (
            "receive(); send(kind='view', position=[9, 9, 9], direction=[1, 0, 0])",
            "position|robot cannot",
        ),
        ("receive(); send(kind='view', position=[1, 1], direction=[1, 0, 0])", "three numbers"),
        ("receive(); send(kind='view', position=[1, 1, 1])", "`direction`"),
        ("receive(); send(kind='view', position=[1, 1, 1], direction=[0, 0, 0])", "length 0"),
        ("receive(); send(kind='jump')", "'jump'"),
        (
            "for _ in range(2): receive(); send(kind='candidate', index=0, view=1)",
            "view 2.*view 1",
        ),
        (
            "receive(); [send(kind='candidate', index=0) for _ in range(2)]; receive()",
            "view 2.*view 1",
        ),
        ("receive(); send(kind='done', view=True)", "view True"),
        ("receive(); asked.clear(); send(kind='done')", "`view`"),
        ("receive(); raise SystemExit('no weights')", "code 1.*no weights"),
        ("receive(); import time; time.sleep(60)", "`decide`.* 1 s"),
    ],
)
def test_an_answer_that_cannot_be_taken_ends_the_run(tmp_path, code, says):
    policy = exec_policy(command_of(tmp_path, code), answer_seconds=1.0)
    with pytest.raises(PolicyError, match=says):
        fly(policy)
    assert policy._sessions == {}


def test_a_program_that_speaks_another_protocol_is_refused(tmp_path):
    command = command_of(tmp_path, "")
    code = Path(tmp_path / "program.py")
    code.write_text(code.read_text().replace("protocol=1", "protocol=2"))
    with pytest.raises(PolicyError, match=r"2.*1"):
        fly(exec_policy(command))


def test_a_program_that_is_done_ends_the_run(tmp_path):
    result = fly(exec_policy(command_of(tmp_path, "receive(); send(kind='done')")))
    assert result.reason is StopReason.NO_CANDIDATE
    assert len(result.rows) == 1


def test_a_question_that_is_timed_again_is_asked_once_and_takes_as_long(tmp_path):
    code = "import time\nwhile True:\n  receive(); time.sleep(0.2); send(kind='candidate', index=0)"
    policy, room, key = exec_policy(command_of(tmp_path, code)), BoxRoom(), jax.random.key(0)
    planner = start(room.camera, room.bounds, policy, starts=[room.start_pose], config=CONFIG)
    planner = observe(planner, room.render(room.start_pose))
    first, again = (decide(planner, room.start_pose, key) for _ in range(2))
    np.testing.assert_array_equal(first[0].T_world_camera, again[0].T_world_camera)
    for _, _, info in (first, again):
        assert info.stage_seconds["scoring"] >= 0.2
    later = observe(again[1], room.render(first[0].T_world_camera))
    decide(later, first[0].T_world_camera, key)
    with pytest.raises(PolicyError, match=r"2 frames.*view 1"):
        decide(planner, room.start_pose, key)
    (session,) = policy._sessions.values()
    pid = session.program._process.pid
    policy.close()
    assert not is_running(pid)
    with pytest.raises(PolicyError, match="has ended"):
        decide(later, first[0].T_world_camera, key)


def test_a_team_may_ask_programs(tmp_path):
    """Each is shown what the others see, too; afterwards all have ended."""
    policies = [exec_policy(command_of(tmp_path, LOTS)) for _ in range(2)]
    rooms = BoxRoom(), BoxRoom()
    rooms[1].start_pose[:3, 3] += 0.6
    team = [Member(room, policy) for room, policy in zip(rooms, policies, strict=True)]
    result = explore_team(team, budget="views:3", config=CONFIG)
    assert [len(member.rows) for member in result.members] == [3, 3]
    assert [policy._sessions for policy in policies] == [{}, {}]


def test_a_state_that_was_stored_is_not_believed(tmp_path):
    policy, room = exec_policy(command_of(tmp_path, LOTS)), BoxRoom()
    planner = start(room.camera, room.bounds, policy, starts=[room.start_pose], config=CONFIG)
    seen = observe(planner, room.render(room.start_pose))
    other = exec_policy(command_of(tmp_path, LOTS))
    start(room.camera, room.bounds, other, config=CONFIG)
    with pytest.raises(PolicyError, match=r"0 frames.*view 1"):
        decide(dataclasses.replace(seen, policy=other), room.start_pose, jax.random.key(0))
    policy.close()
    other.close()


@pytest.mark.parametrize(("name", "value"), [("answer_seconds", -1.0), ("memory", float("nan"))])
def test_limits_that_are_none_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}"):
        exec_policy(sys.executable, **{name: value})


def test_cameras_of_one_policy_have_a_program_each(tmp_path):
    policy = exec_policy(command_of(tmp_path, LOTS))
    room, camera = BoxRoom(), Camera.from_fov(48, 48, 90.0)
    for _ in range(2):
        start(camera, room.bounds, policy, config=CONFIG)
    assert len(policy._sessions) == 2
    policy.close()
