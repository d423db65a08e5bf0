"""The one door to what this package creates, replaces, appends to, locks and deletes.

A folder of ours holds `.r3jax/`: a marker with our name and the folder's kind, and beside it the
files that are being written. Below the topmost folder with a marker every folder is opened from a
handle of the one above, and never through a link; above it, links are the user's own. What earlier
versions wrote without a marker is known by its content. A file's name alone makes nothing ours.
"""

import contextlib
import errno
import functools
import glob
import os
import secrets
import shutil
import stat
import warnings
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Literal, NamedTuple

Kind = Literal[
    "run", "team", "model", "training", "audit", "benchmark", "cell", "site", "planner",
    "selection", "tile-folder",
]  # fmt: skip

MARKER = ".r3jax"
"""Folder in a folder of ours."""

_NOTE = "marker"
_TEXT = """r3jax {kind}

This folder is written by r3jax, which knows it by this file. Beside this file lies what is being
written, or what was when its process was killed: it may be deleted.
"""

_MARKS: dict[Kind, tuple[tuple[str, tuple[bytes, ...]], ...]] = {
    "run": (("run.json", (b'"r3jax-run"',)),),
    "team": (("0/run.json", (b'"r3jax-run"', b'"team"')),),
    "model": (
        ("train.json", (b'"train_views"', b'"packages"')),
        ("checkpoints/training.json", (b'"views_hash"',)),
    ),
    "training": (("training.json", (b'"views_hash"',)),),
    "audit": (("audit.json", (b'"pictures_used"', b'"depth_from"')),),
    "benchmark": (
        ("cells/*/cell.json", (b'"exploration"', b'"test_views"')),
        ("photos/*.json", (b'"chooser"', b'"capture"')),
    ),
    "planner": (("planner.json", (b'"r3jax-planner"',)),),
    "cell": (("cell.json", (b'"exploration"', b'"test_views"')),),
    "selection": (),
    "tile-folder": (),
    "site": (
        ("index.html", (b'<meta name="generator" content="r3jax benchmark">',)),
        ("index.html", (b"</style></head><body>\n<h1>r3jax benchmark</h1>\n",)),
    ),
}
"""What a file of a folder holds that was written before there were markers."""

_LARGEST = 64 << 20
"""Nothing that holds marks is larger [bytes]."""

_HAS_HANDLES = os.open in os.supports_dir_fd and hasattr(os, "O_NOFOLLOW")
_PLAIN = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_NO_LINK = _PLAIN | getattr(os, "O_NOFOLLOW", 0)
_FOLDER = _PLAIN | getattr(os, "O_DIRECTORY", 0)


class NotOursError(OSError):
    """A path at which something lies that this package did not make, or that is a link."""

    def __init__(self, path: Path, reason: str):
        """Takes the path, and in words what lies there and what to do."""
        super().__init__(errno.EEXIST, reason, str(path))
        self.path, self.reason = path, reason

    def __str__(self) -> str:
        return f"{self.path}: {self.reason}"


class _Opened(NamedTuple):
    """An open folder; without a handle where the platform has none (Windows)."""

    path: Path
    handle: int | None

    def at(self, name: str) -> str:
        """Returns the name of a file in it, also for calls that are given the handle."""
        return name if self.handle is not None else str(self.path / name)


@contextlib.contextmanager
def _opened(folder: Path, *, make: bool = False) -> Generator[_Opened]:
    """Opens a folder; below our own folders never through a link.

    Raises:
        NotOursError: a link or a file is in the way.
        OSError: not there, or not permitted.
    """
    folder = folder.absolute()
    root = (_marked(folder) or [folder])[-1]
    if make:
        os.makedirs(root, exist_ok=True)
    with contextlib.ExitStack() as stack:
        opened = _Opened(root, _handle(stack, str(root), None))
        for name in folder.relative_to(root).parts:
            path, inside = opened.path / name, opened.at(name)
            if make:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(inside, dir_fd=opened.handle)
            if is_link(path):
                raise NotOursError(path, "is a link, through which nothing is written: remove it")
            opened = _Opened(path, _handle(stack, inside, opened.handle))
        yield opened


