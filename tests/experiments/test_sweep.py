"""The sweep: what it tries, how a setting reaches a cell, what it chooses, and that it resumes."""

import csv
import dataclasses

import jax
import numpy as np
import pytest
import tyro
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from experiments import suite, sweep
from experiments.artefacts import Origin
from experiments.settings import find_setting, known_settings, with_settings
from experiments.sweep import Options
from experiments.sweep_choice import Trial, choose, leave_one_out
from experiments.sweep_page import Sweep, write_page
from experiments.sweep_space import (
    Listed,
    Range,
    grid_points,
    parse_axes,
    random_points,
    with_default,
)
from r3jax.benchmark.cells import Cell, paths_of
from r3jax.benchmark.conditions import Conditions
from r3jax.benchmark.engines.local import run_here
from r3jax.benchmark.plan import Request
from r3jax.benchmark.record import read_records
from r3jax.benchmark.run_cell import run_cell
from r3jax.evaluation.statistics import mean_over_scenes, paired_difference
from r3jax.exploration.clock import _compilations
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from r3jax.trace.reader import read_run
from tests.benchmark.tiny import CONDITIONS, SETTINGS, make_cells, write_room
from tests.evaluation.records import record
from tests.planning.rooms import center, grid_of, pose_at

KNOWN = known_settings(Conditions())
LAMBDA1, VOXEL = KNOWN["policy.lambda1"], KNOWN["map.voxel_size"]
CELL = Cell("flat", "a" * 64, "ours", 0, CONDITIONS, "b" * 64, 100)
SOURCE = Origin("python -m experiments.sweep", "a machine", "abc")


# What is tried -----------------------------------------------------------------------------------

numbers = st.lists(st.integers(1, 99), min_size=1, max_size=4, unique=True)


@given(numbers, numbers)
def test_a_grid_holds_every_combination_once(first, second):
    words = [f"lambda1={','.join(map(str, first))}", f"num_bins={','.join(map(str, second))}"]
    points = grid_points(parse_axes(words, KNOWN))
    found = [(point["policy.lambda1"], point["map.num_bins"]) for point in points]
    assert found == [(a, b) for a in first for b in second]


@settings(max_examples=20)
@given(st.integers(1, 30), st.integers(0, 5), st.booleans())
def test_random_points_are_in_range_distinct_and_the_same_for_the_same_seed(count, seed, is_log):
    scale = ":log" if is_log else ""
    words = [f"lambda1=2..64{scale}", f"num_candidates=50..200{scale}", "kappa=box,one"]
    axes = parse_axes(words, KNOWN)
    points = random_points(axes, count, seed)
    assert len(points) == len({tuple(point.values()) for point in points}) == count
    for point in points:
        assert 2.0 <= point["policy.lambda1"] <= 64.0
        assert type(point["policy.num_candidates"]) is int
        assert 50 <= point["policy.num_candidates"] <= 200
        assert point["policy.kappa"] in ("box", "one")
    assert random_points(axes, count + 7, seed)[:count] == points
    assert random_points(axes, count, seed + 1) != points


@pytest.mark.parametrize(("scale", "middle"), [(":log", 100.0), ("", 5000.5)])
def test_half_of_the_draws_lie_below_the_middle_of_their_scale(scale, middle):
    (axis,) = parse_axes([f"lambda1=1..10000{scale}"], KNOWN)
    drawn = np.array([p["policy.lambda1"] for p in random_points([axis], 400, 0)])
    assert abs(np.mean(drawn < middle) - 0.5) < 0.1  # four sigma


def test_a_range_of_whole_numbers_has_them_all_alike():
    (axis,) = parse_axes(["num_bins=3..6"], KNOWN)
    rng = np.random.default_rng(0)
    found, counts = np.unique([axis.draw(rng) for _ in range(800)], return_counts=True)
    np.testing.assert_array_equal(found, [3, 4, 5, 6])
    assert np.all(np.abs(counts - 200) < 60)
    assert len(random_points([axis], 4, 0)) == 4
    with pytest.raises(ValueError, match="1 to 4 points of this space, got 5"):
        random_points([axis], 5, 0)


def test_the_default_is_always_tried_and_only_once():
    axes = parse_axes(["lambda1=4,8", "voxel_size=0.1"], KNOWN)
    points = with_default(grid_points(axes), axes)
    assert points[0] == {"policy.lambda1": 16.0, "map.voxel_size": 0.05}
    assert len(points) == 3
    axes = parse_axes(["lambda1=4,16"], KNOWN)
    assert with_default(grid_points(axes), axes) == grid_points(axes)


