"""The page of a recorded run: its map over time, its model, and the scene that it was made in."""

import contextlib
import dataclasses
import functools
from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np

from r3jax.apps.viewer.app import App
from r3jax.apps.viewer.blocks import scoring_of, title_of
from r3jax.apps.viewer.overlays import recorded_points
from r3jax.apps.viewer.queries import Extras, Sources, picture_camera
from r3jax.apps.viewer.server import close_server, open_server, url_of
from r3jax.apps.viewer.story import Offer, RecordedStory, decide_again
from r3jax.errors import InputError
from r3jax.runs.reader import Run
from r3jax.runs.settings import scene_of_run, settings_of_run
from r3jax.simulators.base import Simulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import scene_hash
from r3jax.splatting.model import find_model, newest_name
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene


@dataclass(frozen=True)
class RunPage:
    """A page that is being shown."""

    url: str
    app: App


@contextlib.contextmanager
def open_run_page(
    run: Run,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    allow: tuple[str, ...] = (),
    model: str | None = None,
    with_scene: bool = True,
) -> Generator[RunPage]:
    """Shows a run for as long as the context lasts.

    Args:
        run: with at least one view.
        host: address to listen at.
        port: port to listen at; 0 takes any free one.
        allow: further host names under which the page may be requested.
        model: name of the model to show; None: `last`, or the newest, or none.
        with_scene: open the scene that the run was recorded in when it is needed.

    Raises:
        ValueError, OSError: the port is in use, the address is not this machine's, there is no
            such model, or it is damaged.
    """
    server = open_server(host, port, allow)
    try:
        splats = _splats(run, model)
        scene = RecordedScene(run) if with_scene else None
        header = run.header
        extras = Extras(
            Sources(
                None if splats is None else splats[0],
                functools.partial(recorded_points, run),
                None if scene is None else scene.mesh,
            ),
            (0.0, 0.0, 0.0) if splats is None else splats[1],
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
            subtitle=_summary(run),
            extras=extras,
        )
        try:
            yield RunPage(url_of(server), app)
        finally:
            app.close()
    finally:
        close_server(server)


def _summary(run: Run) -> str:
    """Returns where a run lies, how long it is and how it ended."""
    last, end = run.rows[-1], run.end
    is_used_up = end is not None and end.outcome == "budget"
    ended = "budget used up" if is_used_up else run.outcome
    return f"{run.path} · {len(run.rows)} views, {last.metres:.1f} m · {ended}"


def _decisions(run: Run) -> Iterator[tuple[int, Offer | None]]:
    settings = settings_of_run(run)
    return decide_again(run, settings.policy, settings.config)


def _splats(run: Run, name: str | None) -> tuple[GaussianScene, tuple[float, float, float]] | None:
    """Returns the model of that name, and the background that it was trained with."""
    name = name or newest_name(run.path / "models")
    if name is None:
        return None
    model = find_model(run.path / "models", run.path, name)
    red, green, blue = model.background.tolist()
    return read_scene(model.path), (red, green, blue)


class RecordedScene:
    """The scene that a run was recorded in, opened on first use: large ones take long."""

    def __init__(self, run: Run):
        """Opens nothing yet."""
        self._run = run
        self.remark = ""
        """Why it cannot be opened, once that is known."""

    def photograph(self, T_world_camera: np.ndarray) -> np.ndarray | None:
        """Returns the true picture at a pose, [H, W, 3]; None if the scene cannot be opened."""
        if self._simulator is None:
            return None
        return np.asarray(self._simulator.render(T_world_camera).rgb)

    def mesh(self, top: float) -> bytes:
        """Returns the triangles as GLB, without what lies above a height [m].

        Raises:
            ValueError: the scene cannot be opened, or is too large to be shown.
        """
        from r3jax.apps.viewer.glb import world_glb  # loads trimesh, which few pages need

        if not isinstance(self._simulator, RaycastSimulator):
            raise InputError(self.remark or "the simulator of this scene has no mesh to show")
        return world_glb(self._simulator.world, top)

    @functools.cached_property
    def _simulator(self) -> Simulator | None:
        """For small pictures without noise and without a limit of range."""
        try:
            settings = dataclasses.replace(
                scene_of_run(self._run),
                camera=picture_camera(self._run.camera),
                noise=0.0,
                max_range=None,
                start=None,
            )
            simulator = settings.open()
            if scene_hash(simulator) == self._run.header.scene.get("hash"):
                return simulator
            reason = "its content has changed since"
        except (ValueError, OSError, ImportError) as error:
            reason = " ".join(str(error).split())
        self.remark = f"no true image: the scene cannot be opened ({reason})"
        return None
