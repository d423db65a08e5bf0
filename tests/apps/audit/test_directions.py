"""Directions lead to the view: what the words say is done, and the camera is where it should be."""

import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.audit import directions
from r3jax.apps.audit.directions import spoken_length, steps_between
from r3jax.apps.audit.suggest import walking_order
from tests.apps.audit.room import pose_at
from tests.captures.test_standpoints import grid_of

NUMBER = r"([\d.]+) (cm|m)"


def amount(text: str, what: str) -> float:
    """The length that is said before a word; 0 if it is not said."""
    found = re.search(f"{NUMBER} {what}", text)
    return 0.0 if found is None else float(found[1]) * (0.01 if found[2] == "cm" else 1.0)


def followed(here: np.ndarray, text: str) -> tuple[np.ndarray, float, float]:
    """Where the camera is, its heading and its elevation [deg], for one who does as told."""
    axis = here[:3, 2] if np.hypot(*here[:2, 2]) > 0.05 else -here[:3, 1]
    forward = np.array([*axis[:2], 0.0]) / np.hypot(*axis[:2])
    left = np.array([-forward[1], forward[0], 0.0])
    place = here[:3, 3] + (amount(text, "forward") - amount(text, "back")) * forward
    place = place + (amount(text, "to the left") - amount(text, "to the right")) * left
    place = place + np.array([0.0, 0.0, amount(text, "higher") - amount(text, "lower")])
    turn = re.search(r"turn (\d+)° to the (left|right)", text)
    quarter = re.search(r"turn a quarter to the (left|right)", text)
    angle = 180.0 if "turn round" in text else 0.0
    if quarter is not None:
        angle = 90.0 if quarter[1] == "left" else -90.0
    elif turn is not None:
        angle = float(turn[1]) * (1.0 if turn[2] == "left" else -1.0)
    tilt = re.search(r"tilt it (\d+)° (up|down)", text)
    elevation = 0.0 if tilt is None else float(tilt[1]) * (1.0 if tilt[2] == "up" else -1.0)
    return place, np.degrees(np.arctan2(forward[1], forward[0])) + angle, elevation


coordinate = st.floats(-3.0, 3.0)


@given(
    st.tuples(coordinate, coordinate, coordinate),
    st.tuples(st.floats(-180, 180), st.floats(-75, 75), st.floats(-180, 180), st.floats(-70, 70)),
)
def test_who_does_as_told_is_there(offset, angles):
    heading, tilt, wanted, elevation = np.radians(angles)
    axis = lambda h, e: np.array([np.cos(h) * np.cos(e), np.sin(h) * np.cos(e), np.sin(e)])
    eye = np.array([1.0, 2.0, 1.5])
    here = pose_at(eye, eye + axis(heading, tilt))
    there = pose_at(eye + offset, eye + offset + axis(wanted, elevation))
    place, turned, tilted = followed(here, ", ".join(steps_between(here, there, 1.0)))
    assert np.abs(place - there[:3, 3]).max() <= 0.05 + 1e-6
    assert abs((turned - angles[2] + 180.0) % 360.0 - 180.0) <= 15.0 + 1e-6
    assert abs(tilted - angles[3]) <= 5.0 + 1e-6


def legs(here: np.ndarray, text: str) -> np.ndarray:
    """The corners of the way that words describe, [k, 2]."""
    forward = here[:2, 2] / np.hypot(*here[:2, 2])
    axes = {"forward": forward, "back": -forward,
            "to the left": np.array([-forward[1], forward[0]]),
            "to the right": np.array([forward[1], -forward[0]])}  # fmt: skip
    corners = [here[:2, 3]]
    straight = re.search(rf"{NUMBER} straight, (\d+)° to the (left|right)", text)
    if straight is not None:
        angle = np.radians(float(straight[3]) * (1.0 if straight[4] == "left" else -1.0))
        ahead = np.cos(angle) * forward + np.sin(angle) * axes["to the left"]
        return np.stack([*corners, corners[0] + amount(text, "straight") * ahead])
    going = text.split(", ")[0]
    for number, unit, side in re.findall(
        f"{NUMBER} (forward|back|to the left|to the right)", going
    ):
        step = float(number) * (0.01 if unit == "cm" else 1.0)
        corners.append(corners[-1] + step * axes[side])
    return np.stack(corners)


