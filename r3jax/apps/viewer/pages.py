"""Two pages: of a recorded run, with its model and its scene; of an exploration that runs.

The exploration never waits for the page, nor for a browser: it hands over references through a
queue, another thread does the rest. Nothing flows back: the run is the one that it would be without
a viewer.
"""

import contextlib
import dataclasses
import functools
import math
import queue
import threading
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh
import viser
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from r3jax.apps.viewer.app import App
from r3jax.apps.viewer.blocks import scoring_of, title_of
from r3jax.apps.viewer.pictures import linear_light, recorded_points
from r3jax.apps.viewer.queries import Extras, Sources, picture_camera
from r3jax.apps.viewer.server import close_server, open_server, url_of
from r3jax.apps.viewer.story import LiveStory, Offer, RecordedStory, decide_again
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.taken_views import TakenView
from r3jax.geometry.cameras import Camera
from r3jax.planning.planner import Planner
from r3jax.runs.reader import Run
from r3jax.runs.settings import scene_of_run, settings_of_run
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.base import Simulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import scene_hash
from r3jax.simulators.world import Material, World
from r3jax.splatting.model import find_model, newest_name
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene

_Item = tuple[TakenView, Planner] | threading.Event | None
"""A view and the planner that has seen it; an event to be set on the way; None: the end."""


MAX_FACES = 500_000
"""Worlds with more triangles are not sent to a browser: 72 bytes each, and more for colors."""

_LARGEST_TEXTURE = 1024
"""Longer side of a texture [px]; larger ones are made smaller."""


def world_glb(world: World, top: float = math.inf) -> bytes:
    """Writes the triangles of a world with their textures.

    Surfaces are seen from their front only.

    Args:
        world: the world.
        top: triangles that lie above this height as a whole are left out, so that one looks into
            a room from above [m].

    Raises:
        ValueError: more triangles than `MAX_FACES`.
    """
    if len(world.faces) > MAX_FACES:
        raise InputError(
            f"the mesh has {len(world.faces)} triangles, more than the {MAX_FACES} that a "
            "browser is given"
        )
    is_low = world.vertices[world.faces, 2].min(axis=1) <= top
    scene = trimesh.Scene()
    for number, material in enumerate(world.materials):
        chosen = np.flatnonzero((world.face_material == number) & is_low)
        if len(chosen):
            scene.add_geometry(_mesh(world, chosen, material))
    return export_glb(scene, include_normals=False, tree_postprocessor=_without_light)


def _mesh(world: World, chosen: np.ndarray, material: Material) -> trimesh.Trimesh:
    """Makes a mesh of some faces, all of one material."""
    corners = world.vertices[world.faces[chosen]].reshape(-1, 3)
    uv = world.face_uv[chosen].reshape(-1, 2)
    visual = TextureVisuals(uv, material=_pbr(material))
    if world.face_color is not None:
        rgb = world.face_color[chosen].reshape(-1, 3).astype(np.float64).clip(0.0, 1.0)
        linear = np.concatenate([linear_light(rgb), np.ones((len(rgb), 1))], axis=1)
        visual.vertex_attributes["color"] = np.rint(linear * 255.0).astype(np.uint8)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(corners, faces, visual=visual, process=False)


def _pbr(material: Material) -> PBRMaterial:
    color = linear_light(np.asarray(material.color, dtype=np.float64))
    texture = None
    if material.texture is not None:
        texture = _Jpeg.of(material.texture)
    return PBRMaterial(
        baseColorFactor=[*color, 1.0],
        baseColorTexture=texture,
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )


