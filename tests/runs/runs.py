"""Small runs for the tests of the trace."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from r3jax.exploration.captures import points_along
from r3jax.exploration.taken_views import Choice, Coverage, StepRow, frame_hash, stored_form
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.runs.header import RunHeader, camera_fields

CAMERA = Camera.from_fov(8, 6, 70.0)


def make_header(**changes) -> RunHeader:
    fields = {
        "scene": {"name": "toy", "hash": "abc"},
        "policy": {"name": "r3", "settings": {"num_candidates": 7}},
        "budget": "views:4",
        "seed": 3,
        "config": {"voxel_size": 0.05, "max_range": 5.0},
        "camera": camera_fields(CAMERA),
        "bounds": [[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]],
        "packages": {"r3jax": "0"},
    }
    return RunHeader(**fields | changes)


def make_pose(step: int) -> np.ndarray:
    angle = 0.3 * step
    pose = np.eye(4, dtype=np.float32)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [0.1 * step, 1.0 / 3.0, 1.5]
    return pose


def make_view(step: int) -> tuple[StepRow, Frame]:
    rng = np.random.default_rng(step)
    depth = rng.uniform(0.5, 4.0, (6, 8)).astype(np.float32)
    depth[0, 0], depth[0, 1] = 0.0, np.inf
    rgb = rng.random((6, 8, 3), dtype=np.float32)
    frame = stored_form(
        Frame(jnp.asarray(rgb), jnp.asarray(depth), jnp.asarray(make_pose(step)), CAMERA)
    )
    choice = None
    if step > 0:
        choice = Choice(
            pose=make_pose(step),
            score=1.0 / 7.0,
            waypoints=np.stack([make_pose(step - 1)[:3, 3], make_pose(step)[:3, 3]]),
            length=0.1,
            num_candidates=100,
            num_reachable=60,
            top={"total": [0.5, None], "path": [0.1, 0.3]},
        )
    row = StepRow(
        step=step,
        pose=np.asarray(frame.T_world_camera),
        sha256=frame_hash(frame),
        choice=choice,
        seconds=0.1 * step,
        metres=0.1 * step,
        radians=0.3 * step,
        charged={"planning": 0.1, "mapping": 1.0 / 3.0, "flight": 0.1},
        coverage=Coverage(10 * step, 4096, 0, 5 * step, 0.01 * step, 9, 0.5, 0.25),
    )
    return row, frame


def make_flight(
    legs: Sequence[tuple[np.ndarray, int]], before: StepRow | None = None
) -> list[StepRow]:
    """The rows of a run along paths, each over waypoints and in so many pieces, without frames.

    A path is moved to where the one before ended. With `before`, the last row of a run, the rows
    are those behind it in a merged run.
    """
    row, _ = make_view(0)
    step, metres = (0, 0.0) if before is None else (before.step + 1, before.metres)
    row = replace(row, step=step, metres=metres, charged={"flight": 0.0})
    if legs:
        row = replace(row, pose=_placed(row.pose, legs[0][0][0]))
    rows = [row]
    for waypoints, num in legs:
        way = (waypoints - waypoints[0] + row.pose[:3, 3]).astype(np.float32)
        length = float(np.linalg.norm(np.diff(way.astype(np.float64), axis=0), axis=1).sum())
        for number, place in enumerate(points_along(way.astype(np.float64), num), 1):
            pose = _placed(row.pose, place)
            row = replace(
                row,
                step=row.step + 1,
                pose=pose,
                choice=Choice(pose, 1.0, way, length, 1, 1) if number == 1 else None,
                metres=row.metres + length / num,
                charged={"flight": 1.0},
                captured=number < num,
            )
            rows.append(row)
    return rows


def _placed(pose: np.ndarray, place: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] = place
    return pose
