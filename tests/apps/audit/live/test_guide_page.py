"""The page of a guide as a browser shows it, as wide as a phone."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import r3jax
from r3jax.apps.audit.live.guide_page import open_guide
from tests.apps.audit.room import LENS, SIZE, picture, round_poses

pytest.importorskip("playwright.sync_api", reason="the page is tested with playwright")
from playwright import sync_api

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"


@pytest.mark.skipif(not Path(CHROMIUM).exists(), reason="Chromium is not installed")
def test_a_phone_shows_where_to_go_what_is_done_and_what_is_wrong():
    config = r3jax.MappingConfig(capacity=1 << 13)
    bounds = np.stack([np.zeros(3), SIZE])
    planner, poses = r3jax.start(LENS.camera, bounds, "random", config=config), round_poses(4)
    complaints: list[str] = []
    with open_guide(port=0) as guide, sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 390, "height": 800})
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(guide.url)
        sync_api.expect(page.locator("#next")).to_contain_text("Waiting")
        for pose in poses[:2]:
            frame = r3jax.Frame.from_arrays(*picture(pose), pose, LENS.camera)
            planner = r3jax.observe(planner, frame)
            guide.observed(planner, frame, name="second <i>", warnings=["Blurred <b>badly</b>"])
        there = poses[2]
        way = np.stack([poses[1][:3, 3], there[:3, 3]])
        guide.decided(frame, r3jax.Decision(there, way, 1.0, 1.0, there[None]))
        sync_api.expect(page.locator("#next")).to_contain_text("turn a quarter to the left")
        sync_api.expect(page.locator("#done")).to_contain_text("2 pictures")
        sync_api.expect(page.locator("#warn li")).to_have_text("Blurred <b>badly</b>")
        sync_api.expect(page.locator("#name")).to_contain_text("second <i>")
        assert page.locator("#plan circle").count() == 2
        assert page.evaluate("document.getElementById('latest').naturalWidth") == LENS.width
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        browser.close()
    assert complaints == []
