"""Runs one cell: explores once, then trains from scratch, evaluates and records each snapshot.

Finished stages are not repeated: a process that is killed at any moment and restarted
resumes after the last complete stage (a training after its last checkpoint).
"""

import contextlib
import dataclasses
import functools
import itertools
import json
import time
import traceback
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from r3jax.apps.benchmark.cells import (
    Cell,
    CellPaths,
    identity,
    paths_of,
    snapshots_left,
    sources_of,
)
from r3jax.apps.benchmark.record import make_record, write_record
from r3jax.apps.benchmark.reference_images import ReferenceImages, load_reference_images
from r3jax.apps.benchmark.submitted import load_submission, retake
from r3jax.evaluation.evaluate import evaluate
from r3jax.evaluation.image_metrics import load_lpips
from r3jax.evaluation.judge import map_of
from r3jax.exploration.config import parse_budget
from r3jax.exploration.loop import explore
from r3jax.exploration.state import COMPLETE, StopReason
from r3jax.exploration.taken_views import StepRow
from r3jax.files import (
    clear_partial,
    lock_folder,
    make_folder,
    own_folder,
    remove,
    write_atomic,
)
from r3jax.formats.submissions import Submission, content_hash
from r3jax.runs.header import RunError, RunHeader, camera_fields, package_versions, policy_fields
from r3jax.runs.reader import Run, read_run
from r3jax.runs.writer import RunWriter
from r3jax.scoring.renderability import renderability
from r3jax.simulators.base import Simulator
from r3jax.simulators.scenes.registry import open_scene, scene_hash
from r3jax.splatting.errors import CheckpointError
from r3jax.splatting.ply import write_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training import train
from r3jax.splatting.training.checkpoints import remove_checkpoints
from r3jax.splatting.views import load_views

OnStage = Callable[[str], None]
"""Callback with the name of a stage, in a few words."""

_LOCK_PATIENCE = 20.0
"""A worker whose parent was killed needs a moment to notice [s]."""


class CellError(RuntimeError):
    """Raised when a cell cannot be computed, with the reason."""


def run_cell(cell: Cell, root: Path, on_stage: OnStage = lambda stage: None) -> None:
    """Computes the unfinished part of a cell.

    Args:
        cell: the cell to compute.
        root: folder of the benchmark.
        on_stage: called with the name of each stage.

    Raises:
        CellError: another process works on it, or some snapshots failed; the others are recorded.
        KeyboardInterrupt: Ctrl-C; the next call resumes from here.
    """
    paths = paths_of(root, cell)
    own_folder(paths.folder, "cell", "move it away")
    with _lock(paths.folder):
        clear_partial(paths.folder)
        try:
            _run_locked(cell, root, paths, on_stage)
        except Exception:
            write_atomic(paths.error, traceback.format_exc().encode())
            raise
        remove(paths.error)


def _run_locked(cell: Cell, root: Path, paths: CellPaths, on_stage: OnStage) -> None:
    left = snapshots_left(root, cell)
    if not left:
        return
    write_atomic(paths.identity, json.dumps(identity(cell), indent=1).encode())
    run = _finished_run(paths.run) or _explore(cell, root, paths, on_stage)
    reference = load_reference_images(root, cell)
    failures: list[str] = []
    tracebacks: list[str] = []
    for snapshot in left:
        stage: OnStage = lambda what, snapshot=snapshot: on_stage(f"{snapshot}: {what}")
        try:
            _do_snapshot(cell, root, run, reference, snapshot, stage)
        except Exception as error:  # the other snapshots may work
            failures.append(f"{snapshot}: {type(error).__name__}: {error}")
            tracebacks.append(f"\n{snapshot}: {traceback.format_exc()}")
    if failures:
        failure = CellError("; ".join(failures))
        # A note is no part of the message, but stands in error.txt.
        failure.add_note("".join(tracebacks))
        raise failure


@contextlib.contextmanager
def _lock(folder: Path) -> Generator[None]:
    """Locks the cell: one process at a time."""
    end = time.monotonic() + _LOCK_PATIENCE
    while True:
        try:
            lock = lock_folder(folder)
            break
        except BlockingIOError:
            if time.monotonic() > end:
                raise CellError(f"{folder}: another process is at this cell") from None
            time.sleep(0.2)
    with lock:
        yield


