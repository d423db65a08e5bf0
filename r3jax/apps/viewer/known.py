"""What is drawn of a moment: its blocks and what they are worth.

Shape symbols: n blocks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from r3jax.apps.viewer.blocks import Blocks, blocks_of
from r3jax.apps.viewer.terms import NUM_PROBES, SurfaceTerms, probe_positions, surface_terms
from r3jax.apps.viewer.timeline import Moment
from r3jax.geometry.cameras import Camera
from r3jax.scoring.config import ScoringConfig
from r3jax.trace.header import RunHeader
from r3jax.trace.rows import StepRow

_ABOVE_HEADS = 0.6
_BELOW_CEILING = 0.3


@dataclass(frozen=True)
class Known:
    """A moment, ready to be drawn."""

    moment: Moment
    blocks: Blocks

    terms: SurfaceTerms | None
    """As probes in known free space see them; None where only colors are wanted."""


def known_at(
    moment: Moment, camera: Camera, config: ScoringConfig, budget: int, *, with_terms: bool = True
) -> Known:
    """The blocks of a moment's map, and what cameras in known free space think of them.

    Args:
        moment: the moment.
        camera: of the run.
        config: of the scores.
        budget: blocks at most.
        with_terms: False leaves the terms out, which take most of the time.
    """
    state = moment.map_state
    terms = None
    if with_terms:
        positions = probe_positions(moment.grid)
        terms = surface_terms(state, camera, positions, config, pad_to=NUM_PROBES)
    return Known(moment, blocks_of(state, budget), terms)


def scoring_of(header: RunHeader) -> ScoringConfig:
    """The settings of the scores, with the range of the run's sensor."""
    max_range = float(header.config.get("max_range", 5.0))
    return ScoringConfig(max_range=jnp.asarray(max_range, dtype=jnp.float32))


def title_of(header: RunHeader) -> str:
    """Who explored what, in a few words; a file's name without its folders."""
    scene = str(header.scene.get("name", "")).rpartition("/")[2]
    return f"{header.policy.get('name', '')} in {scene}"


def cut_height(rows: Sequence[StepRow], points: np.ndarray) -> float:
    """Height above which nothing is drawn, so that one looks in from above [m].

    Args:
        rows: of the trace, at least one: the cameras stay in view.
        points: centers of blocks [n, 3] [m].
    """
    typical = float(np.median([row.pose[2, 3] for row in rows])) + _ABOVE_HEADS
    if len(points) == 0:
        return typical
    # Below the ceiling in any case, even where the cameras flew right under it.
    return min(typical, float(np.percentile(points[:, 2], 99.5)) - _BELOW_CEILING)
