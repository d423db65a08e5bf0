"""Records that may share a table, and headings that tell the tables apart."""

from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.benchmark.tables import groups_on_equal_terms, headed_groups, on_equal_terms
from r3jax.evaluation.comparison import check_equal_terms
from tests.evaluation.records import benchmark, record

TRAINING = record()["training"]


def of(name="r3", scene="flat", clock="model", iterations=50, version=0):
    """A record; another `version` is one of the same name."""
    training = TRAINING | {"iterations": iterations}
    return record(name, scene, views=6, clock=clock, training=training, commit=str(version))


RECORDS = st.builds(
    of,
    st.sampled_from(["r3", "random"]),
    st.sampled_from(["flat", "house"]),
    st.sampled_from(["model", "wall"]),
    st.sampled_from([50, 100]),
    st.sampled_from([0, 1, 2]),
)


def test_records_of_other_terms_have_a_table_of_their_own():
    same = benchmark(("r3", "random"), scenes=("flat",), seeds=(0, 1), views=6)
    other = record("r3", views=6, clock="wall")
    twice = record("r3", seed=0, snapshot=60, views=6)
    groups = groups_on_equal_terms([*same, other, twice])
    assert [len(group) for group in groups] == [4, 1, 1]


@given(st.lists(RECORDS, min_size=1, max_size=8))
def test_every_record_is_in_one_table_and_no_two_tables_have_one_heading(records):
    found = headed_groups(records)
    for _, group in found:
        check_equal_terms(group)
    key = lambda one: repr(sorted(one.items()))
    assert sorted(key(one) for _, group in found for one in group) == sorted(map(key, records))
    headings = [heading for heading, _ in found]
    assert len(set(headings)) == len(headings)
    for heading, (one, *_) in found:
        if len({each["clock"] for each in records}) > 1:
            assert f"the clock: {one['clock']}" in heading
        else:
            assert "clock" not in heading


def test_a_heading_tells_what_differs_and_nothing_else():
    assert [heading for heading, _ in headed_groups([of(), of("random")])] == ["views:30"]
    assert [heading for heading, _ in headed_groups([of(), of("random", iterations=100)])] == [
        "views:30, training iterations: 50",
        "views:30, training iterations: 100",
    ]
    other = of("random") | {"scene_hash": "f" * 64}
    assert [heading for heading, _ in headed_groups([of(), other, of(scene="house")])] == [
        "views:30, the scene's hash in flat: hash of flat",
        f"views:30, the scene's hash in flat: {'f' * 24}...",
    ]
    (_, again) = headed_groups([of(), of(version=1)])
    assert again[0] == ("views:30, table 2 on the same terms: it has a record of the same name")
    older = of("random")
    older["sensing"] = {k: v for k, v in older["sensing"].items() if k != "noise"}
    assert headed_groups([older, of()])[0][0] == "views:30, the exploration's noise: None"


def test_terms_do_not_depend_on_names():
    assert on_equal_terms(of(), of("random"))
    assert on_equal_terms(of(), of(version=1))
    assert not on_equal_terms(of(), of(clock="wall"))
    assert not on_equal_terms(of(), of() | {"scene_hash": "another"})
