"""FisherRF: the view with most information on the least certain parameters.

Its rule for choosing among photos (JiangWenPL/FisherRF), here among the hundred candidates that
all policies draw: arg max of the score, no path, no unknown space. The map
has no harmonics beyond the constant one, so neither has theta.

The information of views, its scores, and greedy batches by them:

    H_v[theta] = sum over the pixels of v of (d C / d theta)^2,   C the sum of a pixel's channels
    ratio:  sum over theta of H_v / (H + lambda)                  (FisherRF, Jiang et al. 2024)
    d-opt:  sum over theta of log(1 + H_v / (H + lambda))         (POp-GS, Wilson et al. 2025)

H is the sum of H_v over the views that the model was trained on, at the model as it is. theta are
centers, sizes, opacities and colors; rotations are left out, as published.

Published are two ways to square: the code takes squares by the activated sizes and opacities and
multiplies them once by the activation's derivative, where the chain rule squares that factor
(`quirk`). Both forms are here. Scores take any list of poses: candidates of a robot or a pool.

Shape symbols: V views on offer; T views trained on.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.baselines.information import on_cpu, pixel_squares, with_room
from r3jax.baselines.online_map import BALLS, OnlineConfig, OnlinePolicy, memory_of
from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.planning.candidates import Candidates, draw_lots
from r3jax.planning.policy import Situation
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.scene import GaussianScene

Criterion = Literal["ratio", "d-opt"]
"""How information becomes a score."""


@dataclass(frozen=True)
class Form:
    """Which of the published forms."""

    criterion: Criterion = "ratio"
    """How information becomes a score."""

    quirk: bool = True
    """The derivatives of the activations enter once, as in FisherRF's code, not squared."""

    damping: float = 1e-6
    """Lambda."""

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """RGB behind everything."""


def information(
    config: RasterConfig,
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    form: Form,
) -> tuple[GaussianScene, Array]:
    """Computes H of a view for all parameters but rotations, and counts dropped intersections."""
    behind = jnp.asarray(form.background, dtype=jnp.float32)
    squares, overflow = pixel_squares(scene, camera, T_world_camera, behind, config)
    squares = eqx.tree_at(lambda s: s.quats, squares, jnp.zeros_like(squares.quats))
    return (with_quirk(squares, scene) if form.quirk else squares), overflow


def with_quirk(squares: GaussianScene, scene: GaussianScene) -> GaussianScene:
    """Divides squares by the activations' derivatives, which are squared in them, once."""
    opacity = jax.nn.sigmoid(scene.opacity_logits)
    # Where float32 rounds a derivative to 0 (an opacity of 1, after long trainings), its square
    # is 0, too: nothing is left to divide.
    divide = lambda square, slope: jnp.where(slope > 0.0, square / slope, 0.0)
    return eqx.tree_at(
        lambda s: (s.log_scales, s.opacity_logits),
        squares,
        (
            divide(squares.log_scales, jnp.exp(scene.log_scales)),
            divide(squares.opacity_logits, opacity * (1.0 - opacity)),
        ),
    )


@partial(jax.jit, static_argnames="form")
def _added(
    config: RasterConfig,
    scene: GaussianScene,
    camera: Camera,
    pose: Array,
    total: GaussianScene,
    form: Form,
) -> tuple[GaussianScene, Array]:
    """Adds one more view to the sum of H."""
    found, overflow = information(config, scene, camera, pose, form)
    return jax.tree.map(jnp.add, total, found), overflow


@partial(jax.jit, static_argnames="form")
def _scores(
    config: RasterConfig,
    scene: GaussianScene,
    camera: Camera,
    poses: Array,
    known: GaussianScene,
    form: Form,
) -> tuple[Array, Array]:
    """Computes the score of every pose."""

    def score(pose: Array) -> tuple[Array, Array]:
        found, overflow = information(config, scene, camera, pose, form)
        return gain(found, known, form), overflow

    return jax.lax.map(score, poses)


