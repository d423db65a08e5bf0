"""Sentences of an audit: numbers as exact as they are, and no more."""

from dataclasses import replace

import pytest

from r3jax.apps.audit.sentences import coarse, two_digits
from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import source_of
from r3jax.captures.survey import survey_of
from r3jax.formats.nerfstudio import read_transforms
from tests.apps.audit.room import round_poses, write_nerfstudio


@pytest.mark.parametrize(
    ("value", "said"),
    [(2.0, "2.0"), (1.949, "1.9"), (0.0123, "0.012"), (9.96, "10"), (76.4, "76"), (1234.0, "1200")],
)
def test_an_area_has_two_digits(value, said):
    assert two_digits(value) == said


def test_a_view_into_the_distance_is_said_to_make_what_is_near_coarse(tmp_path):
    """Seen on a roof terrace with pyramids behind: voxels were wider than the terrace was away."""
    images = read_transforms(write_nerfstudio(tmp_path, round_poses(6), depth=True))
    near = replace(source_of(images, "room"), is_metric=False)

    def read(index):
        rgb, depth = near.read(index)
        return rgb, depth + 150.0 * (rgb[..., :1].sum(axis=-1) % 8 == 0)

    assert coarse(survey_of(near, SurveySettings())) == []
    far = replace(near, read=read)
    (said,) = coarse(survey_of(far, SurveySettings(trust_depth=True)))
    median = survey_of(far, SurveySettings(trust_depth=True)).median_depth
    assert f"--max-range {10 * median:.2g} " in said
    assert coarse(survey_of(far, SurveySettings(trust_depth=True, max_range=10 * median))) == []
