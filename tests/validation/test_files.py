"""Only regular files within a limit are opened, and names that lead out of a folder are refused."""

import os
from pathlib import Path

import pytest

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import (
    below,
    check_regular,
    check_tree,
    plain_text,
    read_bytes,
)


def test_a_file_and_a_link_to_it(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    (tmp_path / "b").symlink_to("a")
    assert read_bytes(tmp_path / "a", 5) == read_bytes(tmp_path / "b", 5) == b"12345"
    check_tree(tmp_path)
    with pytest.raises(ForeignFileError, match="more than"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(FileNotFoundError):
        check_regular(tmp_path / "c")


def test_a_pointer_of_git_lfs_says_how_to_fetch_the_file(tmp_path):
    text = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "0" * 64 + "\nsize 12\n"
    (tmp_path / "a").write_text(text)
    with pytest.raises(ForeignFileError, match="git lfs pull"):
        read_bytes(tmp_path / "a", 1000)
    (tmp_path / "b").write_text(f"notes on {text}")
    assert read_bytes(tmp_path / "b", 1000)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_marks_of_byte_order_are_no_text(encoding):
    assert plain_text('{"ü": 1}'.encode(encoding)) == '{"ü": 1}'.encode()


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "zero"])
def test_what_is_no_file_is_not_opened(tmp_path, kind):
    path = tmp_path / "x"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path = tmp_path / "x\0y"
    with pytest.raises(ForeignFileError):
        read_bytes(path, 100)


def test_a_pipe_or_a_dead_link_in_a_folder(tmp_path):
    (tmp_path / "deep").mkdir()
    os.mkfifo(tmp_path / "deep" / "pipe")
    with pytest.raises(ForeignFileError, match="pipe"):
        check_tree(tmp_path)
    os.remove(tmp_path / "deep" / "pipe")
    (tmp_path / "deep" / "link").symlink_to("nowhere")
    with pytest.raises(ForeignFileError, match="leads nowhere"):
        check_tree(tmp_path)


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
        ("../images/1.png", "images/1.png"),
        ("..\\scan\\images\\1.png", "images/1.png"),
        ("images/../../scan/images/1.png", "images/1.png"),
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
    "name",
    ["C:\\x\\gone.png", "C:/x/gone.png", "/images/../x.png", "\\\\a\\b", "../beside/images/1.png"],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path, name):
    (tmp_path / "beside" / "images").mkdir(parents=True)
    (tmp_path / "beside" / "images" / "1.png").touch()
    tmp_path = tmp_path / "capture"
    tmp_path.mkdir()
    with pytest.raises(ForeignFileError, match=r"absolute path|leads out"):
        below(tmp_path, name)
