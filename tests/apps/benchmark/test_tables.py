"""Records that may share a table, and headings that tell the tables apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.benchmark.tables import (
    comparison_table,
    groups_on_equal_terms,
    headed_groups,
    on_equal_terms,
    reference_in,
)
from r3jax.evaluation.comparison import (
    check_equal_terms,
    mean_over_scenes,
    paired_difference,
    scores_by_method,
)
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


def entries_of(table):
    return {row.labels[0]: dict(zip(table.columns, row.entries, strict=True)) for row in table.rows}


def test_a_comparison_has_means_differences_and_costs():
    cells = benchmark(("random", "r3", "r3-pano"), views=6)
    for cell in cells:
        if cell["policy"] == "r3":
            cell["measured"] = {"decision_ms": 10.0 + cell["seed"]}
            cell["exploration"] |= {"map_bytes": 3e6}
    found = entries_of(comparison_table(cells, reference="r3"))
    scores = scores_by_method(cells, "psnr")
    mean = mean_over_scenes(scores["random"])
    assert found["random"]["PSNR [dB]"].value == pytest.approx(mean.value)
    assert found["random"]["PSNR [dB]"].extra == {"low": mean.low, "high": mean.high}
    difference = paired_difference(scores["random"], scores["r3"])
    assert found["random"]["minus r3"].value == pytest.approx(difference.value)
    assert difference.value < 0.0
    assert found["r3"]["minus r3"].value is None
    assert found["r3"]["decision [ms]"].value == pytest.approx(11.0)
    assert found["r3"]["map [MB]"].value == pytest.approx(3.0)
    assert found["random"]["decision [ms]"].value is None  # records of an earlier version
    assert found["random"]["path [m]"].value == pytest.approx(24.0)
    poor = np.mean([np.mean(np.less(c["views"]["psnr"], 20.0)) for c in cells
                    if c["policy"] == "random"])  # fmt: skip
    assert found["random"]["< 20 dB [%]"].value == pytest.approx(100.0 * poor)


def test_a_comparison_leaves_out_what_is_missing():
    cells = benchmark(("random", "r3"), views=6)
    cells = [c for c in cells if (c["policy"], c["scene"]) != ("random", "house")]
    found = entries_of(comparison_table(cells))
    assert found["random"]["PSNR [dB]"].value is None
    assert found["random"]["minus r3"].value is None
    alone = entries_of(comparison_table(cells, scenes=["flat"]))
    assert alone["random"]["minus r3"].value is not None
    fewer = [c for c in benchmark(("random", "r3"), views=6)
             if (c["policy"], c["seed"]) != ("random", 2)]  # fmt: skip
    shared = [c for c in fewer if c["seed"] != 2]
    assert (
        entries_of(comparison_table(fewer))["random"]["minus r3"]
        == entries_of(comparison_table(shared))["random"]["minus r3"]
    )


def test_the_reference_is_the_last_method_unless_told():
    cells = benchmark(("random", "r3"), views=6)
    assert reference_in(cells, None) == reference_in(cells, "mine") == "r3"
    assert reference_in(cells, "random") == "random"
    with pytest.raises(ValueError, match="mine"):
        comparison_table(cells, reference="mine")
