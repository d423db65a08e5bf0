"""transforms.json: the recorded frames as a data set that 3DGS trainers read.

nerfstudio's convention: OpenGL camera axes (x right, y up, z backward), camera to world, meters,
world z up, pixel centers at +0.5. Depth images are uint16; one step is
`depth_unit_scale_factor` meters; 0 is no measurement and `depth_beyond_range_value` means that
nothing lies within the sensor's range.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.files import write_atomic
from r3jax.trace import BEYOND_RANGE, DEPTH_STEPS_PER_METRE
from r3jax.trace.reader import Run
from r3jax.trace.rows import StepRow

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns the camera's axes: `T_world_opengl = T_world_opencv @ this`; its own inverse."""


def transforms_of(run: Run, points: str | None = None) -> dict[str, Any]:
    """The content of transforms.json.

    Args:
        run: a run with at least one view.
        points: path of a point cloud relative to the run folder, where there is one.
    """
    content = (
        {"camera_model": "OPENCV"}
        | _lens(run)
        | _DEPTH
        | {"frames": [_frame(run, row, run.path) for row in run.rows]}
    )
    return content if points is None else content | {"ply_file_path": points}


def write_transforms(run: Run, points: str | None = None) -> Path:
    """Writes transforms.json into the run folder.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    return _write(run.path, transforms_of(run, points))


def write_team_transforms(folder: Path, runs: Sequence[Run], points: str | None = None) -> Path:
    """Writes one transforms.json for runs in a folder; each frame has the lens that took it.

    Args:
        folder: that holds the run folders.
        runs: in it; of one world, with cameras that may differ.
        points: path of a point cloud relative to the folder, where there is one.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    frames = [_frame(run, row, folder) | _lens(run) for run in runs for row in run.rows]
    content = {"camera_model": "OPENCV"} | _DEPTH | {"frames": frames}
    return _write(folder, content if points is None else content | {"ply_file_path": points})


_DEPTH = {
    "depth_unit_scale_factor": 1.0 / DEPTH_STEPS_PER_METRE,
    "depth_beyond_range_value": BEYOND_RANGE,
}


def _lens(run: Run) -> dict[str, Any]:
    camera = run.camera
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.fx),
        "fl_y": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }


def _frame(run: Run, row: StepRow, folder: Path) -> dict[str, Any]:
    return {
        "file_path": run.image_path(row.step).relative_to(folder).as_posix(),
        "depth_file_path": run.depth_path(row.step).relative_to(folder).as_posix(),
        "transform_matrix": (row.pose.astype(np.float64) @ OPENGL_FROM_OPENCV).tolist(),
    }


def _write(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "transforms.json"
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())
    return path
