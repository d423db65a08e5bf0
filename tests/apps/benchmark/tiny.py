"""A benchmark so small that its cells take seconds: a box room, three views of 48 pixels."""

import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

from r3jax.apps.benchmark.cells import Cell, Conditions
from r3jax.apps.benchmark.reference_images import (
    ReferenceImages,
    reference_path,
    save_reference_images,
)
from r3jax.apps.benchmark.run_cell import run_cell
from r3jax.geometry.cameras import look_at
from r3jax.simulators.scenes.registry import open_scene, scene_hash
from r3jax.splatting.views import load_views

CONDITIONS = Conditions(
    budget="views:3",
    snapshots=("views:2", "views:3"),
    clock="model",
    resolution=48,
    fov=90.0,
    voxel_size=0.1,
    map_capacity=1 << 14,
    train_resolution=48,
    iterations=30,
    gaussians=200,
    capacity=400,
    lpips="none",
)

SETTINGS = {"num_candidates": 10, "num_frontier": 3}


def make_cells(
    room: str, root: Path, policies=("random",), seeds=(0,), settings=SETTINGS, **changes
) -> tuple[Cell, ...]:
    """Cells of the room and, where they belong, four test views."""
    conditions = dataclasses.replace(CONDITIONS, **changes)
    simulator = open_scene(room, camera=conditions.camera, noise=0.0)
    digest = scene_hash(simulator)
    center = np.zeros(3)
    corners = [np.array([x, y, 0.2]) for x in (-1.5, 0.8) for y in (-1.0, 1.0)]
    poses = np.stack([np.asarray(look_at(corner, center)) for corner in corners])
    frames = [simulator.render(pose.astype(np.float64)) for pose in poses]
    views = load_views(frames, conditions.train_resolution)
    path = reference_path(root, digest, "four", conditions)
    save_reference_images(path, ReferenceImages("four", poses, views))
    return tuple(
        Cell(room, digest, policy, seed, conditions, "four", len(poses), dict(settings))
        for policy in policies
        for seed in seeds
    )


def main() -> None:
    """`python -m tests.apps.benchmark.tiny ROOM ROOT STAGE`: a cell, up to a stage without end."""
    room, root, last_stage = sys.argv[1], Path(sys.argv[2]), sys.argv[3]

    def on_stage(stage: str) -> None:
        print(stage, flush=True)
        if stage.startswith(last_stage):
            time.sleep(600)

    run_cell(make_cells(room, root)[0], root, on_stage)


if __name__ == "__main__":
    main()
