"""What goes beyond the paper against the reference: variants, paths, and the aim, by hand."""

import csv

import numpy as np
import pytest

from experiments import extensions
from experiments.degeneracy import revisit_rate
from experiments.pages.artifacts import Origin
from r3jax.trace.reader import read_run
from r3jax.trace.writer import RunWriter
from tests.evaluation.records import record
from tests.trace.runs import make_header, make_view

SOURCE = Origin("python -m experiments.extensions", "a machine", "abc")
PSNR = {("", 1): 18.0, ("", 2): 20.0, ("refine", 1): 19.0, ("refine", 2): 21.5}
"""By setting and views, the same for every test view but for what makes it hard."""


@pytest.fixture(scope="module")
def records():
    hard = np.arange(12.0)
    return [
        record("ours-pano", scene, seed, views, budget=2, psnr=PSNR[name, views] + hard)
        | {"run": "run", "settings": {name: 4} if name else {}}
        for name in ("", "refine")
        for scene in ("flat", "office")
        for seed in (0, 1)
        for views in (1, 2)
    ]


def test_variants_are_policies_with_settings():
    assert extensions.parse_variant("ours-ahead") == ("ours-ahead", {})
    found = extensions.parse_variant("ours:refine=4,lambda1=0.5,motion=ground")
    assert found == ("ours", {"refine": 4, "lambda1": 0.5, "motion": "ground"})
    with pytest.raises(ValueError, match="variant 'ours:refine' takes NAME=VALUE, got 'refine'"):
        extensions.parse_variant("ours:refine")


def test_every_variant_is_asked_for_on_the_same_terms():
    options = extensions.Options(size="small", variants=("ours-pano", "ours-pano:refine=4"))
    requests = extensions.requests_of(options)
    assert [request.settings for request in requests] == [{}, {"refine": 4}] * 3
    assert [request.scenes for request in requests[::2]] == [
        request.scenes for request in requests[1::2]
    ]
    assert len({(str(r.conditions), r.seeds, r.max_test_views) for r in requests}) == 1
    for request in requests:  # the settings are some that the policy has
        request.conditions.policy(*request.policies, request.settings)
    with pytest.raises(ValueError, match="lacks ours-pano"):
        extensions.requests_of(extensions.Options(variants=("ours-pano:refine=4",)))


def test_the_aim_compares_fewer_views_with_all_of_the_reference(records):
    rows = {
        (row["method"], row["after"]): row["difference"] for row in extensions.aim_rows(records)
    }
    assert rows == pytest.approx(
        {
            ("ours-pano", "views:1"): -2.0,
            ("ours-pano (refine=4)", "views:1"): -1.0,
            ("ours-pano (refine=4)", "views:2"): 1.5,
        }
    )


def test_the_page_holds_quality_paths_and_aim(records, tmp_path):
    with RunWriter(tmp_path / "run", make_header()) as writer:
        for step in range(3):
            writer.add(*make_view(step))
    extensions.write_page(tmp_path / "out", tmp_path, records, SOURCE)
    page = (tmp_path / "out" / "beyond.md").read_text()
    assert SOURCE.commit in page
    assert "| ours-pano (refine=4) | views:2 | +1.50 |" in page
    lines = (tmp_path / "out" / "paths.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [(row["method"], row["scene"]) for row in rows] == [
        (method, scene)
        for method in ("ours-pano", "ours-pano (refine=4)")
        for scene in ("flat", "office")
    ]
    poses = np.stack([np.asarray(row.pose) for row in read_run(tmp_path / "run").rows[:2]])
    assert float(rows[0]["revisit rate"]) == revisit_rate(poses)
    assert float(rows[0]["path [m]"]) == pytest.approx(0.4 * 2)
