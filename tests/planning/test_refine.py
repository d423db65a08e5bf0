"""Candidates that climb: never worse, never colliding, within limits, and near the best there is.

The flat is half known; the utility is worked out anew on the whole map.
"""

import dataclasses
import functools
import itertools
from types import SimpleNamespace
from unittest import mock

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.candidates import Candidates, candidates_along, path_lengths, poses_along
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decision import net_utility
from r3jax.planning.policy import Situation
from r3jax.planning.refinement import climb
from r3jax.planning.refinement import refine as real
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.planning.robot.limits import Limits
from r3jax.planning.robot.motion import MOTIONS, Motion
from r3jax.planning.robot.travel import plan_travel
from r3jax.scoring.batch import score_views
from r3jax.scoring.config import ScoringConfig
from tests.planning.rooms import center, known_flat
from tests.planning.walls import SEEN_FROM, VOXEL, box, wall

NUM, REFINED = 12, 3  # one shape: one compile
CAMERA = Camera.from_fov(48, 48, 60.0)
SCORING = ScoringConfig(max_range=4.0, zbuffer_size=48, panorama_size=64)
EYE = center(6, 6, 4)
"""Where the robot is [m]."""

CONFIG = PlannerConfig(
    num_candidates=NUM, num_frontier=0, refine=REFINED, refine_radius=0.3, scoring=SCORING
)
seeds = st.integers(0, 10_000)


def situation_of(motion: Motion) -> Situation:
    """A robot in the first room that looks along x."""
    state, grid = known_flat()
    start = poses_along(EYE[None], np.array([[1.0, 0.0, 0.0]]))[0]
    heights = motion.heights_from(float(EYE[2]))
    travel = plan_travel(grid, EYE, heights=heights)
    limits = Limits(motion, start, heights)
    masked = mask_unexplorable(grid, travel.reachable)
    return Situation(state, grid, masked, travel, CAMERA, None, limits)


def candidates(where: Situation, seed: int, *, poor: bool = False) -> Candidates:
    """From stops, to anywhere, or poorly to the floor, as far as the carrier may."""
    rng = np.random.default_rng(seed)
    stops = where.travel.stops(np.argwhere(where.travel.safe & where.travel.reachable))
    places = stops[rng.integers(len(stops), size=NUM)]
    places[:, :2] += rng.uniform(-0.05, 0.05, (NUM, 2))
    directions = rng.normal(size=(NUM, 3))
    directions = 0.1 * directions - np.array([0.0, 0.0, 1.0]) if poor else directions
    return where.limits.project_to_feasible(candidates_along(places, directions))


def utility_of(where: Situation, views: Candidates) -> np.ndarray:
    poses = views.poses_on_device()
    scores = score_views(where.map_state, where.scoring_grid, CAMERA, poses, SCORING)
    return np.asarray(scores.total, np.float64)


def paths_of(where: Situation, views: Candidates) -> np.ndarray:
    return where.limits.path_costs(path_lengths(where.travel, views), views.direction)


def is_other(after: Candidates, before: Candidates) -> np.ndarray:
    """Which views are not what they were."""
    moved = np.any(after.position != before.position, axis=1)
    return moved | np.any(after.direction != before.direction, axis=1)


def refined(where: Situation, poses: Candidates, config: PlannerConfig = CONFIG):
    """Before and after: utilities, paths and totals, the latter by the same sums."""
    utility, path = utility_of(where, poses), paths_of(where, poses)
    weigh = functools.partial(net_utility, lambda2=config.lambda2, among=(utility, path))
    known_of = {"utility": utility, "path": path}
    after, found = real.refine_best(where, poses, known_of, config, weigh)
    return weigh(utility, path), after, found, weigh


def law_never_worse(
    seed: int = 0,
    motion: Motion = MOTIONS["free"],
    *,
    config: PlannerConfig = CONFIG,
    poor: bool = False,
) -> None:
    where = situation_of(motion)
    poses = candidates(where, seed, poor=poor)
    before = utility_of(where, poses)
    total, after, found, weigh = refined(where, poses, config)
    is_new = is_other(after, poses)
    assert is_new.sum() <= REFINED
    exact = utility_of(where, after)
    np.testing.assert_allclose(found["utility"], exact, rtol=1e-5)
    np.testing.assert_allclose(found["path"], paths_of(where, after), atol=1e-9)
    np.testing.assert_array_equal(found["utility"][~is_new], before[~is_new])
    assert np.all(exact[is_new] > before[is_new])
    assert np.all(weigh(exact, found["path"])[is_new] > total[is_new])
    best = np.argsort(-total)[:REFINED]
    assert set(np.flatnonzero(is_new)) <= set(best)


