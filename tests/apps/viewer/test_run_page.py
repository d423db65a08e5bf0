"""The page in real Chromium: it loads, the slider moves the camera, a drag is answered."""

import contextlib
import dataclasses
import itertools
import shutil
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import r3jax

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")
pytest.importorskip(
    "playwright.sync_api", reason="the page is tested with playwright, which is not installed"
)
from playwright import sync_api
from viser import transforms

from r3jax.apps.viewer.run_page import Query, open_run_page
from tests.apps.viewer.conftest import VIEWS

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
PATIENCE = 120.0  # seconds; of a machine with other work
NUMBER = "#r3jax-renderability"


@pytest.fixture(scope="module")
def viewer(run):
    with open_run_page(run) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def complaints():
    return []


@pytest.fixture(scope="module")
def page(viewer, complaints):
    """The page in a browser; what its console complains of goes into `complaints`."""
    if not Path(CHROMIUM).exists():
        pytest.skip("the page is tested in Chromium, which is not installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1200, "height": 800})
        page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.set_default_timeout(1000 * PATIENCE)
        page.goto(viewer.url)
        wait_for_answer(page)
        yield page
        with contextlib.suppress(Exception):  # a browser that is gone is as good as closed
            browser.close()


def wait_for_answer(page) -> float:
    """The number beside the dragged camera once it belongs to its pose."""
    page.wait_for_selector(f'{NUMBER}[data-state="done"]', state="attached")
    return float(page.inner_text(NUMBER))


def holds_within(page, is_true, seconds: float) -> bool:
    """Lets the page work until something holds; False if it takes longer."""
    end = time.monotonic() + seconds
    while not (held := is_true()) and time.monotonic() < end:
        page.wait_for_timeout(50)
    return held


def wait_until(page, is_true) -> None:
    assert holds_within(page, is_true, PATIENCE), "it never came"


def wait_for_frames(page) -> None:
    """Returns when the browser has drawn a few more pictures, however long it takes for one."""
    for _ in range(5):
        page.evaluate("() => new Promise(requestAnimationFrame)")


def answer_at(viewer) -> float:
    """R where the server has the camera, by the public function."""
    app = viewer.app
    moment = app.story.moment(app.controls.settings.step)
    T = jnp.asarray(app.canvas.pose, jnp.float32)
    return float(r3jax.renderability(moment.map_state, app.story.camera, T))


def client_of(viewer):
    return next(iter(viewer.app.canvas._server.get_clients().values()))


def view_position(viewer) -> np.ndarray:
    """Where the view on the slider stands [m]."""
    return np.array(viewer.app.canvas._server.scene.get_handle_by_name("/view").position)


def settle(page, viewer) -> float:
    """Waits for all answers on both sides; the number on the page."""
    assert viewer.app.worker.wait(PATIENCE)
    expected = f"{answer_at(viewer):.3f}"
    wait_until(page, lambda: page.inner_text(NUMBER) == expected)
    return wait_for_answer(page)


def test_the_page_loads_and_says_what_the_map_says(page, viewer):
    assert page.locator("canvas").count() >= 1
    number = settle(page, viewer)
    assert 0.0 < number < 1.0
    assert page.inner_text("#r3jax-view") == str(VIEWS)
    assert page.inner_text("#r3jax-moment") == f"after view {VIEWS} of {VIEWS}"
    assert page.locator("#r3jax-busy").count() == 0


def test_the_scene_is_beside_the_panel(page):
    canvas, panel = (page.locator(what).first.bounding_box() for what in ("canvas", NUMBER))
    assert canvas["x"] + canvas["width"] <= panel["x"] + 1.0


def test_the_slider_moves_the_camera(page, viewer, run):
    thumb = page.locator('[role="slider"]').nth(1)  # below that of the cut
    before = view_position(viewer)
    thumb.focus()
    thumb.press("ArrowLeft")
    thumb.press("ArrowLeft")
    wait_until(page, lambda: page.inner_text("#r3jax-view") == str(VIEWS - 2))
    assert viewer.app.controls.settings.step == VIEWS - 3
    assert viewer.app.worker.wait(PATIENCE)
    after = view_position(viewer)
    np.testing.assert_allclose(after, run.rows[VIEWS - 3].pose[:3, 3], atol=1e-5)
    assert np.abs(after - before).max() > 0.01
    settle(page, viewer)  # the number is that of the earlier map
    assert page.inner_text("#r3jax-moment") == f"after view {VIEWS - 2} of {VIEWS}"


def pixel_of(client, point: np.ndarray) -> tuple[float, float]:
    """Where a point of the world stands on the canvas [px]."""
    camera = client.camera
    R = transforms.SO3(camera.wxyz).as_matrix()
    x, y, z = R.T @ (point - camera.position)
    focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    return 0.5 * camera.image_width + focal * x / z, 0.5 * camera.image_height + focal * y / z


def look_at_the_gizmo(page, viewer) -> np.ndarray:
    """Puts the camera into the open and the eye before it; where the gizmo's x axis ends."""
    app = viewer.app
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # along +y
    pose[:3, 3] = (-0.5, -0.3, 0.1)
    app.canvas.place_camera(pose)
    app.ask()
    client = client_of(viewer)
    client.camera.position = pose[:3, 3] + np.array([0.3, -2.2, 0.9])
    client.camera.look_at = pose[:3, 3]
    eye = client.camera.position.copy()
    wait_until(page, lambda: np.abs(client.camera.position - eye).max() < 1e-3)
    wait_for_frames(page)  # so that the gizmo stands where it will be grabbed
    return pose[:3, 3]


def test_a_dragged_camera_is_answered(page, viewer):
    origin = look_at_the_gizmo(page, viewer)
    before = settle(page, viewer)
    client = client_of(viewer)
    box = page.locator("canvas").first.bounding_box()
    start = viewer.app.canvas.pose

    def at(reach: float) -> tuple[float, float]:
        u, v = pixel_of(client, origin + np.array([reach, 0.0, 0.0]))
        return box["x"] + u, box["y"] + v

    end = time.monotonic() + PATIENCE
    for grip in itertools.cycle((0.42, 0.3, 0.5)):  # along the arrow of x, which is 0.6 m long
        page.mouse.move(*at(grip))
        wait_for_frames(page)  # it is seen that the mouse is over the arrow
        page.mouse.down()
        page.mouse.move(*at(grip + 0.5), steps=6)
        wait_for_frames(page)
        page.mouse.up()
        has_moved = lambda: not np.allclose(viewer.app.canvas.pose, start)
        if holds_within(page, has_moved, 3.0):
            break
        assert time.monotonic() < end, "the camera was never dragged"
    moved = viewer.app.canvas.pose[:3, 3] - origin
    assert moved[0] > 0.1
    np.testing.assert_allclose(moved[1:], 0.0, atol=1e-3)  # along its axis and no other
    after = settle(page, viewer)
    assert after != before


def test_what_belongs_to_another_view_says_so(page, viewer):
    settle(page, viewer)
    app, shown = viewer.app, page.inner_text("#r3jax-moment")
    settings = dataclasses.replace(app.controls.settings, step=0)
    app._mark_stale(Query(settings, app.canvas.pose), camera=True, view=True, scene=True)
    wait_until(page, lambda: page.locator("#r3jax-busy").count() == 1)
    assert page.inner_text("#r3jax-busy") == "View 1: being computed …"
    assert page.inner_text("#r3jax-moment") == shown  # what is drawn until then
    wait_until(page, lambda: page.get_by_text("opening view 1 …").count() == 1)
    assert page.locator(NUMBER).get_attribute("data-state") == "computing"
    assert app.canvas._server.scene.get_handle_by_name("/suggestion") is None
    assert app.look is None
    app._asked = None  # as it is when there is a new view
    app.ask()
    settle(page, viewer)
    wait_until(page, lambda: page.locator("#r3jax-busy").count() == 0)
    assert page.get_by_text("opening view").count() == 0
    assert app.look is not None


def test_the_button_turns_the_camera_along_the_suggestion(page, viewer):
    settle(page, viewer)
    look = viewer.app.look
    assert look is not None
    page.get_by_text("Look along the suggested direction").click()
    wait_until(
        page, lambda: np.allclose(viewer.app.canvas.pose[:3, 2], look.best_direction, atol=1e-4)
    )
    settle(page, viewer)


def test_the_console_has_no_errors(page, complaints):
    assert page.locator("canvas").count() >= 1
    assert complaints == []
