"""The sweep: what it chooses, its page, and that what is done is not done again."""

import dataclasses
import re

import numpy as np
import pytest

from experiments import suite, sweep
from experiments.pages.artifacts import Origin
from experiments.pages.sweep_page import Trial, choose
from experiments.settings import known_settings
from experiments.sweep import Options, parse_axes
from r3jax.apps.benchmark.cells import Conditions
from r3jax.apps.benchmark.engines.local import run_here
from r3jax.apps.benchmark.plan import Request
from r3jax.evaluation.statistics import mean_over_scenes, paired_difference
from tests.apps.benchmark.tiny import CONDITIONS, SETTINGS
from tests.box_room import write_room
from tests.evaluation.records import record

KNOWN = known_settings(Conditions())
LAMBDA1 = KNOWN["policy.lambda1"]
SOURCE = Origin("python -m experiments.sweep", "a machine", "abc")


# What it chooses ---------------------------------------------------------------------------------


def trial(value, level, seeds=(0, 1), scenes=("loft", "kitchen")):
    """Records whose views are a fixed pattern, moved by a level per scene."""
    levels = dict(zip(scenes, level, strict=True))
    rng = np.random.default_rng(5)
    hard = rng.normal(0.0, 2.0, 12)
    records = [
        record("r3", scene, seed, 30, budget=30, psnr=20.0 + levels[scene] + hard + 0.1 * seed)
        for scene in scenes
        for seed in seeds
    ]
    return Trial({LAMBDA1.name: value}, records)


DEFAULT = {LAMBDA1.name: 16.0}


def test_the_best_is_chosen_by_gain_over_the_default():
    """The arg max, with the intervals of its views and seeds, in whatever order records come."""
    trials = [trial(4.0, (0.0, 1.0)), trial(16.0, (0.0, 0.0)), trial(64.0, (-1.0, 1.5))]
    choice = choose(trials, DEFAULT)
    assert (choice.best, choice.default) == (0, 1)
    hard = np.random.default_rng(5).normal(0.0, 2.0, 12).mean()
    for mean, expected in zip(choice.means, [20.55, 20.05, 20.3], strict=True):
        assert abs(mean.value - expected - hard) < 1e-9
    scores = [
        {s: np.array([r["views"]["psnr"] for r in t.records if r["scene"] == s]) for s in t.scores}
        for t in trials
    ]
    assert choice.means[0] == mean_over_scenes(scores[0])
    assert choice.gains[0] == paired_difference(scores[0], scores[1])
    assert abs(choice.gains[0].value - 0.5) < 1e-9
    assert choice.chosen == 0  # the difference is the same in every view
    assert choice.gains[1].value == choice.gains[1].high == 0.0
    turned = [Trial(t.point, t.records[::-1] if t is trials[0] else t.records) for t in trials]
    assert choose(turned, DEFAULT) == choice


def test_a_gain_that_may_be_chance_is_not_chosen():
    """A gain in some views and a loss in others is within the interval; so is no gain at all."""
    base = trial(16.0, (0.0,), seeds=(0,), scenes=("loft",))
    noise = np.random.default_rng(0).normal(0.0, 3.0, 12)
    noise += 0.1 - noise.mean()
    views = np.array(base.records[0]["views"]["psnr"]) + noise
    other = Trial({LAMBDA1.name: 4.0}, [record("r3", "loft", 0, 30, budget=30, psnr=views)])
    choice = choose([base, other], DEFAULT)
    assert choice.best == 1
    assert abs(choice.gains[1].value - 0.1) < 1e-9
    assert choice.gains[1].low < 0.0 < choice.gains[1].high
    assert choice.chosen == 0
    same = choose([trial(16.0, (0.0, 0.0)), trial(4.0, (0.0, 0.0))], DEFAULT)
    assert same.best == same.default == 0  # of equals, the first
    assert same.chosen == 0


# The page ----------------------------------------------------------------------------------------


# The command -------------------------------------------------------------------------------------


def test_a_grid_holds_every_combination_once_and_the_default_first():
    settings, points = sweep.points_of(Options(vary=("lambda1=4,8", "policy.kappa=box,one")))
    assert [setting.name for setting in settings] == ["policy.lambda1", "policy.kappa"]
    found = [(point["policy.lambda1"], point["policy.kappa"]) for point in points]
    assert found == [(16.0, "box"), (4.0, "box"), (4.0, "one"), (8.0, "box"), (8.0, "one")]
    assert len(sweep.points_of(Options(vary=("lambda1=4,16",)))[1]) == 2
    words = ["allow_growth=true,False", "num_bins=1e2", "sh_every=none,5"]
    assert list(parse_axes(words, KNOWN).values()) == [(True, False), (100,), (None, 5)]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["lambda1"], "NAME=VALUES"),
        (["=4"], "NAME=VALUES"),
        (["lamda1=4"], "policy.lambda1"),
        (["policy.voxel_size=4"], "map.voxel_size"),
        (["xyzzy=4"], "--list"),
        (["max_range=4"], "sensor.max_range"),
        (["lambda1=4,many"], "'many'"),
        (["lambda1=inf"], "'inf'"),
        (["num_bins=4.5"], "'4.5'"),
        (["drop_edges=yes"], "'yes'"),
        (["lambda1=4,4.0"], "policy.lambda1"),
        (["lambda1=4", "policy.lambda1=8"], "policy.lambda1"),
    ],
)
def test_a_word_that_is_not_understood_is_named(words, named):
    with pytest.raises(ValueError, match=re.escape(named)):
        parse_axes(words, KNOWN)
    with pytest.raises(SystemExit, match=re.escape(named)):
        sweep.main(Options(vary=tuple(words)))


@pytest.mark.full
def test_what_is_done_is_not_done_again(tmp_path, monkeypatch):
    room = write_room(tmp_path / "room.ply")
    tiny = dataclasses.replace(CONDITIONS, snapshots=("views:3",))
    request = Request((room,), ("random",), (0,), tiny, max_test_views=6, settings=SETTINGS)
    done = []

    def run(cells, root, report, jobs):
        done.append([cell.settings.get("scoring.lambda1") for cell in cells])
        run_here(cells, root, report)

    monkeypatch.setattr(sweep, "request_for", lambda options: request)
    monkeypatch.setattr(suite, "run_in_processes", run)
    options = Options(
        policy="random", vary=("lambda1=4",), out=tmp_path / "out", work=tmp_path / "work"
    )
    folder = sweep.main(options)
    assert folder is not None
    assert done == [[None, 4.0]]
    page = (folder / "sweep.md").read_text()
    assert "| 16 |" in page
    assert "| 4 |" in page
    sweep.main(options)
    assert len(done) == 1
    assert (folder / "sweep.md").read_text() == page
    sweep.main(dataclasses.replace(options, vary=("lambda1=4,64",)))
    assert done[1:] == [[64.0]]
    assert "| 64 |" in (folder / "sweep.md").read_text()
