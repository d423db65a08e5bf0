"""Records have exactly the fields and types that their class names."""

from dataclasses import dataclass, field

import pytest

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.json_text import build, check_fields, check_type


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
        ({"count": 3.0}, "`count` must be int"),
        ({"count": True}, "`count` must be int"),
        ({"length": "2"}, "`length` must be float"),
        ({"length": float("nan")}, "`length` must be float"),
        ({"length": True}, "`length` must be float"),
        ({"name": None}, "`name` must be str"),
        ({"costs": {"x": "1"}}, "`costs` must be"),
        ({"costs": [1.0]}, "`costs` must be"),
        ({"row": [1.0, "x"]}, "`row` must be"),
        ({"surprise": 1}, "unknown 'surprise'"),
    ],
)
def test_another_type_is_named(change, reason):
    with pytest.raises(ForeignFileError, match=reason):
        build(Record, PLAIN | change)


def test_a_missing_field_is_named():
    with pytest.raises(ForeignFileError, match="the Record lacks name"):
        build(Record, {k: v for k, v in PLAIN.items() if k != "name"})
    with pytest.raises(ForeignFileError, match=r"`thing` lacks b"):
        check_fields("thing", {"a": 1}, {"a": int, "b": str | None})
    with pytest.raises(ForeignFileError, match="expected the fields of a Record, got"):
        build(Record, [1])


def test_a_long_value_is_cut():
    with pytest.raises(ForeignFileError) as caught:
        check_type("x", "y" * 100_000, int)
    assert len(str(caught.value)) < 200
