"""A run as pictures and as a film: what is written, and that nothing is left half done."""

import shutil

import numpy as np
import pytest
from PIL import Image

from r3jax.apps.viewer.drawing import QUANTITIES
from r3jax.apps.viewer.film import HEIGHT, SCENE, WIDTH, export_film
from r3jax.apps.viewer.story import cut_height
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_run
from tests.apps.viewer.conftest import VIEWS


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    pytest.importorskip("av", reason="films are written by PyAV, which is not installed")
    out = tmp_path_factory.mktemp("film") / "out"
    told = []
    written = export_film(run, out, video=True, on_picture=lambda *counts: told.append(counts))
    return out, written, told


def scene(path) -> np.ndarray:
    """The part of a picture that shows the map."""
    left, bottom, width, height = SCENE
    top, low = round((1.0 - bottom - height) * HEIGHT), round((1.0 - bottom) * HEIGHT)
    return picture(path)[top:low, round(left * WIDTH) : round((left + width) * WIDTH)].astype(int)


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def test_there_is_a_picture_for_every_view_and_two_for_every_quantity(exported):
    out, written, told = exported
    assert [p.name for p in sorted((out / "views").iterdir())] == [
        f"{step:06d}.png" for step in range(VIEWS)
    ]
    stills = {f"{kind}-{name}.png" for kind in ("oblique", "above") for name in QUANTITIES}
    assert {p.name for p in out.glob("*.png")} == stills
    assert all(path.exists() for path in written)
    total = VIEWS + len(stills)
    assert told == [(done, total) for done in range(1, total + 1)]
    for path in out.rglob("*.png"):
        assert picture(path).shape == (HEIGHT, WIDTH, 3)


def test_the_film_shows_the_pictures_of_the_views_in_order(exported):
    import av

    out, _, _ = exported
    with av.open(str(out / "run.mp4")) as container:
        assert container.streams.video[0].codec_context.name in ("h264", "mpeg4")
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) > VIEWS  # the last one stays for a while
    for step in range(VIEWS):
        expected = picture(out / "views" / f"{step:06d}.png").astype(float)
        assert np.abs(frames[step] - expected).mean() < 6.0
    last = picture(out / "views" / f"{VIEWS - 1:06d}.png").astype(float)
    assert np.abs(frames[-1] - last).mean() < 6.0


def test_the_map_grows_and_changes_color_with_the_quantity(exported):
    out, _, _ = exported

    def ink(path) -> int:
        return int((scene(path) < 250).any(axis=-1).sum())

    assert 0 < ink(out / "views/000000.png") < ink(out / f"views/{VIEWS - 1:06d}.png")
    differ = scene(out / "above-bias.png") != scene(out / "above-color.png")
    assert differ.any(axis=-1).mean() > 0.1


def test_scores_are_drawn_in_their_colors(exported):
    colors = scene(exported[0] / "above-renderability.png").reshape(-1, 3)
    assert ((colors[:, 0] > colors[:, 1] + 60) & (colors[:, 2] < 120)).any()  # red
    assert ((colors[:, 1] > colors[:, 0] + 40) & (colors[:, 2] < 130)).any()  # green


def test_a_folder_that_holds_something_is_refused_and_left_alone(run, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OSError):
        export_film(run, tmp_path, video=False)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_a_broken_frame_leaves_nothing_behind(run, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "run")
    (copy / "frames" / "000003.png").write_bytes(b"no picture")
    with pytest.raises(RunError, match="000003"):
        export_film(read_run(copy), tmp_path / "deep" / "out", video=False)
    assert list((tmp_path / "deep").iterdir()) == []


def test_cameras_under_the_ceiling_do_not_lift_the_cut_above_it(run):
    ceiling = np.array([[0.0, 0.0, z] for z in np.linspace(0.0, 1.0, 50)])
    assert cut_height(run.rows, ceiling) < 1.0
    high = np.array([[0.0, 0.0, 50.0]])
    heights = [row.pose[2, 3] for row in run.rows]
    assert min(heights) < cut_height(run.rows, high) < max(heights) + 1.0
