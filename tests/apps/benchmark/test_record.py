"""A file of records: what is read is what was written, and a damaged line is named."""

import pytest

from r3jax.apps.benchmark.record import read_records, write_records
from tests.evaluation.records import record


def test_records_come_back_in_their_order(tmp_path):
    path = tmp_path / "records.jsonl"
    records = [record(policy, seed=seed) for policy in ("r3", "random") for seed in (2, 0)]
    write_records(path, records)
    assert read_records(path) == records


@pytest.mark.parametrize("harm", ['{"format": 1}', "no JSON", "", '{"format": 99}'])
def test_a_line_that_is_no_record_is_named(tmp_path, harm):
    path = tmp_path / "records.jsonl"
    write_records(path, [record(seed=0), record(seed=1)])
    first, second = path.read_text().splitlines()
    path.write_text(f"{first}\n{harm}\n{second}\n")
    with pytest.raises(ValueError, match=r"records\.jsonl, line 2"):
        read_records(path)