def test_names_may_be_whole_or_short_and_ranges_are_read():
    axes = parse_axes(["policy.lambda1=1..64:log", "voxel_size = 0.05, 0.1"], KNOWN)
    assert axes == (Range(LAMBDA1, 1.0, 64.0, True), Listed(VOXEL, (0.05, 0.1)))
    words = ["allow_growth=true,False", "num_bins=1e2", "sh_every=none,5"]
    values = [axis.values for axis in parse_axes(words, KNOWN)]
    assert values == [(True, False), (100,), (None, 5)]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("lambda1", "takes NAME=VALUES such as"),
        ("=4", "takes NAME=VALUES such as"),
        ("lamda1=4", r"no setting 'lamda1': did you mean policy\.lambda1"),
        ("policy.voxel_size=4", r"did you mean map\.voxel_size"),
        ("bins=4", r"did you mean map\.num_bins"),
        ("xyzzy=4", r"no setting 'xyzzy': --list shows all"),
        ("resolution=64", "no setting 'resolution'"),
        ("max_range=4", r"may be policy\.max_range or sensor\.max_range: give the whole name"),
        ("lambda1=4,many", r"policy\.lambda1 takes numbers, got 'many'"),
        ("lambda1=inf", "takes numbers, got 'inf'"),
        ("num_bins=4.5", "takes whole numbers, got '4.5'"),
        ("drop_edges=yes", "takes true or false, got 'yes'"),
        ("lambda1=4,4.0", "has a value twice"),
        ("lambda1=4..2", "a range needs LOW < HIGH"),
        ("lambda1=0..2:log", "LOW < HIGH and LOW > 0"),
        ("lambda1=1..2:ln", r"LOW\.\.HIGH or LOW\.\.HIGH:log"),
        ("kappa=box..one", "only of numbers"),
    ],
)
def test_a_word_that_is_not_understood_is_named(word, message):
    with pytest.raises(ValueError, match=message):
        parse_axes([word], KNOWN)


def test_a_setting_given_twice_and_a_grid_over_a_range_are_refused():
    with pytest.raises(ValueError, match=r"policy\.lambda1 is given twice"):
        parse_axes(["lambda1=4", "policy.lambda1=8"], KNOWN)
    with pytest.raises(ValueError, match=r"policy\.lambda1 has a range.*--random"):
        grid_points(parse_axes(["lambda1=1..4"], KNOWN))


# How a setting reaches a cell --------------------------------------------------------------------

ODD = {
    "policy.kappa": "one", "policy.delta": "pairwise", "training.strategy": "mcmc",
    "training.background": "white", "training.sh_degree": 1,
}  # fmt: skip


def changed(setting):
    """Another value that can work."""
    if setting.name in ODD:
        return ODD[setting.name]
    if setting.kind is bool:
        return not setting.default
    return 7 if setting.default is None else 2 * setting.default


@pytest.mark.parametrize("name", KNOWN)
def test_every_setting_makes_another_cell_and_its_default_the_same(name):
    here = known_settings(CONDITIONS)[name]
    assert here.sentence
    assert find_setting(name, KNOWN) == KNOWN[name]
    other = with_settings(CELL, {name: changed(here)})
    assert other.name != CELL.name
    assert with_settings(CELL, {name: here.default}).name == CELL.name
    assert with_settings(other, {name: here.default}).name == CELL.name


def test_the_range_of_the_scores_follows_that_of_the_sensor_unless_it_is_given():
    both = {"sensor.max_range": 3.0, "policy.max_range": 5.0}
    assert with_settings(CELL, both).settings["scoring.max_range"] == 5.0
    cell = with_settings(CELL, {"sensor.max_range": 3.0, "policy.max_range": 3.0})
    assert cell == with_settings(CELL, {"sensor.max_range": 3.0})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"policy.kappa": "ball"}, "kappa must be"),
        ({"policy.num_candidates": 2, "policy.num_frontier": 3}, "num_frontier must lie"),
        ({"map.voxel_size": 0.0}, "voxel_size must be positive"),
        ({"training.gaussians": 500}, "capacity 400 has no room"),
    ],
)
def test_a_point_that_cannot_work_is_refused_before_anything_is_run(values, message):
    with pytest.raises(ValueError, match=message):
        with_settings(CELL, values)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("room") / "room.ply")


