"""How the commands print: safe text, tables, and progress on a terminal or in a log.

Only this module imports rich, whose own classes read square brackets in any string as markup. All
long loops report here between their steps, where a pending Ctrl-C is handled.
"""

import shlex
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

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
from r3jax.exploration.config import Budget
from r3jax.exploration.taken_views import StepRow
from r3jax.interrupts import check_interrupt

__all__ = [
    "BarColumn",
    "Console",
    "SpinnerColumn",
    "Table",
    "TaskID",
    "Text",
    "TextColumn",
    "progress_bar",
]


class Console(rich.console.Console):
    """A terminal or a log that prints every string literally; styled text is a `Text`."""

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
        """Replaces the line, and handles a pending Ctrl-C."""
        check_interrupt()
        super().update(None if status is None else _as_it_is(status), **settings)


def _as_it_is(what: rich.console.RenderableType) -> rich.console.RenderableType:
    return Text(printable(what)) if isinstance(what, str) else what


class TextColumn(rich.progress.TextColumn):
    """A column of a bar that prints its text literally."""

    def __init__(self, text_format: str, style: str = "none"):
        """Takes a format over `task` and one style for all of it."""
        super().__init__(text_format, style=style, markup=False)

    def render(self, task: rich.progress.Task) -> Text:
        """Makes the text of a task."""
        return Text(printable(self.text_format.format(task=task)), style=self.style)


def progress_bar(console: Console, *columns: ProgressColumn, transient: bool = False) -> Progress:
    """Makes a progress bar that shows on a terminal only."""
    return Progress(*columns, console=console, disable=not console.is_terminal, transient=transient)


if TYPE_CHECKING:  # training imports what an exploration does not need
    from r3jax.splatting.training import train

T = TypeVar("T")
B = TypeVar("B", bound="Bar")

_STAGES = {
    "forecast": "forecasting the quality",
    "plan": "planning",
    "plan ahead": "planning the view after",
    "gaze": "choosing directions while moving",
    "render": "rendering",
    "map": "mapping",
    "measure": "measuring coverage",
    "record": "writing to disk",
}
_LOG_LINES = 10
"""Lines that a run or a training leaves in a log."""


class Bar:
    """A bar that is shown inside of a `with`; it has the attribute `_bar`."""

    _bar: Progress

    def __enter__(self: B) -> B:
        """Shows the bar."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Removes the bar."""
        self._bar.stop()


class RunProgress(Bar):
    """Follows a run; hand its methods to `explore`."""

    def __init__(self, console: Console, budget: Budget, captured: int = 0):
        """Shows nothing before it is entered.

        Args:
            console: where to.
            budget: of the run.
            captured: frames captured while moving that were recorded before the run goes on.
        """
        self._console = console
        self._budget = budget
        self._views = 0
        self._captured = captured
        self._logged = -1
        self._bar = progress_bar(
            console,
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[facts]}", style="dim"),
            TextColumn("elapsed", style="dim"),
            TimeElapsedColumn(),
            TextColumn("left", style="dim"),
            TimeRemainingColumn(),
        )
        self._task = self._bar.add_task("starting", total=1.0, facts="")

    def on_stage(self, stage: str) -> None:
        """Begins a stage."""
        check_interrupt()
        what = _STAGES.get(stage, stage)
        if self._views < 2 and stage in ("plan", "map", "measure"):
            what += " (compiling on first use)"
        total = f"/{self._budget.amount:.0f}" if self._budget.unit == "views" else ""
        self._bar.update(self._task, description=f"view {self._views + 1}{total}: {what}")

    def on_row(self, row: StepRow) -> None:
        """Reports a view that is done."""
        self._captured += row.captured
        self._views = row.step + 1 - self._captured
        share = self._budget.spent_share(
            views=self._views, frames=row.step + 1, seconds=row.seconds, metres=row.metres
        )
        facts = (
            f"{100 * row.coverage.known_share:.0f} % explored, "
            f"R {row.coverage.mean_renderability:.2f}, {row.seconds:.0f} s on the clock"
        )
        self._bar.update(self._task, completed=share, facts=facts)
        line = int(share * _LOG_LINES)
        if not self._console.is_terminal and line > self._logged:
            self._logged = line
            self._console.print(f"view {self._views}: {facts}")


class Stages(Bar):
    """A bar on a terminal, a line for each stage in a log."""

    def __init__(self, console: Console):
        """Shows nothing before it is entered."""
        self._console, self._stage = console, ""
        self._bar = progress_bar(
            console,
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(),
            transient=True,
        )
        self._task = self._bar.add_task("", total=None, count="")

    def on_progress(self, stage: str, steps: int) -> None:
        """Begins a stage of `steps` (0: not known), or counts steps as done (no name)."""
        check_interrupt()
        if not stage:
            task = self._bar.tasks[0]
            self.at(self._stage, int(task.completed) + steps, int(task.total or 0))
            return
        self._stage = stage
        self._bar.reset(self._task, description=stage, total=steps or None, count="")
        if not self._console.is_terminal:
            self._console.say(stage)

    def at(self, stage: str, done: int, total: int) -> None:
        """Counts steps of a stage as done; the stage begins if it has not."""
        check_interrupt()
        if stage != self._stage:
            self.on_progress(stage, total)
        count = f"{done}/{total}" if total else ""
        self._bar.update(self._task, completed=done, total=total or None, count=count)

    def each(self, stage: str, items: Iterable[T], total: int) -> Iterator[T]:
        """Passes items on, each a step of a stage."""
        for done, item in enumerate(items):
            self.at(stage, done, total)
            yield item


class TrainProgress(Bar):
    """A bar on a terminal, ten lines in a log; hand `on_progress` to `fit`."""

    def __init__(self, console: Console, iterations: int):
        """Shows nothing before it is entered."""
        self._console, self._logged = console, -1
        self._bar = progress_bar(
            console,
            SpinnerColumn(),
            TextColumn("step {task.completed:.0f}/{task.total:.0f}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[facts]}", style="dim"),
        )
        self._task = self._bar.add_task("", total=iterations, facts="compiling on first use")

    def on_progress(self, progress: "train.Progress") -> None:
        """Counts steps as done."""
        facts = (
            f"loss {progress.loss:.4f}, PSNR {progress.psnr:.2f} dB, "
            f"{progress.num_gaussians} Gaussians, {progress.seconds_left:.0f} s left"
        )
        self._bar.update(self._task, completed=progress.step, facts=facts)
        line = progress.step * _LOG_LINES // progress.iterations
        if not self._console.is_terminal and line > self._logged:
            self._logged = line
            self._console.print(f"step {progress.step}: {facts}")
