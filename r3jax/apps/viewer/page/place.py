"""What is drawn of the place: the map's voxels, the recorded points, the splats or the mesh."""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

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
from r3jax.apps.viewer.page.panel import PLACES, Controls, DisplaySettings
from r3jax.apps.viewer.story import Moment, Story
from r3jax.exploration.explain_run import Reason
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.scene import GaussianScene

_KNOWN_KEPT = 6
"""Moments whose blocks and terms are kept: a slider goes back and forth."""

_NODES = {"voxels": "/map", "recorded points": "/points", "splats": "/splats", "mesh": "/mesh"}
_POINT_EDGE = 0.02
_CELLS, _CELL_EDGE = "/unexplored", 0.05

Points = tuple[np.ndarray, np.ndarray]
"""Points [n, 3] float32 [m] and their colors [n, 3] uint8."""

Show = Callable[[], None]
"""Puts a part of an answer on the page."""


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
    def names(self) -> tuple[str, ...]:
        """What there is to draw, the voxels first."""
        known = {"recorded points": self.points, "splats": self.model, "mesh": self.mesh}
        return ("voxels", *(name for name, what in known.items() if what is not None))


class PlaceLayer:
    """Draws the place, and knows what is drawn. For one thread at a time."""

    def __init__(
        self,
        canvas: Canvas,
        controls: Controls,
        story: Story,
        config: ScoringConfig,
        sources: Sources,
        remark: Callable[[], str],
    ):
        """Draws nothing yet.

        Args:
            canvas: where to draw.
            controls: where to say what is drawn.
            story: whose camera asks for the resolution.
            config: of the scores.
            sources: what can be drawn.
            remark: what is said beside it.
        """
        self._canvas, self._controls, self._story = canvas, controls, story
        self._config, self._sources, self._remark = config, sources, remark
        self._known: OrderedDict[tuple[int, bool], Known] = OrderedDict()
        self._points: Points | None = None
        self._drawn: tuple[object, ...] | None = None
        self._gaussians: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None

    def draw(
        self,
        settings: DisplaySettings,
        T_world_camera: np.ndarray,
        moment: Moment,
        reason: Reason | str,
    ) -> Iterator[Show]:
        """What is wished for, unless it is what is drawn already.

        Args:
            settings: of the user.
            T_world_camera: of the dragged camera, [4, 4].
            moment: what was known.
            reason: why the moment's view was taken, or why that is not known.
        """
        shows_causes = settings.surface == "voxels" and settings.quantity == CAUSE
        key: tuple[object, ...] = (settings.surface, settings.cut)
        if settings.surface == "voxels":
            key += (moment.step, settings.quantity, settings.place)
            if shows_causes:
                key += (reason if isinstance(reason, str) else "",)
            elif settings.place != PLACES[0] and settings.quantity != "color":
                key += (T_world_camera[:3, 3].tobytes(),)
        if self._drawn == key:
            return
        cells = np.zeros((0, 3), np.float32)
        if shows_causes:
            show = self._causes(settings.cut, moment, reason)
            if isinstance(reason, Reason):
                cells = reason.cells[reason.cells[:, 2] <= settings.cut]
        elif settings.surface == "voxels":
            show = self._voxels(settings, T_world_camera[:3, 3], moment)
        elif settings.surface == "recorded points":
            show = self._recorded(settings.cut)
        elif settings.surface == "splats":
            show = self._splats(settings.cut)
        else:
            show = self._mesh(settings.cut)

        def show_it() -> None:
            show()
            self._canvas.show_points(
                _CELLS, cells, np.tile(CAUSE_COLORS[0], (len(cells), 1)), _CELL_EDGE
            )
            self._canvas.show_only(_NODES[settings.surface], tuple(_NODES.values()))
            self._drawn = key

        yield show_it

    def _say(self, text: str) -> None:
        self._controls.show_note("; ".join(part for part in (text, self._remark()) if part))

    def _voxels(self, settings: DisplaySettings, position: np.ndarray, moment: Moment) -> Show:
        """The map, colored as wished and cut open."""
        has_score = settings.quantity != "color"
        from_free_space = settings.place == PLACES[0]
        known = self._known_at(moment, with_terms=has_score and from_free_space)
        # The blocks' own map: that of the same view replayed may hold its rows in another order.
        terms, state = known.terms, known.moment.map_state
        if has_score and not from_free_space:
            terms = surface_terms(state, self._story.camera, position[None], self._config)
        blocks = known.blocks
        colors = block_colors(blocks, state, terms, settings.quantity)
        text = voxel_note(blocks) + ("; gray: no such place sees them" if has_score else "")
        return self._blocks(blocks, colors, settings.cut, text)

    def _causes(self, cut: float, moment: Moment, reason: Reason | str) -> Show:
        """The map that a view was chosen on, by what the view was after; gray if unknown."""
        if isinstance(reason, str):
            blocks = self._known_at(moment, with_terms=False).blocks
            causes = np.zeros(len(blocks.centers), np.intp)
            text = f"what the view was after: {reason}"
        else:
            before = self._story.moment(moment.step - 1)
            blocks = self._known_at(before, with_terms=False).blocks
            causes = block_causes(blocks, before.map_state.capacity, reason)
            text = (
                f"{voxel_note(blocks)}, before view {moment.step}; by what it was after; gray: "
                "not in its view; dark dots: unexplored cells in its view"
            )
        return self._blocks(blocks, cause_colors(causes), cut, text)

    def _blocks(self, blocks: Blocks, colors: np.ndarray, cut: float, text: str) -> Show:
        """Blocks in their colors [n, 3], cut open, and what is said of them."""
        low = blocks.centers[:, 2] <= cut

        def show() -> None:
            self._canvas.show_points("/map", blocks.centers[low], colors[low], blocks.edge)
            self._say(text)

        return show

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

    def _recorded(self, cut: float) -> Show:
        """The measured points, cut open."""
        if self._points is None:
            assert self._sources.points is not None
            self._points = self._sources.points()
        points, colors = self._points
        low = points[:, 2] <= cut

        def show() -> None:
            self._canvas.show_points("/points", points[low], colors[low], _POINT_EDGE)
            self._say(f"{len(points)} measured points, the same number from each view")

        return show

    def _splats(self, cut: float) -> Show:
        """The trained splats, cut open."""
        model = self._sources.model
        assert model is not None
        if self._gaussians is None:
            self._gaussians = splat_arrays(model)
        centers, covariances, colors, opacities = self._gaussians
        low = centers[:, 2] <= cut
        total = int(np.asarray(model.is_alive).sum())

        def show() -> None:
            arrays = centers[low], covariances[low], colors[low], opacities[low]
            self._canvas.show_splats("/splats", arrays)
            self._say(f"{len(centers)} of {total} Gaussians, without view-dependent color")

        return show

    def _mesh(self, cut: float) -> Show:
        """The scene's own triangles, but for those above the cut."""
        assert self._sources.mesh is not None
        glb = self._sources.mesh(cut)

        def show() -> None:
            self._canvas.show_mesh("/mesh", glb)
            self._say(f"the scene's own mesh, {len(glb) / 1e6:.1f} MB, without its lamps")

        return show


def voxel_note(blocks: Blocks) -> str:
    """How many voxels are drawn, and how."""
    if blocks.num_voxels == len(blocks.centers):
        return f"{blocks.num_voxels} voxels of {100 * blocks.edge:.3g} cm"
    return (
        f"{blocks.num_voxels} voxels, drawn as {len(blocks.centers)} blocks of "
        f"{100 * blocks.edge:.3g} cm"
    )
