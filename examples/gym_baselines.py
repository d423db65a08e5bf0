"""Policies that are not learned, in the environment `r3jax/Explore-v0`: what learning has to beat.

pip install 'r3jax[gym,sim]' && python examples/gym_baselines.py
"""

import gymnasium
import numpy as np

BASELINES = {
    "random": lambda seen, info, rng: rng.choice(np.flatnonzero(seen["mask"])),
    "nearest": lambda seen, info, rng: np.argmin(info["path"]),
    "r3": lambda seen, info, rng: np.argmax(info["utilities"]),
}


def main(views: int = 20, **options) -> dict[str, float]:
    """Returns of an episode of each baseline, by its name."""
    env = gymnasium.make("r3jax.apps.gym:r3jax/Explore-v0", max_episode_steps=views, **options)
    returns = {}
    for name, choose in BASELINES.items():
        (seen, info), rng = env.reset(seed=0), np.random.default_rng(0)
        total, is_over = 0.0, False
        while not is_over:
            seen, reward, ended, truncated, info = env.step(int(choose(seen, info, rng)))
            total, is_over = total + reward, ended or truncated
        returns[name] = total
        print(f"{name}: renderability +{total:.3f}, {info['voxels']} voxels")
    return returns


if __name__ == "__main__":
    main()
