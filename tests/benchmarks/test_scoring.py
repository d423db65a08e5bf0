"""How long the closed forms take on 60 000 voxels. Run by `make benchmark`."""

import functools

import jax
import numpy as np
import pytest

import r3jax
from r3jax.kernels.native import platform
from r3jax.mapping.occupancy import cells_of
from r3jax.planning.candidates import poses_along
from r3jax.planning.registry import make_policy
from r3jax.scoring.batch import score_positions, score_views
from r3jax.scoring.panorama import panorama_of
from tests.benchmarks.conftest import Explored

pytestmark = pytest.mark.full


def test_voxel_renderability_and_panorama(benchmark, explored, scoring):
    """Target: 1 ms together."""
    position, focal = explored.pose[:3, 3], explored.camera.focal

    def query():
        return jax.block_until_ready(
            (
                r3jax.voxel_renderability(explored.map, position, focal),
                r3jax.panorama(explored.map, explored.grid, explored.camera, position, scoring),
            )
        )

    query()
    terms, panorama = benchmark(query)
    assert float(terms.value.max()) > 0.9
    assert float(panorama.best_score) > 0.0


def test_view_utility(benchmark, explored, scoring):
    """Target: 2 ms."""
    query = lambda: jax.block_until_ready(
        r3jax.view_utility(explored.map, explored.grid, explored.camera, explored.pose, scoring)
    )
    query()
    assert float(benchmark(query).rendering) > 0.0


def test_renderability(benchmark, explored):
    query = lambda: jax.block_until_ready(
        r3jax.renderability(explored.map, explored.camera, explored.pose)
    )
    query()
    assert float(benchmark(query)) > 0.5


def test_100_views(benchmark, explored, scoring):
    """Target: 20 ms."""
    poses = np.repeat(np.asarray(explored.pose)[None], 100, axis=0)
    score = lambda: jax.block_until_ready(
        score_views(explored.map, explored.grid, explored.camera, poses, scoring)
    )
    score()
    assert benchmark(score).total.shape == (100,)


@pytest.fixture(scope="module")
def around(explored) -> np.ndarray:
    """A thousand views from where the frames were taken, looking anywhere, [1000, 4, 4]."""
    rng = np.random.default_rng(0)
    places = np.stack([frame.position for frame in explored.frames])
    places = places[rng.integers(0, len(places), 1000)]
    return poses_along(places, rng.normal(size=(1000, 3))).astype(np.float32)


def test_1000_renderabilities(benchmark, explored, around):
    """Target: 1 s; memory does not grow with the number of poses."""
    query = functools.partial(r3jax.renderability, explored.map, explored.camera)
    mapped = jax.jit(jax.vmap(query))
    score = lambda: jax.block_until_ready(mapped(around))
    score()
    assert float(benchmark(score).max()) > 0.5


@pytest.fixture(params=["kernels", "formulas"])
def form(request, monkeypatch):
    """The machine code of CPUs, and the plain JAX that other platforms get, on this CPU."""
    if request.param == "formulas":
        monkeypatch.setattr(platform, "can_call_kernels", lambda: False)
    # What was traced in the other form must not serve this one.
    jax.clear_caches()
    yield
    jax.clear_caches()


@pytest.mark.usefixtures("form")
def test_10_panoramas(benchmark, explored, scoring, around):
    cells = cells_of(explored.grid)

    def one(position):
        return panorama_of(explored.map, cells, explored.camera, position, scoring)

    mapped = jax.jit(jax.vmap(one))
    score = lambda: jax.block_until_ready(mapped(around[:10, :3, 3]))
    score()
    assert float(benchmark(score).best_score.sum()) > 0.0


@pytest.mark.usefixtures("form")
def test_100_renderabilities(benchmark, explored, around):
    query = functools.partial(r3jax.renderability, explored.map, explored.camera)
    mapped = jax.jit(jax.vmap(query))
    score = lambda: jax.block_until_ready(mapped(around[:100]))
    score()
    assert float(benchmark(score).max()) > 0.5


def test_100_panoramas(benchmark, explored, scoring):
    positions = np.repeat(np.asarray(explored.pose)[None, :3, 3], 100, axis=0)
    score = lambda: jax.block_until_ready(
        score_positions(explored.map, explored.grid, explored.camera, positions, scoring)
    )
    score()
    assert benchmark(score).best_score.shape == (100,)


@functools.cache
def apartment_after(views: int, edge: int) -> Explored:
    """An apartment after so many views from the middles of its rooms."""
    return Explored(0, edge, views)


AFTER = [(6, 96), *(pytest.param(n, 256, marks=pytest.mark.measured) for n in (60, 120))]


@pytest.mark.parametrize(("views", "edge"), AFTER)
def test_a_decision(benchmark, views, edge):
    """Target: 100 ms after 60 views, 150 ms after 120, of `r3-pano` among 100 candidates."""
    explored, policy = apartment_after(views, edge), make_policy("r3-pano")
    state = policy.init(explored.camera, explored.grid, key=jax.random.key(0))
    for frame in explored.frames:
        state = policy.observe(state, explored.map, frame)
    pose, key = np.asarray(explored.pose, dtype=np.float64), jax.random.key(1)
    decide = lambda: policy.decide(state, explored.map, explored.grid, pose, key=key)
    decide()
    decision, _, info = benchmark(decide)
    assert decision is not None
    assert info.num_candidates == 100


FLOWN = [
    ("r3-pano", 2, 96),
    *(
        pytest.param(policy, views, 256, marks=pytest.mark.measured)
        for policy in ("r3-pano", "r3-ahead")
        for views in (4, 40)
    ),
]


@pytest.mark.parametrize(("policy", "views", "edge"), FLOWN)
def test_a_decision_on_its_own_way(benchmark, policy, views, edge):
    """Target: 200 ms of `r3-ahead`, after so many views of the flat that it chose itself."""
    policy = make_policy(policy)
    world = r3jax.open_scene("flat", camera=r3jax.Camera.from_fov(edge, edge))
    pose = world.start_pose
    planner = r3jax.start(world.camera, world.bounds, policy, starts=[pose])
    *keys, last = jax.random.split(jax.random.key(0), views)
    for key in keys:
        planner = r3jax.observe(planner, world.render(pose))
        decision, planner, _ = r3jax.decide(planner, pose, key)
        pose = decision.T_world_camera
    planner = r3jax.observe(planner, world.render(pose))
    r3jax.decide(planner, pose, last)
    decision, _, info = benchmark(lambda: r3jax.decide(planner, pose, last))
    assert decision is not None
    assert info.num_candidates == 100
