"""The page of a run: recorded, with its model and its scene; or of an exploration that runs.

Settings and drags become queries. One thread computes the newest query, part by part, the quick
ones first: the photo of a view; the map, if it has changed, and R of the dragged camera; the splats
and the panorama from there. Results of older queries are never shown.

An exploration never waits for the page, nor for a browser: it hands over references through a
queue, and another thread does the rest. Nothing flows back, so the run is the same as without a
viewer.
"""

import contextlib
import dataclasses
import functools
import math
import queue
import threading
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Generic, TypeVar

import jax.numpy as jnp
import numpy as np
import trimesh
import viser
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from r3jax.apps.viewer.drawing import (
    BUDGET,
    CAUSE,
    CAUSE_COLORS,
    Blocks,
    CameraPreview,
    Context,
    Known,
    QuickPreview,
    block_causes,
    block_colors,
    cause_colors,
    known_at,
    linear_light,
    offer_segments,
    paint,
    panorama_image,
    path_segments,
    preview_from,
    preview_pictures,
    quick_preview_from,
    quick_preview_image,
    recorded_points,
    splat_arrays,
    surface_terms,
    to_bytes,
)
from r3jax.apps.viewer.facts import (
    PLACES,
    Caption,
    legend_html,
    menu_of,
    pictures_html,
    preview_html,
    view_html,
)
from r3jax.apps.viewer.layout import Canvas, Color, Controls, DisplaySettings, Menu, place_eye
from r3jax.apps.viewer.server import close_server, open_server, url_of
from r3jax.apps.viewer.story import (
    LiveStory,
    Moment,
    Offer,
    RecordedStory,
    Story,
    cut_height,
    decide_again,
    scoring_of,
    title_of,
)
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.taken_views import TakenView, name_of, unit_of
from r3jax.geometry.cameras import Camera
from r3jax.planning.planner import Planner
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run
from r3jax.runs.replay import Reason
from r3jax.runs.settings import scene_of_run, settings_of_run
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.base import Simulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import scene_hash
from r3jax.simulators.world import Material, World
from r3jax.splatting.model import find_model, newest_name
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.views import fitted_size

_KNOWN_KEPT = 3
"""Number of moments whose blocks and terms are cached: a slider goes back and forth."""

_NODES = {"voxels": "/map", "points": "/points", "splats": "/splats", "mesh": "/mesh"}
_POINT_EDGE = 0.02
_CELLS, _CELL_EDGE = "/unexplored", 0.05

Points = tuple[np.ndarray, np.ndarray]
"""Points [n, 3] float32 [m] and their colors [n, 3] uint8."""

Show = Callable[[], None]
"""Shows a part of a result on the page."""


@dataclass(frozen=True)
class _Drawing:
    """A drawing, ready to be shown."""

    draw: Show
    moment: str
    """Description of the moment that it shows."""

    detail: str
    """A detail, such as the number of voxels."""

    cells: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """Unexplored cells drawn beside it, [k, 3] [m]."""


