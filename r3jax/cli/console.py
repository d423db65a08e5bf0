"""How the commands print: text that may come from a file or a name is shown, never obeyed.

Only this module imports rich, whose own classes read square brackets in any string as markup.
"""

import shlex
from typing import Any

import rich.console
import rich.progress
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.status import Status
from rich.table import Table
from rich.text import Text

from r3jax.cli.errors import printable
from r3jax.interrupts import check_interrupt

__all__ = [
    "BarColumn",
    "Console",
    "Progress",
    "SpinnerColumn",
    "Table",
    "TaskID",
    "Text",
    "TextColumn",
    "TimeElapsedColumn",
    "TimeRemainingColumn",
    "progress_bar",
]


class Console(rich.console.Console):
    """A terminal or a log that takes every string as it is; styled text is a `Text`."""

    def __init__(self, **settings: Any):
        """Takes rich's settings, of which `stderr=True` is the one that matters."""
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def say(self, text: str, style: str = "") -> None:
        """Prints text on one line however long it is: paths must stay whole for copying."""
        self.print(text, style=style or None, soft_wrap=True)

    def next(self, command: str, *words: object) -> None:
        """Names the command that comes next, to be copied into a shell."""
        self.say(f"next      r3jax {shlex.join([command, *map(str, words)])}")

    def render_str(self, text: str, **settings: Any) -> Text:
        """Makes rich's text of a string: all that is printed comes through here."""
        return super().render_str(printable(text), **settings)

    def status(self, status: rich.console.RenderableType, **settings: Any) -> Status:
        """Shows a spinner with a line beside it."""
        return _Status(_as_it_is(status), console=self, **settings)


class _Status(Status):
    """A spinner; rich would read its line as markup."""

    def update(self, status: rich.console.RenderableType | None = None, **settings: Any) -> None:
        """Replaces the line; a Ctrl-C that got lost is obeyed."""
        check_interrupt()
        super().update(None if status is None else _as_it_is(status), **settings)


def _as_it_is(what: rich.console.RenderableType) -> rich.console.RenderableType:
    return Text(printable(what)) if isinstance(what, str) else what


class TextColumn(rich.progress.TextColumn):
    """What a bar says of its task, as it is."""

    def __init__(self, text_format: str, style: str = "none"):
        """Takes a format over `task` and one style for all of it."""
        super().__init__(text_format, style=style, markup=False)

    def render(self, task: rich.progress.Task) -> Text:
        """Makes the text of a task."""
        return Text(printable(self.text_format.format(task=task)), style=self.style)


def progress_bar(console: Console, *columns: ProgressColumn, transient: bool = False) -> Progress:
    """A bar that shows on a terminal only."""
    return Progress(*columns, console=console, disable=not console.is_terminal, transient=transient)
