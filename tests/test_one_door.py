"""Only `r3jax.files` creates, replaces, appends to and deletes files; all else calls it."""

import ast
from pathlib import Path

import pytest

import r3jax

ROOT = Path(r3jax.__file__).parent

METHODS = {"unlink", "rmdir", "rename", "touch", "mkdir", "write_text", "write_bytes"}
METHODS |= {"symlink_to", "hardlink_to", "chmod"}

OF_OS = {"remove", "unlink", "rename", "renames", "replace", "mkdir", "makedirs", "rmdir"}
OF_OS |= {"removedirs", "symlink", "link", "truncate", "mkfifo", "mknod", "open", "chmod"}
HARMLESS = {"shutil": {"which"}, "tempfile": {"gettempdir", "TemporaryFile"}}

EXCEPTIONS = {
    # PyAV seeks in what it writes: a file in a folder that `whole_folder` has just made.
    "apps/viewer/film.py": {"open"},
    # The null device, in the place of a pipe without a reader.
    "cli/main.py": {"open"},
    # A scratch folder of the system's, and links in it to the frames of a capture that grows.
    "cli/commands/audit.py": {"TemporaryDirectory"},
    "apps/audit/live/growing.py": {"mkdir", "write_text", "symlink_to", "unlink"},
}
"""Files that may do more than call `r3jax.files`, and what."""


def writes(source):
    """Names of the calls in a source that change something on the disk."""
    for call in ast.walk(ast.parse(source)):
        if not isinstance(call, ast.Call):
            continue
        function = call.func
        if isinstance(function, ast.Name):
            name, owner = function.id, ""
        elif isinstance(function, ast.Attribute):
            name = function.attr
            owner = function.value.id if isinstance(function.value, ast.Name) else "?"
        else:
            continue
        modes = [k.value for k in call.keywords if k.arg == "mode"] + call.args[:2]
        if (
            (owner and name in METHODS)
            or (owner == "os" and name in OF_OS)
            or (owner in HARMLESS and name not in HARMLESS[owner])
            or (owner and name == "replace" and len(call.args) == 1 and not call.keywords)
            or (name == "open" and any(map(is_writing, modes)))
        ):
            yield name


def is_writing(mode):
    """Whether an argument is a mode such as `wb`; a path is longer, or no constant."""
    text = mode.value if isinstance(mode, ast.Constant) else None
    return isinstance(text, str) and len(text) <= 3 and bool(set(text) & set("wax+"))


def test_nothing_else_writes():
    found = {}
    for path in ROOT.rglob("*.py"):
        name = path.relative_to(ROOT).as_posix()
        if name != "files.py" and (calls := set(writes(path.read_text()))):
            found[name] = calls
    assert found == EXCEPTIONS


@pytest.mark.parametrize(
    "source",
    [
        "path.unlink()",
        "(folder / 'a').rename(other)",
        "path.replace(other)",
        "os.replace(a, b)",
        "shutil.rmtree(a)",
        "open(path, 'w')",
        "path.open('xb')",
        "open(path, mode='r+')",
        "tempfile.mkdtemp()",
    ],
)
def test_what_writes_is_noticed(source):
    assert list(writes(source))


@pytest.mark.parametrize("source", ["a.replace('x', 'y')", "open(path)", "shutil.which('git')"])
def test_what_reads_is_not(source):
    assert not list(writes(source))
