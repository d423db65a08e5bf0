"""`r3jax team`, as a user meets it."""

import json
import shutil

import numpy as np
import pytest

from r3jax.cli.main import main
from r3jax.files import lock_folder
from r3jax.formats.nerfstudio import read_transforms
from r3jax.runs.reader import read_run
from r3jax.simulators.clearance import APART

VIEWS = 3


def team(room, out, *words):
    """A small team; the same shapes everywhere, so that each part compiles once."""
    options = {"scene": room, "policy": "random", "budget": f"views:{VIEWS}", "clock": "model"}
    options |= {"resolution": 48, "capacity": 16384, "voxel-size": 0.1, "candidates": 20}
    options |= {"out": out, "name": "pair", "meet-every": 0.5}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return main(["team", *given, "--fov", "90", "60", *words])


@pytest.fixture(scope="module")
def pair(room, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    assert team(room, out) == 0
    return out / "pair"


@pytest.mark.full
def test_every_camera_leaves_a_run_that_replays(pair, capsys):
    for number in ("0", "1"):
        assert main(["replay", str(pair / number)]) == 0
        assert f"{2 * VIEWS} frames" in capsys.readouterr().err
        assert (pair / number / "report" / "report.html").exists()


@pytest.mark.full
def test_the_cameras_start_apart_with_their_own_lenses(pair):
    first, second = (read_run(pair / number) for number in ("0", "1"))
    assert first.camera.fx < second.camera.fx
    gap = first.rows[0].pose[:3, 3] - second.rows[0].pose[:3, 3]
    assert np.linalg.norm(gap) == pytest.approx(APART, abs=1e-5)


@pytest.mark.full
def test_one_data_set_holds_the_frames_of_all(pair):
    frames = json.loads((pair / "transforms.json").read_text())["frames"]
    assert len(frames) == 2 * VIEWS
    assert len({frame["fl_x"] for frame in frames}) == 2
    assert all((pair / frame["file_path"]).exists() for frame in frames)
    capture = read_transforms(pair / "transforms.json")
    assert len({lens.params for lens in capture.lenses}) == 2
    lines = [json.loads(line) for line in (pair / "coverage.jsonl").read_text().splitlines()]
    assert [line["seconds"] for line in lines] == sorted(line["seconds"] for line in lines)
    assert len(lines) == 2 * VIEWS


@pytest.mark.full
def test_a_team_goes_on(pair, room, tmp_path, capsys):
    budget = ("--budget", f"views:{VIEWS + 1}")
    assert team(room, tmp_path, "--name", "long", *budget) == 0
    shutil.copytree(pair, tmp_path / "pair")
    assert main(["team", "--resume", str(tmp_path / "pair"), *budget]) == 0
    assert f"views {VIEWS} + {VIEWS}" in capsys.readouterr().err
    for name in ("transforms.json", "coverage.jsonl", "0/trace.jsonl", "1/run.json"):
        assert (tmp_path / "pair" / name).read_bytes() == (tmp_path / "long" / name).read_bytes()


@pytest.mark.full
def test_two_processes_do_not_write_one_team(room, pair, tmp_path, capsys):
    with lock_folder(pair):
        assert main(["team", "--resume", str(pair)]) == 2
        assert "another process is writing this team" in capsys.readouterr().err
    (tmp_path / "pair").mkdir()
    (tmp_path / "pair" / "transforms.json").write_text("{}")
    assert team(room, tmp_path) == 2
    assert "holds something that is not a team" in capsys.readouterr().err


@pytest.mark.full
@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["explore", "--resume", "{pair}/0"], "r3jax team --resume"),
        (["merge", "{pair}/0", "{pair}/1"], "its camera is not that of"),
        (["team", "--resume", "{pair}", "--seed", "1"], "--seed"),
    ],
)
def test_what_a_member_of_a_team_cannot_do_is_said(pair, capsys, command, message):
    assert main([word.format(pair=pair) for word in command]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
