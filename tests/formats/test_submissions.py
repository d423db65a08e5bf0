"""Submissions as files: what is written is read, what is damaged is refused and said where."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from r3jax.formats.errors import FormatError
from r3jax.formats.submissions import (
    Submission,
    SubmittedFrame,
    content_hash,
    parse_submission,
    read_submission,
    submission_text,
    write_submission,
)
from r3jax.validation.errors import ForeignFileError

SCENE = {"name": "flat", "hash": "0" * 64, "noise": 0.01, "max_range": 5.0}
SCENE |= {"up": None, "scale": 1.0, "cull_backfaces": False}
CAMERA = {"width": 64, "height": 64, "fx": 55.4, "fy": 55.4, "cx": 32.0, "cy": 32.0}


def make_submission(frames=2, **changes):
    """Frames a tenth of a meter apart, one a second."""
    fields = {
        "scene": SCENE,
        "seed": 0,
        "budget": "views:60",
        "camera": CAMERA,
        "policy": {"name": "mine", "version": "3"},
        "frames": tuple(
            SubmittedFrame(n, pose_at(0.1 * n, 0.0, 1.0), 1.0 * n) for n in range(frames)
        ),
        "exploration": {"clock": "model"},
    }
    return Submission(**fields | changes)


def pose_at(x, y, z):
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = x, y, z
    return pose


LENGTHS = st.floats(-50.0, 50.0, width=32)
TIMES = st.floats(0.0, 1e6, allow_nan=False)


@st.composite
def frames(draw):
    number = draw(st.integers(1, 4))
    made = []
    for index in range(number):
        q, _ = np.linalg.qr(
            draw(arrays(np.float64, (3, 3), elements=st.floats(-1.0, 1.0))) + np.eye(3) * 3
        )
        pose = pose_at(*draw(st.tuples(LENGTHS, LENGTHS, LENGTHS)))
        pose[:3, :3] = q * np.sign(np.linalg.det(q))
        path = draw(st.none() | arrays(np.float32, (draw(st.integers(2, 4)), 3), elements=LENGTHS))
        made.append(
            SubmittedFrame(
                index,
                pose,
                draw(TIMES),
                draw(TIMES),
                draw(st.none() | TIMES),
                path,
                draw(st.booleans()),
                draw(st.none() | st.just("ab" * 32)),
            )
        )
    return tuple(made)


def assert_same(a, b):
    for item in dataclasses.fields(Submission):
        if item.name != "frames":
            assert getattr(a, item.name) == getattr(b, item.name), item.name
    assert len(a.frames) == len(b.frames)
    for mine, theirs in zip(a.frames, b.frames, strict=True):
        for item in dataclasses.fields(SubmittedFrame):
            np.testing.assert_array_equal(getattr(mine, item.name), getattr(theirs, item.name))


@given(frames())
def test_what_is_written_is_read_bit_for_bit(made):
    submission = dataclasses.replace(make_submission(), frames=made)
    again = parse_submission(submission_text(submission).encode())
    assert_same(again, submission)
    assert content_hash(again) == content_hash(submission)


def test_a_file_is_a_line_for_each_frame_after_the_first_one(tmp_path):
    path = tmp_path / "mine.jsonl"
    write_submission(path, make_submission(frames=5))
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0]["format"] == "r3jax-submission"
    assert [line["frame"] for line in lines[1:]] == [0, 1, 2, 3, 4]
    assert lines[2].keys() == {"frame", "pose", "seconds"}  # what is at its default is left out
    assert_same(read_submission(path), make_submission(frames=5))


def changed(line, **fields):
    """The lines of a submission of three frames, some fields of one of them changed."""
    lines = [json.loads(text) for text in submission_text(make_submission(3)).splitlines()]
    lines[line] |= fields
    lines[line] = {k: v for k, v in lines[line].items() if v is not ...}
    return "\n".join(map(json.dumps, lines)).encode()


SCALED = (2.0 * np.eye(4)).tolist()
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "line 1"),
        (b"\xff\xfe", "line 1"),
        (b"{}\n", "line 1.*format"),
        (submission_text(make_submission(1)).splitlines()[0].encode(), "no frames"),
        (changed(0, version=2), "line 1.* 2"),
        (changed(0, protocol=9), "line 1.*protocol 9"),
        (changed(0, protocol="1"), "line 1.*protocol"),
        (changed(0, protocol=True), "line 1.*protocol True"),
        (changed(0, budget=...), "line 1.*budget"),
        (changed(0, speed=3), "line 1.*'speed'"),
        (changed(0, scene={"name": "flat"}), "line 1.*scene.*hash"),
        (changed(0, scene=SCENE | {"hash": 3}), "line 1.*scene.hash"),
        (changed(0, camera=CAMERA | {"width": 3.5}), "line 1.*camera.width"),
        (changed(0, camera=CAMERA | {"fx": 0.0}), "line 1: fx"),
        (changed(0, policy={"name": "mine"}), "line 1.*policy.*version"),
        (changed(0, exploration={"haste": 1}), "line 1.*exploration.*'haste'"),
        (changed(0, exploration={"speed": -1.0}), "line 1: speed"),
        (changed(0, exploration={"num_bins": 1 << 40}), "exploration.num_bins"),
        (changed(0, motion={"speed": 0.0}), "line 1: speed"),
        (changed(0, exploration={"speed": "fast"}), "line 1.*exploration.speed"),
        (changed(0, exploration={"clock": "sun"}), "line 1.*exploration.clock"),
        (changed(0, motion={"heights": "low"}), "line 1.*motion.heights"),
        (changed(0, outcome="tired"), "line 1.*outcome"),
        (changed(2, frame=0), "line 3.*frame 0"),
        (changed(2, frame=2), "line 3.*frame 2"),
        (changed(3, pose=SCALED), "line 4: `pose`"),
        (changed(3, pose=MIRRORED), "line 4: `pose`"),
        (changed(3, pose=[[1.0]]), "line 4: `pose`"),
        (changed(3, pose=...), "line 4.*`pose`"),
        (changed(3, pose=[[str(x) for x in row] for row in np.eye(4)]), "line 4: `pose`"),
        (changed(3)[:-40], "line 4"),
        (changed(3).replace(b"\n", b"\n \n", 1), "line 2"),
        (changed(3, seconds="late"), "line 4.*seconds"),
        (changed(3, path=[[0.0, 0.0, 0.0]]), "line 4: `path`"),
        (changed(3, shutter=1), "line 4.*'shutter'"),
        (changed(3).replace(b'"seconds": 2.0', b'"seconds": NaN'), "line 4: NaN"),
        (changed(3).replace(b'"frame": 2', b'"frame": 2, "frame": 2'), "line 4.*'frame'"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(data, says, tmp_path):
    with pytest.raises(ForeignFileError, match=says):
        parse_submission(data)
    (tmp_path / "theirs.jsonl").write_bytes(data)
    with pytest.raises(FormatError, match=r"theirs\.jsonl: "):
        read_submission(tmp_path / "theirs.jsonl")


def test_a_byte_order_mark_and_empty_lines_at_the_end_change_nothing():
    data = changed(1)
    odd = b"\xef\xbb\xbf" + data + b"\r\n\n \n"
    assert_same(parse_submission(odd), parse_submission(data))
