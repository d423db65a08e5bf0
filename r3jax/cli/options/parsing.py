"""Command lines for the option classes: groups in boxes, examples, numbers as people write them."""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Callable, Collection
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

_GROUP = "group_of_options_"
"""Beginning of the names of the fields that hold groups."""

_DIGITS = 30
"""More than any setting needs; 1e999999999 is not written out."""


def parser_class(kind: type, *, with_examples: bool) -> type:
    """Makes the dataclass that tyro parses for a command.

    The fields that the command inherits from a class with a `TITLE` become one nested dataclass,
    which tyro shows in a box of its own; all others stay beside --help.

    Args:
        kind: the frozen dataclass of the options.
        with_examples: put its `EXAMPLES` behind its first words.
    """
    own: list[Any] = []
    groups: dict[str, list[Any]] = {
        base.TITLE: [] for base in kind.__mro__ if "TITLE" in vars(base)
    }
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        owner = next(base for base in kind.__mro__ if field.name in vars(base)["__annotations__"])
        hint = _described(hints[field.name], _docstrings(owner).get(field.name, ""))
        entry = (field.name, hint, dataclasses.field(default=field.default))
        title = vars(owner).get("TITLE")
        (own if title is None else groups[title]).append(entry)
    own.sort(key=lambda entry: entry[2].default is not dataclasses.MISSING)
    for number, (title, fields) in enumerate(groups.items()):
        group = _made(kind, fields)
        hint = Annotated[group, tyro.conf.arg(name=title)]
        own.append((f"{_GROUP}{number}", hint, dataclasses.field(default_factory=group)))
    made = _made(kind, own)
    made.__doc__ = inspect.cleandoc(kind.__doc__ or "")
    if with_examples:
        lines = "\n".join(f"    {line}" for line in getattr(kind, "EXAMPLES", ()))
        made.__doc__ += f"\n\nFor example\n{lines}"
    return made


def options_of(kind: type, parsed: Any) -> Any:
    """Makes the options of what tyro has parsed: inverse of the grouping."""
    values: dict[str, Any] = {}
    for name, value in vars(parsed).items():
        values |= vars(value) if name.startswith(_GROUP) else {name: value}
    return kind(**values)


def given_words(options: Any, names: Collection[str]) -> list[str]:
    """Writes options that differ from their defaults as words of a command line.

    Args:
        options: an instance of a command's options.
        names: fields to write; those that have no default are arguments, and left out.
    """
    words: list[str] = []
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        has_default = field.default is not dataclasses.MISSING
        if field.name not in names or not has_default or value == field.default:
            continue
        option = f"--{field.name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif str(value).startswith("-"):
            words.append(f"{option}={value}")
        else:
            words += [option, str(value)]
    return words


def _made(like: type, fields: list[Any]) -> type:
    made = dataclasses.make_dataclass(like.__name__, fields, frozen=True)
    made.__doc__ = ""  # else tyro would show the signature
    return made


def _described(hint: Any, text: str) -> Any:
    """A field's type with its help; None as a default says nothing, so it is not shown."""
    kinds = [arg for arg in get_args(hint) if arg is not NoneType]
    is_optional = get_origin(hint) in (Union, UnionType) and len(kinds) == 1
    metavar = None
    if is_optional and get_origin(kinds[0]) is Literal:
        metavar = f"{{{','.join(get_args(kinds[0]))}}}"
    elif is_optional and kinds[0] is Path:
        metavar = "PATH"
    more = tyro.conf.arg(help=text, help_behavior_hint=_default_shown, metavar=metavar)
    inner = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    return Annotated[(inner[0], more, *inner[1:])]


def _default_shown(default: str) -> str:
    return "" if default in ("None", "False", "") else f"(default: {default})"


def _docstrings(kind: type) -> dict[str, str]:
    """The strings below the fields of a class, each as one line."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(node, ast.ClassDef)
    found: dict[str, str] = {}
    for field, below in zip(node.body, node.body[1:], strict=False):
        match field, below:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(text.split())
            case _:
                pass
    return found


def number_rules() -> ConstructorRegistry:
    """What reads `int`, `float`, and either of them where None is the default."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_rule)
    return registry


def whole_number(text: str) -> int:
    """The whole number that a text stands for, as digits or as in 1e5.

    Raises:
        ValueError: it is none; says so in words.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("nan")
    if value.is_finite() and value.adjusted() < _DIGITS and int(value) == value:
        return int(value)
    raise ValueError(f"it takes one whole number, such as 512 or 1e5, got {text!r}")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"it takes one number, such as 0.05, got {text!r}") from None


_READERS: dict[Any, Callable[[str], int | float]] = {int: whole_number, float: _number}


def _rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    is_union = get_origin(info.type) in (Union, UnionType)
    kinds = set(get_args(info.type)) if is_union else {info.type}
    is_optional = NoneType in kinds
    kinds -= {NoneType}
    if len(kinds) != 1 or not kinds <= set(_READERS):
        return None
    kind: type = kinds.pop()
    read = _READERS[kind]

    def from_words(words: list[str]) -> int | float | None:
        return None if is_optional and words == ["None"] else read(words[0])

    name = kind.__name__.upper()
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=name,
        instance_from_str=from_words,
        is_instance=lambda value: isinstance(value, int | kind) or (is_optional and value is None),
        str_from_instance=lambda value: [str(value)],
    )
