"""The table of frames on the way: modes apart, numbers by hand."""

import numpy as np
import pytest

from experiments.captures import MODES, Options, quality_rows, requests_of


def record(policy, seed, psnr, views, **settings):
    return {
        "policy": policy, "settings": settings, "scene": "flat", "seed": seed,
        "views": {"psnr": psnr}, "exploration": {"views": views},
    }  # fmt: skip


def test_each_mode_is_a_request_of_its_own_under_the_model_clock():
    requests = requests_of(Options(policies=("active-gs",)))
    assert [request.conditions.loop.get("capture_every") for request in requests] == [
        None,
        0.3,
        0.3,
    ]
    assert [bool(r.conditions.loop.get("plan_while_moving")) for r in requests] == [0, 0, 1]
    assert {request.conditions.clock for request in requests} == {"model"}
    assert len(requests) == len(MODES)
    with pytest.raises(ValueError, match="'asleep' is none of"):
        requests_of(Options(modes=("asleep",)))


def test_a_line_per_method_by_hand():
    records = [
        record("active-gs", 0, [10.0, 20.0], 40),
        record("active-gs", 1, [12.0, 22.0], 50),
        record("active-gs", 0, [18.0, 22.0], 90, **{"on the way": "captures"}),
        record("active-gs", 1, [20.0, 24.0], 110, **{"on the way": "captures"}),
    ]
    blind, seen = quality_rows(records)
    assert blind == {
        "method": "active-gs", "flat": "16.00 [11.5] / 45", "mean": "16.00", "minus active-gs": "",
    }  # fmt: skip
    assert seen["method"] == "active-gs (on the way=captures)"
    assert seen["flat"] == f"21.00 [{np.mean([18.2, 20.2]):.1f}] / 100"
    assert seen["minus active-gs"].startswith("+5.00 [")
