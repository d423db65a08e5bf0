"""Names from files: those of a folder are taken, all that lead out of it are not."""

from pathlib import Path

import pytest

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import below


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


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("images\\1.png", "images/1.png"),
        ("images/1.PNG", "images/1.png"),
        ("images\\2.jpg", "images/2.JPG"),
        ("C:\\Users\\me\\scan\\images\\1.png", "images/1.png"),
        ("/home/me/scan/images/1.PNG", "images/1.png"),
        ("a\\b.png", "a\\b.png"),  # a name of this system
        ("images\\gone.png", "images/gone.png"),
    ],
)
def test_names_as_other_computers_spell_them(tmp_path, name, found):
    (tmp_path / "images").mkdir()
    for file in ("images/1.png", "images/2.JPG", "a\\b.png"):
        (tmp_path / file).touch()
    assert below(tmp_path, name) == tmp_path / found


@pytest.mark.parametrize(
    "name", ["C:\\x\\gone.png", "C:/x/gone.png", "/images/../x.png", "\\\\a\\b"]
)
def test_absolute_names_that_lead_nowhere_are_refused(tmp_path, name):
    with pytest.raises(ForeignFileError, match=r"absolute path|leads out"):
        below(tmp_path, name)
