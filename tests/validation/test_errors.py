"""A format version that is not read is refused, with the r3jax that reads it."""

import pytest

from r3jax.validation.errors import VersionError, check_version


def test_the_versions_between_are_read():
    for version in (2, 3, 4):
        check_version(version, 4, oldest=2)


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (5, "version 5.*2 to 4"),
        (1, "version 1"),
        (None, "None"),
        (True, "True"),
        ("3", "format version 3"),
        (3.0, "format version 3.0"),
        ("x" * 1000, "format version x{20},"),
    ],
)
def test_every_other_is_refused_with_the_way_out(found, message):
    with pytest.raises(VersionError, match=message):
        check_version(found, 4, oldest=2)
