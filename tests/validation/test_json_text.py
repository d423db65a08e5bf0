"""JSON reads as Python's own reader has it, but for what no file should hold."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import parse_json

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
        (b"[NaN]", "NaN is no number"),
        (b"[-Infinity]", "-Infinity is no number"),
        (b"[1e999]", "1e999 is too large"),
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
    with pytest.raises(ForeignFileError, match="more than 4,000,000 values"):
        parse_json(text)