def test_settings_are_in_the_map_in_the_run_and_in_the_record(room, tmp_path):
    values = {
        "map.voxel_size": 0.2,
        "map.num_bins": 96,
        "map.drop_edges": False,
        "policy.lambda1": 4.0,
        "training.lambda_dssim": 0.0,
    }
    (plain,) = make_cells(room, tmp_path, policies=("ours-pano",), snapshots=("views:3",))
    cell = with_settings(plain, values)
    run_cell(cell, tmp_path)
    run = read_run(paths_of(tmp_path, cell).run)
    assert {k: run.header.config[k] for k in ("voxel_size", "num_bins", "drop_edges")} == {
        "voxel_size": 0.2, "num_bins": 96, "drop_edges": False,
    }  # fmt: skip
    assert run.header.policy["settings"]["scoring"]["lambda1"] == 4.0
    state = run.checkpoint()[1]
    assert (state.num_bins, float(state.voxel_size)) == (96, pytest.approx(0.2))
    (found,) = read_records(tmp_path, [cell])
    assert found["settings"] == SETTINGS | {"scoring.lambda1": 4.0}
    assert found["sensing"]["num_bins"] == 96
    assert found["sensing"]["drop_edges"] is False
    assert found["sensing"]["voxel_size"] == 0.2
    assert found["training"]["lambda_dssim"] == 0.0


@pytest.mark.parametrize("name", ["ours", "ours-pano"])
def test_a_sweep_over_numbers_compiles_once(name):
    free = np.zeros((12, 12, 10), dtype=bool)
    free[2:10, 2:10, 2:8] = True
    grid, pose, key = grid_of(free), pose_at(center(5, 5, 4)), jax.random.key(0)
    walls = np.stack([center(x, y, z) for x in (1, 10) for y in range(10) for z in range(8)])
    state = integrate_points(
        empty_map(1 << 10), walls, np.full(walls.shape, 0.5, np.float32), pose[:3, 3]
    )

    def decide(**given):
        few = {"num_candidates": 6, "num_frontier": 2, "scoring.panorama_size": 32}
        policy = CONDITIONS.policy(
            name, few | {k.replace("_of_", "."): v for k, v in given.items()}
        )
        memory = policy.init(Camera.from_fov(24, 24, 60.0), grid, key=key)
        decision, _, _ = policy.decide(memory, state, grid, pose, key=key)
        return decision

    first = decide(scoring_of_lambda1=1.0)
    decide(scoring_of_lambda1=16.0)  # what is compiled a step later, too
    before = _compilations.count
    others = [decide(scoring_of_lambda1=x, lambda2=y) for x, y in [(4.0, 0.1), (999.5, 0.0)]]
    decide(radius=0.8, scoring_of_tolerance=1.0, scoring_of_max_range=3.0)
    assert _compilations.count == before
    utility = [d.utilities["utility"] for d in (first, *others)]
    assert np.all(utility[2] > utility[1])
    assert np.all(utility[1] > utility[0])


# What it chooses ---------------------------------------------------------------------------------


def trial(value, level, seeds=(0, 1), scenes=("loft", "kitchen")):
    """Records whose views are a fixed pattern, moved by a level per scene."""
    levels = dict(zip(scenes, level, strict=True))
    rng = np.random.default_rng(5)
    hard = rng.normal(0.0, 2.0, 12)
    records = [
        record("ours", scene, seed, 30, budget=30, psnr=20.0 + levels[scene] + hard + 0.1 * seed)
        for scene in scenes
        for seed in seeds
    ]
    return Trial({LAMBDA1.name: value}, records)


DEFAULT = {LAMBDA1.name: 16.0}


def test_the_best_is_the_arg_max_with_the_interval_of_its_views_and_seeds():
    trials = [trial(4.0, (0.0, 1.0)), trial(16.0, (0.0, 0.0)), trial(64.0, (-1.0, 1.5))]
    choice = choose(trials, DEFAULT)
    assert (choice.best, choice.default) == (0, 1)
    for i, expected in enumerate([20.55, 20.05, 20.3]):
        hard = np.random.default_rng(5).normal(0.0, 2.0, 12).mean()
        assert choice.means[i].value == pytest.approx(expected + hard)
    scores = [
        {s: np.array([r["views"]["psnr"] for r in t.records if r["scene"] == s]) for s in t.scores}
        for t in trials
    ]
    assert choice.means[0] == mean_over_scenes(scores[0])
    assert choice.gains[0] == paired_difference(scores[0], scores[1])
    assert choice.gains[0].value == pytest.approx(0.5)
    assert choice.is_better  # the difference is the same in every view
    assert choice.gains[1].value == choice.gains[1].high == 0.0


def test_of_equals_the_first_is_taken_and_a_draw_is_not_better():
    trials = [trial(16.0, (0.0, 0.0)), trial(4.0, (0.0, 0.0))]
    choice = choose(trials, DEFAULT)
    assert choice.best == choice.default == 0
    assert not choice.is_better
    with pytest.raises(ValueError, match="was not tried"):
        choose(trials, {LAMBDA1.name: 17.0})