def _finished_run(path: Path) -> Run | None:
    """Reads the exploration if it is there and came to its end, else returns None."""
    try:
        run = read_run(path)
    except RunError:
        return None
    return run if run.end is not None and run.end.outcome in COMPLETE else None


def _explore(cell: Cell, root: Path, paths: CellPaths, on_stage: OnStage) -> Run:
    """Explores, or resumes an interrupted exploration."""
    conditions = cell.conditions
    on_stage("opening the scene")
    simulator = _open(cell)
    if cell.submission is not None:
        return _retake(cell, load_submission(root, cell.submission), simulator, paths, on_stage)
    if sources_of(cell.policy) != cell.sources:
        raise CellError(
            f"the source of the policy {cell.policy} has changed since the benchmark was planned: "
            "start again"
        )
    policy = conditions.policy(cell.policy, cell.settings)
    header = _header(cell, simulator, policy_fields(policy))
    on_stage("exploring")
    recorder, begun = _begin_or_resume(paths.run, header)
    with recorder:
        result = explore(
            simulator,
            policy,
            budget=conditions.budget,
            seed=cell.seed,
            config=conditions.exploration_config(),
            recorder=recorder,
            resume=begun,
            on_view=lambda view, _: on_stage(f"exploring, {view.row.step + 1} views"),
        )
    if result.reason is StopReason.INTERRUPTED:
        raise KeyboardInterrupt
    if result.reason.value not in COMPLETE:
        raise CellError(f"the exploration ended early: {result.message}")
    return read_run(paths.run)


def _open(cell: Cell) -> Simulator:
    """Opens the scene of a cell.

    Raises:
        CellError: it is not the one that the cell was planned for.
    """
    conditions = cell.conditions
    simulator = open_scene(
        cell.scene,
        up=cell.up,
        scale=cell.scale,
        cull_back_faces=cell.cull_backfaces,
        camera=conditions.camera,
        noise=conditions.noise,
        seed=cell.seed,
        max_range=conditions.max_range,
    )
    found = scene_hash(simulator)
    if found != cell.scene_hash:
        raise CellError(
            f"the scene {cell.scene} has the hash {found[:12]}, but {cell.scene_hash[:12]} when "
            "the benchmark was planned: the file has changed since then; start again"
        )
    return simulator


def _header(cell: Cell, simulator: Simulator, policy: dict[str, Any]) -> RunHeader:
    """Makes the header of the exploration of a cell by a policy."""
    conditions = cell.conditions
    return RunHeader(
        scene={
            "name": cell.scene,
            "hash": cell.scene_hash,
            "up": cell.up,
            "scale": cell.scale,
            "cull_backfaces": cell.cull_backfaces,
            "noise": conditions.noise,
            "max_range": conditions.max_range,
            "start": None,
        },
        policy=policy,
        budget=conditions.budget,
        seed=cell.seed,
        config=dataclasses.asdict(conditions.exploration_config()),
        camera=camera_fields(simulator.camera),
        bounds=np.asarray(simulator.bounds).tolist(),
        packages=package_versions(),
    )


def _retake(
    cell: Cell, submission: Submission, simulator: Simulator, paths: CellPaths, on_stage: OnStage
) -> Run:
    """Takes the frames of a submission again, from the first one: that is quickly done."""
    motion = {} if submission.motion is None else {"motion": submission.motion}
    policy = {"name": submission.name, "settings": motion, "submitted": submission.policy}
    header = _header(cell, simulator, policy)
    on_stage("taking the frames again")
    retake(
        submission,
        simulator,
        cell.conditions.exploration_config(),
        header,
        paths.run,
        on_frame=lambda frame: on_stage(f"taking the frames again, {frame + 1} views"),
    )
    return read_run(paths.run)


def _begin_or_resume(path: Path, header: RunHeader) -> tuple[RunWriter, Run | None]:
    """Creates a new run, or opens the existing one and reads its recorded views."""
    if (path / "run.json").exists():
        try:
            return RunWriter.resume(path)
        except RunError as error:  # of another version, damaged, not ours to write
            raise CellError(f"{error}; move it away to explore again") from None
    try:
        return RunWriter(path, header), None
    except RunError as error:  # somebody else's folder
        raise CellError(str(error)) from None


