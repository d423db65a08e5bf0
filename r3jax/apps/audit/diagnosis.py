"""How well every surface would render for somebody who stands somewhere else, and why not better.

Renderability belongs to a voxel *and* a place from which it is asked. The places here are spread
over all where somebody could stand (`captures.standpoints`), to take an image or to look at the
result; of each voxel the answers of those that see it are averaged.

Shape symbols: N rows of the map; p standpoints.
"""

import functools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.geometry.selection import for_selected
from r3jax.mapping.seen import visible_rows
from r3jax.mapping.state import MapState
from r3jax.scoring.batch import map_over_devices
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.views import panorama_view

TERMS = ("bias", "noise", "resolution")
"""Factors of renderability, in the paper's order."""

LEAST = 1e-3
"""Terms are not counted lower, so that their logarithm stays finite."""


@dataclass(frozen=True)
class ViewScore:
    """How well one view would render, and why not better."""

    renderability: float
    """Mean over all pixels; a pixel without a voxel counts 0. Where surfaces may be not known, mean
    over the pixels that show a known one; NaN where there is none."""

    coverage: float
    """Share of the pixels that show a known voxel."""

    bias: float
    """Mean over the pixels that show a voxel."""

    noise: float
    """Mean over the pixels that show a voxel."""

    resolution: float
    """Mean over the pixels that show a voxel."""

    cause: str
    """What costs most: `unseen` (pixels without a voxel), `angle`, `noise` or `distance`;
    `not_known` where no pixel shows a known surface."""

    shares: dict[str, float]
    """Share of all pixels of each of `CAUSES`, and `unseen` or `not_known`; they sum to 1."""


CAUSE_OF_TERM = {"bias": "angle", "noise": "noise", "resolution": "distance"}
"""What a low factor means."""


NOT_KNOWN = "not_known"
"""Cause of pixels without a known surface, in captures without a depth camera."""

FEWEST_PICTURES = 2
"""A voxel that fewer pictures have measured is not known, where depth is inferred from pictures."""


def known_rows(state: MapState, is_complete: bool) -> np.ndarray:
    """Returns a mask of the rows of the map of all images that are known surfaces, [N].

    Args:
        state: the map.
        is_complete: True if a depth camera measured it: then all are.
    """
    return np.asarray(state.count) >= (1 if is_complete else FEWEST_PICTURES)


def view_score(
    state: MapState,
    camera: Camera,
    pose: np.ndarray,
    config: ScoringConfig,
    known: np.ndarray | None = None,
) -> ViewScore:
    """Evaluates one view.

    Args:
        state: the map.
        camera: of the view; its focal length in the unit that the map was made with.
        pose: `T_world_camera`, [4, 4] [audit units].
        config: range and size of the depth buffer.
        known: rows that are known surfaces, [N]: pixels without one are not known. None: all are,
            and pixels without a voxel show what was never seen.
    """
    seen = term_images(state, camera, jnp.asarray(pose, dtype=jnp.float32), config)
    row, value = np.asarray(seen.row), np.asarray(seen.value)
    is_hit = row < state.capacity
    if known is not None:
        is_hit &= known[np.where(is_hit, row, 0)]
    coverage = float(is_hit.mean())
    images = {name: np.asarray(getattr(seen, name))[is_hit] for name in TERMS}
    mean = {name: float(x.mean()) if x.size else 0.0 for name, x in images.items()}
    # log R = sum of the logarithms: what each term costs adds up over the pixels that show any.
    costs = -np.log(np.maximum(np.stack([images[name] for name in TERMS]), LEAST))
    cost = {
        CAUSE_OF_TERM[name]: float(x.sum()) / is_hit.size
        for name, x in zip(TERMS, costs, strict=True)
    }
    count = np.asarray(state.count)[np.asarray(seen.row)[is_hit]]
    pixels = np.bincount(cause_of(value[is_hit], costs, count), minlength=len(CAUSES))
    if known is None:
        cost["unseen"] = (1.0 - coverage) * -np.log(LEAST)
        mean_value = float(np.where(is_hit, value, 0.0).mean())
    else:
        if not is_hit.any():
            cost = {NOT_KNOWN: 0.0}
        mean_value = float(value[is_hit].mean()) if is_hit.any() else float("nan")
    return ViewScore(
        renderability=mean_value,
        coverage=coverage,
        bias=mean["bias"],
        noise=mean["noise"],
        resolution=mean["resolution"],
        cause=max(cost, key=lambda name: cost[name]),
        shares={
            **dict(zip(CAUSES, (pixels / is_hit.size).tolist(), strict=True)),
            "unseen" if known is None else NOT_KNOWN: 1.0 - coverage,
        },
    )


