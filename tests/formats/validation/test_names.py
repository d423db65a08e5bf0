"""Names from files: those of a folder are taken, all that lead out of it are not."""

from pathlib import Path

import pytest

from r3jax.formats.validation.errors import ForeignFileError
from r3jax.formats.validation.names import below


@pytest.mark.parametrize("name", ["a.png", "a/b c.png", "./a.png", "a//b.png", "..a", "a..", "ü"])
def test_names_below_the_folder(name):
    path = below(Path("/folder"), name)
    assert path.is_relative_to("/folder")
    assert path.resolve() == Path("/folder").joinpath(name).resolve()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../a", "leads out"),
        ("a/../../b", "leads out"),
        ("a/..", "leads out"),
        ("..\\a", "leads out"),
        ("a\\..\\b", "leads out"),
        ("/etc/passwd", "absolute"),
        ("", "no name"),
        (" ", "no name"),
        ("a\0b", "no name"),
        (".", "is a folder"),
        ("x" * 2000, "2000 characters"),
    ],
)
def test_names_that_are_refused(name, reason):
    with pytest.raises(ForeignFileError, match=reason):
        below(Path("/folder"), name)
