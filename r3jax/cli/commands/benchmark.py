"""`r3jax benchmark`: plans the cells, has them run, and shows what came out."""

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import jax

from r3jax.apps.benchmark.cells import Cell, paths_of
from r3jax.apps.benchmark.conditions import Conditions, parse_settings
from r3jax.apps.benchmark.engines.local import (
    Event,
    Report,
    run_here,
    run_in_processes,
    visible_gpus,
)
from r3jax.apps.benchmark.engines.slurm import run_on_cluster
from r3jax.apps.benchmark.plan import Request, cells_left, make_plan
from r3jax.apps.benchmark.record import collect, read_records
from r3jax.apps.benchmark.tables import Entry, Table, quality_table
from r3jax.cli.checks import seeds_of, words
from r3jax.cli.console import (
    BarColumn,
    Console,
    SpinnerColumn,
    TaskID,
    Text,
    TextColumn,
    progress_bar,
)
from r3jax.cli.console import Table as ConsoleTable
from r3jax.cli.errors import UserError, one_line
from r3jax.cli.options import BenchmarkOptions
from r3jax.evaluation.comparison import snapshots_of

_LOOP = ("capture_every", "capture_rate", "gaze", "plan_while_moving")
"""Options that are settings of the loop."""


def run_benchmark(options: BenchmarkOptions) -> int:
    """Runs what is left of a benchmark and prints its table.

    Returns:
        0 all cells are done, 1 some failed, 130 interrupted (start it again to go on).

    Raises:
        UserError: an unknown scene or policy, a setting that cannot work, a missing package.
    """
    console = Console(stderr=True)
    try:
        request = _request(options)
        parameters = _settings("slurm", options.slurm)
        if options.jobs > 0 and visible_gpus():
            # The workers have the GPUs; planning must not hold on to their memory.
            jax.config.update("jax_platforms", "cpu")
        options.out.mkdir(parents=True, exist_ok=True)
        with console.status("planning ...") as status:
            cells = make_plan(request, options.out, lambda what: status.update(f"{what} ..."))
        left = cells_left(options.out, cells)
        _announce(console, options, cells, left)
        with BenchmarkProgress(console, len(cells), len(left), options.out) as progress:
            interrupted = _run(options, left, parameters, progress.on_event)
        collected = collect(options.out)
    except (ValueError, OSError, ImportError) as error:
        raise UserError(one_line(error)) from error
    records = read_records(options.out, cells)
    if records:
        print_results(Console(), records)
    console.say(f"records  {collected}")
    code = _conclude(console, progress.failures, interrupted)
    if code == 0:
        console.next("view", paths_of(options.out, cells[0]).run)
    return code


def _request(options: BenchmarkOptions) -> Request:
    conditions = Conditions(
        budget=options.budget,
        snapshots=words(options.snapshots or ""),
        clock=options.clock,
        resolution=options.resolution,
        fov=options.fov,
        noise=options.noise,
        max_range=options.max_range,
        voxel_size=options.voxel_size,
        train_resolution=options.train_resolution,
        iterations=options.iterations,
        gaussians=options.gaussians,
        capacity=options.capacity,
        backend=options.backend,
        lpips=options.lpips,
        loop={name: getattr(options, name) for name in _LOOP},
    )
    conditions.exploration_config().check_scales()
    return Request(
        scenes=words(options.scenes),
        policies=words(options.policies),
        seeds=seeds_of(options),
        conditions=conditions,
        max_test_views=options.test_views or None,
        settings=_settings("settings", options.settings),
        up=options.up,
        scale=options.scale,
        cull_backfaces=options.cull_backfaces,
    )


def _settings(option: str, words: Sequence[str]) -> dict[str, Any]:
    try:
        return parse_settings(words)
    except ValueError as error:
        raise ValueError(f"--{option} takes {error}") from None


def _run(
    options: BenchmarkOptions, cells: Sequence[Cell], parameters: dict[str, Any], report: Report
) -> bool:
    """Has the cells run; True if Ctrl-C ended it."""
    if not cells:
        return False
    try:
        if options.engine == "slurm":
            run_on_cluster(cells, options.out, report, jobs=options.jobs, parameters=parameters)
        elif options.jobs == 0:
            run_here(cells, options.out, report)
        else:
            run_in_processes(cells, options.out, report, jobs=options.jobs)
    except KeyboardInterrupt:
        return True
    return False


