"""`r3jax benchmark`: plans the cells, has them run, and shows what came out."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from r3jax.apps.benchmark.cells import Cell, Conditions, paths_of
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
from r3jax.apps.benchmark.site import write_site
from r3jax.apps.benchmark.submitted import plan_submission, problems_of
from r3jax.apps.benchmark.table_formats import to_csv, to_latex, to_markdown
from r3jax.apps.benchmark.tables import (
    Entry,
    Table,
    by_scene_table,
    headed_groups,
    on_equal_terms,
    tables_of_group,
)
from r3jax.cli.console import (
    Bar,
    BarColumn,
    Console,
    SpinnerColumn,
    TaskID,
    Text,
    TextColumn,
    progress_bar,
)
from r3jax.cli.console import Table as ConsoleTable
from r3jax.cli.errors import one_line, printable
from r3jax.cli.options.benchmark import BenchmarkOptions, parse_settings, words
from r3jax.cli.parsing import settings_for
from r3jax.errors import InputError
from r3jax.evaluation.comparison import methods_of, with_short_names
from r3jax.files import MARKER, lock_folder, own_folder, remove_own
from r3jax.formats.submissions import Submission, read_submission
from r3jax.interrupts import check_interrupt, settle_interrupt
from r3jax.planning.policies import current_name
from r3jax.runs.header import plain_settings

_SHOWN = 20
"""Problems of a submission that are printed."""

_LOOP = ("capture_every", "capture_rate", "gaze", "plan_while_moving")
"""Options that are settings of the loop."""


def run_benchmark(options: BenchmarkOptions) -> int:
    """Runs the remaining cells of a benchmark and prints its table, or only checks submissions.

    Returns:
        0 all cells are done, 1 some failed or a submission breaks a rule, 130 interrupted (run it
        again to resume).

    Raises:
        ValueError, OSError, ImportError: an unknown scene or policy, a setting that cannot work, a
            missing package.
    """
    console = Console(stderr=True)
    if options.submissions.check:
        return _check_submissions(console, options)
    if options.results.site is not None:
        return _write_site(console, options)
    if options.machines.jobs > 0 and visible_gpus():
        # The workers have the GPUs; planning must not hold on to their memory.
        jax.config.update("jax_platforms", "cpu")
    is_new = not options.out.is_dir() or not any(options.out.iterdir())
    own_folder(options.out, "benchmark", "give another --out")
    with _only_one(options.out):
        try:
            with console.status("planning ...") as status:
                cells = _plan(options, lambda what: status.update(f"{what} ..."))
        except BaseException:
            if is_new:  # a benchmark that cannot be planned leaves nothing
                remove_own(options.out, ["lock", f"{MARKER}/*"])
            raise
        left = cells_left(options.out, cells)
        _announce(console, options, cells, left)
        with BenchmarkProgress(console, len(cells), len(left), options.out) as progress:
            interrupted = _run(options, left, progress.on_event)
        collected = collect(options.out)
    _show(console, options, cells)
    console.say(f"records  {collected}")
    code = _conclude(console, progress.failures, interrupted)
    if code == 0:
        console.next("view", paths_of(options.out, cells[0]).run)
    return code


def _only_one(folder: Path) -> ExitStack:
    """Takes the folder's lock: two benchmarks would wait for each other's cells."""
    try:
        return lock_folder(folder)
    except BlockingIOError:
        raise InputError(
            f"{folder}: another process runs this benchmark: wait for it, or give another --out"
        ) from None


def _show(console: Console, options: BenchmarkOptions, cells: Sequence[Cell]) -> None:
    """Prints the tables of what was done, those of submissions with the records beside them."""
    records = read_records(options.out, cells)
    for line in _images_again(records):
        console.say(line)
    if options.submissions.submission:
        records = beside(records, read_records(options.out))
    if records:
        print_results(Console(), records, options.results.format, options.results.reference)


def _write_site(console: Console, options: BenchmarkOptions) -> int:
    """Writes the page of all records."""
    assert options.results.site is not None
    with console.status("reading the records, and rendering the worst views ..."):
        page = write_site(options.out, options.results.site, options.results.reference)
    console.say(f"page     {page}")
    return 0


def _read(options: BenchmarkOptions, path: Path) -> Submission:
    """Reads a submission, with the scene at the user's location.

    Meshes are stored elsewhere on every machine.
    """
    submission = read_submission(path)
    if options.scenes == BenchmarkOptions.scenes:
        return submission
    return replace(submission, scene=submission.scene | {"name": options.scenes})


def _check_submissions(console: Console, options: BenchmarkOptions) -> int:
    """Reports the problems of each file, or the number of its valid frames."""
    code = 0
    for path in options.submissions.submission:
        try:
            submission = _read(options, path)
        except ValueError as error:
            console.say(one_line(error), style="red")
            code = 1
            continue
        with console.status(f"checking {path} ..."):
            problems = problems_of(submission)
        for problem in problems[:_SHOWN]:
            console.say(f"{path}, {problem}", style="red")
        if len(problems) > _SHOWN:
            console.say(f"{path}: and {len(problems) - _SHOWN} more problems", style="red")
        if problems:
            code = 1
        else:
            console.say(f"{path}: {len(submission.frames)} frames, no problems found")
    return code


def _plan(options: BenchmarkOptions, on_stage: Callable[[str], None]) -> tuple[Cell, ...]:
    """Plans the cells of the policies, or of the submissions."""
    if not options.submissions.submission:
        request = _request(options)
        _check_reference(options.results.reference, request)
        return make_plan(request, options.out, on_stage)
    conditions, snapshots = _judging(options), words(options.snapshots or "")
    cells: list[Cell] = []
    for path in options.submissions.submission:
        submission = _read(options, path)
        try:
            cell = plan_submission(
                submission,
                conditions,
                options.out,
                snapshots=snapshots,
                max_test_views=options.training.test_views or None,
                on_stage=on_stage,
            )
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
        cells.append(cell)
    names = [(cell.scene, cell.policy, cell.seed, str(cell.settings)) for cell in cells]
    for name, path in zip(names, options.submissions.submission, strict=True):
        if names.count(name) > 1:
            raise InputError(
                f"{path}: another submission has the same policy name {name[1]!r} in {name[0]} "
                f"with the seed {name[2]}: rename `policy.name` in one of them"
            )
    return tuple(cells)


def _check_reference(reference: str | None, request: Request) -> None:
    """Refuses a reference that will not be in the table, before anything is explored."""
    if reference is None:
        return
    planned = [
        {"policy": policy, "settings": plain_settings(point), "scene": scene}
        for policy in map(current_name, request.policies)
        for point in request.points
        for scene in request.scenes
    ]
    methods = methods_of(with_short_names(planned)) if planned else []
    if reference not in methods:
        raise InputError(f"--reference {reference!r}: the table has {', '.join(methods)}")


def _judging(options: BenchmarkOptions) -> Conditions:
    """Returns how models are trained and evaluated; the rest comes from the submission."""
    size = options.training.train_resolution
    return Conditions(
        resolution=max(Conditions.resolution, size), **settings_for(Conditions, options.training)
    )


def _images_again(records: Sequence[dict[str, Any]]) -> list[str]:
    """Reports how many images of each submission were rendered identically here."""
    lines: dict[str, None] = {}
    for record in records:
        if (told := record.get("submission")) is not None and told["known_images"]:
            name = f"{record['policy']}, {record['scene']}, seed {record['seed']}"
            share = f"{told['same_images']} of {told['known_images']} images"
            lines[f"{name}: {share} are bit-identical to those of the exploration"] = None
    return list(lines)


def beside(
    records: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Adds to records those of the same scenes and snapshots that were made on equal terms.

    Args:
        records: of submissions.
        others: all of the same folder.
    """
    chosen = list(records)
    for other in others:
        alike = [
            record
            for record in records
            if all(record[name] == other[name] for name in ("scene", "snapshot", "budget"))
        ]
        # Others would be in a table of their own, which was not requested.
        if other not in chosen and any(on_equal_terms(record, other) for record in alike):
            chosen.append(other)
    return chosen