CAUSES = ("fine", "angle", "rare", "distance", "noise")
"""What a voxel suffers from most; the numbers in `Diagnosis.cause` count along these."""

FINE = 0.5
"""A voxel whose mean renderability is at least this counts as fine."""

FEW = 3
"""A voxel that was measured in fewer images was seen too rarely."""


class Demand(eqx.Module):
    """From where surfaces will be looked at. Surfaces do not move, so it is made once."""

    position: Float[Array, "p 3"]
    """The standpoints [audit units]."""

    visible: Bool[Array, "p N"]
    """True where a standpoint sees a voxel."""

    @property
    def num_seen(self) -> Float[Array, " N"]:
        """Standpoints that see each voxel."""
        return jnp.sum(self.visible, axis=0, dtype=jnp.float32)


class StandpointScores(eqx.Module):
    """What the standpoints say of the voxels."""

    value: Float[Array, "p N"]
    """Renderability of each voxel from each standpoint; 0 where it does not see it."""

    terms: Float[Array, "3 N"]
    """Sums of bias, noise and resolution over the standpoints that see a voxel."""

    costs: Float[Array, "3 N"]
    """Sums of -log of the same."""


@dataclass(frozen=True)
class Diagnosis:
    """What is wrong with each voxel. Means are over the standpoints that see it."""

    num_seen: np.ndarray
    """Standpoints that see the voxel, [N]; where there is none the rest is 0."""

    value: np.ndarray
    """Mean renderability, [N]."""

    bias: np.ndarray
    """Mean factor of the angle, [N]."""

    noise: np.ndarray
    """Mean factor of the color's consistency, [N]."""

    resolution: np.ndarray
    """Mean factor of the distance, [N]."""

    num_directions: np.ndarray
    """Direction bins that have seen the voxel, [N]."""

    cause: np.ndarray
    """Index into `CAUSES`, [N] int."""

    @property
    def is_seen(self) -> np.ndarray:
        """True for voxels that some standpoint sees, [N]."""
        return self.num_seen > 0.0

    @property
    def mean(self) -> float:
        """Mean renderability of the surfaces that can be seen; 0 where there are none."""
        return float(self.value[self.is_seen].mean()) if self.is_seen.any() else 0.0

    @property
    def fine_share(self) -> float:
        """Share of the surfaces that can be seen, of those that are fine."""
        evaluated = self.is_seen
        return float((self.value[evaluated] >= FINE).mean()) if evaluated.any() else 0.0

    def share(self, cause: str) -> float:
        """Returns the share of this cause among the surfaces that can be seen, in [0, 1]."""
        evaluated = self.is_seen
        wanted = self.cause[evaluated] == CAUSES.index(cause)
        return float(wanted.mean()) if evaluated.any() else 0.0


def demand_of(state: MapState, standpoints: np.ndarray, config: ScoringConfig) -> Demand:
    """Computes which voxels each standpoint sees.

    Args:
        state: the map.
        standpoints: [p, 3] [audit units].
        config: range and size of the panoramic depth buffer.
    """
    position = jnp.asarray(standpoints, dtype=jnp.float32)
    return Demand(position, map_over_devices(functools.partial(_visible, state, config), position))


