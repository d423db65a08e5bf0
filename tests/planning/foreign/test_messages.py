"""Messages: what is encoded is decoded; other bytes are refused in words, and never executed."""

import contextlib
import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from r3jax.planning.policies.foreign.messages import (
    DTYPES,
    MAX_ARRAYS,
    MAX_HEADER,
    PREFIX,
    Message,
    MessageError,
    decode,
    encode,
    length_of,
)

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 60), 1 << 60) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=5,
)
ARRAYS = st.sampled_from(sorted(DTYPES)).flatmap(
    lambda name: arrays(
        np.dtype(name), array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
    )
)


@st.composite
def messages(draw):
    fields = draw(st.dictionaries(st.text(max_size=5), PLAIN, max_size=3))
    for reserved in ("kind", "arrays"):
        fields.pop(reserved, None)
    named = draw(st.dictionaries(st.text(max_size=5), ARRAYS, max_size=3))
    return Message(draw(st.text(max_size=5)), fields, named)


@given(messages())
def test_what_is_encoded_is_decoded(message):
    data = encode(message)
    assert length_of(data[: PREFIX.size]) == len(data)
    again = decode(data)
    assert (again.kind, again.fields) == (message.kind, message.fields)
    assert list(again.arrays) == list(message.arrays)
    for name, array in message.arrays.items():
        assert again.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(again.arrays[name], array)


@given(messages(), st.data())
def test_damaged_bytes_are_refused_or_another_message(message, data):
    """A byte changed, a piece taken out or put in: a message or a `MessageError`, nothing else."""
    whole = bytearray(encode(message))
    place = data.draw(st.integers(0, len(whole) - 1))
    piece = data.draw(st.binary(max_size=6))
    whole[place : place + data.draw(st.integers(0, 6))] = piece
    with contextlib.suppress(MessageError):
        decode(bytes(whole))


def raw(header, data=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return PREFIX.pack(len(text), len(data)) + text + data


def listed(**entry):
    return {"kind": "view", "arrays": [{"name": "a", "dtype": "uint8", "shape": [2]} | entry]}


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "0 bytes are not a whole message"),
        (raw({"kind": "view"})[:-1], "bytes are not a whole message"),
        (b"Loading weights ...\n", "nothing but messages may go to the standard output"),
        (PREFIX.pack(MAX_HEADER + 1, 0), "announce a header of 1048577"),
        (PREFIX.pack(2, MAX_ARRAYS + 1) + b"{}", "and arrays of 67108865 bytes"),
        (raw(b"\x80\x04]\x94."), "the header is not understood: this is not JSON"),
        (raw(b'{"kind": "view", "position": [NaN]}'), "NaN is no number"),
        (raw([1]), "`header` must be dict"),
        (raw({}), "`kind` must be str"),
        (raw({"kind": "view", "arrays": 3}), "`arrays` must be list"),
        (raw(listed(shape=[-1])), "is odd or listed twice"),
        (raw(listed(shape=2)), "`a.shape` must be list"),
        (raw(listed(dtype="object"), b"ab"), "is odd or listed twice"),
        (raw(listed(shape=[1 << 40])), "more numbers than bytes were sent"),
        (raw(listed(), b"a"), "more numbers than bytes were sent"),
        (raw(listed(), b"abc"), "1 bytes belong to no array"),
        (raw({"kind": "view", "arrays": 2 * listed()["arrays"]}, b"abcd"), "listed twice"),
    ],
)
def test_what_is_no_message_is_refused(data, says):
    with pytest.raises(MessageError, match=says):
        decode(data)


def test_what_cannot_be_sent_is_refused():
    with pytest.raises(ValueError, match="the array 'a' is complex128"):
        encode(Message("decide", arrays={"a": np.zeros(2, complex)}))
    with pytest.raises(ValueError, match="JSON"):
        encode(Message("decide", {"path": float("inf")}))


def test_the_bytes_lie_as_the_documentation_says():
    data = encode(Message("view", {"x": 1}, {"a": np.array([[1, 2]], np.int32)}))
    header = b'{"kind":"view","x":1,"arrays":[{"name":"a","dtype":"int32","shape":[1,2]}]}'
    assert data == struct.pack("<II", len(header), 8) + header + struct.pack("<ii", 1, 2)
