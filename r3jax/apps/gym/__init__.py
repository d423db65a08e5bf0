"""Exploration as an environment of gymnasium, registered as `r3jax/Explore-v0` by this import."""

from r3jax.extras import naming_extras

ENV_ID = "r3jax/Explore-v0"
"""Name of the environment."""

MAX_STEPS = 60
"""Views of an episode, unless `gymnasium.make` is given other `max_episode_steps`."""

with naming_extras():
    from gymnasium.envs.registration import register, registry

if ENV_ID not in registry:
    register(
        ENV_ID,
        entry_point="r3jax.apps.gym.environment:ExploreEnv",
        max_episode_steps=MAX_STEPS,
    )
