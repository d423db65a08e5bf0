"""How rivals choose photos one after the other from all that are on offer.

    fisherrf   by the radiance field in training: the photo of the largest information gain joins
               every `EVERY` steps
    gavis      by the map of the photos chosen so far: the photo whose rays are known least

Both begin with the same few photos, drawn by the seed. A photo's pixels are not seen before
it is chosen; photos that are there need no path.

Shape symbols: n photos on offer.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from r3jax.baselines.fisherrf import Form, known_information, scores
from r3jax.baselines.gavis import Gavis
from r3jax.captures.source import Source
from r3jax.captures.survey import RANGE, Survey
from r3jax.mapping.occupancy import empty_grid, integrate_depth, mark_free_ball
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_growing
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.initialize import initialize
from r3jax.splatting.training.train import Addition, Growth, fit, where_new
from r3jax.splatting.views import Views, fitted_size

EVERY = 50
"""Steps of the training between two choices of `fisherrf`."""

_FISHER_WIDTH = 128
"""Longer side of the images whose pixels are summed over [px]; never more than the photos'."""

_CAPACITY = 1 << 16
_BODY = 0.3

_integrate_depth = jax.jit(integrate_depth)
_mark_free_ball = jax.jit(mark_free_ball)


def first_photos(count: int, num: int, seed: int) -> list[int]:
    """Draws the photos that a choice of `num` from `count` begins with: four, or half of few."""
    first = max(1, min(4, num // 2))
    return np.random.default_rng(seed).choice(count, first, replace=False).tolist()


def by_fisher(views: Views, num: int, seed: int, gaussians: int) -> np.ndarray:
    """Chooses by the Fisher information of a model in training (FisherRF's form), in order.

    Args:
        views: all photos on offer; the poses of those that are not chosen are looked at.
        num: of photos to choose.
        seed: of the first photos and of the training.
        gaussians: that all photos bring together at most.
    """
    chosen, form, share = first_photos(len(views), num, seed), Form(), max(1, gaussians // num)
    poses = np.asarray(views.T_world_camera)
    camera = jax.tree.map(lambda x: x[0], views.cameras)
    camera = camera.resized(*fitted_size(camera.width, camera.height, _FISHER_WIDTH))
    config = TrainConfig(
        iterations=(num - len(chosen)) * EVERY + 1,
        num_gaussians=len(chosen) * share,
        capacity=2 * gaussians,
        seed=seed,
    )

    def drawn(step: int) -> Views:
        """Draws as many photos as there are steps, so that nothing is recompiled."""
        order = np.random.default_rng((seed, step)).permutation(chosen)
        return views.take(np.resize(order, EVERY))

    def add(step: int, scene: GaussianScene) -> Addition:
        if len(chosen) == num:
            return Addition(drawn(step))
        # Harmonics that are not trained yet would count as the least known.
        degree = min(step // config.schedule().sh_every, scene.sh_degree)
        trained = eqx.tree_at(lambda s: s.sh, scene, scene.sh[:, : (degree + 1) ** 2])
        known = known_information(trained, camera, poses[chosen], form)
        found = scores(trained, camera, poses, known, form)
        found[chosen] = -np.inf
        chosen.append(int(np.argmax(found)))
        latest = views.take(np.array(chosen[-1:]))
        born = initialize(latest, share, share, scene.sh_degree, key=jax.random.key(seed))
        return Addition(drawn(step), where_new(born, scene))

    if len(chosen) < num:
        fit(drawn(0), config, growth=Growth(EVERY, add))
    return np.array(chosen)


def by_gavis(
    source: Source, survey: Survey, offered: Sequence[int], num: int, seed: int
) -> np.ndarray:
    """Chooses by the entropy of the rays that the photos chosen so far leave open, in order.

    Args:
        source: the capture.
        survey: its coordinates and the sizes of its map.
        offered: numbers of the photos on offer, [n].
        num: of photos to choose.
        seed: of the first photos.
    """
    poses = survey.alignment.poses(source.poses[list(offered)]).astype(np.float32)
    places, reach = poses[:, :3, 3], RANGE + survey.voxel_size
    grid = empty_grid(np.stack([places.min(0) - reach, places.max(0) + reach]), survey.cell_size)
    state, policy = empty_map(_CAPACITY, survey.voxel_size), Gavis()
    chosen: list[int] = []
    firsts = first_photos(len(poses), num, seed)
    while len(chosen) < num:
        if len(chosen) < len(firsts):
            best = firsts[len(chosen)]
        else:
            camera = source.camera(int(offered[chosen[0]]))
            found = policy.entropies(state, grid, camera, poses)
            found[chosen] = -np.inf
            best = int(np.argmax(found))
        chosen.append(best)
        frame = source.frame(int(offered[best]), survey.alignment)
        state = integrate_growing(state, frame, RANGE)
        grid = _mark_free_ball(_integrate_depth(grid, frame, RANGE), frame.position, _BODY)
    return np.array(chosen)