def _request(options: BenchmarkOptions) -> Request:
    snapshots = words(options.snapshots or "")
    loop = {name: getattr(options.exploration, name) for name in _LOOP}
    conditions = Conditions(**settings_for(Conditions, options, snapshots=snapshots, loop=loop))
    conditions.exploration_config().check_scales()
    return Request(
        scenes=words(options.scenes),
        policies=words(options.policies),
        seeds=options.seed_numbers,
        conditions=conditions,
        max_test_views=options.training.test_views or None,
        settings=parse_settings("settings", options.exploration.settings),
        sweeps=options.sweeps,
        **vars(options.meshes),
    )


def _run(options: BenchmarkOptions, cells: Sequence[Cell], report: Report) -> bool:
    """Runs the cells; returns True if Ctrl-C ended it."""
    if not cells:
        return False
    jobs = options.machines.jobs
    try:
        if options.machines.engine == "slurm":
            run_on_cluster(
                cells, options.out, report, jobs=jobs, parameters=options.machines.parameters
            )
        elif jobs == 0:
            run_here(cells, options.out, report)
        else:
            run_in_processes(cells, options.out, report, jobs=jobs)
    except KeyboardInterrupt:
        settle_interrupt()
        return True
    return False


def _announce(
    console: Console, options: BenchmarkOptions, cells: Sequence[Cell], left: Sequence[Cell]
) -> None:
    console.say(f"{len(cells)} cells, {len(cells) - len(left)} of them done")
    machines = options.machines
    crowded = machines.engine == "local" and machines.jobs > max(1, len(visible_gpus()))
    if left and crowded and options.exploration.clock == "wall":
        console.say(
            f"warning: {machines.jobs} cells at a time slow each other down, and the wall clock "
            "charges the policies for it: use --jobs 1 or --clock model",
            style="yellow",
        )