def law_safe(seed: int = 0, motion: Motion = MOTIONS["free"]) -> None:
    """Every view that is new stands in a stop, within reach of its start, and is allowed."""
    where = situation_of(motion)
    poses = candidates(where, seed)
    _, after, found, _ = refined(where, poses)
    stops = where.travel.safe & where.travel.reachable
    for start, pose in zip(poses.position, after.T_world_camera, strict=True):
        assert stops[where.travel.cell_of(pose[:3, 3])]
        assert np.abs(pose[:3, 3] - start).max() <= CONFIG.refine_radius + 1e-9
        assert rigid_error(pose) is None
        assert abs(pose[2, 0]) < 1e-6  # no roll
    assert np.all(np.isfinite(found["path"]))
    again = where.limits.project_to_feasible(after)
    np.testing.assert_allclose(again.direction, after.direction, atol=1e-6)
    np.testing.assert_array_equal(again.position, after.position)


@pytest.mark.full
@given(seeds, st.sampled_from(list(MOTIONS)))
@settings(max_examples=12)
def test_no_view_gets_worse_or_collides(seed, motion_name):
    law_never_worse(seed, MOTIONS[motion_name])
    law_safe(seed, MOTIONS[motion_name])


def law_whatever_climbs(seed: int = 0, motion: Motion = MOTIONS["free"]) -> None:
    """The same where a climb ends anywhere, and the way counts for more than the view."""

    def stray(*args, moves: bool) -> np.ndarray:
        rng, starts = np.random.default_rng(seed), args[4]
        assert isinstance(starts, climb.Starts)
        positions = np.asarray(starts.position) + rng.uniform(-0.5, 0.5, (REFINED, 3))
        angles = rng.uniform((-np.pi, -1.5), (np.pi, 1.5), (REFINED, 2))
        return np.concatenate([positions, angles], axis=1)

    better = np.repeat([0.0, 1e9], REFINED)
    all_better = SimpleNamespace(total=better, exploration=better, rendering=better)
    with mock.patch.object(real, "climb", stray):
        for lambda2 in (0.5, 5.0):
            config = dataclasses.replace(CONFIG, lambda2=lambda2)
            law_never_worse(seed, motion, config=config, poor=True)
        with mock.patch.object(real, "score_views_near", return_value=all_better):
            law_safe(seed, motion)


@pytest.mark.full
@given(seeds, st.sampled_from(list(MOTIONS)))
@settings(max_examples=12)
def test_where_a_climb_ends_is_checked(seed, motion_name):
    law_whatever_climbs(seed, MOTIONS[motion_name])


def law_gains() -> None:
    """Random directions leave much to gain: half of the best of these, a tenth or more."""
    where, gains = situation_of(MOTIONS["free"]), []
    for seed in range(4):
        poses = candidates(where, seed)
        before = utility_of(where, poses)
        total, _, found, _ = refined(where, poses)
        best = np.argsort(-total)[:REFINED]
        gains += list(found["utility"][best] / before[best] - 1.0)
    assert np.median(gains) > 0.1


@pytest.mark.full
def test_climbing_gains():
    law_gains()


@pytest.mark.full
def test_turning_alone_gains_and_stays():
    where = situation_of(MOTIONS["free"])
    config = dataclasses.replace(CONFIG, refine_radius=0.0)
    poses = candidates(where, 1)
    before = utility_of(where, poses)
    _, after, found, _ = refined(where, poses, config)
    np.testing.assert_array_equal(after.position, poses.position)
    assert (found["utility"] / before).max() > 1.05


@pytest.mark.full
def test_climbs_compile_once():
    where = situation_of(MOTIONS["free"])
    refined(where, candidates(where, 0))
    before = climb._move._cache_size()
    for seed, motion in enumerate(("free", "gimbal", "handheld", "ground")):
        where = situation_of(MOTIONS[motion])
        refined(where, candidates(where, seed))
    assert climb._move._cache_size() == before


def badly_seen() -> tuple[r3jax.MapState, OccupancyGrid]:
    """A wall seen well from in front; a patch of it only along the wall. Nothing is unexplored."""
    state = wall()
    keys = np.stack([[20, y, z] for y in range(6, 11) for z in range(14, 19)])
    points = np.resize((keys + 0.5) * VOXEL, (625, 3)).astype(np.float32)
    eye = np.array([1.9, -3.0, 1.6], np.float32)
    for _ in range(2):
        state = r3jax.integrate_points(state, points, np.full_like(points, 0.2), eye)
    return state, box(9.0)


