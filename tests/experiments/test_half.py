"""Half of the views in hindsight: a greedy choice, and the table, by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import half
from experiments.artefacts import Origin
from r3jax.geometry.cameras import look_at
from r3jax.scoring.demand import demand_of, gain_of
from r3jax.scoring.voxels import voxels_of
from tests.evaluation.records import record
from tests.planning.known_hall import CAMERA, SCORING, known

pytestmark = pytest.mark.full

ASKING = np.array([[1.0, 0.9, 1.2], [2.0, 0.8, 1.4], [1.2, 1.8, 1.0]])
NUM = 4
PSNR = {"first": 18.0, "every second": 19.0, "in hindsight": 19.5, "all": 20.0}


@pytest.fixture(scope="module")
def poses():
    """Four views, each of them twice."""
    rng = np.random.default_rng(2)
    eyes = rng.uniform([0.6, 0.6, 0.8], [2.0, 2.0, 1.6], (NUM, 3))
    ends = np.array([[4.0, 1.0, 1.2], [1.5, 3.0, 1.2], [3.0, 2.5, 0.2], [4.0, 3.0, 2.2]])
    return np.repeat([look_at(eye, end) for eye, end in zip(eyes, ends, strict=True)], 2, axis=0)


def choose(state, poses, num):
    return half.chosen_in_hindsight((state, known()[1]), CAMERA, poses, ASKING, num, SCORING)


def test_the_first_choice_adds_most_and_none_is_taken_twice(poses):
    state, _ = known()
    blank = eqx.tree_at(lambda m: (m.visited, m.resolution), state, replace_fn=jnp.zeros_like)
    voxels = voxels_of(blank, SCORING.delta)
    demand = demand_of(voxels, jnp.asarray(ASKING, jnp.float32), CAMERA.focal, SCORING)
    gain = jax.jit(lambda pose: gain_of(voxels, demand, CAMERA, pose, SCORING))
    gains = [float(gain(jnp.asarray(pose, jnp.float32))) for pose in poses[::2]]
    chosen = choose(state, poses, NUM)
    assert chosen[0] == 2 * int(np.argmax(gains))
    assert min(gains) > 0.0
    assert sorted(i // 2 for i in chosen) == list(range(NUM))


def test_what_the_run_had_seen_is_forgotten(poses):
    state, _ = known()
    seen = eqx.tree_at(lambda m: m.visited, state, jnp.full_like(state.visited, 2**32 - 1))
    assert choose(seen, poses, NUM) == choose(state, poses, NUM)


def test_the_table_compares_every_choice_with_all_views(tmp_path):
    hard = np.arange(12.0)
    cases = [(scene, seed) for scene in ("flat", "office") for seed in (0, 1)]
    records = [
        record("ours-pano", scene, seed, views, budget=60, psnr=PSNR[name] + seed + hard)
        for scene, seed in cases
        for views, name in ((30, "first"), (60, "all"))
    ]
    halves = [
        {
            "policy": choice,
            "settings": {},
            "scene": scene,
            "seed": seed,
            "views": {"psnr": PSNR[choice] + seed + hard},
        }
        for choice in (half.EVERY_SECOND, half.IN_HINDSIGHT)
        for scene, seed in reversed(cases)
    ]
    half.write_page(tmp_path, records, halves, Origin("a command", "a machine", "abc"))
    page = (tmp_path / "half.md").read_text()
    assert "| all | 26.00 | 26.00 | 26.00 | +0.00 [+0.00, +0.00] |" in page
    assert "| first, views:30 | 24.00 | 24.00 | 24.00 | -2.00 [-2.00, -2.00] |" in page
    assert "| every second | 25.00 | 25.00 | 25.00 | -1.00 [-1.00, -1.00] |" in page
    assert "| in hindsight | 25.50 | 25.50 | 25.50 | -0.50 [-0.50, -0.50] |" in page
    assert "commit: abc" in page
