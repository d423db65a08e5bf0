"""FisherRF: the view whose pixels would move the parameters that are known least.

Its rule for choosing among photos (JiangWenPL/FisherRF), here among the hundred candidates that
all policies draw: arg max of the score, no path, no unknown space. Formulas are in `fisher`. The
map has no harmonics beyond the constant one, so neither has theta.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Array

from r3jax.baselines.fisher import Criterion, Form, known_information, scores
from r3jax.baselines.policy import OnlineConfig, OnlinePolicy, memory_of
from r3jax.baselines.settings import BALLS
from r3jax.planning.candidates import Candidates
from r3jax.planning.greedy import draw_lots
from r3jax.planning.policy import Situation


@dataclass(frozen=True)
class FisherConfig(OnlineConfig):
    """Settings of `fisherrf`."""

    lambda2: float = 0.0
    """The published rule knows no path."""

    criterion: Criterion = "ratio"
    """`ratio`: FisherRF. `d-opt`: sum of log(1 + H_v / (H + lambda)) (POp-GS)."""

    quirk: bool = True
    """The derivatives of the activations enter once, as in the authors' code, not squared."""

    damping: float = 1e-6
    """Lambda."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        if self.criterion not in ("ratio", "d-opt"):
            raise ValueError(f"criterion must be 'ratio' or 'd-opt', got {self.criterion!r}")
        if not 0.0 < self.damping < np.inf:
            raise ValueError(f"damping must be a finite number > 0, got {self.damping}")

    @property
    def form(self) -> Form:
        """Which of the published forms."""
        return Form(self.criterion, self.quirk, self.damping)


@dataclass(frozen=True)
class FisherRF(OnlinePolicy):
    """Views that tell most of the least known parameters of a map that it trains while flying."""

    config: FisherConfig = field(default_factory=FisherConfig)

    name = "fisherrf"
    source = "FisherRF, Jiang et al., ECCV 2024, on an online map"
    Config = FisherConfig
    settings = BALLS

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """The information that each view adds to that of all frames so far."""
        online, form = memory_of(situation), self.config.form
        camera = self.score_camera(situation.camera)
        # Anew for each decision: the model has moved since, and with it what is known of it.
        known = known_information(online.scene, camera, online.frames.T_world_camera, form)
        found = scores(online.scene, camera, candidates.poses_on_device(), known, form)
        lots = draw_lots(len(candidates.valid), key=key)
        return candidates, {"utility": found.astype(np.float64)} | lots