def _handle(stack: contextlib.ExitStack, name: str, above: int | None) -> int | None:
    if not _HAS_HANDLES:
        return None
    # A link that has come since it was looked for is refused here.
    handle = os.open(name, _FOLDER if above is None else _FOLDER | _NO_LINK, dir_fd=above)
    stack.callback(os.close, handle)
    return handle


def is_link(path: Path) -> bool:
    """Returns whether a path is a link itself, or a junction of Windows."""
    return path.is_symlink() or getattr(os.path, "isjunction", lambda _: False)(path)


def _marked(folder: Path) -> list[Path]:
    """Finds the folders of ours that contain a folder, itself first."""
    return [at for at in (folder, *folder.parents) if kind_of(at) is not None]


def kind_of(folder: Path) -> str | None:
    """Reads the kind of a folder of ours from its marker; None without one."""
    note = folder / MARKER / _NOTE
    try:
        descriptor = os.open(note, os.O_RDONLY | _NO_LINK | getattr(os, "O_NONBLOCK", 0))
        with open(descriptor, "rb") as file:
            words = file.read(64).split()
    except OSError:
        return None
    is_ours = len(words) > 1 and words[0] == b"r3jax" and not is_link(note.parent)
    return words[1].decode("ascii", "replace") if is_ours else None


def check_own(folder: Path, kind: Kind, remedy: str = "give another folder") -> None:
    """Refuses a folder that is neither new nor ours, and of the same kind; touches nothing.

    Empty files and folders are no obstacle: nothing is lost with them.

    Args:
        folder: that is to be written.
        kind: kind of the content to be written there.
        remedy: what the user can do.

    Raises:
        NotOursError: something else is there.
        OSError: it cannot be read.
    """
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise NotOursError(folder, f"is a file, where a folder is needed: {remedy}")
    if is_own(folder, kind) or (kind_of(folder) is None and _is_void(folder)):
        return
    article = "an" if kind == "audit" else "a"
    raise NotOursError(folder, f"holds something that is not {article} {kind}: {remedy}")


def is_own(folder: Path, kind: Kind) -> bool:
    """Checks whether a folder is ours: by its marker, or without one by its content."""
    found = kind_of(folder)
    if found is not None:
        return found == kind
    return any(
        holds(path, *marks) for pattern, marks in _MARKS[kind] for path in folder.glob(pattern)
    )


def holds(path: Path, *marks: bytes) -> bool:
    """Checks whether a path is a regular file, not a link, that contains all of these bytes."""
    try:
        found = os.lstat(path)
        if not stat.S_ISREG(found.st_mode) or found.st_size > _LARGEST:
            return False
        content = path.read_bytes()
    except OSError:
        return False
    return all(mark in content for mark in marks)


def _is_void(folder: Path) -> bool:
    return all(
        not is_link(path) and (path.is_dir() or (path.is_file() and not path.stat().st_size))
        for path in folder.rglob("*")
    )


def own_folder(folder: Path, kind: Kind, remedy: str = "give another folder") -> None:
    """Makes a folder ours, if it is not yet: from now on it is known by its marker.

    Raises:
        NotOursError: as `check_own`; or a link is in the way.
        OSError: it cannot be made.
    """
    check_own(folder, kind, remedy)
    make_folder(folder / MARKER)
    if kind_of(folder) == kind:
        return
    # Only an empty file can be there: of a process that was killed in between.
    with _opened(folder / MARKER) as opened:
        flags = os.O_WRONLY | os.O_CREAT | _NO_LINK
        descriptor = os.open(opened.at(_NOTE), flags, 0o666, dir_fd=opened.handle)
        with open(descriptor, "wb") as file:
            file.write(_TEXT.format(kind=kind).encode())


def disown_folder(folder: Path) -> None:
    """Takes the marker out, and whatever a killed process left beside it; never through a link."""
    if not is_link(folder) and kind_of(folder) is not None:
        clear_partial(folder)
        remove_own(folder, [f"{MARKER}/{_NOTE}"])


def clear_partial(folder: Path) -> None:
    """Deletes what lies unfinished beside the marker; only who holds the folder's lock may.

    Raises:
        OSError: not permitted.
    """
    if kind_of(folder) is None:
        return
    for path in (folder / MARKER).iterdir():
        if path.is_dir() and not is_link(path):
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != _NOTE:
            remove(path)


