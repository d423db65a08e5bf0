"""The choice from a pool: greedy, from chosen poses only, and the tables by hand."""

import csv

import jax
import numpy as np
import pytest

from experiments import pool_choice, pool_selection
from experiments.pages.pool_table import gain_rows, mean_rows, result_rows
from experiments.pool_choice import choose, pool_of
from experiments.pool_selection import Options
from r3jax.apps.benchmark.photos.choosers import SCORED
from r3jax.geometry.cameras import Camera
from r3jax.planning.registry import policy_names
from r3jax.simulators.scenes.registry import open_scene

pytestmark = pytest.mark.full

POOL, FIRST, NUM = 12, 2, 6


@pytest.fixture(scope="module")
def flat():
    return open_scene("flat", camera=Camera.from_fov(48, 48))


@pytest.fixture(scope="module")
def poses(flat):
    """The pool, of few places: all that the flat has would take long to find."""
    return pool_of(Places(flat), POOL, key=jax.random.key(0))


class Places:
    """A ground truth that knows three free places."""

    def __init__(self, simulator):
        start = simulator.start_pose[:3, 3]
        self.places = start + np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.1], [0.0, -0.3, 0.0]])

    def free_positions(self, spacing, margin):
        return self.places


class Spy:
    """A simulator that remembers from where it was asked."""

    def __init__(self, simulator):
        self._simulator, self.asked = simulator, []
        self.camera, self.bounds = simulator.camera, simulator.bounds

    def render(self, pose):
        self.asked.append(np.array(pose))
        return self._simulator.render(pose)


def test_the_pool_is_free_and_repeatable(flat, poses):
    assert poses.shape == (POOL, 4, 4)
    places = Places(flat).places
    assert {tuple(p) for p in poses[:, :3, 3]} == {tuple(p) for p in places}
    assert len(np.unique(poses[:, :3, 2], axis=0)) == POOL
    np.testing.assert_array_equal(poses, pool_of(Places(flat), POOL, key=jax.random.key(0)))
    assert np.any(pool_of(Places(flat), POOL, key=jax.random.key(1)) != poses)


@pytest.mark.parametrize("name", ["active-gs", "active-gamer", "cover", "uniform", "random"])
def test_every_choice_begins_alike_and_takes_no_pose_twice(flat, poses, name):
    spy = Spy(flat)
    chosen, frames = choose(name, spy, poses, FIRST, NUM, seed=0)
    assert chosen[:FIRST] == [0, 1]
    assert len(set(chosen)) == len(frames) == NUM
    # Pictures come from the chosen poses only, one each.
    np.testing.assert_array_equal(np.stack(spy.asked), poses[chosen])


def test_the_best_of_the_pool_is_taken(flat, poses, monkeypatch):
    totals = np.array([9.0, 8.0, 1.0, 5.0, 3.0, 7.0, 2.0, 0.0, 6.0, 4.0, -1.0, -2.0])
    monkeypatch.setattr(pool_choice, "totals_of", lambda *args, **keys: totals.copy())
    chosen, _ = choose("unseen", flat, poses, FIRST, NUM, seed=0)
    assert chosen == [0, 1, 5, 8, 3, 9]


def test_unexplored_cells_can_be_left_out(flat, poses, monkeypatch):
    seen = []

    def spy(policy, where, poses, *, key):
        seen.append(bool(where.scoring_grid.unexplored.any()))
        assert where.grid.unexplored.any()
        return np.zeros(len(poses))

    monkeypatch.setattr(pool_choice, "totals_of", spy)
    for known_cells in (False, True):
        choose("unseen", flat, poses, FIRST, FIRST + 1, seed=0, known_cells=known_cells)
    assert seen == [True, False]


