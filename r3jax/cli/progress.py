"""Tells the user what happens: a bar on a terminal, a few lines in a log."""

from types import TracebackType

from r3jax.cli.console import (
    BarColumn,
    Console,
    MofNCompleteColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    progress_bar,
)
from r3jax.exploration.budget import Budget
from r3jax.trace.rows import StepRow

_STAGES = {
    "forecast": "forecasting the quality",
    "plan": "planning",
    "render": "rendering",
    "map": "mapping",
    "measure": "measuring coverage",
    "record": "writing to disk",
}
_LOG_LINES = 10
"""Lines that a run leaves in a log."""


class RunProgress:
    """Follows a run; hand its methods to `explore`."""

    def __init__(self, console: Console, budget: Budget):
        """Shows nothing before it is entered."""
        self._console = console
        self._budget = budget
        self._views = 0
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
        """A stage begins."""
        what = _STAGES.get(stage, stage)
        if self._views < 2 and stage in ("plan", "map", "measure"):
            what += " (compiling on first use)"
        total = f"/{self._budget.amount:.0f}" if self._budget.unit == "views" else ""
        self._bar.update(self._task, description=f"view {self._views + 1}{total}: {what}")

    def on_step(self, row: StepRow) -> None:
        """A view is done."""
        self._views = row.step + 1
        share = self._budget.spent_share(views=self._views, seconds=row.seconds, metres=row.metres)
        facts = (
            f"{100 * row.coverage.known_share:.0f} % explored, "
            f"R {row.coverage.mean_renderability:.2f}, {row.seconds:.0f} s on the clock"
        )
        self._bar.update(self._task, completed=share, facts=facts)
        line = int(share * _LOG_LINES)
        if not self._console.is_terminal and line > self._logged:
            self._logged = line
            self._console.print(f"view {self._views}: {facts}")

    def __enter__(self) -> "RunProgress":
        """Shows the bar."""
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Takes the bar down."""
        self._bar.stop()


class Stages:
    """A bar on a terminal, a line for each stage in a log."""

    def __init__(self, console: Console):
        """Shows nothing before it is entered."""
        self._console = console
        self._bar = progress_bar(
            console,
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            transient=True,
        )
        self._task = self._bar.add_task("", total=None)

    def on_progress(self, stage: str, steps: int) -> None:
        """A stage begins, or one of its steps is done (no name)."""
        if not stage:
            self._bar.advance(self._task, steps)
            return
        self._bar.reset(self._task, description=stage, total=max(steps, 1))
        if not self._console.is_terminal:
            self._console.say(stage)

    def __enter__(self) -> "Stages":
        """Shows the bar."""
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Takes the bar down."""
        self._bar.stop()