def gain(found: GaussianScene, known: GaussianScene, form: Form) -> Float[Array, ""]:
    """Computes how much a view of information `found` adds to the `known` information."""

    def part(new: Array, old: Array) -> Array:
        share = new / (old + form.damping)
        return jnp.sum(jnp.log1p(share) if form.criterion == "d-opt" else share)

    return jnp.asarray(sum(jax.tree.leaves(jax.tree.map(part, found, known))))


def known_information(
    scene: GaussianScene, camera: Camera, poses: np.ndarray, form: Form
) -> GaussianScene:
    """Sums H over the views that the model was trained on. Not to be called under jit.

    Args:
        scene: the model as it is.
        camera: of all views.
        poses: T_world_camera of each view, [T, 4, 4].
        form: which of the published forms.
    """
    scene, camera = on_cpu((scene, camera))
    total = jax.tree.map(jnp.zeros_like, scene)
    # One view a call: a scan would be recompiled for every number of views.
    for pose in np.asarray(poses, np.float32):
        total = with_room(partial(_added, form=form), scene, camera, pose, total)
    return total


def scores(
    scene: GaussianScene, camera: Camera, poses: Any, known: GaussianScene, form: Form
) -> np.ndarray:
    """Scores any list of poses. Not to be called under jit.

    Args:
        scene: the model as it is.
        camera: of all views.
        poses: T_world_camera of the views on offer, [V, 4, 4].
        known: sum of H over the views trained on (`known_information`).
        form: which of the published forms.

    Returns:
        Scores [V]; the greatest is the view to take.
    """
    arguments = on_cpu((scene, camera, jnp.asarray(poses, jnp.float32), known))
    return np.array(with_room(partial(_scores, form=form), *arguments))


def greedy_batch(
    scene: GaussianScene,
    camera: Camera,
    pool: np.ndarray,
    trained: np.ndarray,
    num: int,
    form: Form,
) -> list[int]:
    """Takes `num` views of a pool one by one; each counts as known for the next, untrained.

    Args:
        scene: the model as it is.
        camera: of all views.
        pool: T_world_camera of the views on offer, [V, 4, 4].
        trained: those of the views trained on, [T, 4, 4].
        num: views wanted, at most V.
        form: which of the published forms.

    Returns:
        Their indices in the pool, in order.
    """
    known, chosen = known_information(scene, camera, trained, form), list[int]()
    for _ in range(min(num, len(pool))):
        found = scores(scene, camera, pool, known, form)
        found[chosen] = -np.inf
        chosen.append(int(np.argmax(found)))
        more = known_information(scene, camera, pool[chosen[-1:]], form)
        known = jax.tree.map(jnp.add, known, more)
    return chosen


@dataclass(frozen=True)
class FisherConfig(OnlineConfig):
    """Settings of `fisherrf`."""

    lambda2: float = 0.0
    """Returns no cost: the published rule ignores the path."""

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
            raise InputError(f"criterion must be 'ratio' or 'd-opt', got {self.criterion!r}")
        if not 0.0 < self.damping < np.inf:
            raise InputError(f"damping must be a finite number > 0, got {self.damping}")

    @property
    def form(self) -> Form:
        """Which of the published forms."""
        return Form(self.criterion, self.quirk, self.damping)


@dataclass(frozen=True)
class FisherRF(OnlinePolicy):
    """Views with most information on the least certain parameters of a map trained online."""

    config: FisherConfig = field(default_factory=FisherConfig)

    name = "fisherrf"
    source = "FisherRF, Jiang et al., ECCV 2024, on an online map"
    Config = FisherConfig
    settings = BALLS

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes the information that each view adds to that of all frames so far."""
        online, form = memory_of(situation), self.config.form
        camera = self.score_camera(situation.camera)
        # Recomputed for each decision: the model has changed since, and its information with it.
        known = known_information(online.scene, camera, online.frames.T_world_camera, form)
        found = scores(online.scene, camera, candidates.poses_on_device(), known, form)
        lots = draw_lots(len(candidates.valid), key=key)
        return candidates, {"utility": found.astype(np.float64)} | lots
