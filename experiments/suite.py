"""The comparison that several tables and figures share: cells of the benchmark in three sizes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from experiments.pages.artifacts import Origin, joint_origin
from r3jax.apps.benchmark.cells import Cell, Conditions, paths_of, snapshots_left
from r3jax.apps.benchmark.engines.local import Event, run_in_processes
from r3jax.apps.benchmark.engines.slurm import run_on_cluster
from r3jax.apps.benchmark.plan import Request, cells_left, make_plan
from r3jax.apps.benchmark.record import collect, read_records, write_record
from r3jax.planning.registry import policy_names

T = TypeVar("T")

HOUSE = "mesh:experiments/scenes/aws_small_house/aws_small_house.glb"

Records = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Options:
    """What every experiment of this kind is asked."""

    size: Literal["smoke", "small", "paper"] = "smoke"
    """`smoke`: minutes. `small`: hours on two cores. `paper`: the paper's size, a day."""

    out: Path = Path("experiments/results")
    """Folder of the tables and figures."""

    work: Path = Path("runs/experiments")
    """Folder of the cells; what is done there is not done again."""

    scenes: tuple[str, ...] = ()
    """Scenes other than the size's."""

    policies: tuple[str, ...] = ()
    """Policies other than the size's."""

    seeds: tuple[int, ...] = ()
    """Seeds other than the size's."""

    snapshots: tuple[int, ...] = ()
    """Views or seconds at which models are judged, other than the size's; the last ends the run."""

    engine: Literal["local", "slurm"] = "local"
    """Processes on this machine, or an array job."""

    jobs: int = 1
    """Cells at a time; more than one slow each other's wall clock down."""

    kept: tuple[Path, ...] = ()
    """Files of records that lie beside a table made elsewhere: these cells are not run again."""


@dataclass(frozen=True)
class _Size:
    """Scenes, policies, seeds and conditions; budgets are those of the experiment."""

    scenes: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    max_test_views: int | None
    conditions: Conditions


_SIZES = {
    "smoke": _Size(
        scenes=("flat",),
        policies=("random", "active-gs", "r3", "r3-pano"),
        seeds=(0,),
        max_test_views=30,
        conditions=Conditions(
            resolution=128, train_resolution=64, iterations=300, gaussians=5_000, capacity=10_000
        ),
    ),
    "small": _Size(
        scenes=("flat", "office", HOUSE),
        policies=policy_names(),
        seeds=(0, 1),
        max_test_views=120,
        conditions=Conditions(
            resolution=256,
            train_resolution=128,
            iterations=1500,
            gaussians=20_000,
            capacity=40_000,
        ),
    ),
    "paper": _Size(
        scenes=("flat", "office", HOUSE),
        policies=("active-gamer", "active-gs", "r3", "r3-pano"),
        seeds=(0,),
        max_test_views=None,
        conditions=Conditions(
            resolution=512,
            train_resolution=512,
            iterations=7_000,
            gaussians=100_000,
            capacity=200_000,
        ),
    ),
}

_AMOUNTS = {
    ("smoke", "views"): (10, 20),
    ("small", "views"): (30, 60),
    ("paper", "views"): (60, 120, 180, 240, 300),
    ("smoke", "seconds"): (8, 16),
    ("small", "seconds"): (30, 60),
    ("paper", "seconds"): (60, 120, 180, 240, 300),
}
"""Snapshots by size and unit; the last one is the budget."""


def request_of(options: Options, unit: Literal["views", "seconds"]) -> Request:
    """Makes the request to the benchmark."""
    size = _SIZES[options.size]
    amounts = options.snapshots or _AMOUNTS[options.size, unit]
    snapshots = tuple(f"{unit}:{amount}" for amount in amounts)
    # Seconds are measured on this machine; views cost the same whatever the machine.
    clock = "wall" if unit == "seconds" else "model"
    return Request(
        scenes=options.scenes or size.scenes,
        policies=options.policies or size.policies,
        seeds=options.seeds or size.seeds,
        max_test_views=size.max_test_views,
        conditions=replace(size.conditions, budget=snapshots[-1], snapshots=snapshots, clock=clock),
    )


def run_suite(options: Options, unit: Literal["views", "seconds"]) -> tuple[Path, Records]:
    """Runs what is left of the cells.

    Returns:
        The folder of the cells, and their records.

    Raises:
        SystemExit: a cell failed; the others are done, and the same command tries it again.
    """
    root, _, records = run_requests(options, unit, [request_of(options, unit)])
    return root, records


def run_requests(
    options: Options, unit: Literal["views", "seconds"], requests: Sequence[Request]
) -> tuple[Path, list[Cell], Records]:
    """Runs what is left of the cells of all requests, in the folder of the suite's.

    Returns:
        The folder of the cells, the cells, and their records.

    Raises:
        SystemExit: a cell failed; the others are done, and the same command tries it again.
    """
    root = options.work / f"{options.size}-{unit}"
    root.mkdir(parents=True, exist_ok=True)
    cells = [cell for request in requests for cell in make_plan(request, root)]
    take_over(options.kept, root, cells)
    run_cells(cells, root, engine=options.engine, jobs=options.jobs)
    return root, cells, read_records(root, cells)


def run_cells(cells: Sequence[Cell], root: Path, *, engine: str = "local", jobs: int = 1) -> None:
    """Runs what is left of the cells, and says so line by line.

    Args:
        cells: what to do.
        root: folder of the benchmark.
        engine: `local` or `slurm`.
        jobs: cells at a time.

    Raises:
        SystemExit: a cell failed; the others are done, and the same command tries it again.
    """
    left, failed = cells_left(root, cells), []

    def report(event: Event) -> None:
        if event.kind in ("done", "failed"):
            print(f"{event.cell.name}: {event.kind} {event.text}", flush=True)
        if event.kind == "failed":
            failed.append(event.cell.name)

    print(f"{len(cells)} cells, {len(cells) - len(left)} of them done", flush=True)
    if left and engine == "slurm":
        run_on_cluster(left, root, report, jobs=jobs)
    elif left:
        run_in_processes(left, root, report, jobs=jobs)
    collect(root)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}; see error.txt in {root / 'cells'}")


def take_over(files: Sequence[Path], root: Path, cells: Sequence[Cell]) -> None:
    """Puts records that were made elsewhere where those of these cells lie: they are done then.

    A cell's folder is named by the scene, the settings, the seed and all else that its results
    depend on but the version of the code, so a record of other terms finds no place.

    Args:
        files: as `record.write_records` writes them.
        root: folder of the benchmark.
        cells: whose records are wanted; one that is there stays.

    Raises:
        ValueError: a line is no record.
        OSError: a file cannot be read.
    """
    found = {(r["run"], r["snapshot"]): r for file in files for r in read_records(file)}
    for cell in cells:
        paths = paths_of(root, cell)
        for snapshot in snapshots_left(root, cell):
            record = found.get((paths.run.relative_to(root).as_posix(), snapshot))
            if record is not None:
                paths.folder.mkdir(parents=True, exist_ok=True)
                write_record(paths.record(snapshot), record)


def origin(module: str, records: Records) -> Origin:
    """Returns where a result comes from: the records tell machine and commit."""
    machines = [record["machine"] for record in records]
    return joint_origin(module, machines, [record["commit"] for record in records])
