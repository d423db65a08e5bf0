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
def test_what_is_encoded_is_a_header_and_the_bytes_of_its_arrays(message):
    data = encode(message)
    end = 8 + struct.unpack("<I", data[:4])[0]
    header = json.loads(data[8:end])
    assert len(data) == end + struct.unpack("<I", data[4:8])[0]
    assert header.pop("kind") == message.kind
    assert [entry["name"] for entry in header.pop("arrays")] == list(message.arrays)
    assert header == message.fields
    assert data[end:] == b"".join(
        array.astype(array.dtype.newbyteorder("<")).tobytes() for array in message.arrays.values()
    )


@given(messages())
def test_an_answer_is_decoded(message):
    data = encode(Message(message.kind, message.fields))
    assert length_of(data[: PREFIX.size]) == len(data)
    assert decode(data) == Message(message.kind, message.fields)


@given(messages(), st.data())
def test_damaged_bytes_are_refused_or_another_message(message, data):
    """A byte changed, a piece taken out or put in: a message or a `MessageError`, nothing else."""
    whole = bytearray(encode(Message(message.kind, message.fields)))
    place = data.draw(st.integers(0, len(whole) - 1))
    piece = data.draw(st.binary(max_size=6))
    whole[place : place + data.draw(st.integers(0, 6))] = piece
    with contextlib.suppress(MessageError):
        decode(bytes(whole))


def raw(header, data=b""):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return PREFIX.pack(len(text), len(data)) + text + data


@pytest.mark.parametrize(
    "data",
    [
        b"",
        raw({"kind": "view"})[:-1],
        b"Loading weights ...\n",
        PREFIX.pack(MAX_HEADER + 1, 0),
        raw({"kind": "view"}, b"ab"),
        raw(b"\x80\x04]\x94."),
        raw(b'{"kind": "view", "position": [NaN]}'),
        raw([1]),
        raw({}),
        raw({"kind": "view", "arrays": 3}),
        raw({"kind": "view", "arrays": [{"name": "a", "dtype": "uint8", "shape": [0]}]}),
    ],
)
def test_what_is_no_answer_is_refused(data):
    with pytest.raises(MessageError):
        decode(data)


def test_what_cannot_be_sent_is_refused():
    with pytest.raises(ValueError, match="complex128"):
        encode(Message("decide", arrays={"a": np.zeros(2, complex)}))
    with pytest.raises(ValueError, match="JSON"):
        encode(Message("decide", {"path": float("inf")}))


def test_the_bytes_lie_as_the_documentation_says():
    data = encode(Message("view", {"x": 1}, {"a": np.array([[1, 2]], np.int32)}))
    header = b'{"kind":"view","x":1,"arrays":[{"name":"a","dtype":"int32","shape":[1,2]}]}'
    assert data == struct.pack("<II", len(header), 8) + header + struct.pack("<ii", 1, 2)
