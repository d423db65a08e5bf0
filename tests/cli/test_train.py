"""`r3jax train` and `r3jax evaluate`, as a user meets them, on a small recording."""

import csv
import json

import numpy as np
import pytest
from PIL import Image

from r3jax.cli.main import main
from r3jax.files import lock_folder
from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.ply import read_scene
from r3jax.splatting.render import render
from tests.splatting.clouds import random_cloud

WIDTH, HEIGHT, VIEWS = 40, 32, 10
SMALL = {"iterations": 60, "gaussians": 300, "hold-out": 5}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten views round a cloud of Gaussians, with depth, in the layout of a recording."""
    folder = tmp_path_factory.mktemp("recordings") / "cloud"
    (folder / "images").mkdir(parents=True)
    (folder / "depth").mkdir()
    camera = Camera(WIDTH, HEIGHT, 36.0, 36.0, 20.0, 16.0)
    poses = []
    for i in range(VIEWS):
        angle = 2 * np.pi * i / VIEWS
        position = np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), 0.4])
        pose = look_at(position, np.zeros(3))
        config = RasterConfig(max_intersections=1 << 13)
        image = render(random_cloud(0), camera, pose, config=config)
        rgb = np.round(255 * np.clip(np.asarray(image.rgb), 0, 1)).astype(np.uint8)
        depth = np.where(np.asarray(image.alpha) > 0.8, 1000 * np.asarray(image.depth), 0)
        Image.fromarray(rgb).save(folder / "images" / f"{i:03d}.png")
        Image.fromarray(depth.astype(np.uint16)).save(folder / "depth" / f"{i:03d}.png")
        poses.append(np.asarray(pose, dtype=np.float64).reshape(-1))
    np.savetxt(folder / "poses.txt", np.stack(poses))
    # OpenCV's convention: pixel centers at whole numbers.
    np.savetxt(folder / "K.txt", np.array([[36.0, 0, 19.5], [0, 36.0, 15.5], [0, 0, 1]]))
    return folder


def train(recording, out, *words, **changes):
    """A short training; the same shapes as all others here, so that each part compiles once."""
    options = SMALL | {"out": out, "up": "z"} | {k.replace("_", "-"): v for k, v in changes.items()}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return main(["train", str(recording), *given, *words])


@pytest.fixture(scope="module")
def models(recording, tmp_path_factory):
    """A folder with one trained model."""
    out = tmp_path_factory.mktemp("models")
    assert train(recording, out) == 0
    return out


def test_a_training_leaves_model_record_and_curve(models):
    folder = models / "last"
    scene = read_scene(folder / "scene.ply")
    record = json.loads((folder / "train.json").read_text())
    assert record["test_views"] == [0, 5]
    assert len(record["train_views"]) == VIEWS - 2
    assert record["resolution"] == WIDTH
    assert record["config"]["iterations"] == 60
    rows = list(csv.DictReader((folder / "history.csv").read_text().splitlines()))
    assert [int(row["step"]) for row in rows] == list(range(1, 61))
    psnr = np.array([float(row["psnr"]) for row in rows])
    assert psnr[-8:].mean() > psnr[:8].mean() + 1.0
    assert int(rows[-1]["gaussians"]) == scene.capacity
    assert (folder / "points.ply").stat().st_size > 15 * scene.capacity


@pytest.mark.full
def test_the_hint_names_a_command_that_judges_the_model(recording, tmp_path, capsys):
    assert train(recording, tmp_path, name="second") == 0
    hint = capsys.readouterr().err.splitlines()[-1].split()
    assert hint[:2] == ["next", "r3jax"]
    assert main([*hint[2:], "--lpips", "none", "--worst", "0", "--up", "z"]) == 0
    assert str(tmp_path / "second") in capsys.readouterr().out


def test_an_existing_model_is_kept(recording, models, capsys):
    before = (models / "last" / "scene.ply").read_bytes()
    assert train(recording, models) == 2
    message = capsys.readouterr().err
    assert "--overwrite" in message
    assert "--resume" in message
    assert (models / "last" / "scene.ply").read_bytes() == before


def test_overwrite_replaces_a_model(recording, tmp_path, capsys):
    scenes = []
    for words in ([], ["--overwrite", "--seed", "3"]):
        assert train(recording, tmp_path, *words) == 0
        scenes.append((tmp_path / "last" / "scene.ply").read_bytes())
    assert scenes[0] != scenes[1]
    assert json.loads((tmp_path / "last" / "train.json").read_text())["config"]["seed"] == 3
    assert train(recording, tmp_path, "--overwrite", "--resume") == 2
    assert "choose one" in capsys.readouterr().err
    assert (tmp_path / "last" / "scene.ply").read_bytes() == scenes[1]


def test_two_processes_do_not_train_one_model(recording, models, tmp_path, capsys):
    with lock_folder(models / "last"):
        assert train(recording, models, "--overwrite") == 2
    assert "another process is training here" in capsys.readouterr().err
    (tmp_path / "last").mkdir()
    (tmp_path / "last" / "thesis.txt").write_text("mine")
    assert train(recording, tmp_path, "--overwrite") == 2
    assert "holds something that is not a model" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "last").iterdir()] == ["thesis.txt"]


def test_resume_of_other_settings_is_refused(recording, models, capsys):
    record = (models / "last" / "train.json").read_bytes()
    assert train(recording, models, "--resume", seed=7) == 2
    assert "seed" in capsys.readouterr().err
    assert (models / "last" / "train.json").read_bytes() == record