@jax.jit
def _visible(
    voxels: MapState, config: ScoringConfig, positions: Float[Array, "p 3"]
) -> Bool[Array, "p N"]:
    def seen_from(position: Float[Array, " 3"]) -> Bool[Array, " N"]:
        return visible_rows(voxels, panorama_view(position, config), config)

    return jax.vmap(seen_from)(positions)


def score_from_standpoints(
    state: MapState, demand: Demand, focal: Float[Array, ""], config: ScoringConfig
) -> StandpointScores:
    """Scores the voxels of the map from every standpoint.

    Args:
        state: the map; its surfaces are those of the demand.
        demand: the standpoints, and the voxels that each sees.
        focal: focal length of the camera that would render [px], in the map's unit.
        config: of the closed forms.
    """
    # Numbers of the standpoints, as floats: `map_over_devices` distributes floats.
    ids = jnp.arange(demand.position.shape[0], dtype=jnp.float32)
    part = functools.partial(_answers, state, demand, focal, config)
    value, terms, costs = map_over_devices(part, ids)
    return StandpointScores(value, jnp.sum(terms, axis=0), jnp.sum(costs, axis=0))


@jax.jit
def _answers(
    voxels: MapState,
    demand: Demand,
    focal: Float[Array, ""],
    config: ScoringConfig,
    ids: Float[Array, " q"],
) -> tuple[Float[Array, "q N"], Float[Array, "q 3 N"], Float[Array, "q 3 N"]]:
    """Computes values, terms and costs for some of the standpoints."""
    num = voxels.count.shape[0]

    def answer(number: Float[Array, ""]) -> tuple[Array, Array, Array]:
        index = number.astype(jnp.int32)
        position = demand.position[index]

        def score(
            rows: Int[Array, " K"], valid: Bool[Array, " K"], found: tuple[Array, Array]
        ) -> tuple[Array, Array]:
            terms = score_voxels(voxels.take(rows, valid), position, focal, config.forms)
            target = jnp.where(valid, rows, num)
            value, factors = found
            three = jnp.stack([terms.bias, terms.noise, terms.resolution])
            return (
                value.at[target].set(terms.value, mode="drop"),
                factors.at[:, target].set(three, mode="drop"),
            )

        seen = demand.visible[index] & voxels.present
        blank = jnp.zeros(num), jnp.ones((3, num))
        value, factors = for_selected(seen, score, blank)
        costs = -jnp.log(jnp.maximum(factors, LEAST))
        return value, jnp.where(seen[None, :], factors, 0.0), costs

    return jax.lax.map(answer, ids)


def diagnose(state: MapState, demand: Demand, answers: StandpointScores) -> Diagnosis:
    """Evaluates every voxel by the mean of the answers.

    Args:
        state: the map.
        demand: who was asked.
        answers: their scores of this map.
    """
    count = np.asarray(demand.num_seen)
    value = np.asarray(jnp.sum(answers.value, axis=0)) / np.maximum(count, 1.0)
    bias, noise, resolution = np.asarray(answers.terms) / np.maximum(count, 1.0)
    directions = np.bitwise_count(np.asarray(state.visited)).sum(axis=0).astype(np.int64)
    return Diagnosis(
        num_seen=count,
        value=value,
        bias=bias,
        noise=noise,
        resolution=resolution,
        num_directions=directions,
        cause=cause_of(value, np.asarray(answers.costs), np.asarray(state.count)),
    )


def cause_of(value: np.ndarray, costs: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Returns the index into `CAUSES` of each voxel, [N]: its costliest term, or `fine`.

    A voxel with a low bias is called `rare` if hardly any image has measured it, else `angle`.

    Args:
        value: mean renderability, [N].
        costs: sums of -log of bias, noise and resolution, [3, N].
        count: images that have measured the voxel, [N].
    """
    dearest = np.argmax(costs, axis=0)
    of_bias = np.where(count < FEW, CAUSES.index("rare"), CAUSES.index("angle"))
    of_others = np.where(dearest == 1, CAUSES.index("noise"), CAUSES.index("distance"))
    found = np.where(dearest == 0, of_bias, of_others)
    return np.where(value >= FINE, CAUSES.index("fine"), found)
