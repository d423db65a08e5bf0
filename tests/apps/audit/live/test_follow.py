"""From a folder that grows to a page in the browser, and to what is audited in the end."""

import json
import shutil
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

import r3jax
from r3jax.apps.audit.audit import audit
from r3jax.apps.audit.live import follow as module
from r3jax.apps.audit.live.follow import follow
from r3jax.apps.audit.live.guide_page import open_guide, scan_progress
from r3jax.apps.audit.settings import AuditSettings
from tests.apps.audit.room import LENS, SIZE, picture, round_poses, write_recording

POSES = round_poses(10)
BOUNDS = np.stack([np.zeros(3), SIZE])


def asked(page, name: str, host: str | None = None) -> bytes:
    request = urllib.request.Request(f"{page.url}/{name}", headers={"Host": host} if host else {})
    with urllib.request.urlopen(request, timeout=5) as answer:
        return answer.read()


def news(page) -> dict:
    return json.loads(asked(page, "news.json"))


def wait_for(page, is_so, seconds: float = 120.0) -> dict:
    end = time.monotonic() + seconds
    while not is_so(found := news(page)):
        assert time.monotonic() < end, found
        time.sleep(0.02)
    return found


def frame_at(pose) -> r3jax.Frame:
    rgb, depth = picture(pose)
    return r3jax.Frame.from_arrays(rgb, depth, pose, LENS.camera)


def test_a_folder_that_grows_is_followed_and_what_came_in_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_CAPACITY", 1 << 13)
    whole, path = write_recording(tmp_path / "whole", POSES), tmp_path / "growing"
    for name in ("images", "depth"):
        (path / name).mkdir(parents=True)
    shutil.copy(whole / "K.txt", path)
    lines = (whole / "poses.txt").read_text().splitlines()
    stop, left = threading.Event(), []
    with open_guide(port=0) as page:
        run = lambda: left.append(follow(path, page, tmp_path / "scratch", up="z", stop=stop))
        thread = threading.Thread(target=run)
        thread.start()
        assert "Waiting" in wait_for(page, lambda found: True)["next"]
        for number in range(len(POSES) - 1):
            for kind in ("images", "depth"):
                shutil.copy(whole / kind / f"{number:03d}.png", path / kind)
            with open(path / "poses.txt", "a") as file:
                file.write(lines[number] + "\n")
            found = wait_for(page, lambda found, n=number: found.get("name") == f"{n:03d}.png")
        shutil.copy(whole / "images" / "009.png", path / "images")  # half a frame stays out
        found = wait_for(page, lambda found: found["is_current"])
        assert found["next"].endswith(".")
        assert len(found["path"]) == 9
        assert 0.0 < found["fine_share"] <= 1.0
        assert asked(page, "plan.png")[1:4] == asked(page, "latest.png")[1:4] == b"PNG"
        stop.set()
        thread.join(60)
    (source,) = left
    assert source.labels == tuple(f"{i:03d}.png" for i in range(9))
    np.testing.assert_allclose(source.poses, POSES[:9], atol=1e-9)
    assert np.array_equal(source.read(8)[0], picture(POSES[8])[0])
    audited = audit(source, AuditSettings(up="z", views=0, folds=2))
    assert found["fine_share"] == pytest.approx(audited.diagnosis.fine_share, abs=0.05)


def test_a_robot_shows_the_same_page_with_three_verbs():
    config = r3jax.MappingConfig(capacity=1 << 13)
    planner = r3jax.start(LENS.camera, BOUNDS, "r3-pano", starts=[POSES[0]], config=config)
    with open_guide(port=0) as page:
        for pose in POSES[:2]:
            frame = frame_at(pose)
            planner = r3jax.observe(planner, frame)
            page.observed(planner, frame, warnings=["a <b>warning</b>"])
        before = news(page)
        assert before["next"].startswith("Keep")
        there = POSES[5]
        way = np.stack([POSES[1][:3, 3], there[:3, 3]])
        page.decided(frame, r3jax.Decision(there, way, 1.0, 1.0, there[None]))
        found = news(page)
        assert found["target"]["x"] == pytest.approx(there[0, 3])
        assert found["way"] == [pytest.approx(place[:2]) for place in way]
        page.decided(frame, None)
        assert news(page)["next"].startswith("Nothing new")
        assert found["warnings"] == ["a <b>warning</b>"]


def test_the_page_needs_nothing_from_elsewhere_and_answers_its_own_name_only():
    with open_guide(port=0) as page:
        text = asked(page, "").decode()
        assert text.startswith("<!doctype html>")
        assert "//" not in text.replace("http://www.w3.org/2000/svg", "")
        for name, host in (("plan.png", None), ("../etc/passwd", None), ("", "evil.example:80")):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                asked(page, name, host)


def test_surfaces_seen_from_all_sides_are_done_and_others_not():
    config = r3jax.MappingConfig(capacity=1 << 13)
    shares, dark = [], []
    for count in (1, 10):
        planner = r3jax.start(LENS.camera, BOUNDS, "random", config=config)
        for pose in POSES[:count]:
            planner = r3jax.observe(planner, frame_at(pose))
        done = scan_progress(planner, LENS.camera, POSES[:, :3, 3])
        assert done.fine_share + sum(done.causes.values()) == pytest.approx(1.0)
        shares.append(done.fine_share * done.area)
        dark.append(done.dark)
    assert shares[1] > 3 * shares[0] > 0
    assert dark[0] > 2 * dark[1]
