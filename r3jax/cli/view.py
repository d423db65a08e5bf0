"""`r3jax view`: a run in the browser, or as pictures and a film without one."""

import contextlib
import functools
import os
import sys
import threading
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.viewer.decisions import Offer, decide_again
from r3jax.apps.viewer.film import export_film
from r3jax.apps.viewer.glb import world_glb
from r3jax.apps.viewer.known import scoring_of, title_of
from r3jax.apps.viewer.shapes import recorded_points
from r3jax.apps.viewer.video import load_av
from r3jax.cli.captures import Capture
from r3jax.cli.console import (
    BarColumn,
    Console,
    MofNCompleteColumn,
    TextColumn,
    TimeRemainingColumn,
    progress_bar,
)
from r3jax.cli.errors import UserError, check_folder_name, one_line
from r3jax.cli.options import Evaluate, View
from r3jax.cli.pages import check_viser
from r3jax.cli.selection import find_training
from r3jax.cli.setup import plan_of_run, ways_to_open
from r3jax.exploration.replay import config_of
from r3jax.formats.errors import FormatError
from r3jax.simulators.base import Simulator
from r3jax.simulators.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_scene, scene_hash
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.trace.errors import RunError
from r3jax.trace.reader import Run, read_run


def run_view(options: View) -> int:
    """Shows a run until Ctrl-C, or writes its pictures.

    Raises:
        UserError: not a run, no views, a port that is in use, a folder that holds something, a
            missing package.
    """
    console = Console(stderr=True)
    try:
        run = read_run(options.path)
        if not run.rows:
            raise UserError(f"{run.path}: the run has no views yet: there is nothing to see")
        config_of(run)  # says what is wrong with it
        if options.export is not None:
            return _export(run, options.export, options.video, console)
        if options.video:
            raise UserError("--video belongs to --export FOLDER")
        with open_viewer(options, run, console) as viewer:
            with contextlib.suppress(KeyboardInterrupt):
                console.say(f"view      {viewer.url}")
                console.say("Ctrl-C ends it")  # from here on, and not only once this waits
                until_interrupted()
            end_at_once()
    except (RunError, FormatError, ValueError, OSError, ImportError) as error:
        raise UserError(one_line(error)) from error
    return 0


def until_interrupted() -> None:
    """Waits for Ctrl-C."""
    threading.Event().wait()


def end_at_once() -> None:
    """Ends the process: the page writes nothing, and what it works on may take half a minute yet.

    An answer that is being worked out or compiled cannot be stopped, and Python would wait for it,
    as viser does for its browsers.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


@dataclass(frozen=True)
class Viewer:
    """A page that is being shown."""

    url: str
    app: Any
    """A `viewer.app.App`, which cannot be named where viser may not be installed."""


@contextlib.contextmanager
def open_viewer(options: View, run: Run, console: Console) -> Generator[Viewer]:
    """The page of a run, for as long as the context lasts.

    Raises:
        UserError: viser is not installed, or there is no such model.
        ValueError, OSError: the port is in use, the address is not this machine's.
    """
    check_viser()
    from r3jax.apps.viewer.answers import Extras
    from r3jax.apps.viewer.app import App
    from r3jax.apps.viewer.server import LOOPBACK, close_server, open_server, url_of
    from r3jax.apps.viewer.story import RecordedStory
    from r3jax.apps.viewer.surface import Sources

    server = open_server(options.host, options.port, options.allow)
    try:
        if options.host not in LOOPBACK:
            text = f"everybody who can reach {options.host} sees the page, and can use it"
            console.say(text, style="yellow")
        with console.status("opening the run ..."):
            splats = _splats(run, options.name)
            scene = None if options.no_scene else Scene(run)
            header = run.header
            extras = Extras(
                Sources(
                    None if splats is None else splats.model,
                    functools.partial(recorded_points, run),
                    None if scene is None else scene.mesh,
                ),
                (0.0, 0.0, 0.0) if splats is None else splats.background,
                None if scene is None else scene.photograph,
                functools.partial(_decisions, run),
                lambda: "" if scene is None else scene.remark,
            )
            app = App(
                server,
                RecordedStory(run),
                scoring_of(header),
                np.asarray(header.bounds, np.float64),
                title=title_of(header),
                subtitle=f"{run.path}; {run.outcome}",
                extras=extras,
            )
        try:
            yield Viewer(url_of(server), app)
        finally:
            app.close()
    finally:
        close_server(server)


def _decisions(run: Run) -> Iterator[tuple[int, Offer | None]]:
    plan = plan_of_run(run)
    return decide_again(run, plan.policy, plan.config)


@dataclass(frozen=True)
class Splats:
    """A trained model."""

    model: GaussianScene
    background: tuple[float, float, float]
    """What it was trained with."""


def _splats(run: Run, name: str | None) -> Splats | None:
    """The model of that name; without one `last`, or else the newest, or else none.

    Raises:
        UserError: there is no model of that name.
        ValueError: its file is damaged.
    """
    if name is not None:
        check_folder_name(name)
    else:
        found = sorted((run.path / "models").glob("*/scene.ply"), key=_written)
        if not found:
            return None
        names = [path.parent.name for path in found]
        name = "last" if "last" in names else names[-1]
    options = Evaluate(path=run.path, name=name)
    training = find_training(options, Capture(run.path, run))
    red, green, blue = training.background.tolist()
    return Splats(read_scene(training.model), (red, green, blue))


def _written(path: Path) -> float:
    return path.stat().st_mtime


class Scene:
    """The scene that a run was recorded in, opened when first asked for: large ones take long."""

    def __init__(self, run: Run):
        """Opens nothing yet."""
        self._run = run
        self.remark = ""
        """Why it cannot be opened, once that is known."""

    def photograph(self, T_world_camera: np.ndarray) -> np.ndarray | None:
        """The true picture at a pose, [H, W, 3]; None if the scene cannot be opened."""
        if self._simulator is None:
            return None
        return np.asarray(self._simulator.render(T_world_camera).rgb)

    def mesh(self, top: float) -> bytes:
        """The triangles as GLB, without what lies above a height [m].

        Raises:
            ValueError: the scene cannot be opened, or is too large to be shown.
        """
        if not isinstance(self._simulator, RaycastSimulator):
            raise ValueError(self.remark or "the simulator of this scene has no mesh to show")
        return world_glb(self._simulator.world, top)

    @functools.cached_property
    def _simulator(self) -> Simulator | None:
        """For small pictures without noise and without a limit of range."""
        from r3jax.apps.viewer.answers import picture_camera

        scene = self._run.header.scene
        try:
            simulator = open_scene(
                scene["name"],
                **ways_to_open(scene),
                camera=picture_camera(self._run.camera),
                noise=0.0,
                max_range=None,
                seed=self._run.header.seed,
            )
            if scene_hash(simulator) == scene.get("hash"):
                return simulator
            reason = "its content has changed since"
        except (ValueError, OSError, ImportError) as error:
            reason = one_line(error)
        self.remark = f"no true image: the scene cannot be opened ({reason})"
        return None


def _export(run: Run, out: Path, video: bool, console: Console) -> int:
    """Writes the pictures.

    Raises:
        FormatError, RunError, ImportError, OSError: as `export_film`.
    """
    if video:
        load_av()  # says what is missing before an hour has passed
    with progress_bar(
        console,
        TextColumn("drawing"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        transient=True,
    ) as bar:
        task = bar.add_task("", total=None)
        written = export_film(
            run,
            out,
            video=video,
            on_picture=lambda done, total: bar.update(task, completed=done, total=total),
        )
    for path in written:
        console.say(f"written   {path}")
    return 0
