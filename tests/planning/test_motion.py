"""Motions: what is refused, what ways cost by hand, and records that read back as they were."""

import dataclasses
import json
import math
from types import SimpleNamespace

import pytest

from r3jax.errors import InputError
from r3jax.planning.config import PlannerConfig
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import (
    MOTIONS,
    UNLIMITED,
    Motion,
    make_motion,
    motion_of,
    motion_of_record,
)
from r3jax.runs.header import settings_of


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"heights": (0.2, 0.5)}, "heights 0.2 to 0.5 m"),
        ({"heights": (0.5, -0.5)}, "heights 0.5 to -0.5"),
        ({"heights": (0.0, math.inf)}, "heights"),
        ({"elevations": (-100.0, 0.0)}, "elevations"),
        ({"elevations": (10.0, -10.0)}, "elevations 10 to -10"),
        ({"body": -0.1}, "body"),
        ({"speed": 0.0}, "speed"),
        ({"speed": 1e-310}, "speed"),
        ({"turn_per_meter": math.nan}, "turn_per_meter"),
        ({"turn_rate": 30.0}, "turn_rate"),
    ],
)
def test_what_nothing_can_move_with_is_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        Motion(**wrong)


def test_a_motion_by_name_takes_changes():
    slow = make_motion("ground", speed=0.1, heights=(0.0, 0.3))
    assert slow == dataclasses.replace(MOTIONS["ground"], speed=0.1, heights=(0.0, 0.3))
    assert make_motion() == Motion()
    with pytest.raises(ValueError, match=r"'boat'.*gimbal"):
        make_motion("boat")
    with pytest.raises(ValueError, match=r"wheels.*heights_above"):
        make_motion("ground", wheels=4)


def test_heights_count_from_the_start_or_from_the_world():
    assert MOTIONS["free"].heights_from(1.3) == UNLIMITED
    assert MOTIONS["ground"].heights_from(1.3) == (1.3, 1.3)
    assert Motion(heights=(-0.5, 0.25)).heights_from(1.5) == (1.0, 1.75)
    assert Motion(heights=(0.5, 2.0), heights_above="world").heights_from(1.5) == (0.5, 2.0)
    assert [name for name, motion in MOTIONS.items() if motion.is_relative] == [
        "ground",
        "handheld",
    ]


def test_a_way_takes_its_length_and_then_its_turn():
    """Worked out by hand: 2 m at 0.5 m/s, then a quarter turn at 30 degrees/s."""
    motion = Motion(speed=0.5, turn_rate=30.0)
    assert motion.seconds(2.0, math.radians(90.0)) == pytest.approx(4.0 + 3.0)
    assert Motion(speed=0.5).seconds(2.0, 1.0) == 4.0
    assert Motion().seconds(2.0, 1.0) is None


@pytest.mark.parametrize("name", MOTIONS)
def test_a_record_reads_back_as_it_was(name):
    policy = make_policy("random", motion=MOTIONS[name])
    settings = json.loads(json.dumps(settings_of(policy), allow_nan=False))
    # Older runs have no word of a motion: they read, and are written, as they always were.
    assert ("motion" in settings) == (name != "free")
    assert motion_of_record(settings.get("motion")) == MOTIONS[name]


def test_a_record_without_refinement_reads_as_it_always_did():
    plain, refined = (settings_of(make_policy("r3", refine=num)) for num in (0, 4))
    assert not {"refine", "refine_radius"} & set(plain)
    assert refined["refine"] == 4
    assert PlannerConfig(refine_radius=refined["refine_radius"]).refine == 0


def test_a_damaged_record_is_refused():
    with pytest.raises(ValueError, match="legs"):
        motion_of_record({"legs": 2})
    with pytest.raises(InputError):
        motion_of_record("ground")


def test_a_policy_that_says_nothing_flies():
    assert motion_of(object()) == motion_of(SimpleNamespace(config=None)) == Motion()
    assert (
        motion_of(SimpleNamespace(config=PlannerConfig(motion=MOTIONS["ground"])))
        == (MOTIONS["ground"])
    )