def test_a_gain_in_some_views_and_a_loss_in_others_is_within_the_interval():
    base = trial(16.0, (0.0,), seeds=(0,), scenes=("loft",))
    noise = np.random.default_rng(0).normal(0.0, 3.0, 12)
    noise += 0.1 - noise.mean()
    views = np.array(base.records[0]["views"]["psnr"]) + noise
    other = Trial({LAMBDA1.name: 4.0}, [record("ours", "loft", 0, 30, budget=30, psnr=views)])
    choice = choose([base, other], DEFAULT)
    assert choice.best == 1
    assert choice.gains[1].value == pytest.approx(0.1)
    assert choice.gains[1].low < 0.0 < choice.gains[1].high
    assert not choice.is_better


def test_a_scene_left_out_is_judged_by_the_choice_of_the_others():
    scenes = ("loft", "kitchen", "library")
    trials = [
        trial(4.0, (9.0, 0.0, 0.0), scenes=scenes),  # the loft's own favorite
        trial(16.0, (0.0, 0.0, 0.0), scenes=scenes),
        trial(64.0, (-2.0, 5.0, 1.0), scenes=scenes),
    ]
    found = {row.scene: row for row in leave_one_out(trials, 1)}
    assert {scene: row.best for scene, row in found.items()} == {
        "loft": 2,
        "kitchen": 0,
        "library": 0,
    }
    assert found["loft"].gain.value == pytest.approx(-2.0)
    assert found["kitchen"].gain.value == pytest.approx(0.0)
    assert leave_one_out([trial(16.0, (0.0,), scenes=("loft",))], 0) == ()


# The page ----------------------------------------------------------------------------------------


def page_of(tmp_path, trials, setting=(LAMBDA1,), reported=("flat", "mesh:a/house.glb")):
    write_page(tmp_path, Sweep("ours", setting, tuple(trials)), reported, SOURCE)
    return (tmp_path / "sweep.md").read_text()


def test_the_page_holds_every_value_the_choice_and_where_it_comes_from(tmp_path):
    values = (4.0, 16.0, 64.0, 256.0)
    page = page_of(tmp_path, [trial(v, (i, -0.2 * i)) for i, v in enumerate(values)])
    for value in values:
        assert f"| {value:g} |" in page
    assert "Best is **lambda1 = 256**" in page
    assert "The interval lies above 0" in page
    assert "lambda1 lies at an end of what was tried" in page
    assert "With 2 of 3 seeds" in page
    assert "report other scenes (flat, house)" in page
    assert SOURCE.commit in page
    with Image.open(tmp_path / "policy_lambda1.png") as picture:
        assert SOURCE.commit in picture.info["Description"]
    lines = [x for x in (tmp_path / "sweep.csv").read_text().splitlines() if x[0] != "#"]
    rows = list(csv.DictReader(lines))
    assert len(rows) == len(values) * 2 * 2
    assert {float(row["policy.lambda1"]) for row in rows} == set(values)
    assert float(rows[-1]["minus_default"]) == pytest.approx(1.6 / 2)


def test_the_page_warns_of_scenes_that_tables_report(tmp_path):
    trials = [trial(16.0, (0.0, 0.0), seeds=(0, 1, 2)), trial(4.0, (-1.0, 0.0), seeds=(0, 1, 2))]
    page = page_of(tmp_path, trials, reported=("loft",))
    assert "**loft is reported by the committed tables" in page
    assert "That is the default." in page
    assert "of 3 seeds" not in page
    assert "no say in it" in page


def test_several_settings_have_a_figure_each_and_words_are_values_too(tmp_path):
    kappa = KNOWN["policy.kappa"]
    trials = [
        Trial({LAMBDA1.name: value, kappa.name: word}, trial(value, (i, j)).records)
        for i, value in enumerate((1 / 3, 16.0))
        for j, word in enumerate(("box", "one"))
    ]
    page = page_of(tmp_path, trials, (LAMBDA1, kappa))
    assert "| 0.3333 | box |" in page
    assert "Best is **lambda1 = 16, kappa = one**" in page
    assert (tmp_path / "policy_lambda1.png").exists()
    assert (tmp_path / "policy_kappa.png").exists()


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


def test_what_is_done_is_not_done_again(room, tmp_path, monkeypatch):
    tiny = dataclasses.replace(CONDITIONS, snapshots=("views:3",))
    request = Request((room,), ("ours-pano",), (0,), tiny, max_test_views=6, settings=SETTINGS)
    done = []

    def run(cells, root, report, jobs):
        done.append([cell.settings.get("scoring.lambda1") for cell in cells])
        run_here(cells, root, report)

    monkeypatch.setattr(sweep, "request_for", lambda options: request)
    monkeypatch.setattr(suite, "run_in_processes", run)
    options = Options(vary=("lambda1=4",), out=tmp_path / "out", work=tmp_path / "work")
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
