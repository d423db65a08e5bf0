"""What is drawn of the place: the map's voxels, the recorded points, the splats or the mesh."""

import functools
from collections import OrderedDict
from collections.abc import Callable
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
from r3jax.apps.viewer.color_maps import CAUSE_COLORS
from r3jax.apps.viewer.overlays import splat_arrays
from r3jax.apps.viewer.page.canvas import Canvas
from r3jax.apps.viewer.page.layers import PLACES
from r3jax.apps.viewer.page.legend import Caption
from r3jax.apps.viewer.page.panel import DisplaySettings
from r3jax.apps.viewer.story import Moment, Story
from r3jax.exploration.explain_run import Reason
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.scene import GaussianScene

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
        """Whether `draw` would draw what is drawn already."""
        return self._drawn == _key(settings, T_world_camera, moment.step, reason)

    def draw(
        self,
        settings: DisplaySettings,
        T_world_camera: np.ndarray,
        moment: Moment,
        reason: Reason | str,
    ) -> Show:
        """What is wished for.

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
        """The map, colored as wished and cut open."""
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
        """The map that a view was chosen on, by what the view was after; gray if unknown."""
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
        return f"after view {step + 1} of {len(self._story.rows)}"

    def _blocks(
        self, blocks: Blocks, colors: np.ndarray, cut: float, moment: str, detail: str
    ) -> _Drawing:
        """Blocks in their colors [n, 3], cut open."""
        low = blocks.centers[:, 2] <= cut
        show = functools.partial(
            self._canvas.show_points, "/map", blocks.centers[low], colors[low], blocks.edge
        )
        return _Drawing(show, moment, detail)

    def _known_at(self, moment: Moment, *, with_terms: bool) -> Known:
        """Blocks and terms of a moment, from the few that are kept or made anew."""
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
        """The measured points, cut open."""
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
        """The trained splats, cut open."""
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
        """The scene's own triangles, but for those above the cut."""
        assert self._sources.mesh is not None
        glb = self._sources.mesh(cut)
        show = functools.partial(self._canvas.show_mesh, "/mesh", glb)
        return _Drawing(show, _WHOLE, f"the ground truth, {len(glb) / 1e6:.1f} MB, without lamps")


_WHOLE = "of the whole run"


def _key(
    settings: DisplaySettings, T_world_camera: np.ndarray, step: int, reason: Reason | str
) -> tuple[object, ...]:
    """What a drawing depends on: equal keys, equal drawings."""
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
    """How many voxels are drawn, and how."""
    if blocks.num_voxels == len(blocks.centers):
        return f"{blocks.num_voxels:,} voxels of {100 * blocks.edge:.3g}\u00a0cm"
    return (
        f"{blocks.num_voxels:,} voxels, drawn as {len(blocks.centers):,} blocks of "
        f"{100 * blocks.edge:.3g}\u00a0cm"
    )
