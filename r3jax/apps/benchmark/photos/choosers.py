"""Choosers among photos: a policy by its utility, or a method that scores the trained model.

Shape symbols: K candidates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np

from r3jax.apps.benchmark.photos.known import Known
from r3jax.baselines.active_gamer import ActiveGamer, empty_share
from r3jax.baselines.fisherrf import Form, known_information, scores
from r3jax.baselines.pixels import score_pixels
from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.planning.candidates import candidates_along
from r3jax.planning.policy import Situation
from r3jax.planning.registry import make_policy
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.views import fitted_size

SCORED = (
    "r3",
    "active-gs",
    "active-gamer",
    "cover",
    "gavis",
    "random",
)
"""Policies that give a pose a score."""

_WITHOUT_CELLS = ("cover",)
"""Policies whose published rule knows no unexplored cells: in a flight they have them to be able to
explore, but photos that are there need no exploring."""


@runtime_checkable
class Chooser(Protocol):
    """Scores photos that were not chosen by their poses; it never gets their pixels."""

    def begin(self, known: Known) -> Any:
        """Returns the chooser's memory before the first photo."""
        ...

    def observe(self, memory: Any, known: Known, frame: Frame) -> Any:
        """Takes note of a photo that has just been chosen; `known` holds it already."""
        ...

    def score(
        self, memory: Any, known: Known, model: GaussianScene, poses: np.ndarray, *, key: jax.Array
    ) -> np.ndarray:
        """Scores candidates, [K]; the greatest wins, the first of them if several do.

        Args:
            memory: what `observe` returned.
            known: map, grid and frames of the photos chosen so far.
            model: the radiance field in training, as it is now, with the harmonics that are trained
                so far; not to be kept.
            poses: of the candidates, [K, 4, 4].
            key: randomness of this choice.
        """
        ...


@dataclass(frozen=True)
class FisherChooser:
    """Fisher information of the model in training, of the photos chosen and of those on offer."""

    form: Form

    def begin(self, known: Known) -> Any:
        """Returns None: the information is that of the model as it is."""
        return None

    def observe(self, memory: Any, known: Known, frame: Frame) -> Any:
        """Returns the memory unchanged."""
        return memory

    def score(
        self, memory: Any, known: Known, model: GaussianScene, poses: np.ndarray, *, key: jax.Array
    ) -> np.ndarray:
        """Computes the scores of `baselines.fisherrf` at images `_FISHER_WIDTH` wide."""
        del memory, key
        camera = known.camera
        camera = camera.resized(*fitted_size(camera.width, camera.height, _FISHER_WIDTH))
        trained = np.stack([np.asarray(frame.T_world_camera) for frame in known.chosen])
        information = known_information(model, camera, trained, self.form)
        return scores(model, camera, poses, information, self.form).astype(np.float64)


_FISHER_WIDTH = 128
"""Longer side of the images whose pixels are summed over [px]; never more than the photos'."""

MODEL_CHOOSERS: dict[str, Callable[[], Chooser]] = {
    "fisherrf": lambda: FisherChooser(Form()),
}
"""Choosers that look at the model, by name: rivals that need a radiance field, which is here the
one in training."""


@dataclass(frozen=True)
class PolicyChooser:
    """A policy by its utility alone, without paths and without the model."""

    policy: Any

    known_cells: bool = False
    """True tells the policy that no cell is unexplored."""

    def begin(self, known: Known) -> Any:
        """Returns the policy's initial state; nothing in it is random."""
        return self.policy.init(known.camera, known.grid, key=jax.random.key(0))

    def observe(self, memory: Any, known: Known, frame: Frame) -> Any:
        """As in the loop: the map holds the frame."""
        return self.policy.observe(memory, known.map_state, frame)

    def score(
        self, memory: Any, known: Known, model: GaussianScene, poses: np.ndarray, *, key: jax.Array
    ) -> np.ndarray:
        """Computes the policy's total score of each pose, as if no path cost anything."""
        del model
        where = known.situation(memory.memory, known_cells=self.known_cells)
        return totals_of(self.policy, where, poses, key=key)


def check_chooser(name: str) -> None:
    """Refuses who cannot choose among photos.

    Raises:
        ValueError: no method of that name scores poses; lists those that do.
    """
    if name not in SCORED and name not in MODEL_CHOOSERS:
        known = ", ".join((*SCORED, *MODEL_CHOOSERS))
        raise InputError(f"{name} cannot choose among photos; known: {known}")


def make_chooser(name: str, num_candidates: int, max_range: float) -> Chooser:
    """Makes a chooser by name.

    Args:
        name: one of `SCORED` or `MODEL_CHOOSERS`.
        num_candidates: photos that are scored at once.
        max_range: of the sensor [m].

    Raises:
        ValueError: as `check_chooser`.
    """
    check_chooser(name)
    if name in MODEL_CHOOSERS:
        return MODEL_CHOOSERS[name]()
    scoring = ScoringConfig(max_range=max_range)
    policy = make_policy(name, num_candidates=num_candidates, num_frontier=0, scoring=scoring)
    return PolicyChooser(policy, known_cells=name in _WITHOUT_CELLS)


def totals_of(policy: Any, where: Situation, poses: np.ndarray, *, key: jax.Array) -> np.ndarray:
    """Computes a policy's total score of each pose, as if no path cost anything, [K] float64."""
    if isinstance(policy, ActiveGamer):
        state, grid, scoring = where.map_state, where.grid, policy.scoring_for(where.grid)
        flat = poses.astype(np.float32)
        return np.array(
            score_pixels(empty_share, state, grid, where.camera, flat, scoring), np.float64
        )
    candidates = candidates_along(poses[:, :3, 3], poses[:, :3, 2])
    _, utilities = policy.score(where, candidates, key=key)
    return np.array(policy.weigh(utilities | {"path": np.zeros(len(poses))}), np.float64)
