"""Submissions as cells of a benchmark: explored on their own terms, trained like all others."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from r3jax.apps.benchmark.cells import Cell
from r3jax.apps.benchmark.conditions import OWN_OF_LOOP, Conditions
from r3jax.apps.benchmark.plan import Request, prepare_scene
from r3jax.apps.benchmark.submission_checks import Problem, check_submission
from r3jax.exploration.guard import check_world
from r3jax.files import make_folder
from r3jax.formats.submissions import (
    Submission,
    content_hash,
    read_submission,
    write_submission,
)
from r3jax.geometry.cameras import Camera
from r3jax.planning.robot.motion import MOTIONS
from r3jax.runs.header import camera_fields
from r3jax.simulators.base import Simulator
from r3jax.simulators.scenes.registry import open_scene

FOLDER = "submissions"
"""Folder of a benchmark for the submissions that it judges."""


def open_submitted(submission: Submission) -> Simulator:
    """Opens the scene of a submission as it says.

    Raises:
        ValueError: the scene is unknown, or its file is refused.
        ImportError: its simulator is not installed.
    """
    scene = submission.scene
    return open_scene(
        scene["name"],
        up=scene["up"],
        scale=scene["scale"],
        cull_back_faces=scene["cull_backfaces"],
        camera=submission.intrinsics,
        noise=scene["noise"],
        seed=submission.seed,
        max_range=scene["max_range"],
    )


def problems_of(submission: Submission) -> list[Problem]:
    """Lists what keeps a submission from being judged: rules of the protocol that it breaks."""
    try:
        _check_terms(submission)
        _ = conditions_of(submission, Conditions(train_resolution=16))
        simulator = open_submitted(submission)
        check_world(simulator.bounds, submission.config.cell_size, "`exploration.cell_size`")
        return check_submission(submission, simulator)
    except (ValueError, ImportError) as error:
        return [Problem(None, str(error))]


def _check_terms(submission: Submission) -> None:
    """Refuses what no map or training could be made of.

    Raises:
        ValueError: names the field.
    """
    if not 0 <= submission.seed < 1 << 31:
        raise ValueError(f"`seed` must lie between 0 and 2^31 - 1, got {submission.seed}")
    if len(submission.frames) < 2:
        raise ValueError("a model is trained on two frames at least, and there is one")
    submission.config.check_scales()


def conditions_of(
    submission: Submission, base: Conditions, snapshots: tuple[str, ...] = ()
) -> Conditions:
    """The terms of a submission's exploration, with the training and judging of `base`.

    Args:
        submission: gives budget, sensor, maps and clock.
        base: gives the rest.
        snapshots: where a model is trained; by default at the budget.

    Raises:
        ValueError: a camera that no benchmark has, or a setting that cannot work.
    """
    config = submission.config
    loop = {
        name: value for name, value in dataclasses.asdict(config).items() if name not in OWN_OF_LOOP
    }
    width, fov = _square(submission)
    return dataclasses.replace(
        base,
        budget=submission.budget,
        snapshots=snapshots,
        clock=config.clock,
        resolution=width,
        fov=fov,
        noise=submission.scene["noise"],
        max_range=config.max_range,
        voxel_size=config.voxel_size,
        cell_size=config.cell_size,
        map_capacity=config.capacity,
        loop=loop,
    )


def _square(submission: Submission) -> tuple[int, float]:
    """Width [px] and field of view [degrees] of the square images of a benchmark."""
    camera = submission.camera
    width, half = int(camera["width"]), 0.5 * camera["width"]
    # As people write it: the focal length is stored in float32.
    fov = round(math.degrees(2.0 * math.atan(half / camera["fx"])), 4)
    if camera_fields(Camera.from_fov(width, width, fov)) != camera:
        raise ValueError(
            "`camera`: the benchmark has square images and pixels with the principal point in the "
            f"middle, got {camera}"
        )
    return width, fov


def plan_submission(
    submission: Submission,
    base: Conditions,
    root: Path,
    *,
    snapshots: tuple[str, ...] = (),
    max_test_views: int | None = 120,
    on_stage: Callable[[str], None] = lambda stage: None,
) -> Cell:
    """The cell of a submission, with its scene's test views rendered and stored.

    Args:
        submission: as it was read.
        base: how models are trained and judged.
        root: folder of the benchmark.
        snapshots: where a model is trained; by default at the budget.
        max_test_views: of the scene at most; None: all of the lattice.
        on_stage: told what happens now.

    Raises:
        ValueError: it breaks a rule; says which, and what to do.
        OSError: a folder that cannot be written.
    """
    on_stage(f"checking {submission.name}")
    if problems := problems_of(submission):
        more = f"; {len(problems) - 1} more: --check lists all" if len(problems) > 1 else ""
        raise ValueError(f"{problems[0]}{more}")
    conditions = conditions_of(submission, base, snapshots)
    scene, settings = submission.scene, _settings_of(submission)
    opened: dict[str, Any] = {name: scene[name] for name in ("up", "scale", "cull_backfaces")}
    request = Request(
        (scene["name"],), (), (submission.seed,), conditions, max_test_views, settings, **opened
    )
    view_set = prepare_scene(request, scene["name"], root, on_stage)
    digest = content_hash(submission)
    make_folder(stored_submission(root, digest).parent)
    write_submission(stored_submission(root, digest), submission)
    return Cell(
        scene=scene["name"],
        scene_hash=scene["hash"],
        policy=submission.name,
        seed=submission.seed,
        conditions=conditions,
        test_views_hash=view_set.hash,
        num_test_views=len(view_set),
        settings=settings,
        submission=digest,
        **opened,
    )


def _settings_of(submission: Submission) -> dict[str, Any]:
    """What tables must tell of how the views were chosen: what carried the camera."""
    if submission.robot == MOTIONS["free"]:
        return {}
    names = [name for name, motion in MOTIONS.items() if motion == submission.robot]
    return {"motion": names[0] if names else submission.motion}


def stored_submission(root: Path, digest: str) -> Path:
    """Where a benchmark keeps a submission, by the hash of its content."""
    return Path(root) / FOLDER / f"{digest[:16]}.jsonl"


def load_submission(root: Path, digest: str) -> Submission:
    """Reads a submission that a benchmark keeps.

    Raises:
        ValueError: it is gone or damaged.
    """
    path = stored_submission(root, digest)
    submission = read_submission(path)
    if content_hash(submission) != digest:
        raise ValueError(f"{path} is not what was planned: start the benchmark again")
    return submission