@given(st.integers(0, 400))
def test_a_way_goes_through_nothing_where_one_of_three_does_not(seed):
    rng = np.random.default_rng(seed)
    free = rng.random((20, 20, 8)) > 0.06
    eye, aim = rng.uniform(0.6, 3.4, 3) * [1, 1, 0.3], rng.uniform(0.6, 3.4, 3) * [1, 1, 0.3]
    heading = rng.uniform(0, 2 * np.pi)
    here = pose_at(eye, eye + np.array([np.cos(heading), np.sin(heading), 0.0]))
    there = pose_at(aim, aim + np.eye(3)[0])
    order = directions._order(here, there, grid_of(free))

    def meets(corners: np.ndarray) -> bool:
        height = np.r_[np.full(len(corners) - 1, eye[2]), aim[2]]
        points = np.column_stack([corners, height])
        line = np.concatenate([a + np.linspace(0, 1, 2000)[:, None] * (b - a)
                               for a, b in pairwise(points)])  # fmt: skip
        return bool((~free[tuple((line / 0.2).astype(int).T)]).any())

    forward = here[:2, 2] / np.hypot(*here[:2, 2])
    ahead = (aim - eye)[:2] @ forward * forward
    ways = {"forward": np.stack([eye[:2], eye[:2] + ahead, aim[:2]]),
            "aside": np.stack([eye[:2], aim[:2] - ahead, aim[:2]])}  # fmt: skip
    if order != "straight":
        assert not meets(ways[order])
        said = legs(here, ", ".join(steps_between(here, there, 1.0, order=order)))
        assert np.abs(said[-1] - aim[:2]).max() <= 0.1
        if len(said) == 3:  # the same corner as is checked, up to a step
            assert np.abs(said[1] - ways[order][1]).max() <= 0.1
    elif not meets(np.stack([eye[:2], aim[:2]])):
        said = legs(here, ", ".join(steps_between(here, there, 1.0, order=order)))
        assert np.linalg.norm(said[-1] - aim[:2]) <= 0.05 + 0.12 * np.linalg.norm((aim - eye)[:2])


@pytest.mark.parametrize("floor", [0.2, np.nan])
def test_a_table_between_two_places_stops_a_body_and_no_drone(floor):
    free = np.zeros((33, 17, 14), bool)
    free[1:32, 1:16, 1:13] = True
    free[12:18, 1:16, 3:5] = False  # its top, from wall to wall
    there, grid = pose_at([5.0, 1.6, 1.7], [9.0, 1.6, 1.7]), grid_of(free)
    picture = pose_at([1.0, 1.6, 1.6], [2.0, 1.6, 1.6])
    _, is_blocked = directions._nearest(picture[None], grid, there, floor)
    assert is_blocked == np.isfinite(floor)
    assert directions._order(picture, there, grid, floor) == (
        "straight" if is_blocked else "forward"
    )


def test_turning_on_the_spot_meets_nothing():
    free = np.zeros((33, 17, 14), bool)  # held against the thing that it looks at
    there = pose_at([1.0, 1.6, 1.6], [9.0, 1.6, 1.6])
    poses = np.stack([pose_at([1.0, 1.6, 1.6], [1.0, 2.6, 1.6]),
                      pose_at([2.0, 1.6, 1.6], [2.0, 2.6, 1.6])])  # fmt: skip
    assert directions._nearest(poses, grid_of(free), there, 0.2) == (0, False)


def test_a_picture_that_looks_straight_down_faces_its_upper_edge():
    here = np.eye(4)
    here[:3, :3] = np.stack([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], axis=1)
    there = pose_at([1.0, 0.0, 0.0], [1.0, 1.0, 0.0])
    place, heading, _ = followed(here, ", ".join(steps_between(here, there, 1.0)))
    np.testing.assert_allclose(place, [1.0, 0.0, 0.0], atol=1e-9)
    assert abs(heading - 90.0) < 1e-9


def test_lengths_are_said_in_steps_of_a_person():
    said = [spoken_length(x, "m") for x in (0.01, 0.34, 0.94, 0.97, 2.34)]
    assert said == ["10 cm", "30 cm", "90 cm", "1.0 m", "2.3 m"]
    assert spoken_length(0.0123, "u") == "0.012 u"


@given(st.integers(0, 200))
def test_a_walk_comes_to_each_view_once_and_to_the_nearest_first(seed):
    rng = np.random.default_rng(seed)
    eyes, start = rng.normal(size=(int(rng.integers(0, 9)), 3)), rng.normal(size=3)
    order = walking_order(eyes, start)
    assert sorted(order) == list(range(len(eyes)))
    here = start
    for place, index in enumerate(order):
        rest = eyes[order[place:]]
        assert (
            np.linalg.norm(eyes[index] - here) <= np.linalg.norm(rest - here, axis=1).min() + 1e-9
        )
        here = eyes[index]