def _announce(
    console: Console, options: BenchmarkOptions, cells: Sequence[Cell], left: Sequence[Cell]
) -> None:
    console.say(f"{len(cells)} cells, {len(cells) - len(left)} of them done")
    crowded = options.engine == "local" and options.jobs > max(1, len(visible_gpus()))
    if left and crowded and options.clock == "wall":
        console.say(
            f"warning: {options.jobs} cells at a time slow each other down, and the wall clock "
            "charges the policies for it; --jobs 1 or --clock model measure the same for all",
            style="yellow",
        )


def _conclude(console: Console, failures: Sequence[Event], interrupted: bool) -> int:
    for event in failures:
        console.say(f"failed   {event.cell.name}: {event.text}", style="red")
    if failures:
        console.say("the error's traceback is in error.txt of the cell's folder")
    if interrupted:
        console.say("interrupted: the same command goes on from here")
        return 130
    return 1 if failures else 0


class BenchmarkProgress:
    """Cells done, time left and what each running cell does; a line per cell in a log."""

    def __init__(self, console: Console, total: int, left: int, root: Path):
        """Shows nothing before it is entered.

        Args:
            console: where to.
            total: cells of the benchmark.
            left: those that are not done yet.
            root: its folder: records are collected there whenever a cell is done.
        """
        self._console, self._root = console, root
        self._total, self._done = total, total - left
        self._left, self._finished = left, 0
        self._begin = time.monotonic()
        self._tasks: dict[str, TaskID] = {}
        self.failures: list[Event] = []
        self._bar = progress_bar(
            console,
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[facts]}", style="dim"),
        )
        self._overall = self._bar.add_task(
            "cells", total=total, completed=self._done, facts=self._facts()
        )

    def on_event(self, event: Event) -> None:
        """Something happened to a cell."""
        name = event.cell.name
        if event.kind == "started":
            self._tasks[name] = self._bar.add_task(name, total=None, facts=event.text)
        elif event.kind == "stage":
            self._bar.update(self._tasks[name], facts=event.text)
        else:
            self._end(event)

    def _end(self, event: Event) -> None:
        self._finished += 1
        if event.kind == "failed":
            self.failures.append(event)
        else:
            self._done += 1
        self._bar.remove_task(self._tasks.pop(event.cell.name))
        self._bar.update(self._overall, completed=self._done, facts=self._facts())
        # A benchmark that is killed leaves a table of what was complete.
        collect(self._root)
        if not self._console.is_terminal:
            what = "done" if event.kind == "done" else f"failed: {event.text}"
            self._console.say(f"{event.cell.name}: {what}; {self._facts()}")

    def _facts(self) -> str:
        text = f"{self._done}/{self._total} done"
        if self.failures:
            text += f", {len(self.failures)} failed"
        remaining = self._left - self._finished
        if self._finished and remaining:
            seconds = (time.monotonic() - self._begin) / self._finished * remaining
            text += f", about {_duration(seconds)} left"
        return text

    def __enter__(self) -> "BenchmarkProgress":
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


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


_MARKS = {1: "bold", 2: "italic"}


def print_results(console: Console, records: Sequence[dict[str, Any]]) -> None:
    """Prints methods x metrics by scenes, every number a mean over seeds.

    Args:
        console: where to.
        records: of one benchmark, as `benchmark.record.read_records` gives them.
    """
    notes: dict[str, None] = {}
    for snapshot in snapshots_of(records):
        chosen = [record for record in records if record["snapshot"] == snapshot]
        table = quality_table(chosen)
        console.print(_for_terminal(table))
        notes |= dict.fromkeys(table.notes)
    for note in notes:
        console.print(note, style="dim")


def _for_terminal(table: Table) -> ConsoleTable:
    shown = ConsoleTable(*table.heads, title=table.title, box=None, title_justify="left")
    for column in table.columns:
        shown.add_column(column, justify="right", no_wrap=True)
    last = None
    for row in table.rows:
        method, *others = row.labels
        labels = [method if method != last else "", *others]
        last = method
        shown.add_row(*labels, *map(_entry, row.entries))
    return shown


def _entry(entry: Entry) -> Text:
    return Text("–" if entry.value is None else entry.text, style=_MARKS.get(entry.rank, ""))