def steps_within(run: Run, snapshot: str) -> tuple[StepRow, ...]:
    """Returns the views that were taken within a snapshot's budget.

    As in the loop, a view must arrive within the budget; the time that mapping it takes comes
    after.
    """
    budget = parse_budget(snapshot)
    chosen = itertools.accumulate((not row.captured for row in run.rows), initial=0)

    def is_within(numbered: tuple[int, StepRow]) -> bool:
        before, row = numbered
        seconds = row.seconds - row.charged.get("mapping", 0.0)
        # A frame captured while moving belongs to the view at the end of its path.
        return budget.allows(
            views=before + 1, frames=row.step + 1, seconds=seconds, metres=row.metres
        )

    within = itertools.takewhile(is_within, zip(chosen, run.rows, strict=False))
    return tuple(row for _, row in within)


def _do_snapshot(
    cell: Cell, root: Path, run: Run, reference: ReferenceImages, snapshot: str, on_stage: OnStage
) -> None:
    """Trains, evaluates and records one snapshot."""
    conditions, paths = cell.conditions, paths_of(root, cell)
    steps = steps_within(run, snapshot)
    scene = _train(cell, paths, run, len(steps), snapshot, on_stage)
    on_stage("mapping its views")
    frames = (run.frame(row.step) for row in steps)
    loop = conditions.exploration_config()
    state = map_of(
        frames,
        voxel_size=loop.voxel_size,
        max_range=loop.max_range,
        num_bins=loop.num_bins,
        drop_edges=loop.drop_edges,
    )
    camera = conditions.camera
    expected = [float(renderability(state, camera, jnp.asarray(T))) for T in reference.poses]
    on_stage("evaluating")
    config = conditions.train_config(cell.seed)
    evaluation = evaluate(
        scene,
        reference.views,
        config.raster,
        lpips=None if conditions.lpips == "none" else load_lpips(conditions.lpips),
        renderability=expected,
    )
    assert run.end is not None
    outcome = run.end.outcome if len(steps) == len(run.rows) else StopReason.BUDGET.value
    timings = [stages for stages in run.timings if stages.get("step", 0) < len(steps)]
    decisions = [stages["plan"] for stages in timings if "plan" in stages]
    record = make_record(root, cell, snapshot, steps, outcome, evaluation.rows, decisions)
    if cell.submission is not None:
        record |= {"submission": _submission_fields(load_submission(root, cell.submission), run)}
    write_record(paths.record(snapshot), record)
    # The model is kept, the optimizer's state is not.
    remove_checkpoints(paths.checkpoints(snapshot))


def _submission_fields(submission: Submission, run: Run) -> dict[str, Any]:
    """Returns a record's fields about the submission that it judges."""
    pairs = zip(submission.frames, run.rows, strict=True)
    return {
        "sha256": content_hash(submission),
        "policy": submission.policy,
        "packages": submission.packages,
        # Whether the simulator computed here as it did there.
        "same_images": sum(frame.sha256 == row.sha256 for frame, row in pairs),
        "known_images": sum(frame.sha256 is not None for frame in submission.frames),
    }


def _train(
    cell: Cell, paths: CellPaths, run: Run, num_views: int, snapshot: str, on_stage: OnStage
) -> GaussianScene:
    """Trains vanilla 3DGS on the first views, from scratch or from the newest checkpoint."""
    on_stage("reading its views")
    frames = (run.frame(step) for step in range(num_views))
    views = load_views(frames, cell.conditions.train_resolution)
    config = cell.conditions.train_config(cell.seed)
    folder = paths.checkpoints(snapshot)
    fit = functools.partial(
        train.fit,
        views,
        config,
        folder=folder,
        checkpoint_every=max(1, min(1000, config.iterations // 5)),
        on_progress=lambda progress: on_stage(
            f"training, step {progress.step}/{progress.iterations}"
        ),
    )
    try:
        result = fit(resume=True)
    except CheckpointError:  # nothing there yet, or all of it is damaged
        result = fit(overwrite=True)
    if result.interrupted:
        raise KeyboardInterrupt
    make_folder(paths.model(snapshot).parent)
    write_scene(paths.model(snapshot), result.scene)
    return result.scene
