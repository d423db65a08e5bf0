"""Candidates are those of the run: caught while it decides, or decided again."""

import dataclasses

import numpy as np
import pytest

from r3jax.apps.viewer.drawing import offer_segments
from r3jax.apps.viewer.story import decide_again
from r3jax.planning.registry import make_policy
from r3jax.runs.header import RunError
from r3jax.runs.settings import settings_of_run


@pytest.fixture(scope="module")
def plan(run):
    return settings_of_run(run)


@pytest.fixture(scope="module")
def offers(run, plan):
    return dict(decide_again(run, plan.policy, plan.config))


def test_every_view_but_the_first_was_chosen_from_candidates(run, offers):
    assert list(offers) == [row.step for row in run.rows]
    assert offers[0] is None
    for row in run.rows[1:]:
        offer, choice = offers[row.step], row.choice
        assert offer is not None
        assert choice is not None
        assert len(offer.poses) == choice.num_candidates
        assert int(np.isfinite(offer.utilities["path"]).sum()) == choice.num_reachable
        np.testing.assert_allclose(offer.poses[offer.chosen], choice.pose, atol=1e-5)


def test_the_scores_are_those_of_the_trace(run, offers):
    for row in run.rows[1:]:
        assert row.choice is not None
        total = offers[row.step].utilities["total"]
        best = np.sort(total[np.isfinite(total)])[::-1]
        recorded = [value for value in row.choice.top["total"] if value is not None]
        np.testing.assert_allclose(recorded, best[: len(recorded)], rtol=1e-6)


def test_another_policy_is_found_out(run, plan):
    other = make_policy("frontier", num_candidates=20, num_frontier=6)
    with pytest.raises(RunError, match="view 1"):
        dict(decide_again(run, other, plan.config))


def test_a_merged_run_is_refused(run, plan):
    header = dataclasses.replace(run.header, parent={"merged": ["a", "b"], "merged_views": [2, 3]})
    merged = dataclasses.replace(run, header=header)
    with pytest.raises(RunError, match="merged"):
        dict(decide_again(merged, plan.policy, plan.config))


def test_views_that_a_fork_took_over_have_no_candidates(run, plan):
    header = dataclasses.replace(run.header, parent={"forked": "x", "views": 3, "decided_from": 3})
    fork = dataclasses.replace(run, header=header)
    steps = decide_again(fork, plan.policy, plan.config)
    assert [next(steps) for _ in range(3)] == [(0, None), (1, None), (2, None)]


def test_candidates_are_drawn_one_frustum_each(run, offers):
    offer = offers[1]
    segments, colors = offer_segments(run.camera, offer)
    assert segments.shape == colors.shape == (9 * len(offer.poses), 2, 3)
    apexes = segments[::9, 0]
    np.testing.assert_allclose(apexes, offer.poses[:, :3, 3], atol=1e-6)
    size = np.linalg.norm(segments[::9, 1] - apexes, axis=1)
    assert size.argmax() == offer.chosen