@dataclass(frozen=True)
class Sources:
    """Sources of drawings beside the voxels. Functions are called when first needed."""

    model: GaussianScene | None = None
    """The trained splats."""

    points: Callable[[], Points] | None = None
    """The recorded points."""

    mesh: Callable[[float], bytes] | None = None
    """Exports the scene as GLB, cut at a height [m]."""

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Names of the surfaces that can be drawn; voxels always can."""
        known = {"points": self.points, "splats": self.model, "mesh": self.mesh}
        return ("voxels", *(name for name, what in known.items() if what is not None))


class PlaceLayer:
    """Draws the place and records the current drawing. For one thread at a time."""

    def __init__(self, canvas: Canvas, story: Story, config: ScoringConfig, sources: Sources):
        """Draws nothing yet.

        Args:
            canvas: the 3D scene.
            story: the run; its camera sets the target resolution.
            config: settings of the scores.
            sources: sources of the drawings.
        """
        self._canvas, self._story, self._config, self._sources = canvas, story, config, sources
        self._known: OrderedDict[tuple[int, bool], Known] = OrderedDict()
        self._points: Points | None = None
        self._drawn: tuple[object, ...] | None = None
        self._gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None
        self.caption: Caption | None = None
        """Caption of the current drawing; None before the first one."""

    def is_drawn(
        self,
        settings: DisplaySettings,
        T_world_camera: np.ndarray,
        moment: Moment,
        reason: Reason | str,
    ) -> bool:
        """Returns True if `draw` would not change the drawing."""
        return self._drawn == _key(settings, T_world_camera, moment.step, reason)

    def draw(
        self,
        settings: DisplaySettings,
        T_world_camera: np.ndarray,
        moment: Moment,
        reason: Reason | str,
    ) -> Show:
        """Computes the drawing that the settings select.

        Args:
            settings: settings of the panel.
            T_world_camera: pose of the draggable camera, [4, 4].
            moment: state of the map after the view.
            reason: why the view was chosen, or why that is not known.

        Returns:
            A function that only draws: everything has been computed.
        """
        layer = settings.layer
        key = _key(settings, T_world_camera, moment.step, reason)
        if layer.surface == "points":
            drawing = self._recorded(settings.cut)
        elif layer.surface == "splats":
            drawing = self._splats(settings.cut)
        elif layer.surface == "mesh":
            drawing = self._mesh(settings.cut)
        elif layer.quantity == CAUSE:
            drawing = self._causes(settings.cut, moment, reason)
        else:
            drawing = self._voxels(settings, T_world_camera[:3, 3], moment)

        def show() -> None:
            drawing.draw()
            colors = np.tile(CAUSE_COLORS[0], (len(drawing.cells), 1))
            self._canvas.show_points(_CELLS, drawing.cells, colors, _CELL_EDGE)
            is_splats = layer.surface == "splats"
            nodes = tuple(_NODES.values())
            self._canvas.show_only(_NODES[layer.surface], nodes, is_splats=is_splats)
            self.caption = Caption(layer, drawing.moment, drawing.detail)
            self._drawn = key

        return show

    def _voxels(self, settings: DisplaySettings, position: np.ndarray, moment: Moment) -> _Drawing:
        """Draws the map, colored by the chosen quantity and cut open."""
        has_score = settings.layer.has_score
        from_free_space = settings.place == PLACES[0]
        known = self._known_at(moment, with_terms=has_score and from_free_space)
        # The blocks' own map: that of the same view replayed may hold its rows in another order.
        terms, state = known.terms, known.moment.map_state
        if has_score and not from_free_space:
            terms = surface_terms(state, self._story.camera, position[None], self._config)
        blocks = known.blocks
        colors = block_colors(blocks, state, terms, settings.layer.quantity)
        detail = voxel_note(blocks)
        if has_score:
            detail += f", mean over {PLACES[0]}" if from_free_space else f", from {PLACES[1]}"
        return self._blocks(blocks, colors, settings.cut, self._after(moment.step), detail)

    def _causes(self, cut: float, moment: Moment, reason: Reason | str) -> _Drawing:
        """Draws the map that a view was chosen on, colored by the causes of its utility.

        The map is gray if these are not known.
        """
        is_known = isinstance(reason, Reason)
        before = self._story.moment(moment.step - 1) if is_known else moment
        known = self._known_at(before, with_terms=False)
        blocks, state = known.blocks, known.moment.map_state
        own = block_colors(blocks, state, None, "color")
        if not is_known:
            colors = cause_colors(np.zeros(len(own), np.intp), own)
            return self._blocks(blocks, colors, cut, self._after(moment.step), reason)
        colors = cause_colors(block_causes(blocks, before.map_state.capacity, reason), own)
        text = f"just before view {moment.step + 1}"
        drawing = self._blocks(blocks, colors, cut, text, voxel_note(blocks))
        return replace(drawing, cells=reason.cells[reason.cells[:, 2] <= cut])

    def _after(self, step: int) -> str:
        rows = self._story.rows
        return f"after {name_of(rows[step], rows)} of {len(rows)}"

    def _blocks(
        self, blocks: Blocks, colors: np.ndarray, cut: float, moment: str, detail: str
    ) -> _Drawing:
        """Draws blocks in their colors [n, 3], cut open."""
        low = blocks.centers[:, 2] <= cut
        show = functools.partial(
            self._canvas.show_points, "/map", blocks.centers[low], colors[low], blocks.edge
        )
        return _Drawing(show, moment, detail)

    def _known_at(self, moment: Moment, *, with_terms: bool) -> Known:
        """Returns the blocks and terms of a moment, from a small cache or computed."""
        for has_terms in (True, with_terms):
            if (moment.step, has_terms) in self._known:
                return self._known[moment.step, has_terms]
        camera, config = self._story.camera, self._config
        known = known_at(moment, camera, config, BUDGET, with_terms=with_terms)
        self._known[moment.step, with_terms] = known
        if len(self._known) > _KNOWN_KEPT:
            self._known.popitem(last=False)
        return known

    def _recorded(self, cut: float) -> _Drawing:
        """Draws the measured points, cut open."""
        if self._points is None:
            assert self._sources.points is not None
            self._points = self._sources.points()
        points, colors = self._points
        low = points[:, 2] <= cut
        show = functools.partial(
            self._canvas.show_points, "/points", points[low], colors[low], _POINT_EDGE
        )
        return _Drawing(show, _WHOLE, f"{len(points):,} points, as many from each view")

    def _splats(self, cut: float) -> _Drawing:
        """Draws the trained splats, cut open."""
        model = self._sources.model
        assert model is not None
        if self._gaussians is None:
            self._gaussians = splat_arrays(model)
        low = self._gaussians[0][:, 2] <= cut
        total = int(np.asarray(model.is_alive).sum())
        num = len(low)
        share = f"{num:,}" if num == total else f"{num:,} of {total:,}"
        centers, covariances, colors, opacities = (part[low] for part in self._gaussians)
        arrays = centers, covariances, colors, opacities
        show = functools.partial(self._canvas.show_splats, "/splats", arrays)
        return _Drawing(show, _WHOLE, f"{share} Gaussians in their mean colors")

    def _mesh(self, cut: float) -> _Drawing:
        """Draws the scene's own triangles below the cut."""
        assert self._sources.mesh is not None
        glb = self._sources.mesh(cut)
        show = functools.partial(self._canvas.show_mesh, "/mesh", glb)
        return _Drawing(show, _WHOLE, f"the ground truth, {len(glb) / 1e6:.1f} MB, without lamps")