@pytest.mark.full
def test_a_climb_comes_near_the_best_of_a_dense_grid():
    """Positions and directions all over the box and round the start, one by one."""
    scoring = ScoringConfig(max_range=4.0, zbuffer_size=32)
    state, grid = badly_seen()
    travel = plan_travel(grid, SEEN_FROM)
    where = Situation(state, grid, grid, travel, CAMERA, None)
    start = candidates_along(SEEN_FROM[None], np.array([[1.0, 0.0, 0.0]]))
    config = dataclasses.replace(CONFIG, refine=1, refine_radius=0.4, scoring=scoring)
    utility = np.asarray(
        score_views(state, grid, CAMERA, start.poses_on_device(), scoring).total, np.float64
    )
    known_of = {"utility": utility, "path": np.zeros(1)}
    _, found = real.refine_best(where, start, known_of, config, lambda utility, path: utility)
    offsets = itertools.product((-0.4, 0.0, 0.4), repeat=3)
    angles = itertools.product(np.radians(np.arange(-30, 31, 6)), np.radians(np.arange(-24, 25, 6)))
    rows = [(*SEEN_FROM + o, *a) for o, a in itertools.product(offsets, angles)]
    rows = np.array(rows)
    ways = np.stack(
        [np.cos(rows[:, 4]) * np.cos(rows[:, 3]), np.cos(rows[:, 4]) * np.sin(rows[:, 3]),
         np.sin(rows[:, 4])], axis=1,
    )  # fmt: skip
    dense = score_views(state, grid, CAMERA, poses_along(rows[:, :3], ways), scoring)
    best = float(np.asarray(dense.total).max())
    assert best > 1.2 * utility[0]
    assert found["utility"][0] > 0.95 * best


@pytest.mark.full
def test_all_candidates_of_a_path_may_be_refined():
    """More than the share that is drawn as Ours draws it: the limit is that of all candidates."""
    state, grid = known_flat()
    pose = poses_along(EYE[None], np.array([[1.0, 0.0, 0.0]]))[0]
    policy = make_policy("ours-ahead", num_candidates=NUM, num_frontier=0, scoring=SCORING,
                         horizon=2, beam=2, branching=2, num_spread=4, refine=NUM)  # fmt: skip
    memory = policy.init(CAMERA, grid, key=jax.random.key(0))
    decision, _, _ = policy.decide(memory, state, grid, pose, key=jax.random.key(4))
    assert decision is not None


@pytest.mark.full
@pytest.mark.parametrize("name", ["ours", "ours-pano", "ours-ahead"])
def test_decisions_with_refinement(name):
    """The choice is one of the candidates, and what it was worth before is no more than after."""
    state, grid = known_flat()
    pose = poses_along(EYE[None], np.array([[1.0, 0.0, 0.0]]))[0]
    chosen = {}
    for num in (0, REFINED):
        settings = dict(num_candidates=NUM, num_frontier=0, scoring=SCORING)
        ahead = dict(horizon=2, beam=2, branching=2, num_spread=4)
        if name == "ours-ahead":
            settings |= ahead
        policy = make_policy(name, refine=num, **settings)
        memory = policy.init(CAMERA, grid, key=jax.random.key(0))
        decision, _, info = policy.decide(memory, state, grid, pose, key=jax.random.key(4))
        assert ("refining" in info.stage_seconds) == (num > 0 and name != "ours-ahead")
        gaps = np.abs(decision.candidates - decision.T_world_camera).max(axis=(1, 2))
        assert gaps.min() == 0.0
        chosen[num] = decision
    plain, better = chosen[0], chosen[REFINED]
    is_new = np.any(plain.candidates != better.candidates, axis=(1, 2))
    assert 0 < is_new.sum() <= REFINED
    assert np.all(better.utilities["utility"] >= plain.utilities["utility"])
    assert np.all((better.utilities["utility"] > plain.utilities["utility"]) == is_new)
    if name == "ours":
        parts = better.utilities["exploration"] * float(SCORING.lambda1)
        np.testing.assert_allclose(
            parts + better.utilities["rendering"], better.utilities["utility"], rtol=1e-5
        )


def test_nothing_to_climb_is_no_error():
    where = situation_of(MOTIONS["free"])
    poses = candidates(where, 0)
    known_of = {"utility": np.ones(NUM), "path": np.full(NUM, np.inf)}
    nothing = lambda utility, path: np.full(len(utility), -np.inf)
    after, found = real.refine_best(where, poses, known_of, CONFIG, nothing)
    assert after is poses
    assert found is known_of


def over_motions(law):
    return lambda modules: [
        law(seed, MOTIONS[name]) for seed, name in enumerate(("free", "gimbal", "handheld"))
    ]


def test_laws_hold_without_a_fault():
    for law in (over_motions(law_never_worse), over_motions(law_whatever_climbs), law_gains):
        law()
