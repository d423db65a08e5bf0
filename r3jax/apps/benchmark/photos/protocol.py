"""The photo-pool protocol: one photo joins the training every 200 steps (COVER, CVPR 2026).

Every eighth photo of a capture is held out for evaluation. A model begins on ten photos drawn
by the seed, the same for all. Every 200 steps the chooser takes one of the five photos nearest to
the one chosen last, by its pose alone; then it joins the map and the training. After the last one
the training goes on for the stated number of steps, and the model is judged.

Shape symbols: K candidates.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np

from r3jax.apps.benchmark.photos.choosers import Chooser
from r3jax.apps.benchmark.photos.known import nothing_known
from r3jax.apps.benchmark.photos.pool import PhotoPool, PhotosError, first_photos, nearest_photos
from r3jax.errors import InputError
from r3jax.evaluation.evaluate import ImageMetric, evaluate
from r3jax.evaluation.scores import ViewRow
from r3jax.exploration.config import ExplorationConfig
from r3jax.splatting.config import Backend, RasterConfig
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.growth import Addition, Growth, where_new
from r3jax.splatting.training.initialize import initialize
from r3jax.splatting.training.train import fit
from r3jax.splatting.views import Views

OnStage = Callable[[str], None]


@dataclass(frozen=True)
class PhotoTerms:
    """On what terms every chooser chooses; the defaults of the numbers of photos are COVER's."""

    choose: int = 20
    """Photos that are chosen."""

    first: int = 10
    """Photos that every choice begins with."""

    nearest: int = 5
    """Candidates of a choice: the photos nearest to the last one."""

    every: int = 200
    """Steps between two choices."""

    iterations: int = 2000
    """Steps after the last photo has joined."""

    gaussians: int = 20_000
    """Gaussians that photos bring in all; each brings the same share at most."""

    capacity: int = 40_000
    """Maximum number of Gaussians."""

    max_range: float = 5.0
    """Depth beyond it is no part of the map [m]."""

    voxel_size: float = 0.05
    """Voxel size [m]."""

    backend: Backend = "auto"
    """Rasterizer."""

    def __post_init__(self) -> None:
        """Refuses what no choice could be made of."""
        for name in ("choose", "first", "nearest", "every", "iterations", "gaussians"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.gaussians < self.first + self.choose:
            raise InputError(f"{self.gaussians} Gaussians are fewer than the photos")

    @property
    def per_photo(self) -> int:
        """Gaussians that a photo may bring."""
        return self.gaussians // (self.first + self.choose)

    def mapping(self) -> ExplorationConfig:
        """Returns the settings of the map."""
        return ExplorationConfig(voxel_size=self.voxel_size, max_range=self.max_range)

    def train_config(self, seed: int) -> TrainConfig:
        """Returns the settings of the single training."""
        return TrainConfig(
            iterations=self.choose * self.every + self.iterations,
            num_gaussians=self.first * self.per_photo,
            capacity=self.capacity,
            raster=RasterConfig(backend=self.backend),
            seed=seed,
        )


@dataclass(frozen=True)
class Outcome:
    """What a chooser has come to."""

    chosen: list[int]
    """Numbers of the photos, in order; the first ones were given."""

    seconds: list[float]
    """What each choice took, the map's update left out [s]."""

    rows: tuple[ViewRow, ...]
    """One per photo that judges."""

    num_gaussians: int
    """Gaussians of the model that was judged."""


def run_photos(
    pool: PhotoPool,
    chooser: Chooser,
    terms: PhotoTerms,
    seed: int,
    *,
    lpips: ImageMetric | None = None,
    on_stage: OnStage = lambda stage: None,
) -> Outcome:
    """Chooses, trains and judges.

    Args:
        pool: the photos.
        chooser: the method that chooses.
        terms: how many, how long.
        seed: of the first photos, of the chooser and of the training.
        lpips: the perceptual metric; left out by default.
        on_stage: told what happens now.

    Raises:
        PhotosError: the pool is too small.
        KeyboardInterrupt: Ctrl-C while training.
    """
    if terms.first + terms.choose > len(pool.on_offer):
        raise PhotosError(
            f"{pool.name} offers {len(pool.on_offer)} photos beside the {len(pool.test)} that "
            f"judge, fewer than the {terms.first} + {terms.choose} requested: choose fewer"
        )
    choice = _Choice(pool, chooser, terms, seed)
    config = terms.train_config(seed)
    result = fit(
        choice.views(0),
        config,
        growth=Growth(terms.every, choice.add),
        on_progress=lambda progress: on_stage(
            f"{len(choice.chosen)} photos, step {progress.step}/{progress.iterations}"
        ),
    )
    if result.interrupted:
        raise KeyboardInterrupt
    on_stage("judging")
    found = evaluate(
        result.scene, pool.views.take(pool.test), config.raster, lpips=lpips,
        numbers=pool.test.tolist(),
    )  # fmt: skip
    alive = int(np.count_nonzero(np.asarray(result.scene.is_alive)))
    return Outcome(choice.chosen, choice.seconds, found.rows, alive)


class _Choice:
    """The photos chosen so far, and what the chooser knows of them: the state of one run."""

    def __init__(self, pool: PhotoPool, chooser: Chooser, terms: PhotoTerms, seed: int):
        self.pool, self.chooser, self.terms, self.seed = pool, chooser, terms, seed
        self.chosen: list[int] = []
        self.seconds: list[float] = []
        # From poses alone: the box must not tell of photos that were not chosen.
        places = pool.poses[:, :3, 3]
        reach = terms.max_range + terms.voxel_size
        bounds = np.stack([places.min(axis=0) - reach, places.max(axis=0) + reach])
        self.known = nothing_known(pool.camera, bounds, pool.poses, terms.mapping())
        self.memory = chooser.begin(self.known)
        for number in first_photos(pool, terms.first, seed):
            self._take(number)

    def add(self, step: int, scene: GaussianScene) -> Addition:
        """Chooses a photo until all are chosen; returns the photos and Gaussians to train next."""
        newborn = None
        if len(self.chosen) < self.terms.first + self.terms.choose:
            candidates = nearest_photos(self.pool, self.chosen, self.terms.nearest)
            key = jax.random.fold_in(jax.random.key(self.seed), len(self.chosen))
            model = self._as_trained(scene, step)
            begin = time.perf_counter()
            scores = self.chooser.score(
                self.memory, self.known, model, self.pool.poses[candidates], key=key
            )
            self.seconds.append(time.perf_counter() - begin)
            self._take(int(candidates[np.argmax(scores)]))
            newborn = self._newborn(scene)
        return Addition(self.views(step), newborn)

    def views(self, step: int) -> Views:
        """Draws the photos for the steps up to the next choice, one a step.

        As many as there are steps, so that nothing is recompiled when a photo joins; every photo
        is shown as often as any other, or once more.
        """
        random = np.random.default_rng((self.seed, step))
        order = random.permutation(self.chosen)
        return self.pool.views.take(np.resize(order, self.terms.every))

    def _take(self, number: int) -> None:
        frame = self.pool.frame(number)
        self.chosen.append(number)
        self.known = self.known.shown(frame)
        self.memory = self.chooser.observe(self.memory, self.known, frame)

    def _as_trained(self, scene: GaussianScene, step: int) -> GaussianScene:
        """Returns the scene with the harmonics that are in training at a step.

        The other coefficients are 0 and get no gradient. But pixels would change with them, so they
        would count as the least known.
        """
        every = self.terms.train_config(self.seed).schedule().sh_every
        degree = min(step // every, scene.sh_degree)
        return eqx.tree_at(lambda s: s.sh, scene, scene.sh[:, : (degree + 1) ** 2])

    def _newborn(self, scene: GaussianScene) -> GaussianScene:
        """Makes Gaussians on surfaces that the latest photo shows and the scene does not have."""
        latest = self.pool.views.take(np.array(self.chosen[-1:]))
        per_photo = self.terms.per_photo
        key = jax.random.key(self.seed)
        born = initialize(latest, per_photo, per_photo, scene.sh_degree, key=key)
        return where_new(born, scene)
