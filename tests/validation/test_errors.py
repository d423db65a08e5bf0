"""A format version that is not read is refused, with the r3jax that reads it."""

import pytest

from r3jax.validation.errors import VersionError, check_version


def test_the_versions_between_are_read():
    for version in (2, 3, 4):
        check_version(version, 4, oldest=2)


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (5, "format version 5, this package reads versions 2 to 4: use the newer r3jax"),
        (1, "format version 1, .* use the other r3jax"),
        (None, "format version None"),
        (True, "format version True"),
        ("3", "format version 3"),
        (3.0, "format version 3.0"),
        ("x" * 1000, "format version x{20},"),
    ],
)
def test_every_other_is_refused_with_the_way_out(found, message):
    with pytest.raises(VersionError, match=message):
        check_version(found, 4, oldest=2)