def make_folder(folder: Path) -> None:
    """Makes a folder and those above it; below our own folders never through a link.

    Raises:
        NotOursError: a link is in the way.
        OSError: not permitted; a file is in the way.
    """
    with _opened(folder, make=True):
        pass


def _workshop(path: Path) -> Path:
    """Returns where a file is written before it gets its name.

    That is beside the marker of the folder it is in.
    """
    marked = _marked(path.absolute().parent)
    return marked[0] / MARKER if marked else path.parent


def _partial_name(path: Path) -> str:
    return f".{path.name}.{secrets.token_hex(4)}.partial"


def write_atomic(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Writes a file under a temporary name, flushes it to the disk, then renames it.

    A reader sees the old file or the new one, never a part. Of several writers at once, the last
    to rename wins; each has a temporary name of its own, on whatever machine it runs. A link or a
    hard link of that name is replaced; what it leads to stays as it is.

    Args:
        path: the file.
        data: its content.
        durable: False for a file that need not survive a power cut: nothing is flushed.

    Raises:
        NotOursError: a folder on the way is a link.
        OSError: the disk is full, not writable, ...; nothing is left behind then.
    """
    with _opened(path.parent) as folder, _opened(_workshop(path)) as shop:
        temporary = shop.at(_partial_name(path))
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_LINK
        descriptor = os.open(temporary, flags, 0o666, dir_fd=shop.handle)
        try:
            with open(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            name = folder.at(path.name)
            os.replace(temporary, name, src_dir_fd=shop.handle, dst_dir_fd=folder.handle)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary, dir_fd=shop.handle)
            raise


def place_link(path: Path, target: Path) -> bool:
    """Makes a symbolic link under a temporary name, then renames it; False where links cannot be.

    Raises:
        NotOursError: a folder on the way is a link.
        OSError: the folder is not writable, ...
    """
    with _opened(path.parent) as folder, _opened(_workshop(path)) as shop:
        temporary = shop.at(_partial_name(path))
        try:
            os.symlink(target, temporary, dir_fd=shop.handle)
        except (NotImplementedError, PermissionError):  # Windows without the privilege
            return False
        name = folder.at(path.name)
        os.replace(temporary, name, src_dir_fd=shop.handle, dst_dir_fd=folder.handle)
    return True


PNG_MARK = b"tEXtSoftware\x00r3jax"
"""What every picture of ours holds: it may be replaced by the next."""


def check_replaceable(path: Path, mark: bytes) -> None:
    """Refuses a file that the user named, if one is there that does not hold our mark.

    Raises:
        NotOursError: something else is there.
    """
    if os.path.lexists(path) and not holds(path, mark):
        raise NotOursError(
            path, "something is there that r3jax did not write: give another name, or remove it"
        )


@contextlib.contextmanager
def whole_folder(path: Path) -> Generator[Path]:
    """Yields an empty folder that gets its name when the block ends, and is deleted if it fails.

    Raises:
        NotOursError: see `check_vacant`; another process may have been faster.
        OSError: it cannot be made.
    """
    path = path.absolute()  # "." has no name
    make_folder(path.parent)
    partial = _workshop(path) / _partial_name(path)
    with _opened(partial.parent) as shop:
        os.mkdir(shop.at(partial.name), dir_fd=shop.handle)
    try:
        yield partial
        check_vacant(path)
        with _opened(partial.parent) as shop, _opened(path.parent) as folder:
            if not _HAS_HANDLES and path.is_dir():  # Windows replaces no empty folder
                path.rmdir()
            old, new = shop.at(partial.name), folder.at(path.name)
            os.rename(old, new, src_dir_fd=shop.handle, dst_dir_fd=folder.handle)
    except OSError:
        check_vacant(path)  # in a moment between, another process may have been faster
        raise
    finally:
        # Libraries may have made names of their own from this one, which is unique.
        for left in partial.parent.glob(f"{glob.escape(partial.name)}*"):
            shutil.rmtree(left, ignore_errors=True)


def check_vacant(path: Path) -> None:
    """Refuses a path where something is, but for an empty folder.

    Raises:
        NotOursError: something is there.
    """
    if os.path.lexists(path) and (is_link(path) or not path.is_dir() or any(path.iterdir())):
        raise NotOursError(path, "something is there already, not an empty folder: give another")


def append_line(path: Path, line: str) -> None:
    """Appends one line and flushes it to the disk; a failed append is taken back.

    A file that has other names (hard links, as `cp -al` makes them) is copied first, so that only
    this one changes.

    Raises:
        NotOursError: the file is a link or no regular file, or a folder on the way is a link.
        OSError: the disk is full, not writable, ...
    """
    with _opened(path.parent) as folder:
        if is_link(path):
            raise NotOursError(path, "is a link, through which nothing is written: remove it")
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | _NO_LINK
        descriptor = os.open(folder.at(path.name), flags, 0o666, dir_fd=folder.handle)
    with open(descriptor, "ab+") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise NotOursError(path, "is a pipe or a device, a file should be here: remove it")
        before, data = found.st_size, line.encode() + b"\n"
        if found.st_nlink == 1:
            try:
                file.write(data)
                file.flush()
                os.fsync(descriptor)
            except BaseException:
                # A torn line would hide behind the next one; readers skip only the last line.
                os.truncate(descriptor if os.truncate in os.supports_fd else path, before)
                raise
            return
        file.seek(0)
        data = file.read() + data
    write_atomic(path, data)


def remove(path: Path) -> None:
    """Deletes a file, or a link itself; one that is not there is no error.

    Raises:
        NotOursError: a folder on the way is a link.
        OSError: not permitted; a folder.
    """
    with contextlib.suppress(FileNotFoundError), _opened(path.parent) as folder:
        os.unlink(folder.at(path.name), dir_fd=folder.handle)


def remove_own(folder: Path, patterns: Iterable[str]) -> None:
    """Deletes files of a folder of ours by their names, then the folders that have become empty.

    Args:
        folder: where to look.
        patterns: what to delete, relative to it, such as `frames/*.png`. Nothing is deleted
            through a link; a link of such a name is deleted, what it leads to is not.

    Raises:
        OSError: not permitted.
    """
    root = folder.resolve()
    found = [path for pattern in patterns for path in root.glob(pattern)]
    found = [path for path in found if path.parent.resolve() == path.parent]
    for path in found:
        if is_link(path) or not path.is_dir():
            remove(path)
    folders = {parent for path in found for parent in path.parents if root in parent.parents}
    folders |= {path for path in found if path.is_dir() and not is_link(path)}
    for path in sorted(folders, key=lambda path: len(path.parts), reverse=True):
        with contextlib.suppress(OSError), _opened(path.parent) as above:
            os.rmdir(above.at(path.name), dir_fd=above.handle)  # unless the user keeps something


def sync_folder(folder: Path) -> None:
    """Makes the names in a folder survive a power cut, where the platform can."""
    with _opened(folder) as opened:
        if opened.handle is not None:
            os.fsync(opened.handle)


def lock_folder(folder: Path) -> contextlib.ExitStack:
    """Takes the lock of a folder, a file `lock` in it: see `lock_file`."""
    return lock_file(folder / "lock")


def lock_file(path: Path, *, wait: bool = False) -> contextlib.ExitStack:
    """Takes a lock; closing it frees the lock, and so does the end of the process.

    The file is made if it is not there; nothing is written into it.

    Args:
        path: the file.
        wait: until it is free.

    Raises:
        BlockingIOError: another process, or another part of this one, holds it.
        OSError: the file cannot be opened for writing, or is a link.
    """
    with contextlib.ExitStack() as held:
        # For reading too: a pipe of that name would wait for a reader.
        flags = os.O_RDWR | os.O_CREAT | _NO_LINK
        with _opened(path.parent) as folder:
            descriptor = os.open(folder.at(path.name), flags, 0o666, dir_fd=folder.handle)
        held.callback(os.close, descriptor)
        try:
            is_taken = _locker()(descriptor, blocking=wait)
        except OSError as error:
            if error.errno != errno.ENOSYS:
                raise
            is_taken = True
            _say_unlocked()
        if not is_taken:
            raise BlockingIOError(errno.EAGAIN, "it is locked by another process", str(path))
        return held.pop_all()


@functools.cache
def _locker() -> Callable[..., bool]:
    with warnings.catch_warnings(action="ignore"):  # of locks that outlive their process
        from filelock import lock_descriptor
    return lock_descriptor


@functools.cache
def _say_unlocked() -> None:
    warnings.warn(
        "this platform has no file locks: do not write one folder from two processes",
        RuntimeWarning,
        stacklevel=2,
    )
