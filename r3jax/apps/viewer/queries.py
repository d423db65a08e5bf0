"""Works out what the page is to show, part by part, the quick ones first.

The photo of a view comes at once; then the map, if it has changed, and R of the dragged camera;
then the splats and the panorama from where the camera is.

What is drawn of the place: the map's voxels, the recorded points, the splats or the mesh.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from r3jax.apps.viewer.blocks import (
    BUDGET,
    CAUSE,
    Blocks,
    Known,
    block_causes,
    block_colors,
    cause_colors,
    known_at,
    surface_terms,
)
from r3jax.apps.viewer.canvas import Canvas, Color
from r3jax.apps.viewer.facts import (
    PLACES,
    Caption,
    legend_html,
    pictures_html,
    preview_html,
    view_html,
)
from r3jax.apps.viewer.panel import Controls, DisplaySettings
from r3jax.apps.viewer.pictures import (
    CAUSE_COLORS,
    CameraPreview,
    Context,
    QuickPreview,
    paint,
    panorama_image,
    path_segments,
    preview_from,
    preview_pictures,
    quick_preview_from,
    quick_preview_image,
    splat_arrays,
    to_bytes,
)
from r3jax.apps.viewer.story import Moment, Offer, Story, offer_segments
from r3jax.exploration.taken_views import name_of, unit_of
from r3jax.geometry.cameras import Camera
from r3jax.runs.header import RunError
from r3jax.runs.replay import Reason
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.views import fitted_size

_KNOWN_KEPT = 3
"""Moments whose blocks and terms are kept: a slider goes back and forth."""

_NODES = {"voxels": "/map", "points": "/points", "splats": "/splats", "mesh": "/mesh"}
_POINT_EDGE = 0.02
_CELLS, _CELL_EDGE = "/unexplored", 0.05

Points = tuple[np.ndarray, np.ndarray]
"""Points [n, 3] float32 [m] and their colors [n, 3] uint8."""

Show = Callable[[], None]
"""Puts a part of an answer on the page."""


@dataclass(frozen=True)
class _Drawing:
    """Something that is ready to be drawn."""

    draw: Show
    moment: str
    """Moment that it shows."""

    detail: str
    """Such as how many voxels there are."""

    cells: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """Unexplored cells drawn beside it, [k, 3] [m]."""


@dataclass(frozen=True)
class Sources:
    """What can be drawn beside the voxels. Functions are called when first needed."""

    model: GaussianScene | None = None
    """The trained splats."""

    points: Callable[[], Points] | None = None
    """The recorded points."""

    mesh: Callable[[float], bytes] | None = None
    """The scene as GLB, without what lies above a height [m]."""

    @property
    def surfaces(self) -> tuple[str, ...]:
        """What there is to draw; there are always voxels."""
        known = {"points": self.points, "splats": self.model, "mesh": self.mesh}
        return ("voxels", *(name for name, what in known.items() if what is not None))


class PlaceLayer:
    """Draws the place, and knows what is drawn. For one thread at a time."""

    def __init__(self, canvas: Canvas, story: Story, config: ScoringConfig, sources: Sources):
        """Draws nothing yet.

        Args:
            canvas: where to draw.
            story: whose camera asks for the resolution.
            config: of the scores.
            sources: what can be drawn.
        """
        self._canvas, self._story, self._config, self._sources = canvas, story, config, sources
        self._known: OrderedDict[tuple[int, bool], Known] = OrderedDict()
        self._points: Points | None = None
        self._drawn: tuple[object, ...] | None = None
        self._gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None
        self.caption: Caption | None = None
        """What is drawn; None before the first picture."""

    def is_drawn(
        self,
        settings: DisplaySettings,
        T_world_camera: np.ndarray,
        moment: Moment,
        reason: Reason | str,
    ) -> bool:
        """Returns True if `draw` would draw what is drawn already."""
        return self._drawn == _key(settings, T_world_camera, moment.step, reason)

    def draw(
        self,
        settings: DisplaySettings,
        T_world_camera: np.ndarray,
        moment: Moment,
        reason: Reason | str,
    ) -> Show:
        """Computes the drawing that the settings select, if it is not there yet.

        Args:
            settings: of the user.
            T_world_camera: of the dragged camera, [4, 4].
            moment: what was known.
            reason: why the moment's view was taken, or why that is not known.

        Returns:
            Draws it: everything has been worked out.
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
    """Describes how many voxels are drawn, and in blocks of which size."""
    if blocks.num_voxels == len(blocks.centers):
        return f"{blocks.num_voxels:,} voxels of {100 * blocks.edge:.3g}\u00a0cm"
    return (
        f"{blocks.num_voxels:,} voxels, drawn as {len(blocks.centers):,} blocks of "
        f"{100 * blocks.edge:.3g}\u00a0cm"
    )