_WHOLE = "of the whole run"


def _key(
    settings: DisplaySettings, T_world_camera: np.ndarray, step: int, reason: Reason | str
) -> tuple[object, ...]:
    """Returns everything that a drawing depends on: equal keys, equal drawings."""
    layer = settings.layer
    key: tuple[object, ...] = (layer, settings.cut)
    if not layer.is_of_one_view:
        return key
    key += (step,)
    if layer.quantity == CAUSE:
        return (*key, reason if isinstance(reason, str) else "")
    if layer.has_score:
        key += (settings.place,)
        if settings.place != PLACES[0]:
            key += (T_world_camera[:3, 3].tobytes(),)
    return key


def voxel_note(blocks: Blocks) -> str:
    """Describes the number of voxels, and the size of the blocks that are drawn."""
    if blocks.num_voxels == len(blocks.centers):
        return f"{blocks.num_voxels:,} voxels of {100 * blocks.edge:.3g}\u00a0cm"
    return (
        f"{blocks.num_voxels:,} voxels, drawn as {len(blocks.centers):,} blocks of "
        f"{100 * blocks.edge:.3g}\u00a0cm"
    )


_PATH_WIDTH = 0.03
"""Width of the line along the path [m]."""

_REPLAYED = 0.9
"""Share of the progress bar for replaying frames; the rest is drawing."""

_LEVEL = 0.1
"""Change of the floor's height above which the grid is moved [m]."""

PICTURE_SIZE = 192
"""Longer side of rendered splats and true images [px]."""


Photographer = Callable[[np.ndarray], np.ndarray | None]
"""The true picture at a pose `T_world_camera` [4, 4], RGB in [0, 1], [H, W, 3]; None: there is
none."""


@dataclass(frozen=True)
class Extras:
    """Data beside the run itself."""

    sources: Sources = field(default_factory=Sources)
    """Sources of drawings beside the voxels."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background with which the splats were trained."""

    photographer: Photographer | None = None
    """Takes true pictures, with `picture_camera`."""

    decisions: Callable[[], Iterator[tuple[int, Offer | None]]] | None = None
    """Decides the whole run again, for its candidates."""

    remark: Callable[[], str] = lambda: ""
    """Returns a note for the user, such as the reason why there is no true image."""


@dataclass(frozen=True)
class Query:
    """Settings and pose that the page should show."""

    settings: DisplaySettings

    T_world_camera: np.ndarray
    """Camera-to-world pose of the dragged camera, [4, 4] float64."""


def picture_camera(camera: Camera) -> Camera:
    """Returns a run's camera at the size of the pictures beside the dragged one."""
    return camera.resized(*fitted_size(camera.width, camera.height, PICTURE_SIZE))


