"""The sweep: what it chooses, its page, and that what is done is not done again."""

import csv
import dataclasses

import numpy as np
import pytest
import tyro
from PIL import Image

from experiments import suite, sweep
from experiments.pages.artifacts import Origin
from experiments.pages.sweep_page import Trial, choose, setting_figure, write_page
from experiments.settings import known_settings
from experiments.sweep import Options
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


def page_of(tmp_path, trials, settings=(LAMBDA1,), reported=("flat", "mesh:a/house.glb")):
    write_page(tmp_path, settings, trials, reported, SOURCE)
    return (tmp_path / "sweep.md").read_text()


def test_the_page_holds_every_point_the_choice_and_its_origin(tmp_path):
    kappa = KNOWN["policy.kappa"]
    trials = [
        Trial({LAMBDA1.name: value, kappa.name: word}, trial(value, (i, -0.2 * i)).records)
        for i, value in enumerate((1 / 3, 16.0))
        for word in ("box", "one")
    ]
    page = page_of(tmp_path, trials, (LAMBDA1, kappa))
    assert "| 0.3333 | box |" in page
    assert "| 16 | one |" in page
    assert SOURCE.commit in page
    for name in ("policy_lambda1.png", "policy_kappa.png"):
        with Image.open(tmp_path / name) as picture:
            assert SOURCE.commit in picture.info["Description"]
    lines = [x for x in (tmp_path / "sweep.csv").read_text().splitlines() if x[0] != "#"]
    rows = list(csv.DictReader(lines))
    assert [row["lambda1"] for row in rows] == [str(1 / 3)] * 2 + ["16.0"] * 2
    assert rows[0]["minus default [dB]"].startswith("-0.40 [")


def test_the_page_warns_of_scenes_that_tables_report(tmp_path):
    trials = [trial(16.0, (0.0, 0.0)), trial(4.0, (-1.0, 0.0))]
    assert "**loft" in page_of(tmp_path, trials, reported=("loft",))
    assert "**" not in page_of(tmp_path, trials)


def test_the_figure_marks_the_default_where_nothing_is_told_apart():
    noise = np.random.default_rng(0).normal(0.0, 3.0, 12)
    views = 20.0 + noise - noise.mean()
    base = [record("r3", "loft", 0, 30, budget=30, psnr=np.full(12, 19.9))]
    other = [record("r3", "loft", 0, 30, budget=30, psnr=views)]
    trials = [Trial({LAMBDA1.name: 16.0}, base), Trial({LAMBDA1.name: 8.0}, other)]
    (axes,) = setting_figure(LAMBDA1, trials, choose(trials, DEFAULT)).axes
    assert "16" in axes.get_title(loc="right")


# The command -------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", ["smoke", "small", "paper"])
def test_no_size_tunes_on_scenes_of_the_committed_tables(size):
    request = sweep.request_for(Options(size=size))
    assert not set(request.scenes) & set(sweep.REPORTED)
    assert request.conditions.clock == "model"
    assert request.conditions.snapshots == (request.conditions.budget,)
    axes, points = sweep.points_of(Options(size=size))
    assert len(points) >= 3
    assert [axis.setting.name for axis in axes] == ["policy.lambda1"]
    assert len(points) == len(sweep.points_of(Options(size=size, vary=("lambda1=16",)))[1]) + len(
        [point for point in points if point != DEFAULT]
    )
    if size != "smoke":
        assert len(request.seeds) >= 2
        assert len(request.scenes) >= 2


def test_the_words_of_the_command_line():
    words = ["--vary", "lambda1=4,8", "--vary", "radius=1..2", "--random", "5", "--seeds", "3", "4"]
    options = tyro.cli(Options, args=words)
    assert options.vary == ("lambda1=4,8", "radius=1..2")
    assert (options.random, options.seeds) == (5, (3, 4))
    assert len(sweep.points_of(options)[1]) == 6  # and the default


def test_the_list_has_every_setting(capsys):
    assert sweep.main(Options(list=True)) is None
    printed = capsys.readouterr().out
    for name, setting in KNOWN.items():
        assert f"| {name} |" in printed
        assert setting.sentence in printed


def test_a_mistake_ends_the_command_with_one_line(tmp_path):
    with pytest.raises(SystemExit, match=r"sweep: there is no setting 'lamda1': did you mean"):
        sweep.main(Options(vary=("lamda1=4",), work=tmp_path))
    assert not list(tmp_path.iterdir())


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
