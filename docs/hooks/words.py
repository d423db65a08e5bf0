"""Finds words that read translated: `python docs/hooks/words.py`, a part of `make lint`.

Looks at Markdown, at docstrings and comments of Python, and at the messages of the package. A line
that ends in `words: ok` is let through. Docstrings of public functions must begin with a verb: an
article, a question word or `True` is refused; properties and fields are named by nouns.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

INSTEAD = {
    r"whoever": "everybody who, any",
    r"anew": "again",
    r"so many": "the number of, up to",
    r"all the same": "anyway, equal",
    r"(?:goes|go|going|went) on behind": "resume after",
    r"nobody": "no one, not",
    r"asked (?:of|for)": "required, target",
    r"worth (?:a|so|more|less|nothing)": "gains, pays, utility",
    r"lacks?": "is missing, without, deficit",
    r"foresees?|foreseen": "predict",
    r"its kin": "name them",
    r"all over the place": "throughout",
    r"for ever": "forever, without end",
    r"who chooses": "the policy",
    r"what carries": "the robot, the platform",
    r"found no room": "was dropped",
    r"(?:frames?|captures?|captured|looks?|looking|plans?) on the way": "while moving",
}
"""Patterns, and what to write in their place."""

_PATTERN = re.compile(rf"\b(?:{'|'.join(INSTEAD)})\b", re.IGNORECASE)
_EXCEPTED = "words: ok"


_NO_VERB = {
    *("The", "A", "An", "What", "Which", "Who", "How", "Where", "Why", "True", "False", "Whether"),
    *("All", "Every", "One", "Some", "Each", "Something", "Nothing", "No", "Those", "That"),
}
"""First words of docstrings that describe a value in place of the function."""


def main() -> int:
    """Prints every finding; 1 if there are any."""
    found = 0
    for path in sorted(_files()):
        for number, word in _nouns(path):
            found += 1
            print(f"{path.relative_to(ROOT)}:{number}: {word!r}: begin with a verb")
    for path in sorted(_files()):
        for number, line in _prose(path):
            for match in _PATTERN.finditer(line):
                found += 1
                instead = next(v for k, v in INSTEAD.items() if re.fullmatch(k, match[0], re.I))
                print(f"{path.relative_to(ROOT)}:{number}: {match[0]!r}: say {instead}")
    return int(found > 0)


def _files() -> Iterator[Path]:
    for folder in ("r3jax", "docs", "examples", "experiments"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in {".py", ".md", ".html"} and "results" not in path.parts[:-1]:
                yield path
    yield from (ROOT / "docs" / "results").glob("*.md")
    yield from ROOT.glob("*.md")


def _prose(path: Path) -> Iterator[tuple[int, str]]:
    if path == Path(__file__):
        return
    text = path.read_text("utf-8")
    lines = text.splitlines()
    numbers = _prose_of(text, path) if path.suffix == ".py" else range(1, len(lines) + 1)
    for number in sorted(numbers):
        if not lines[number - 1].rstrip().endswith(_EXCEPTED):
            yield number, lines[number - 1]


def _prose_of(text: str, path: Path) -> set[int]:
    """Returns the lines with comments, docstrings and, in the package, messages."""
    numbers = {
        token.start[0]
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT
    }
    has_messages = (ROOT / "r3jax") in path.parents
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
            continue
        # A string with spaces is a message; docstrings, those of fields too, have some.
        if " " in node.value and (has_messages or "\n" in node.value or _is_docstring(node, text)):
            numbers |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return numbers


def _nouns(path: Path) -> Iterator[tuple[int, str]]:
    """Yields docstrings of public functions of the package that begin with no verb."""
    if path.suffix != ".py" or (ROOT / "r3jax") not in path.parents:
        return
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
            continue
        is_property = any("property" in ast.unparse(mark) for mark in node.decorator_list)
        first = (ast.get_docstring(node) or "").partition(" ")[0]
        if first in _NO_VERB and not is_property:
            yield node.body[0].lineno, first


def _is_docstring(node: ast.Constant, text: str) -> bool:
    return text.splitlines()[node.lineno - 1].lstrip().startswith('"""')


if __name__ == "__main__":
    sys.exit(main())