class QueryHandler:
    """Computes queries in one thread, and records the content of the page."""

    def __init__(
        self,
        canvas: Canvas,
        controls: Controls,
        story: Story,
        config: ScoringConfig,
        bounds: np.ndarray,
        extras: Extras,
        ask_again: Callable[[], None],
    ):
        """Computes nothing yet.

        Args:
            canvas: the 3D scene.
            controls: the panel and the legend.
            story: the run.
            config: settings of the scores.
            bounds: bounds of the scene, [2, 3] [m].
            extras: data beside the run.
            ask_again: called when the last query would now have a better result.
        """
        self._canvas, self._controls, self._story = canvas, controls, story
        self._config, self._extras, self._ask_again = config, extras, ask_again
        self._place = PlaceLayer(canvas, story, config, extras.sources)
        self._view: tuple[object, ...] | None = None
        self._awaited: tuple[int, str] | None = None
        self._candidates: tuple[int, int] | None = None
        self._offers: dict[int, Offer] = {}
        self._asking = ""
        self._deciding: threading.Thread | None = None
        self._closed = threading.Event()
        self._bounds = np.asarray(bounds, np.float64)
        self._grounded: int | None = None
        self._floor: float | None = None
        self.look: CameraPreview | None = None
        """Preview on the page; None while it is computed."""

    def close(self) -> None:
        """Ends the thread that decides again, if there is one."""
        self._closed.set()
        if self._deciding is not None:
            self._deciding.join()

    def prepare(self) -> bool:
        """Prepares for later queries while the page is idle; returns False when done."""
        try:
            return self._story.advance()
        except RunError as error:
            self._controls.show_note(str(error))
            return False
        finally:
            if (
                self._awaited is not None
                and self._story.reason(self._awaited[0]) != self._awaited[1]
            ):
                self._awaited = None
                self._ask_again()

    def work(self, question: Query) -> Iterator[Show]:
        """Yields the parts of a query's result, the quick ones first."""
        settings, pose = question.settings, question.T_world_camera
        step = min(settings.step, len(self._story.rows) - 1)
        reason = self._story.reason(step)
        yield self._show_view(step, reason, shows_views=settings.shows_views)
        yield from self._replay(step)
        moment = self._story.moment(step)
        yield from self._ground(moment)
        draw = functools.partial(self._draw, settings, pose, moment, reason)
        if not settings.layer.has_score:  # takes no scoring: the first picture is soon there
            yield from draw()
        around = self._around(moment)
        glance = quick_preview_from(around, pose)
        yield functools.partial(self._show_glance, glance, moment.step)
        if settings.place == PLACES[0]:  # drawn again for another moment only, and then first
            yield from draw()
        look = preview_from(around, pose, glance)
        yield functools.partial(self._show_look, look, settings.layer.quantity, moment.step)
        yield self._show_pictures(look, settings)
        yield from draw()
        yield self._show_candidates(step, settings.shows_candidates)

    def _draw(
        self, settings: DisplaySettings, pose: np.ndarray, moment: Moment, reason: Reason | str
    ) -> Iterator[Show]:
        """Draws the place and its legend, unless they are up to date."""
        if self._place.is_drawn(settings, pose, moment, reason):
            return
        text = f"View {settings.step + 1}: drawing {settings.layer.name}"
        yield functools.partial(self._controls.show_busy, text, _REPLAYED)
        yield self._place.draw(settings, pose, moment, reason)
        yield self._show_legend

    def _replay(self, step: int) -> Iterator[Show]:
        """Replays the run up to a view, and shows the progress."""
        for done, total in self._story.replay(step):
            text = f"View {step + 1}: replaying frame {done + 1} of {total}"
            yield functools.partial(self._controls.show_busy, text, _REPLAYED * done / total)

    def _ground(self, moment: Moment) -> Iterator[Show]:
        """Draws the grid below the map again if the floor has another height."""
        if moment.step == self._grounded:
            return
        self._grounded = moment.step
        state = moment.map_state
        centers = np.asarray(state.center)[:, np.asarray(state.present)]
        if not centers.size:
            return
        floor = floor_height(centers[2], float(state.voxel_size))
        if self._floor is None or abs(self._floor - floor) > _LEVEL:
            self._floor = floor
            low, high = self._bounds
            yield functools.partial(self._canvas.show_grid, low, high, floor)

    def _show_view(self, step: int, reason: Reason | str, *, shows_views: bool) -> Show:
        """Prepares the picture of a view, its facts, why it was taken, and its path."""
        rows = self._story.rows
        key = (step, len(rows), reason if isinstance(reason, str) else "")
        self._awaited = (step, reason) if isinstance(reason, str) else None
        before = step if shows_views else 0
        if self._view == key:
            return functools.partial(self._canvas.show_views, before)
        pose = np.asarray(rows[step].pose, np.float64)
        image = self._story.image(step)
        facts = view_html(rows[step], len(rows), image, reason, unit_of(rows)[:-1])
        segments, colors = path_segments(rows[: step + 1], len(rows))

        def show() -> None:
            self._controls.show_view(facts)
            self._canvas.show_view(pose, image)
            self._canvas.show_views(before)
            self._canvas.show_lines("/path", segments, colors, _PATH_WIDTH)
            self._view = key

        return show

    def _around(self, moment: Moment) -> Context:
        return Context(
            moment.map_state,
            moment.grid,
            self._story.camera,
            self._config,
            picture_camera(self._story.camera),
            self._extras.sources.model,
            self._extras.background,
        )

    def _show_glance(self, glance: QuickPreview, step: int) -> None:
        self._controls.show_numbers(preview_html(glance, None, step + 1))
        self._canvas.paint_camera(_color_of(glance))

    def _show_look(self, look: CameraPreview, quantity: str, step: int) -> None:
        term = quantity if quantity in look.glance.images else "renderability"
        inside = (
            quick_preview_image(look.glance, term) if look.splats is None else to_bytes(look.splats)
        )
        self._controls.show_numbers(preview_html(look.glance, look, step + 1))
        self._canvas.fill_camera(inside)
        self._canvas.show_suggestion(look.T_world_camera[:3, 3], look.best_direction)
        self.look = look

    def _show_pictures(self, look: CameraPreview, settings: DisplaySettings) -> Show:
        """Prepares the pictures of the draggable camera, with the true image if selected."""
        photographer, quantity = self._extras.photographer, settings.layer.quantity
        if settings.shows_truth and photographer is not None:
            look = replace(look, truth=photographer(look.T_world_camera))
        term = quantity if quantity in look.glance.images else "renderability"
        content = pictures_html(preview_pictures(look, term), panorama_image(look))
        return functools.partial(self._controls.show_pictures, content)

    def _show_legend(self) -> None:
        if self._place.caption is not None:
            has_candidates = self._candidates is not None
            self._controls.show_legend(legend_html(self._place.caption, has_candidates))

    def _show_candidates(self, step: int, is_wanted: bool) -> Show:
        """Prepares the candidates of a view, colored by score, and the legend."""
        segments, colors = np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
        if is_wanted:
            offer = self._story.offer(step) or self._offers.get(step)
            if offer is None:
                self._decide_again()
            else:
                segments, colors = offer_segments(self._story.camera, offer)
        key = (step, len(segments)) if len(segments) else None
        note = "; ".join(part for part in (self._asking, self._extras.remark()) if part)

        def show() -> None:
            if self._candidates != key:
                self._canvas.show_lines("/candidates", segments, colors, 0.006)
                self._candidates = key
            self._show_legend()
            self._controls.show_note(note)

        return show

    def forget_view(self) -> None:
        """Marks the content about the view on the slider as out of date."""
        self._view = None  # shown again even if the slider comes back
        self._canvas.show_lines("/candidates", np.zeros((0, 2, 3)), np.zeros((0, 2, 3)), 0.0)
        self._candidates = None

    def _decide_again(self) -> None:
        """Starts the thread that decides the run again, once."""
        if self._extras.decisions is not None and self._deciding is None:
            self._deciding = threading.Thread(target=self._decide, name="decisions", daemon=True)
            self._deciding.start()

    def _decide(self) -> None:
        assert self._extras.decisions is not None
        total = len(self._story.rows)
        try:
            for step, offer in self._extras.decisions():
                if self._closed.is_set():
                    return
                if offer is not None:
                    self._offers[step] = offer
                is_last = step == total - 1
                self._asking = (
                    "" if is_last else f"asking the planner again: view {step + 1} of {total} …"
                )
                self._controls.show_note(self._asking)
                if step == self._controls.settings.step:
                    self._ask_again()
        except (RunError, ValueError) as error:
            self._asking = f"no candidates to draw: {error}"
            self._controls.show_note(self._asking)


