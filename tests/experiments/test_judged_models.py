"""What is kept of a model and its test views."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.judged_models import FISHER, fisher_scores
from r3jax.splatting.views import Views
from tests.splatting.clouds import random_cloud, view

pytestmark = pytest.mark.full


def views_at(camera, poses) -> Views:
    num, shape = len(poses), (camera.height, camera.width)
    cameras = jax.tree.map(lambda x: jnp.broadcast_to(x, (num,)), camera)
    rgb, depth = jnp.zeros((num, *shape, 3), jnp.uint8), jnp.ones((num, *shape))
    return Views(rgb, depth, jnp.asarray(poses, jnp.float32), cameras)


def test_a_view_that_was_trained_on_tells_least():
    scene, (camera, pose) = random_cloud(3, 50, 1), view(16, 16)
    pose = np.asarray(pose)
    back = pose @ np.diag([-1.0, 1.0, -1.0, 1.0])
    beside = pose.copy()
    beside[:3, 3] += 0.3 * pose[:3, 0]
    found = fisher_scores(scene, pose[None], views_at(camera, [pose, beside, back]))
    assert set(found) == set(FISHER)
    for name, (same, other, away) in found.items():
        assert other > same > 0.0, name
        # Where no Gaussian is, the model knows of nothing that it does not know.
        assert away < same, name
