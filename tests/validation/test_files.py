"""Only regular files within a limit are opened, and databases only if they are whole."""

import os

import pytest

from r3jax.validation.errors import ForeignFileError
from r3jax.validation.files import (
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
    with pytest.raises(ForeignFileError, match="pipe: this is a pipe"):
        check_tree(tmp_path)
    os.remove(tmp_path / "deep" / "pipe")
    (tmp_path / "deep" / "link").symlink_to("nowhere")
    with pytest.raises(ForeignFileError, match="leads nowhere"):
        check_tree(tmp_path)