def floor_height(heights: np.ndarray, voxel_size: float) -> float:
    """Estimates the height of the floor [m]: the lower side of the lowest well-filled layer.

    Args:
        heights: centers of voxels, [n] [m].
        voxel_size: their edge [m].
    """
    layers, counts = np.unique(np.round(heights / voxel_size - 0.5), return_counts=True)
    lowest = layers[counts >= 0.2 * counts.max()][0]
    return float(lowest * voxel_size)


def _color_of(glance: QuickPreview) -> Color:
    """Returns the color of R, darker than the map's, so that lines stand out against it."""
    red, green, blue = paint(np.asarray([glance.renderability]))[0].tolist()
    return round(0.7 * red), round(0.7 * green), round(0.7 * blue)


Question = TypeVar("Question")
Answer = TypeVar("Answer")


class LatestWorker(Generic[Question, Answer]):
    """Computes queries one at a time, in its own thread; the latest query wins.

    A result may come in parts, the quick ones first. A query that is replaced while it waits is
    never computed; if it is replaced during its computation, no further part is computed or shown.
    So everything shown belongs to the latest query.
    """

    def __init__(
        self,
        answer: Callable[[Question], Iterator[Answer]],
        show: Callable[[Question, Answer], None],
        fail: Callable[[Question, Exception], None],
        *,
        quiet: float = 0.05,
        idle: Callable[[], bool] | None = None,
    ):
        """Starts the thread.

        Args:
            answer: computes the parts of a result; called without a lock.
            show: called with each part of the newest query's result. A new query waits until it
                returns, so that it should be quick; it may submit queries itself.
            fail: called in the same way with an error raised by `answer`.
            quiet: a query starts when no other has followed for this time [s].
            idle: called repeatedly without a query, until it returns False.
        """
        self._answer, self._show, self._fail = answer, show, fail
        self._quiet, self._idle = quiet, idle
        self._changed = threading.Condition(threading.RLock())
        self._question: Question | None = None
        self._asked = self._done = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def ask(self, question: Question, mark: Callable[[], None] | None = None) -> None:
        """Replaces the query that is waiting or being computed, if any.

        Args:
            question: the new query.
            mark: called immediately; from then on no earlier result is shown, and nothing of the
                new one has been shown yet.
        """
        with self._changed:
            if mark is not None:
                mark()
            self._question = question
            self._asked += 1
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Waits until the newest query is done; returns False after a timeout [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._done == self._asked, timeout)

    def close(self) -> None:
        """Ends the thread, after its current computation."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (taken := self._take()) is not None:
            number, question = taken
            try:
                for part in self._answer(question):
                    if not self._tell(number, functools.partial(self._show, question, part)):
                        break
            except Exception as error:  # shown, whatever it is; the thread must continue
                self._tell(number, functools.partial(self._fail, question, error))
            with self._changed:
                if number == self._asked:
                    self._done = number
                self._changed.notify_all()

    def _take(self) -> tuple[int, Question] | None:
        """Waits for a query, and until none has followed for a while; None: closed."""
        while True:
            with self._changed:
                if self._closed:
                    return None
                if self._asked != self._done:
                    return self._settled()
                if self._idle is None:
                    self._changed.wait()
                    continue
            if not self._idle():
                self._idle = None

    def _settled(self) -> tuple[int, Question] | None:
        """Waits until no query has followed the newest for a while; the lock is held.

        Returns None if there is no query, or the worker is closed.
        """
        newest = -1
        while newest != self._asked and not self._closed:
            newest = self._asked
            self._changed.wait_for(functools.partial(self._is_past, newest), self._quiet)
        question = self._question
        return None if self._closed or question is None else (newest, question)

    def _is_past(self, number: int) -> bool:
        return self._closed or self._asked != number

    def _tell(self, number: int, tell: Callable[[], None]) -> bool:
        """Reports the result; returns False if there is a newer query."""
        with self._changed:
            is_newest = number == self._asked and not self._closed
            if is_newest:
                tell()
            return is_newest


_THUMBNAIL = 64
"""Width of the pictures in the frusta along the path [px]."""

_QUIET = 0.03
"""A drag is computed after a pause of this length [s]; browsers report it every 50 ms."""


class App:
    """The page of one run."""

    def __init__(
        self,
        server: viser.ViserServer,
        story: Story,
        config: ScoringConfig,
        bounds: np.ndarray,
        *,
        title: str,
        subtitle: str,
        extras: Extras | None = None,
    ):
        """Fills the page and starts the worker.

        Args:
            server: with an empty page; owned by the caller.
            story: the run; a live one may have no view yet.
            config: settings of the scores.
            bounds: bounds of the scene, [2, 3] [m].
            title: title of the page.
            subtitle: text below the title.
            extras: data beside the run.
        """
        extras = extras or Extras()
        self.story = story
        self._lock = threading.Lock()
        self._asked: Query | None = None
        self._num_added = 0
        layers = menu_of(extras.sources.surfaces, with_causes=not story.is_live)
        heights = self._heights(bounds)
        has_truth = extras.photographer is not None
        menu = Menu(title, len(story.rows), layers, heights, story.is_live, has_truth)
        self.controls = Controls(server, subtitle, menu)
        self.canvas = Canvas(server, story.camera)
        self._answers = QueryHandler(
            self.canvas, self.controls, story, config, bounds, extras, self._ask_again
        )
        self.worker: LatestWorker[Query, Show] = LatestWorker(
            self._answers.work,
            lambda question, show: show(),
            lambda question, error: self._tell(error),
            quiet=_QUIET,
            idle=self._prepare,
        )
        low, high = np.asarray(bounds, np.float64)
        place_eye(server, low, np.minimum(high, [*high[:2], heights[2]]))
        if story.is_live:  # for a recorded run they take seconds, and come later
            self._add_views()
        if story.rows:
            self.canvas.place_camera(np.asarray(story.rows[-1].pose, np.float64))
        self.controls.listen(self.ask, self._turn, self._return)
        self.canvas.on_drag(self.ask)
        self.controls.show_busy("Waiting for the first view", 0.0)
        if not story.is_live:  # which has no map before its first view
            self.ask()

    @property
    def look(self) -> CameraPreview | None:
        """Numbers for the dragged camera; None while they are computed."""
        return self._answers.look

    def close(self) -> None:
        """Ends the background threads."""
        self._answers.close()
        self.worker.close()

    def ask(self) -> None:
        """Updates the page to its settings, unless it shows them already or is about to."""
        if not self.story.rows:
            return
        with self._lock:
            question, before = Query(self.controls.settings, self.canvas.pose), self._asked
            self._asked = question
            is_same_pose = before is not None and np.array_equal(
                before.T_world_camera, question.T_world_camera
            )
            if before is not None and is_same_pose and before.settings == question.settings:
                return
            is_new_view = before is None or before.settings.step != question.settings.step
            is_new_scene = before is None or before.settings.scene != question.settings.scene
            if _follows_camera(question) and not is_same_pose:
                is_new_scene = True
            mark = functools.partial(
                self._mark_stale,
                question,
                camera=is_new_view or not is_same_pose,
                view=is_new_view,
                scene=is_new_scene,
            )
            self.worker.ask(question, mark)

    def grow(self) -> None:
        """Updates the page for a new view of the story."""
        num_views = len(self.story.rows)
        self._add_views()
        if self._asked is None:
            self.canvas.place_camera(np.asarray(self.story.rows[-1].pose, np.float64))
        step = num_views - 1 if self.controls.is_following else self.controls.settings.step
        self.controls.set_step(step, num_views)
        with self._lock:
            self._asked = None  # the same query now has another result
        self.ask()

    def _ask_again(self) -> None:
        """Repeats the query on the larger map; the current content stays valid."""
        with self._lock:
            self._asked = Query(self.controls.settings, self.canvas.pose)
            self.worker.ask(self._asked)

    def _mark_stale(self, question: Query, *, camera: bool, view: bool, scene: bool) -> None:
        """Marks each part of the page as belonging to another query."""
        step, layer = question.settings.step, question.settings.layer
        if camera:
            self.controls.mark_camera_stale()
            self.canvas.mark_camera_stale()
            self._answers.look = None
        if view:
            self.controls.mark_view_stale(step)
            self._answers.forget_view()
        if scene:
            what = f"View {step + 1}" if view else layer.title
            self.controls.show_busy(f"{what}: being computed", 0.0)

    def _tell(self, error: Exception) -> None:
        """Reports an error: the requested view will not appear."""
        self.controls.show_ready()
        self.controls.show_note(str(error) or type(error).__name__)

    def _heights(self, bounds: np.ndarray) -> tuple[float, float, float]:
        """Returns the lowest, highest and initial height of the cut [m]."""
        low, high = (float(z) for z in np.asarray(bounds)[:, 2])
        corners = np.array([[0.0, 0.0, high]])
        rows = self.story.rows
        first = cut_height(rows, corners) if rows else low + 0.6 * (high - low)
        return round(low, 2), round(high + 0.1, 2), round(min(max(first, low), high), 2)

    def _add_views(self) -> None:
        while self._num_added < len(self.story.rows):
            self._add_view()

    def _prepare(self) -> bool:
        """Prepares something for later while the page is idle, first the views along the path.

        Returns False if there is nothing left to prepare.
        """
        if not self.story.is_live and self._num_added < len(self.story.rows):
            self._add_view()
            return True
        return self._answers.prepare()

    def _add_view(self) -> None:
        """Adds the next view along the path, with its picture."""
        camera, step = self.story.camera, self._num_added
        self._num_added += 1
        row = self.story.rows[step]
        height = max(1, round(_THUMBNAIL * camera.height / camera.width))
        try:
            image = Image.fromarray(self.story.image(step))
        except RunError as error:
            self.controls.show_note(str(error))
            return
        thumbnail = np.asarray(image.resize((_THUMBNAIL, height), Image.Resampling.BOX))
        pose, go_to = np.asarray(row.pose, np.float64), functools.partial(self._go_to, step)
        self.canvas.add_view(step, pose, thumbnail, go_to, small=row.captured)

    def _go_to(self, step: int) -> None:
        """Selects a view whose frustum was clicked."""
        self.controls.set_step(step, len(self.story.rows))

    def _turn(self) -> None:
        look = self._answers.look
        if look is not None and np.array_equal(look.T_world_camera, self.canvas.pose):
            self.canvas.place_camera(np.asarray(look.T_suggested, np.float64))
            self.ask()

    def _return(self) -> None:
        step = min(self.controls.settings.step, len(self.story.rows) - 1)
        self.canvas.place_camera(np.asarray(self.story.rows[step].pose, np.float64))
        self.ask()


def _follows_camera(question: Query) -> bool:
    """Returns True if the map's colors depend on the position of the dragged camera."""
    settings = question.settings
    return settings.layer.has_score and settings.place != PLACES[0]