class _Jpeg(Image.Image):
    """A texture that trimesh stores as JPEG: a PNG takes ten times the bytes."""

    format = "JPEG"

    @classmethod
    def of(cls, pixels: np.ndarray) -> "_Jpeg":
        """Makes it of [H, W, 3] uint8."""
        image = Image.fromarray(np.ascontiguousarray(pixels))
        image.thumbnail((_LARGEST_TEXTURE, _LARGEST_TEXTURE))
        texture = cls()
        texture.im, texture._mode, texture._size = image.im, image.mode, image.size
        return texture

    def save(self, fp: Any, format: str | None = None, **params: Any) -> None:
        """Keeps edges of color, which Pillow's own settings for JPEG smear."""
        super().save(fp, format, quality=88, subsampling=0)


def _without_light(tree: dict[str, Any]) -> None:
    """Colors are shown as they are: the world's own pictures hold its light."""
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for material in tree.get("materials", ()):
        material["extensions"] = {"KHR_materials_unlit": {}}


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
    """Describes where a run is stored, how long it is and how it ended."""
    last, end = run.rows[-1], run.end
    is_used_up = end is not None and end.outcome == "budget"
    ended = "budget used up" if is_used_up else run.outcome
    return f"{run.path} · {len(run.rows)} views, {last.metres:.1f} m · {ended}"


def _decisions(run: Run) -> Iterator[tuple[int, Offer | None]]:
    settings = settings_of_run(run)
    return decide_again(run, settings.policy, settings.config)


def _splats(run: Run, name: str | None) -> tuple[GaussianScene, tuple[float, float, float]] | None:
    """Reads the model of that name, or the newest, and the background that it was trained with."""
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
        """Renders the true picture at a pose, [H, W, 3], or None if the scene cannot be opened."""
        if self._simulator is None:
            return None
        return np.asarray(self._simulator.render(T_world_camera).rgb)

    def mesh(self, top: float) -> bytes:
        """Exports the triangles as GLB, without those above a height [m].

        Raises:
            ValueError: the scene cannot be opened, or is too large to be shown.
        """
        from r3jax.apps.viewer.pages import world_glb  # loads trimesh, which few pages need

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


def open_live(
    server: viser.ViserServer,
    camera: Camera,
    bounds: np.ndarray,
    config: ExplorationConfig,
    *,
    title: str,
    subtitle: str,
    earlier: Run | None = None,
) -> "LiveFeed":
    """Opens a page for an exploration that is about to begin.

    Args:
        server: with an empty page; it stays the caller's.
        camera: of every view.
        bounds: of the scene, [2, 3] [m].
        config: of the loop.
        title: what it is.
        subtitle: more about it.
        earlier: what was recorded of the run, if it is gone on with.
    """
    story = LiveStory(camera, earlier)
    max_range = jnp.asarray(config.max_range, dtype=jnp.float32)
    scoring = ScoringConfig(max_range=max_range)
    app = App(server, story, scoring, bounds, title=title, subtitle=subtitle)
    return LiveFeed(server, app, story)


class LiveFeed:
    """Takes what a loop hands over, view by view. A context manager: leaving it ends the thread."""

    def __init__(self, server: viser.ViserServer, app: App, story: LiveStory):
        """Starts the thread that brings views to the page.

        Args:
            server: of the page; it stays the caller's.
            app: of the page; closed when the feed is left.
            story: the app's.
        """
        self.url = url_of(server)
        """Where the page is."""
        self.app, self._story = app, story
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def on_view(self, view: TakenView, planner: Planner) -> None:
        """Puts a view that `explore` reports into the queue."""
        self._queue.put((view, planner))

    def settle(self, timeout: float) -> bool:
        """Waits until every view so far is on the page; returns False after a timeout [s]."""
        is_empty = threading.Event()
        self._queue.put(is_empty)
        return is_empty.wait(timeout) and self.app.worker.wait(timeout)

    def _run(self) -> None:
        while (view := self._queue.get()) is not None:
            if isinstance(view, threading.Event):
                view.set()
                continue
            self._story.add(*view)
            self.app.grow()

    def __enter__(self) -> "LiveFeed":
        """Returns the feed itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Takes in what is in the queue, then ends all threads."""
        self._queue.put(None)
        self._thread.join()
        self.app.close()