def _conclude(console: Console, failures: Sequence[Event], interrupted: bool) -> int:
    for event in failures:
        console.say(f"failed   {event.cell.name}: {event.text}", style="red")
    if failures:
        console.say("the error's traceback is in error.txt of the cell's folder")
    if interrupted:
        console.say("interrupted: run the same command again to resume")
        return 130
    return 1 if failures else 0


class BenchmarkProgress(Bar):
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
        """Reports an event of a cell."""
        check_interrupt()
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


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


_MARKS = {1: "bold", 2: "italic"}


def print_results(
    console: Console,
    records: Sequence[dict[str, Any]],
    form: str = "terminal",
    reference: str | None = None,
) -> None:
    """Prints methods x metrics by scenes, and what the methods gain and cost.

    Args:
        console: where to.
        records: of one benchmark, as `benchmark.record.read_records` gives them; what is not on
            equal terms, or has a name that is there already, gets a table of its own.
        form: `terminal`, `csv`, `latex` or `markdown`.
        reference: method that the others are compared with; see `tables.reference_in`.
    """
    if form == "csv":
        _print_text(console, to_csv(by_scene_table(records, reference)))
        return
    notes: dict[str, None] = {}
    for heading, group in headed_groups(records):
        quality, costs = tables_of_group(group, heading, reference)
        if form != "terminal":
            write = to_latex if form == "latex" else to_markdown
            _print_text(console, write(replace(quality, notes=())))
            _print_text(console, write(costs))
            continue
        # Not as the table's own title, which is broken where the table ends.
        console.print(heading, style="italic")
        console.print(_for_terminal(quality))
        console.print(_for_terminal(costs))
        notes |= dict.fromkeys(quality.notes)
    for note in notes:
        console.print(note, style="dim")


def _print_text(console: Console, text: str) -> None:
    """Prints a table for other programs: no line is wrapped, control characters are shown."""
    for line in text.splitlines():
        console.out(printable(line))


def _for_terminal(table: Table) -> ConsoleTable:
    shown = ConsoleTable(*table.heads, box=None)
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
