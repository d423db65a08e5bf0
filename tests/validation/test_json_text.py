"""JSON reads as Python's own reader has it, and records have the fields that their classes name."""

import json
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import build, check_fields, check_type, parse_json

texts = st.text(st.characters(codec="utf-8"), max_size=5)
leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63) + 1, 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts
)
trees = st.recursive(leaves, lambda t: st.lists(t, max_size=3) | st.dictionaries(texts, t))


@given(trees)
def test_what_is_written_is_read(tree):
    text = json.dumps(tree)
    assert parse_json(text) == parse_json(text.encode()) == tree


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b'{"a": 1, "b": {"c": 1, "c": 1}}', "'c' occurs twice"),
        (b"[NaN]", "NaN"),
        (b"[-Infinity]", "-Infinity"),
        (b"[1e999]", "1e999"),
        (b"[9223372036854775808]", "is too large"),
        (b"1" * 5000, "is too large"),
        (b"[" * 100_000, "nested too deeply"),
        (b'["\\ud800"]', "not JSON"),
        (b"\xff\xfe[]", "not JSON"),
        (b"", "not JSON"),
        (b"[1] [2]", "not JSON"),
    ],
)
def test_what_is_refused(data, reason):
    with pytest.raises(ForeignFileError, match=reason):
        parse_json(data)


def test_both_halves_of_a_character_are_one():
    assert parse_json(b'"\\ud83d\\ude00"') == "\N{GRINNING FACE}"


@pytest.mark.parametrize("part", ["[]", "{}", "1.5"])
def test_more_values_than_fit_into_memory_are_refused_unread(part):
    text = "[" + ",".join([part] * 4_100_000) + "]"
    with pytest.raises(ForeignFileError, match="4,000,000"):
        parse_json(text)


@dataclass(frozen=True)
class Inner:
    value: float


@dataclass(frozen=True)
class Record:
    count: int
    length: float
    name: str
    costs: dict[str, float]
    row: list[float | None]
    inner: Inner | None
    extra: dict[str, int] = field(default_factory=dict)


PLAIN = {
    "count": 3, "length": 2, "name": "a", "costs": {"x": 0.5}, "row": [1.5, None], "inner": None,
}  # fmt: skip


def test_a_record_is_built():
    record = build(Record, PLAIN | {"extra": {"k": 1}})
    assert record == Record(3, 2, "a", {"x": 0.5}, [1.5, None], None, {"k": 1})
    ready = build(Record, PLAIN | {"inner": "replaced"}, inner=build(Inner, {"value": 1.0}))
    assert ready.inner == Inner(1.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"count": 3.0}, "`count`"),
        ({"count": True}, "`count`"),
        ({"length": "2"}, "`length`"),
        ({"length": float("nan")}, "`length`"),
        ({"length": True}, "`length`"),
        ({"name": None}, "`name`"),
        ({"costs": {"x": "1"}}, "`costs`"),
        ({"costs": [1.0]}, "`costs`"),
        ({"row": [1.0, "x"]}, "`row`"),
        ({"surprise": 1}, "unknown 'surprise'"),
    ],
)
def test_another_type_is_named(change, reason):
    with pytest.raises(ForeignFileError, match=reason):
        build(Record, PLAIN | change)


def test_a_missing_field_is_named():
    with pytest.raises(ForeignFileError, match=r"Record.*name"):
        build(Record, {k: v for k, v in PLAIN.items() if k != "name"})
    with pytest.raises(ForeignFileError, match=r"`thing` .* b"):
        check_fields("thing", {"a": 1}, {"a": int, "b": str | None})
    with pytest.raises(ForeignFileError, match="Record"):
        build(Record, [1])


def test_a_long_value_is_cut():
    with pytest.raises(ForeignFileError) as caught:
        check_type("x", "y" * 100_000, int)
    assert len(str(caught.value)) < 200
