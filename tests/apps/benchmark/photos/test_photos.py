"""The photo-pool protocol: what is on offer, what a chooser gets to see, and what comes out."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from r3jax.apps.benchmark.photos import choosers, records
from r3jax.apps.benchmark.photos.choosers import check_chooser, make_chooser
from r3jax.apps.benchmark.photos.pool import (
    PhotosError,
    first_photos,
    nearest_photos,
    open_pool,
)
from r3jax.apps.benchmark.photos.protocol import PhotoTerms, run_photos
from r3jax.apps.benchmark.photos.records import load_or_compute, record_path, table_rows
from r3jax.cli.main import main
from r3jax.splatting.scene import GaussianScene
from r3jax.validation.json_text import unsealed
from tests.apps.benchmark.photos.room import NUM, TERMS, write_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_recording(tmp_path_factory.mktemp("captures") / "room")


@pytest.fixture(scope="module")
def pool(recording):
    return open_pool(recording, 32, up="z")


def test_every_eighth_photo_judges_and_is_not_on_offer(pool):
    assert pool.test.tolist() == [0, 8, 16]
    assert sorted([*pool.test, *pool.on_offer]) == list(range(NUM))
    assert (pool.views.width, pool.views.height) == (32, 32)
    for seed in range(5):
        first = first_photos(pool, 4, seed)
        assert len(set(first)) == 4
        assert set(first) <= set(pool.on_offer)
        assert first == first_photos(pool, 4, seed)
    assert first_photos(pool, 4, 0) != first_photos(pool, 4, 1)


def test_candidates_are_the_nearest_that_are_left(pool):
    chosen = [1, 2, 5]
    found = nearest_photos(pool, chosen, 4)
    left = [n for n in pool.on_offer if n not in chosen]
    distance = np.linalg.norm(pool.poses[left, :3, 3] - pool.poses[5, :3, 3], axis=1)
    np.testing.assert_array_equal(found, np.array(left)[np.argsort(distance)[:4]])
    assert len(nearest_photos(pool, pool.on_offer[:-1].tolist(), 4)) == 1


def test_of_photos_at_one_place_the_least_turned_comes_first(pool):
    poses = pool.poses.copy()
    poses[:, :3, 3] = 1.0
    still = dataclasses.replace(pool, poses=poses)
    found = nearest_photos(still, [9], 3)
    left = [n for n in pool.on_offer if n != 9]
    turn = np.linalg.norm(pool.poses[left, :3, :3] - pool.poses[9, :3, :3], axis=(1, 2))
    np.testing.assert_array_equal(found, np.array(left)[np.argsort(turn)[:3]])


class Spy:
    """Takes the last candidate, and notes what it was given."""

    def __init__(self):
        self.observed, self.asked, self.harmonics = [], [], []

    def begin(self, known):
        assert not known.chosen
        assert int(known.map_state.num_occupied) == 0
        return 0

    def observe(self, memory, known, frame):
        self.observed.append(np.asarray(frame.T_world_camera, np.float64))
        assert len(known.chosen) == memory + 1
        assert known.chosen[-1] is frame
        return memory + 1

    def score(self, memory, known, model, poses, *, key):
        assert isinstance(model, GaussianScene)
        # A part of what the model is now: it must have been trained since the last choice.
        self.asked.append((memory, poses, np.asarray(model.means[:20]), key))
        self.harmonics.append(model.sh.shape[1])
        return np.arange(len(poses))


@pytest.fixture(scope="module")
def spied(pool):
    spy = Spy()
    return spy, run_photos(pool, spy, TERMS, seed=1)


def test_a_chooser_sees_the_chosen_photos_the_model_and_poses(pool, spied):
    spy, outcome = spied
    assert outcome.chosen[:3] == first_photos(pool, 3, 1)
    assert len(set(outcome.chosen)) == 6
    assert not set(outcome.chosen) & set(pool.test)
    assert [memory for memory, *_ in spy.asked] == [3, 4, 5]
    np.testing.assert_allclose(np.stack(spy.observed), pool.poses[outcome.chosen], atol=1e-6)
    for n, (_, poses, _, _) in enumerate(spy.asked):
        candidates = nearest_photos(pool, outcome.chosen[: 3 + n], 3)
        np.testing.assert_array_equal(poses, pool.poses[candidates])
        assert outcome.chosen[3 + n] == candidates[-1]
    means = [means for _, _, means, _ in spy.asked]
    assert np.any(means[0] != means[1])
    assert np.any(means[1] != means[2])


def test_a_chooser_sees_the_harmonics_that_are_trained(spied):
    """The others are 0 still: gradients by them would tell of nothing that is in the model."""
    every = TERMS.train_config(1).schedule().sh_every
    degrees = [min((n + 1) * TERMS.every // every, 3) for n in range(TERMS.choose)]
    assert spied[0].harmonics == [(degree + 1) ** 2 for degree in degrees]
    assert degrees[0] < 3


def test_the_photos_that_judge_are_judged(pool, spied):
    _, outcome = spied
    assert [row.view for row in outcome.rows] == pool.test.tolist()
    assert len(outcome.seconds) == 3
    assert all(np.isfinite(row.psnr) for row in outcome.rows)
    assert 100 < outcome.num_gaussians <= 600


def test_nobody_sees_the_pixels_that_were_not_chosen(pool, monkeypatch):
    """Other pixels in all photos that are left out change no choice and no model."""
    opened = []
    honest = type(pool).frame
    monkeypatch.setattr(type(pool), "frame", lambda self, n: opened.append(n) or honest(self, n))
    for name in ("r3", "gavis"):
        opened.clear()
        outcome = run_photos(pool, make_chooser(name, 3, 5.0), TERMS, seed=0)
        assert opened == outcome.chosen


def test_cover_is_the_published_rule(pool, monkeypatch):
    """Without unexplored cells, which the others count."""
    unexplored = {}

    def totals(policy, where, poses, *, key):
        unexplored[policy.name] = bool(np.asarray(where.scoring_grid.unexplored).any())
        return np.zeros(len(poses))

    monkeypatch.setattr(choosers, "totals_of", totals)
    for name in ("cover", "r3", "gavis"):
        run_photos(pool, make_chooser(name, 3, 5.0), TERMS, seed=0)
    assert unexplored == {"cover": False, "r3": True, "gavis": True}


def test_the_same_run_gives_the_same_bits_and_another_seed_another_choice(pool, spied):
    again = run_photos(pool, Spy(), TERMS, seed=1)
    assert again.chosen == spied[1].chosen
    assert [r.psnr for r in again.rows] == [r.psnr for r in spied[1].rows]


def test_who_looks_at_the_model_joins_by_name(pool, monkeypatch, tmp_path):
    with pytest.raises(ValueError, match=r"frontier cannot choose among photos; known: r3, "):
        make_chooser("frontier", 3, 5.0)
    monkeypatch.setitem(choosers.MODEL_CHOOSERS, "spy", Spy)
    check_chooser("spy")
    record = load_or_compute(tmp_path, pool, "spy", TERMS, 0)
    assert record["chooser"] == "spy"
    assert unsealed(json.loads(record_path(tmp_path, pool, "spy", 0).read_text())) == record


def test_fisherrf_is_asked_of_the_model_and_of_the_chosen_photos(pool, monkeypatch):
    asked = []
    honest = choosers.known_information

    def known_information(model, camera, poses, form):
        asked.append(poses)
        return honest(model, camera, poses, form)

    monkeypatch.setattr(choosers, "known_information", known_information)
    outcome = run_photos(pool, make_chooser("fisherrf", 3, 5.0), TERMS, seed=0)
    before = [pool.poses[outcome.chosen[:n]] for n in range(TERMS.first, len(outcome.chosen))]
    assert len(asked) == len(before) == TERMS.choose
    for poses, expected in zip(asked, before, strict=True):
        np.testing.assert_allclose(poses, expected, atol=1e-6)


def test_a_record_is_made_once_on_equal_terms(pool, tmp_path, monkeypatch):
    made = []
    outcome = run_photos(pool, make_chooser("random", 3, 5.0), TERMS, seed=0)
    monkeypatch.setattr(records, "run_photos", lambda *a, **k: made.append(a[2]) or outcome)
    first = load_or_compute(tmp_path, pool, "random", TERMS, 0)
    assert load_or_compute(tmp_path, pool, "random", TERMS, 0) == first
    assert len(made) == 1
    longer = dataclasses.replace(TERMS, iterations=20)
    assert load_or_compute(tmp_path, pool, "random", longer, 0)["terms"]["iterations"] == 20
    path = record_path(tmp_path, pool, "random", 0)
    for damage in (lambda text: "{", lambda text: text.replace('"psnr": [', '"psnr": [9', 1)):
        path.write_text(damage(path.read_text()))
        load_or_compute(tmp_path, pool, "random", TERMS, 0)
    assert made == [TERMS, longer, TERMS, TERMS]


def record(chooser: str, seed: int, psnr: list[float], lpips=None, capture: str = "a"):
    mean = float(np.mean(psnr))
    return {
        "capture": capture, "chooser": chooser, "seed": seed, "psnr": psnr,
        "ssim": [0.5] * len(psnr), "lpips": lpips or [None] * len(psnr),
        "metrics": {"psnr": {"mean": mean, "percentile_5": mean - 3.0}},
        "choice_seconds": [9.0, 0.1, 0.3],
    }  # fmt: skip


def test_the_table_by_hand():
    rows = table_rows(
        [
            record("random", 0, [20.0, 22.0]), record("random", 1, [18.0, 20.0]),
            record("r3", 1, [19.0, 21.0]), record("r3", 0, [21.0, 23.0]),
            record("cover", 0, [30.0, 30.0]),
        ]
    )  # fmt: skip
    assert [row["chooser"] for row in rows] == ["cover", "r3", "random"]
    assert rows[1]["PSNR [dB]"].startswith("21.00 [")
    assert rows[1]["minus random"] == "+1.00 [+1.00, +1.00]"  # paired by photo and by seed
    assert rows[1]["5th percentile"] == "18.00"
    assert rows[1]["seconds a choice"] == "0.200"  # the first one compiles
    assert rows[0]["minus random"] == rows[2]["minus random"] == ""  # other seeds; itself
    assert "LPIPS" not in rows[0]
    (row,) = table_rows([record("r3", 0, [20.0, 22.0], lpips=[0.2, 0.4])])
    assert row["LPIPS"] == "0.300"


def test_captures_without_depth_are_refused(recording, tmp_path):
    frames = [
        {"file_path": str(n), "transform_matrix": np.eye(4).tolist()}
        | ({"depth_file_path": "d.png"} if n == 0 else {})
        for n in range(3)
    ]
    content = {"frames": frames, "fl_x": 10.0, "w": 16, "h": 16}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(PhotosError, match=r"2 of 3 photos have no depth image.*depth_file_path"):
        open_pool(tmp_path, 16)


def test_too_few_photos_are_refused(pool):
    asked = dataclasses.replace(TERMS, first=10, choose=6)
    with pytest.raises(PhotosError, match=r"offers 15 photos beside the 3 .* 10 \+ 6"):
        run_photos(pool, make_chooser("random", 3, 5.0), asked, seed=0)
    with pytest.raises(PhotosError, match="too few to begin with 15"):
        first_photos(pool, 15, 0)


@pytest.mark.parametrize(
    ("name", "value"), [("choose", 0), ("nearest", 0), ("every", 0), ("gaussians", 20)]
)
def test_terms_that_cannot_work_are_refused(name, value):
    with pytest.raises(ValueError, match=name if value == 0 else "fewer than the photos"):
        PhotoTerms(**{name: value})


WORDS = [
    "--choose", "2", "--first", "3", "--nearest", "3", "--every", "10", "--iterations", "10",
    "--gaussians", "300", "--capacity", "600", "--train-resolution", "32", "--lpips", "none",
    "--up", "z", "--voxel-size", "0.1",
]  # fmt: skip


def test_the_command_prints_a_table_and_does_nothing_twice(recording, tmp_path, capsys):
    words = ["benchmark", "--photos", str(recording), "--out", str(tmp_path), *WORDS]
    assert main([*words, "--policies", "cover,random"]) == 0
    out = capsys.readouterr()
    assert "minus random" in out.out
    assert "room, cover, seed 0: " in out.err
    stamps = [path.stat().st_mtime_ns for path in sorted((tmp_path / "photos").iterdir())]
    assert len(stamps) == 2
    assert main([*words, "--policies", "cover,random"]) == 0
    assert stamps == [p.stat().st_mtime_ns for p in sorted((tmp_path / "photos").iterdir())]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--policies", "r3-pano"], "r3-pano cannot choose among photos"),
        (["--scenes", "office"], "--photos takes these from the captures"),
        (["--choose", "30"], "choose fewer"),
    ],
)
def test_mistakes_are_named(recording, tmp_path, capsys, words, says):
    base = [word for word in WORDS if "--choose" not in words or word not in ("--choose", "2")]
    given = ["benchmark", "--photos", str(recording), "--out", str(tmp_path), *base, *words]
    assert main(given) == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_keys_differ_from_choice_to_choice(spied):
    keys = {tuple(np.asarray(jax.random.key_data(key))) for *_, key in spied[0].asked}
    assert len(keys) == 3