_PATH_WIDTH = 0.03
"""Width of the line along the path [m]."""

_REPLAYED = 0.9
"""Share of the work that replaying frames is said to be; the rest is drawing."""

_LEVEL = 0.1
"""The grid moves when the floor is found elsewhere by so much [m]."""

PICTURE_SIZE = 192
"""Longer side of rendered splats and true images [px]."""


Photographer = Callable[[np.ndarray], np.ndarray | None]
"""The true picture at a pose `T_world_camera` [4, 4], RGB in [0, 1], [H, W, 3]; None: there is
none."""


@dataclass(frozen=True)
class Extras:
    """What may be known beside the run itself."""

    sources: Sources = field(default_factory=Sources)
    """What can be drawn beside the voxels."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What the splats were trained with."""

    photographer: Photographer | None = None
    """Takes true pictures, with `picture_camera`."""

    decisions: Callable[[], Iterator[tuple[int, Offer | None]]] | None = None
    """Decides the whole run again, for its candidates."""

    remark: Callable[[], str] = lambda: ""
    """What the user should know by now, such as why there is no true image."""


@dataclass(frozen=True)
class Query:
    """What the page should show."""

    settings: DisplaySettings

    T_world_camera: np.ndarray
    """Camera-to-world pose of the dragged camera, [4, 4] float64."""


def picture_camera(camera: Camera) -> Camera:
    """Returns a run's camera at the size of the pictures beside the dragged one."""
    return camera.resized(*fitted_size(camera.width, camera.height, PICTURE_SIZE))


class QueryHandler:
    """Answers questions in one thread, and remembers what is on the page."""

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
        """Works out nothing yet.

        Args:
            canvas: where to draw.
            controls: where to write.
            story: what it is about.
            config: of the scores.
            bounds: of the scene, [2, 3] [m].
            extras: what else is known.
            ask_again: called when more is known than when the last question was asked.
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
        """The one that stands on the page; None while it is worked out."""

    def close(self) -> None:
        """Ends the thread that decides again, if there is one."""
        self._closed.set()
        if self._deciding is not None:
            self._deciding.join()

    def prepare(self) -> bool:
        """Prepares for later questions while the page is idle; returns False when done."""
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
        """Yields the parts of the answer to a question, the quick and visible ones first."""
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
        """Draws the place and its legend, unless they are there already."""
        if self._place.is_drawn(settings, pose, moment, reason):
            return
        text = f"View {settings.step + 1}: drawing {settings.layer.name}"
        yield functools.partial(self._controls.show_busy, text, _REPLAYED)
        yield self._place.draw(settings, pose, moment, reason)
        yield self._show_legend

    def _replay(self, step: int) -> Iterator[Show]:
        """Brings the story to a view; tells how many frames have been replayed."""
        for done, total in self._story.replay(step):
            text = f"View {step + 1}: replaying frame {done + 1} of {total}"
            yield functools.partial(self._controls.show_busy, text, _REPLAYED * done / total)

    def _ground(self, moment: Moment) -> Iterator[Show]:
        """Draws the grid below the map again where the floor turns out to be elsewhere."""
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
        """Prepares what the camera would see, beside the true image if that is selected."""
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
        """Forgets what is shown of the view on the slider: it belongs to another one."""
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