def test_what_has_no_score_is_refused():
    turning = {"ours-pano", "ours-ahead", "r3con"}
    # A map of their own, which no pool has trained.
    online = {"active-gs-online", "fisherrf", "fisherrf-d-opt", "gauss-mi"}
    assert set(policy_names()) - set(SCORED) == turning | online | {"frontier"}
    with pytest.raises(ValueError, match=r"frontier cannot choose.*unseen-depth"):
        Options(policies=("ours", "frontier"))
    with pytest.raises(ValueError, match="none given"):
        Options(policies=())


def record(policy, seed, psnr, scene="flat"):
    scores = {
        views: {
            "psnr": value,
            "psnr_p5": value - 5,
            "poor_share": 0.25,
            "ssim": 0.5,
            "psnr_by_view": [value - 6.0, value, value + 6.0],
        }
        for views, value in psnr.items()
    }
    flight = {"scene": scene, "seed": seed, "policy": policy, "commit": "abc"}
    return {"flight": flight, "machine": "m", "scores": scores, "chosen": []}


RECORDS = [
    record("ours", 0, {"10": 18.0, "20": 22.0}),
    record("ours", 1, {"10": 20.0, "20": 23.0}),
    record("random", 0, {"10": 21.0, "20": 24.0}),
    record("random", 1, {"10": 15.0, "20": 20.0}),
]


def test_tables_by_hand():
    rows = result_rows(RECORDS)
    assert [row["views"] for row in rows] == [10, 20] * 4
    assert "psnr_by_view" not in rows[0]
    table = mean_rows(RECORDS)
    assert [line["policy"] for line in table] == ["ours", "random"]
    assert table[0]["PSNR at 10"].startswith("19.00 [")
    assert table[1]["PSNR at 20"].startswith("22.00 [")
    assert table[1]["5th percentile at 20"] == "17.00"
    assert table[0]["under 20 dB at 10"] == "25 %"


def test_gains_are_taken_view_by_view():
    """What all views have in common between two policies leaves no spread at all."""
    table = gain_rows([*RECORDS[:2], record("unseen", 0, {"10": 16.0, "20": 21.0}),
                       record("unseen", 1, {"10": 18.0, "20": 22.0})])  # fmt: skip
    assert table == [
        {"ours minus": "unseen", "all at 10": "+2.00 [+2.00, +2.00]",
         "all at 20": "+1.00 [+1.00, +1.00]"}
    ]  # fmt: skip
    assert gain_rows(RECORDS[2:]) == []


def test_gains_of_two_scenes_stand_apart_and_together():
    numbers = {("ours", "flat"): 20.0, ("random", "flat"): 16.0,
               ("ours", "office"): 15.0, ("random", "office"): 17.0}  # fmt: skip
    records = [record(policy, 0, {"10": x}, scene) for (policy, scene), x in numbers.items()]
    (line,) = gain_rows(records)
    assert line["flat at 10"] == "+4.00 [+4.00, +4.00]"
    assert line["office at 10"] == "-2.00 [-2.00, -2.00]"
    assert line["all at 10"].startswith("+1.00 [")


def test_results_say_where_they_come_from_and_are_kept(tmp_path, monkeypatch):
    made = []

    def stand_in(choice, folder):
        made.append(choice.policy)
        found = record(choice.policy, 0, {"8": 10.0, "16": 12.0})
        return {name: found[name] for name in ("scores", "chosen")}

    monkeypatch.setattr(pool_selection, "make", stand_in)
    options = Options(policies=("ours", "unseen"), out=tmp_path / "out", work=tmp_path / "work")
    folder = pool_selection.main(options)
    assert pool_selection.main(options) == folder
    assert made == ["ours", "unseen"]  # the second time nothing is made again
    lines = (folder / "pool_selection.csv").read_text().splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == ["# command", "# machine", "# commit"]
    rows = list(csv.DictReader(lines[3:]))
    assert [(row["policy"], row["views"]) for row in rows][:2] == [("ours", "8"), ("ours", "16")]
    assert (folder / "pool_selection.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "pool_selection.md").read_text()
    assert "| unseen | 10.00 [" in page
    assert "| unseen | +0.00 [+0.00, +0.00] | +0.00 [+0.00, +0.00] |" in page
