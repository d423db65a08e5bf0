"""The environment keeps gymnasium's contract, and its steps are those of the planner."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from r3jax.apps.gym import ENV_ID
from r3jax.apps.gym.environment import ExploreEnv
from r3jax.errors import InputError
from tests.box_room import write_room
from tests.test_examples import load

SMALL = {"num_candidates": 8, "width": 32, "height": 24, "num_probes": 8, "capacity": 1 << 14}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return {"scene": write_room(tmp_path_factory.mktemp("room") / "room.ply"), **SMALL}


@pytest.fixture(scope="module")
def env(room):
    return gymnasium.make(ENV_ID, **room)


@pytest.fixture(scope="module")
def viewed(room):
    return gymnasium.make(ENV_ID, actions="view", reward="coverage", **room)


@pytest.mark.parametrize("actions", ["candidates", "view"])
def test_gymnasium_finds_nothing_wrong(room, actions):
    env = gymnasium.make(ENV_ID, actions=actions, render_mode="rgb_array", **room)
    check_env(env.unwrapped)


def test_the_same_seed_and_actions_give_the_same_episode(env):
    def episode(seed: int) -> list:
        (seen, info), rewards = env.reset(seed=seed), []
        for _ in range(3):
            seen, reward, *_, info = env.step(int(np.argmax(info["utilities"])))
            rewards.append(reward)
        return [rewards, seen["pose"], seen["depth"], seen["candidates"]]

    first, second, other = episode(3), episode(3), episode(4)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[3], other[3])


def test_a_candidate_is_where_the_camera_goes(env):
    seen, info = env.reset(seed=0)
    assert seen["mask"].any()
    choice = int(np.flatnonzero(seen["mask"])[-1])
    wanted, length = seen["candidates"][choice], info["path"][choice]
    seen, _, ended, truncated, info = env.step(choice)
    np.testing.assert_allclose(seen["pose"][:3, 3], wanted[:3], atol=1e-5)
    np.testing.assert_allclose(seen["pose"][:3, 2], wanted[3:], atol=1e-5)
    assert info["reached"]
    assert info["length"] <= length + 1e-4
    assert not ended
    assert not truncated


def test_rewards_add_up_to_what_was_gained(env):
    env.reset(seed=0)
    inner = env.unwrapped
    first, total = inner._worth(), 0.0
    for _ in range(3):
        _, reward, *_ = env.step(0)
        total += reward
    assert total == pytest.approx(inner._worth() - first)
    assert total > 0.0


def test_a_view_behind_a_wall_is_refused(viewed):
    seen, _ = viewed.reset(seed=0)
    corner = np.ones(5, np.float32)  # no camera fits into the corner of the box
    after, reward, *_, info = viewed.step(corner)
    assert not info["reached"]
    assert reward == 0.0
    np.testing.assert_array_equal(after["pose"], seen["pose"])


def test_a_pose_becomes_an_action_and_back(viewed):
    seen, _ = viewed.reset(seed=0)
    wanted = next(row for row, ok in zip(seen["candidates"], seen["mask"], strict=True) if ok)
    inner = viewed.unwrapped
    pose = np.eye(4)
    pose[:3, 3], pose[:3, 2] = wanted[:3], wanted[3:]
    back = inner._wanted(inner.action_of(pose))
    np.testing.assert_allclose(back[:3, 3], wanted[:3], atol=1e-4)
    heading = lambda axis: np.arctan2(axis[1], axis[0])
    assert heading(back[:3, 2]) == pytest.approx(heading(wanted[3:]), abs=1e-4)


def test_the_local_map_shows_the_free_space_round_the_camera(viewed):
    seen, _ = viewed.reset(seed=0)
    middle = len(seen["local_map"]) // 2
    assert seen["local_map"][middle, middle, middle] == 1
    assert {0, 1, 2} == set(np.unique(seen["local_map"]))


def test_several_run_beside_each_other(room):
    envs = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="sync", **room)
    seen, _ = envs.reset(seed=0)
    assert seen["image"].shape == (2, 24, 32, 3)
    seen, rewards, *_ = envs.step(np.zeros(2, int))
    assert rewards.shape == (2,)
    envs.close()


@pytest.mark.parametrize(
    "wrong", [{"actions": "jump"}, {"reward": "fun"}, {"render_mode": "human"}]
)
def test_what_is_not_known_is_refused(room, wrong):

    with pytest.raises(InputError, match=next(iter(wrong))):
        ExploreEnv(**room | wrong)


def test_the_baselines_of_the_example_explore(room):
    returns = load("gym_baselines").main(views=3, **room)
    assert set(returns) == {"random", "nearest", "r3"}
    assert all(value > 0.0 for value in returns.values())
