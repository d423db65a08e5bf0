"""Watching an exploration changes nothing of it, and never holds it up."""

import threading

import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")

from r3jax.apps.viewer.run_page import open_live
from r3jax.apps.viewer.server import close_server, open_server
from r3jax.apps.viewer.story import LiveStory
from r3jax.exploration.loop import explore
from r3jax.runs.settings import open_run_scene, settings_of_run
from tests.apps.viewer.conftest import VIEWS
from tests.box_room import write_room
from tests.cli.small_runs import explore as explore_by_words
from tests.cli.small_runs import main_without_report

PATIENCE = 60.0


@pytest.fixture(scope="module")
def world(run):
    return settings_of_run(run), open_run_scene(run)


@pytest.fixture
def server():
    server = open_server("127.0.0.1", 0)
    yield server
    close_server(server)


def opened(world, server, **more):
    plan, simulator = world
    words = {"title": "live", "subtitle": "here"}
    return open_live(server, simulator.camera, simulator.bounds, plan.config, **words, **more)


def go(world, on_view):
    plan, simulator = world
    return explore(simulator, plan.policy, budget=plan.budget, config=plan.config, on_view=on_view)


def test_a_watched_run_is_the_run_that_nobody_watched_and_ends_on_the_page(run, world, server):
    with opened(world, server) as feed:
        result = go(world, feed.on_view)
        assert [row.sha256 for row in result.rows] == [row.sha256 for row in run.rows]
        for mine, recorded in zip(result.rows, run.rows, strict=True):
            assert mine.coverage == recorded.coverage
            assert mine.seconds == recorded.seconds
            np.testing.assert_array_equal(mine.pose, recorded.pose)
        feed.settle(PATIENCE)
        app, last = feed.app, VIEWS - 1
        assert len(app.story.rows) == VIEWS
        assert app.controls.settings.step == last
        moment, offer = app.story.moment(last), app.story.offer(last)
        np.testing.assert_array_equal(moment.map_state.key, result.state.map_state.key)
        np.testing.assert_array_equal(moment.grid.log_odds, result.state.grid.log_odds)
        chosen = run.rows[-1].choice
        np.testing.assert_allclose(offer.poses[offer.chosen], chosen.pose, atol=1e-5)
        for name in ("/map", f"/views/{last:06d}"):
            assert server.scene.get_handle_by_name(name) is not None
        view = server.scene.get_handle_by_name("/view")
        np.testing.assert_allclose(view.position, run.rows[-1].pose[:3, 3], atol=1e-5)


def test_the_loop_does_not_wait_for_the_page(world, server, monkeypatch):
    gate, stuck = threading.Event(), threading.Event()
    add = LiveStory.add

    def slow_add(self, view, planner):
        stuck.set()
        assert gate.wait(PATIENCE)
        add(self, view, planner)

    monkeypatch.setattr(LiveStory, "add", slow_add)
    with opened(world, server) as feed:
        result = go(world, feed.on_view)
        assert len(result.rows) == VIEWS  # the run is over, and the page has shown nothing yet
        assert stuck.wait(PATIENCE)
        assert len(feed.app.story.rows) == 0
        gate.set()
        feed.settle(PATIENCE)
        assert len(feed.app.story.rows) == VIEWS


def test_the_command_writes_the_same_bytes_live_and_goes_on_live(run, tmp_path, capsys):
    room = write_room(tmp_path / "room.ply")
    words = ("--live", "--port", "0")
    assert explore_by_words(room, tmp_path, "--budget", "views:2", *words) == 0
    assert "live      http://127.0.0.1:" in capsys.readouterr().err
    path = tmp_path / "box"
    resume = ["explore", "--resume", str(path), "--budget", f"views:{VIEWS}", *words]
    assert main_without_report(resume) == 0
    assert (path / "trace.jsonl").read_bytes() == (run.path / "trace.jsonl").read_bytes()
    for step in range(VIEWS):
        name = f"frames/{step:06d}.png"
        assert (path / name).read_bytes() == (run.path / name).read_bytes()


def test_a_run_that_is_gone_on_with_shows_its_earlier_views(run, world, server):
    with opened(world, server, earlier=run) as feed:
        assert [row.step for row in feed.app.story.rows] == list(range(VIEWS))
        np.testing.assert_array_equal(
            feed.app.story.image(2), (np.asarray(run.frame(2).rgb) * 255).round().astype(np.uint8)
        )
        with pytest.raises(LookupError):
            feed.app.story.moment(2)
