"""Counts the house for `docs/architecture.md`: files, lines, names used twice, the walks.

    python -m docs.figures.house

Walks are lists between `<!-- walk: NAME -->` and the next blank line of that page; each step begins
with the dotted name of what it calls.
"""

import ast
import importlib
import io
import re
import tokenize
from collections import Counter, defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "architecture.md"
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip
_WALK = re.compile(r"<!-- walk: (.+?) -->\n\n?((?:.*\S.*\n)+)")
_STEP = re.compile(r"^(?:\d+\.|-) `(r3jax\.[\w.]+)`", re.MULTILINE)


def lines_of_code(source: str) -> int:
    """Counts lines without blanks, comments and docstrings."""
    docs: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docs.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docs)


def table(root: Path) -> list[str]:
    """Returns Markdown rows of files, lines and lines of code by folder."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for path in sorted(root.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        folder = path.relative_to(root).parts[0]
        numbers = (1, len(source.splitlines()), lines_of_code(source))
        for name in (f"{folder}/" if (root / folder).is_dir() else folder, "all"):
            counts[name] = [a + b for a, b in zip(counts[name], numbers, strict=True)]
    rows = ["| folder | files | lines | lines of code |", "|---|---|---|---|"]
    names = [*sorted(counts.keys() - {"all"}), "all"]
    return rows + ["| " + " | ".join([n, *(f"{c:,}" for c in counts[n])]) + " |" for n in names]


def imports(root: Path) -> dict[str, set[str]]:
    """Returns for each module of the package the modules that import it."""
    files = {_module(path): path for path in root.rglob("*.py")}
    found: dict[str, set[str]] = {name: set() for name in files}
    for name, path in files.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            targets: list[str] = []
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                targets = [t if t in files else node.module for t in inner]
            for target in targets:
                if target in found and target != name:
                    found[target].add(name)
    return found


def _module(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def names_used_twice(root: Path) -> dict[str, list[str]]:
    """Returns names of classes, and of modules, that the package uses more than once."""
    classes: Counter[str] = Counter()
    modules: Counter[str] = Counter()
    for path in root.rglob("*.py"):
        if path.stem != "__init__":
            modules[path.stem] += 1
        tree = ast.parse(path.read_text(encoding="utf-8"))
        classes.update(n.name for n in tree.body if isinstance(n, ast.ClassDef))
    twice = lambda counter: sorted(name for name, count in counter.items() if count > 1)
    return {"classes": twice(classes), "modules": twice(modules)}


def read_walks() -> dict[str, list[str]]:
    """Returns the steps of every walk of the page, as dotted names."""
    text = PAGE.read_text(encoding="utf-8")
    return {name: _STEP.findall(steps) for name, steps in _WALK.findall(text)}


def exists(name: str) -> bool:
    """Returns True if a dotted name is that of a module, or of something in one."""
    parts = name.split(".")
    for i in range(len(parts), 0, -1):
        try:
            place = importlib.import_module(".".join(parts[:i]))
        except ModuleNotFoundError:
            continue
        for part in parts[i:]:
            fields = getattr(place, "__dataclass_fields__", {})
            if not hasattr(place, part) and part not in fields:
                return False
            place = getattr(place, part, None)
        return True
    return False


def main() -> None:
    """Prints the tables and the names, and each step of a walk that is gone."""
    for root in ("r3jax", "tests", "experiments"):
        print(f"\n## {root}\n", *table(ROOT / root), sep="\n")
    for kind, names in names_used_twice(ROOT / "r3jax").items():
        print(f"\n{kind} whose name is used twice: {len(names)}: {', '.join(names)}")
    lone = sorted(name for name, users in imports(ROOT / "r3jax").items() if len(users) == 1)
    print(f"\nmodules that one other imports: {len(lone)}\n", *lone, sep="\n")
    for name, steps in read_walks().items():
        files = {step.rpartition(".")[0] for step in steps}
        print(f"\nwalk of {name}: {len(steps)} steps in {len(files)} modules")
        print(*(f"  gone: {step}" for step in steps if not exists(step)), sep="\n")


if __name__ == "__main__":
    main()
