"""Comparisons of choices of frames: cells run once, and every chooser gives what it was asked."""

import dataclasses
import json

import numpy as np
import pytest

from experiments.select import (
    CHOICES,
    Cell,
    Options,
    by_capture,
    comparable,
    compared,
    exposed_psnr,
    main,
    open_pool,
    table,
)
from tests.apps.audit.room import round_poses, write_recording

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    folder = tmp_path_factory.mktemp("select")
    write_recording(folder / "room", round_poses(16))
    return Options(
        captures=(folder / "room",), shares=(0.3,), seeds=(0, 1), iterations=2, resolution=32,
        gaussians=60, lpips=False, choosers=("uniform", "all"), out=folder / "out",
    )  # fmt: skip


def test_what_is_done_is_not_done_again_and_what_is_missing_is(options):
    main(options)
    path = options.out / "records.jsonl"
    lines = path.read_text().splitlines()
    found = [json.loads(line) for line in lines]
    assert [(r["chooser"], r["share"], r["seed"], r["kept"]) for r in found] == [
        ("uniform", 0.3, 0, 4), ("all", 1.0, 0, 14), ("uniform", 0.3, 1, 4), ("all", 1.0, 1, 14),
    ]  # fmt: skip
    assert all(len(r["psnr"]) == 2 and np.isfinite(r["psnr"]).all() for r in found)
    path.write_text("\n".join(lines[:2]) + "\n")
    main(options)
    again = path.read_text().splitlines()
    assert again[:2] == lines[:2]
    assert [json.loads(line)["psnr"] for line in again[2:]] == [r["psnr"] for r in found[2:]]
    main(options)
    assert path.read_text().splitlines() == again
    assert "uniform" in (options.out / "tables.md").read_text()


@pytest.mark.parametrize("chooser", sorted(set(CHOICES) - {"sharp-frames", "all"}))
def test_choosers_choose_as_many_frames_as_are_wanted(options, chooser):
    pool = open_pool(options.captures[0], options)
    found = CHOICES[chooser](pool, 6, 0, options)
    assert len(set(found.tolist())) == len(found) == 6
    assert found.min() >= 0
    assert found.max() < len(pool.offered)


def test_leads_pair_the_same_captures_and_seeds():
    def record(capture, chooser, seed, psnr):
        cell = Cell(capture, chooser, 0.1, seed, 2, 32)
        seconds = {"wall": 1.0, "cpu": 1.0}
        return {**cell._asdict(), "psnr": psnr, "exposed": psnr, "ssim": [0.5, 0.5], "lpips": [],
                "choosing": seconds, "training": seconds}  # fmt: skip

    records = [
        record("a", "select", 0, [20.0, 24.0]), record("a", "uniform", 0, [19.0, 22.0]),
        record("b", "select", 0, [30.0, 30.0]), record("b", "select", 1, [90.0, 90.0]),
        record("b", "uniform", 0, [31.0, 30.0]),
    ]  # fmt: skip
    at, captures = compared(records, 0.1, ["select", "uniform"])
    assert captures == ["a", "b"]
    assert compared(records, 0.1, ["select", "uniform", "random"])[1] == []
    rows = {row["chooser"]: row for row in table(at)}
    assert rows["uniform"]["select minus it"].startswith("+0.50 ")
    assert rows["select"]["trainings"] == 3
    assert by_capture(records, 0.1)[0] == {"chooser": "select", "a": "22.00", "b": "60.00"}
    records.append(record("b", "random", 0, [10.0, 10.0]))
    assert comparable(records, 0.1) == [["select", "uniform"], ["select", "uniform", "random"]]
    assert compared(records, 0.1, comparable(records, 0.1)[1])[1] == ["b"]
    assert [row["chooser"] for row in by_capture(records, 0.2)] == []


def test_a_gain_of_each_channel_does_not_count_where_exposures_differ():
    truth = np.random.default_rng(0).integers(40, 160, (12, 16, 3)).astype(np.uint8)
    brighter = np.rint(truth * np.array([1.3, 1.2, 0.8])).astype(np.uint8)
    assert exposed_psnr(brighter, truth) > 50.0
    assert exposed_psnr(truth[::-1], truth) < 20.0


def test_an_unknown_chooser_is_refused(options):
    with pytest.raises(ValueError, match="nobody"):
        main(dataclasses.replace(options, choosers=("nobody",)))


def test_no_captures_are_refused_unless_only_the_tables_are_wanted(options):
    with pytest.raises(ValueError, match="--only-table"):
        main(dataclasses.replace(options, captures=()))
