"""A run without a name is named after what it explored; never a path."""

import pytest

from r3jax.cli.options.explore import ExploreOptions, MotionOptions


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
def test_default_names(scene, expected, monkeypatch):
    monkeypatch.setattr("r3jax.cli.options.explore.check_scene", lambda *_: None)
    options = ExploreOptions(scene=scene, seed=3)
    assert options.path("r3").name == f"{expected}-r3-seed3"
    options = ExploreOptions(scene=scene, seed=3, robot=MotionOptions(motion="ground"))
    assert options.path("r3").name == f"{expected}-r3-ground-seed3"
