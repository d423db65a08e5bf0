"""A run without a name is named after what it explored; never a path."""

import pytest

from r3jax.cli.checks import default_name
from r3jax.cli.options import ExploreOptions


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        ("flat", "flat"),
        ("mesh:/data/house.glb", "house"),
        ("replica:office0", "office0"),
        ("habitat:office0", "habitat-office0"),
        ("habitat:/data/office_0/a.stage_config.json", "habitat-a"),
    ],
)
def test_default_names(scene, expected):
    assert default_name(ExploreOptions(seed=3), scene, "ours") == f"{expected}-ours-seed3"
