"""A run as pictures and as a film: what is written, and that nothing is left half done."""

import shutil

import numpy as np
import pytest
from PIL import Image

from r3jax.apps.viewer import film
from r3jax.apps.viewer.blocks import QUANTITIES
from r3jax.apps.viewer.color_maps import UNSEEN
from r3jax.apps.viewer.film import ENCODERS, HEIGHT, WIDTH, Film, export_film, write_video
from r3jax.apps.viewer.stills import Sheet
from r3jax.apps.viewer.story import Timeline
from r3jax.trace.errors import RunError
from r3jax.trace.reader import read_run
from tests.apps.viewer.conftest import VIEWS

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    pytest.importorskip("av", reason="films are written by PyAV, which is not installed")
    out = tmp_path_factory.mktemp("film") / "out"
    told = []
    written = export_film(run, out, video=True, on_picture=lambda *counts: told.append(counts))
    return out, written, told


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path))


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
    scene = np.s_[90 : HEIGHT - 60, : Sheet.scene_width(WIDTH) - 30]

    def ink(path) -> int:
        return int((picture(path)[scene] < 250).any(axis=-1).sum())

    assert 0 < ink(out / "views/000000.png") < ink(out / f"views/{VIEWS - 1:06d}.png")
    differ = picture(out / "above-bias.png")[scene] != picture(out / "above-color.png")[scene]
    assert differ.any(axis=-1).mean() > 0.1


def test_scores_are_drawn_in_their_colors(run):
    drawn = Film(run, Timeline(run)).still("renderability", from_above=True)
    scene = drawn[90 : HEIGHT - 60, : Sheet.scene_width(WIDTH) - 30].reshape(-1, 3).astype(int)
    red = (scene[:, 0] > scene[:, 1] + 60) & (scene[:, 2] < 120)
    green = (scene[:, 1] > scene[:, 0] + 40) & (scene[:, 2] < 130)
    assert red.any()
    assert green.any()
    assert UNSEEN == (150, 155, 163)


def test_a_folder_that_holds_something_is_refused_and_left_alone(run, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OSError, match="something is there already"):
        export_film(run, tmp_path, video=False)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_a_broken_frame_leaves_nothing_behind(run, tmp_path):
    copy = shutil.copytree(run.path, tmp_path / "run")
    (copy / "frames" / "000003.png").write_bytes(b"no picture")
    with pytest.raises(RunError, match="000003"):
        export_film(read_run(copy), tmp_path / "deep" / "out", video=False)
    assert list((tmp_path / "deep").iterdir()) == []


def test_cameras_under_the_ceiling_do_not_lift_the_cut_above_it(run):
    from r3jax.apps.viewer.blocks import cut_height

    ceiling = np.array([[0.0, 0.0, z] for z in np.linspace(0.0, 1.0, 50)])
    assert cut_height(run.rows, ceiling) < 1.0
    high = np.array([[0.0, 0.0, 50.0]])
    heights = [row.pose[2, 3] for row in run.rows]
    assert min(heights) < cut_height(run.rows, high) < max(heights) + 1.0


def test_a_film_without_pictures_or_of_odd_size_is_refused(tmp_path):
    pytest.importorskip("av", reason="films are written by PyAV, which is not installed")
    with pytest.raises(ValueError, match="at least one picture"):
        write_video(tmp_path / "a.mp4", [], 4)
    with pytest.raises(ValueError, match="even sizes, got 33 x 32"):
        write_video(tmp_path / "b.mp4", [np.zeros((32, 33, 3), np.uint8)], 4)


def test_a_film_is_written_by_the_first_encoder_there_is(tmp_path):
    pytest.importorskip("av", reason="films are written by PyAV, which is not installed")
    gray = [np.full((32, 48, 3), value, np.uint8) for value in (40, 120, 200)]
    assert write_video(tmp_path / "a.mp4", gray, 4) in ENCODERS
    assert (tmp_path / "a.mp4").stat().st_size > 0
    assert film.HEIGHT % 2 == film.WIDTH % 2 == 0
