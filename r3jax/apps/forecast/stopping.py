"""Ends an exploration when the forecast of its map reaches a goal."""

from collections.abc import Callable

from r3jax.apps.forecast.forecast import forecast_map
from r3jax.apps.forecast.goal import parse_goal
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import LoopState
from r3jax.geometry.cameras import Camera


def stopping_rule(
    config: ExplorationConfig, camera: Camera
) -> Callable[[LoopState], str | None] | None:
    """Makes the `is_enough` of `explore` from `config.until`.

    Args:
        config: of the loop.
        camera: of the views whose PSNR is forecast.

    Returns:
        Says why no further view is needed, or None; None for a config without a goal.

    Raises:
        ValueError: a goal that is not understood.
    """
    if config.until is None:
        return None
    goal = parse_goal(config.until)

    def is_enough(state: LoopState) -> str | None:
        forecast = forecast_map(state.map_state, state.grid, camera, max_range=config.max_range)
        if not goal.reached(forecast):
            return None
        low, high = forecast.interval(goal.statistic)
        return (
            f"{state.views} views: the forecast of the PSNR of free-space views "
            f"({goal.statistic}) is {forecast.value(goal.statistic):.1f} dB, "
            f"{low:.1f} to {high:.1f} in four of five places; {goal} was asked for"
        )

    return is_enough
