"""Every back-quoted name of our own in docstrings and pages is the name of something that exists.

A text names modules, classes, functions, fields (`mapping.seen`, `MapState.count`) and files
(`kernels/native/ffi.py`). Names of other libraries, of variables and of runs on disk are not ours.
"""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "r3jax"
SOURCES = sorted(PACKAGE.rglob("*.py"))
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
DOTTED = re.compile(r"`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\([^`]*\))?`")
FILES = (".py", ".pyi", ".json", ".jsonl", ".html", ".txt", ".csv", ".ply", ".npz", ".png")
PYTHON_FILE = re.compile(r"`((?:[\w.-]+/)*\w+\.pyi?)`")

OTHERS = {
    "panorama_sfm.py": "of COLMAP",
    "my_policy.py": "a file of the reader's own",
    "Path.is_file": "of pathlib",
    "view.rows": "a variable",
}
"""Names in texts that look like ours, and are not."""


@functools.cache
def members() -> dict[str, set[str]]:
    """Names in every module and class, by their dotted names without `r3jax`."""
    found: dict[str, set[str]] = {"": set()}
    for path in SOURCES:
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        for i in range(len(parts)):
            found.setdefault(".".join(parts[:i]), set()).add(parts[i])
        _collect(ast.parse(path.read_text(encoding="utf-8")), ".".join(parts), found)
    for stub in PACKAGE.rglob("*.pyi"):
        folder = ".".join(stub.relative_to(PACKAGE).parts[:-1])
        _collect(ast.parse(stub.read_text(encoding="utf-8")), folder, found)
    return found


def _collect(tree: ast.Module | ast.ClassDef, name: str, found: dict[str, set[str]]) -> None:
    here = found.setdefault(name, set())
    for node in tree.body if isinstance(tree, ast.ClassDef) else ast.walk(tree):
        match node:
            case ast.ClassDef():
                here.add(node.name)
                _collect(node, node.name, found)
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                here.add(node.name)
            case ast.Import() | ast.ImportFrom():
                here.update(alias.asname or alias.name for alias in node.names)
            case ast.Name(ctx=ast.Store()):
                here.add(node.id)
            case ast.Assign() | ast.AnnAssign():
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                here.update(name.id for t in targets for name in ast.walk(t) if _is_name(name))
            case _:
                pass
    if isinstance(tree, ast.ClassDef):
        inner = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
        here.update(n.attr for n in inner if isinstance(n.value, ast.Name) and n.value.id == "self")
        bases = {name for base in tree.bases for name in re.findall(r"\w+", ast.unparse(base))}
        found.setdefault(f"bases of {tree.name}", set()).update(bases)


def _is_name(node: ast.AST) -> bool:
    return isinstance(node, ast.Name)


def exists(name: str, folder: str) -> bool:
    """True for a name in the package, or one that does not begin with anything of ours."""
    parts = name.removeprefix("r3jax.").split(".")
    starts = [*_packages_above(folder), *(m for m in members() if m.endswith(f".{parts[0]}"))]
    known = [start for start in starts if parts[0] in members()[start]]
    modules = [start for start in starts if start.rpartition(".")[2] == parts[0]]
    is_ours = known or modules or parts[0] in members()
    if not is_ours or name.startswith("self."):
        return not name.startswith("r3jax.")
    chains = [(start, parts) for start in known] + [(start, parts[1:]) for start in modules]
    return any(_has(start, chain) for start, chain in [*chains, (parts[0], parts[1:])])


def _packages_above(folder: str) -> list[str]:
    parts = folder.split(".") if folder else []
    return [".".join(parts[:i]) for i in range(len(parts), -1, -1)]


def _has(place: str, parts: list[str]) -> bool:
    """Follows attributes; what a function returns or an instance holds is not known."""
    if not parts:
        return place in members()
    if place not in members():
        return False
    bases = members().get(f"bases of {place}", set()) & members().keys()
    if parts[0] not in members()[place]:
        return any(_has(base, parts) for base in bases)
    inner = f"{place}.{parts[0]}".lstrip(".")
    if inner not in members() and parts[0] not in members():
        return True  # a function, a constant, an instance
    rest = parts[1:]
    return not rest or any(_has(p, rest) for p in (inner, parts[0]) if p in members())


def docstrings(path: Path) -> Iterator[str]:
    """Every string that stands as a statement of its own, and the comments."""
    source = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield str(node.value.value)
    yield from re.findall(r"^\s*#.*$", source, re.MULTILINE)


def stale_names(text: str, folder: str) -> list[str]:
    names = [name for name in DOTTED.findall(text) if not name.endswith((*FILES, ".NAME"))]
    stale = [name for name in names if not exists(name, folder)]
    near = (ROOT, PACKAGE, ROOT / "docs", PACKAGE / folder.replace(".", "/"))
    for name in PYTHON_FILE.findall(text):
        is_there = any((place / name).exists() for place in near)
        if not is_there and not any(f"/{path}".endswith(f"/{name}") for path in _files()):
            stale.append(name)
    return [name for name in stale if name not in OTHERS]


@functools.cache
def _files() -> list[str]:
    roots = ("r3jax", "tests", "experiments", "docs", "examples")
    return [path.as_posix() for root in roots for path in (ROOT / root).rglob("*.py*")]


def test_docstrings_name_what_exists():
    found = []
    for path in SOURCES:
        folder = ".".join(path.relative_to(PACKAGE).parts[:-1])
        for text in docstrings(path):
            found += [f"{path.relative_to(ROOT)}: {name}" for name in stale_names(text, folder)]
    assert not found, "\n".join(found)


def test_pages_name_what_exists():
    found = []
    for path in PAGES:
        names = stale_names(path.read_text(encoding="utf-8"), "")
        found += [f"{path.relative_to(ROOT)}: {name}" for name in names]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("name", "is_there"),
    [
        ("mapping.state.MapState", True),
        ("MapState.count", True),
        ("r3jax.MapState", True),
        ("jax.numpy", True),
        ("mapping.no_such_module", False),
        ("MapState.no_such_field", False),
        ("r3jax.no_such_name", False),
    ],
)
def test_a_stale_name_is_noticed(name, is_there):
    assert exists(name, "") == is_there
