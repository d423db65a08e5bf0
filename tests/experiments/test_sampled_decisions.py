"""Decisions on a sample against exact ones: the comparison by hand, and a short flight."""

import csv

import numpy as np
import pytest

from experiments import sampled_decisions
from experiments.sampled_decisions import Options, Size, compared, page
from r3jax.planning.candidates import poses_along
from r3jax.planning.policy import Decision

pytestmark = pytest.mark.full

PLACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
TOTAL = np.array([-0.1, 0.3, 0.5, -np.inf])
"""The last one is padding, and repeats the best place."""


def chosen(place: int, direction: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Decision:
    poses = poses_along(PLACES, np.tile([1.0, 0.0, 0.0], (len(PLACES), 1)))
    pose = poses_along(PLACES[[place]], np.array([direction]))[0]
    return Decision(pose, PLACES[[0, place]], 1.0, 0.5, poses, {"total": TOTAL})


def test_what_is_lost_is_a_share_of_the_range():
    assert compared(chosen(2), chosen(2)) == {"same_place": True, "same_view": True, "loss": 0.0}
    other = compared(chosen(2), chosen(1))
    assert not other["same_place"]
    np.testing.assert_allclose(other["loss"], 1 / 3)  # 0.5 - 0.3 of 0.5 + 0.1
    turned = compared(chosen(2), chosen(2, (0.0, 1.0, 0.0)))
    assert turned == {"same_place": True, "same_view": False, "loss": 0.0}


def test_where_all_are_good_the_worst_has_not_lost_everything():
    exact = chosen(2)
    exact.utilities["total"] = np.array([0.3, 0.4, 0.5, -np.inf])
    np.testing.assert_allclose(compared(exact, chosen(0))["loss"], 0.4)  # 0.5 - 0.3 of 0.5


def test_a_place_without_an_exact_total_is_not_rated():
    exact = chosen(2)
    exact.utilities["total"] = np.array([-np.inf, 0.3, 0.5, -np.inf])
    assert np.isnan(compared(exact, chosen(0))["loss"])
    assert np.isnan(compared(exact, None)["loss"])


def test_the_page_by_hand():
    rows = [
        {"policy": "p", "scene": "s", "sample": 4, "decision": i, "same_place": i < 3}
        | {"same_view": i < 2, "loss": loss, "exact_ms": 10.0 * i, "sampled_ms": float(i)}
        for i, loss in enumerate((0.0, 0.2, 0.4, float("nan"), 0.0))
    ]
    text = "\n".join(page(rows, "smoke"))
    # The medians leave the first three out: they compile.
    assert "| p | s | 4 | 5 | 60 % | 40 % | 80 % | 15.0 % | 37.0 % | 35 | 4 |" in text


def test_a_short_flight_is_written_down(tmp_path, monkeypatch):
    monkeypatch.setitem(sampled_decisions.SIZES, "smoke", Size(("flat",), 2, 48))
    folder = sampled_decisions.main(Options(out=tmp_path, policies=("ours-pano",), samples=(1, 8)))
    lines = (folder / "decisions.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [(row["decision"], row["sample"]) for row in rows] == [
        ("1", "1"), ("1", "8"), ("2", "1"), ("2", "8"),
    ]  # fmt: skip
    # A sample of one in one is the exact decision.
    assert all(row["same_view"] == "True" for row in rows if row["sample"] == "1")
