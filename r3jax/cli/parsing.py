"""Reads a command line into the dataclass of a command's options.

A nested dataclass is a group of options, shown in a box of its own; a config of the library is
one, too (`FieldsOf`). What a dataclass refuses in its `__post_init__` ends here as a usage error.
"""

import ast
import dataclasses
import functools
import inspect
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from r3jax.cli.errors import one_line
from r3jax.errors import InputError

_DIGITS = 30
"""More than any setting needs; 1e999999999 is not written out."""


class _Refused(Exception):
    """Carries a refusal through tyro, which would print a usage message for a ValueError."""


def parse(commands: Mapping[str, type], words: Sequence[str], description: str) -> Any:
    """Reads the words after `r3jax`, of which the first is a command.

    Args:
        commands: the dataclass of the options of each command. The first paragraph of its
            docstring describes it in the list of commands, all of it in its own help.
        words: the command line.
        description: what the program does.

    Returns:
        An instance of one of the dataclasses. `--help` and words that cannot be read end the
        process, as `argparse` does.

    Raises:
        InputError: a value that an option's dataclass refuses.
    """
    is_list = not words or words[0] not in commands
    for option, where in getattr(commands.get(words[0] if words else ""), "RETIRED", {}).items():
        if any(word.partition("=")[0] == option for word in words):
            raise InputError(f"{option} has left `r3jax {words[0]}`: {where}")
    kinds: list[Any] = []
    for name, kind in commands.items():
        text = inspect.cleandoc(kind.__doc__ or "")
        text = text.partition("\n\n")[0] if is_list else text
        told = tyro.conf.subcommand(name, description=text, prefix_name=False)
        kinds.append(Annotated[(kind, told)])
    union: Any = Union[tuple(kinds)]  # noqa: UP007
    try:
        return tyro.cli(
            union,
            prog="r3jax",
            description=description,
            args=words,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
            registry=_registry(),
        )
    except _Refused as error:
        raise InputError(str(error)) from error


class FieldsOf:
    """Marks a config of the library, some fields of which are options.

    Their types, defaults and docstrings are the config's own; other fields stay at their defaults.
    `Annotated[ExplorationConfig, FieldsOf("clock")]` is a group with the option `--clock`.
    """

    def __init__(self, *names: str):
        """Takes the names of the fields."""
        self.names = names


def flat(options: Any) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
    """Lists the fields of some options with their values, those of nested groups in their place."""
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            yield from flat(value)
        else:
            yield field, value


def settings_for(kind: type, options: Any, **others: Any) -> dict[str, Any]:
    """Takes from options the values whose names are fields of a config; others go before them."""
    names = {field.name for field in dataclasses.fields(kind)}
    return {field.name: value for field, value in flat(options) if field.name in names} | others


def given_words(options: Any, names: Collection[str] | None = None) -> list[str]:
    """Writes options that differ from their defaults as words of a command line.

    Args:
        options: an instance of a command's options.
        names: fields to write; None: all. Those that have no default are arguments, and left out.
    """
    words: list[str] = []
    for field, value in flat(options):
        has_default = field.default is not dataclasses.MISSING
        if (names is not None and field.name not in names) or not has_default:
            continue
        if value == field.default:
            continue
        option = f"--{field.name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif str(value).startswith("-"):
            words.append(f"{option}={value}")
        else:
            words += [option, str(value)]
    return words


def _registry() -> ConstructorRegistry:
    registry = ConstructorRegistry()
    registry.primitive_rule(_number_rule)
    registry.struct_rule(_group_rule)
    return registry


def _group_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Makes options of the fields of a dataclass; its refusals are usage errors."""
    kind: Any = getattr(info.type, "config", info.type)
    if not dataclasses.is_dataclass(kind) or kind.__module__.startswith("tyro."):
        return None
    hints, texts = get_type_hints(kind, include_extras=True), _docstrings(kind)
    names = getattr(info.type, "names", None)
    fields = [
        StructFieldSpec(
            name=field.name,
            type=_described(hints[field.name], texts.get(field.name, "")),
            default=_default_of(field),
        )
        for field in dataclasses.fields(kind)
        if names is None or field.name in names
    ]

    def make(**values: Any) -> Any:
        try:
            return kind(**values)  # pyright: ignore[reportCallIssue]
        except (InputError, OSError) as error:
            raise _Refused(one_line(error)) from error

    return StructConstructorSpec(make, tuple(fields))


def _default_of(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return tyro.MISSING_NONPROP  # a group: its fields have their own
    return tyro.MISSING_NONPROP if field.default is dataclasses.MISSING else field.default


def _described(hint: Any, text: str) -> Any:
    """Adds help to a field's type; a default of None is not shown, as it says nothing."""
    inner = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    if dataclasses.is_dataclass(inner[0]):
        for marker in inner[1:]:
            if isinstance(marker, FieldsOf):
                part = type("Part", (), {"config": inner[0], "names": marker.names})
                return Annotated[(part, *inner[1:])]
        return hint
    kinds = [arg for arg in get_args(inner[0]) if arg is not NoneType]
    is_optional = get_origin(inner[0]) in (Union, UnionType) and len(kinds) == 1
    metavar = None
    if is_optional and get_origin(kinds[0]) is Literal:
        metavar = f"{{{','.join(get_args(kinds[0]))}}}"
    elif is_optional and kinds[0] in (Path, str):
        metavar = "PATH" if kinds[0] is Path else "TEXT"
    more = tyro.conf.arg(help=text, help_behavior_hint=_default_shown, metavar=metavar)
    return Annotated[(inner[0], more, *inner[1:])]


def _default_shown(default: str) -> str:
    return "" if default in ("None", "False", "") else f"(default: {default})"


@functools.cache
def _docstrings(kind: type) -> dict[str, str]:
    """Collects the strings below the fields of a class and its bases, each as one line."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(node, ast.ClassDef)
        for field, below in zip(node.body, node.body[1:], strict=False):
            match field, below:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    found[name] = " ".join(text.split())
                case _:
                    pass
    return found


def whole_number(text: str) -> int:
    """Reads a whole number, as digits or as in 1e5.

    Raises:
        ValueError: it is none; says so in words.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("nan")
    if value.is_finite() and value.adjusted() < _DIGITS and int(value) == value:
        return int(value)
    raise InputError(f"expects one whole number, such as 512 or 1e5, got {text!r}")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"expects one number, such as 0.05, got {text!r}") from None


_READERS: dict[Any, Callable[[str], int | float]] = {int: whole_number, float: _number}


def _number_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Reads `int`, `float`, and either of them where None is the default."""
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
