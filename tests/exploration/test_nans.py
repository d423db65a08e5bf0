"""No operation of the whole loop makes a NaN, not even one that is thrown away later."""

import jax
import pytest

from r3jax.exploration import explore
from r3jax.planning.registry import policy_names
from tests.exploration.killed_run import CONFIG, small_policy
from tests.exploration.toys import BoxRoom
from tests.tiers import quick_and_full


class HoleyRoom(BoxRoom):
    """A quarter of the picture without depth, a quarter out of range."""

    def render(self, T_world_camera):
        frame = super().render(T_world_camera)
        half = frame.depth.shape[0] // 2
        depth = frame.depth.at[:half, :half].set(0.0).at[half:, half:].set(float("inf"))
        return type(frame)(frame.rgb, depth, frame.T_world_camera, frame.camera)


SCORERS = ("r3", "r3-pano", "active-gs", "cover")
"""One of each way to score; the others score like one of these, and run outside the gate."""

OTHERS = [name for name in policy_names() if name not in SCORERS]


@pytest.mark.parametrize(
    "name",
    [
        *quick_and_full(SCORERS, []),
        *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS),
    ],
)
def test_the_loop_makes_no_nan(name):
    policy = small_policy(name)
    with jax.debug_nans(True):
        result = explore(HoleyRoom(), policy, budget="views:3", config=CONFIG)
    assert len(result.rows) == 3