_Item = tuple[TakenView, Planner] | threading.Event | None
"""A view and the planner that has observed it; an event to set in order; None: the end."""


MAX_FACES = 500_000
"""Worlds with more triangles are not sent to a browser: 72 bytes each, and more for colors."""

_LARGEST_TEXTURE = 1024
"""Longer side of a texture [px]; larger ones are made smaller."""


def world_glb(world: World, top: float = math.inf) -> bytes:
    """Writes the triangles of a world with their textures.

    Surfaces are seen from their front only.

    Args:
        world: the world.
        top: triangles entirely above this height are left out, so that rooms are open from
            above [m].

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
        """Converts pixels [H, W, 3] uint8."""
        image = Image.fromarray(np.ascontiguousarray(pixels))
        image.thumbnail((_LARGEST_TEXTURE, _LARGEST_TEXTURE))
        texture = cls()
        texture.im, texture._mode, texture._size = image.im, image.mode, image.size
        return texture

    def save(self, fp: Any, format: str | None = None, **params: Any) -> None:
        """Keeps edges of color, which Pillow's own settings for JPEG smear."""
        super().save(fp, format, quality=88, subsampling=0)


def _without_light(tree: dict[str, Any]) -> None:
    """Turns lighting off: the colors of the world contain its light."""
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
    moving = sum(row.captured for row in run.rows)
    views = f"{len(run.rows) - moving} views" + (
        f", {moving} frames while moving" if moving else ""
    )
    return f"{run.path} · {views}, {last.metres:.1f} m · {ended}"


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
        if not isinstance(self._simulator, RaycastSimulator):
            raise InputError(self.remark or "the simulator of this scene has no mesh to show")
        return world_glb(self._simulator.world, top)

    @functools.cached_property
    def _simulator(self) -> Simulator | None:
        """Simulator of small pictures without noise and without a limit of range."""
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
        server: server of an empty page; owned by the caller.
        camera: camera of every view.
        bounds: bounds of the scene, [2, 3] [m].
        config: settings of the loop.
        title: title of the page.
        subtitle: text below the title.
        earlier: recording of a resumed run; None for a new one.
    """
    story = LiveStory(camera, earlier)
    max_range = jnp.asarray(config.max_range, dtype=jnp.float32)
    scoring = ScoringConfig(max_range=max_range)
    app = App(server, story, scoring, bounds, title=title, subtitle=subtitle)
    return LiveFeed(server, app, story)


class LiveFeed:
    """Receives the views of a loop. A context manager: leaving it ends the thread."""

    def __init__(self, server: viser.ViserServer, app: App, story: LiveStory):
        """Starts the thread that brings views to the page.

        Args:
            server: server of the page; owned by the caller.
            app: the page; closed when the feed is left.
            story: the story of the page.
        """
        self.url = url_of(server)
        """URL of the page."""
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
        """Shows all views in the queue, then ends all threads."""
        self._queue.put(None)
        self._thread.join()
        self.app.close()
