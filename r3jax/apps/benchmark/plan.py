"""Plans a benchmark: scenes x policies x seeds, and which cells are finished."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.benchmark.cells import Cell, Conditions, snapshots_left, sources_of
from r3jax.apps.benchmark.reference_images import (
    FOLDER,
    ReferenceImages,
    reference_path,
    save_reference_images,
)
from r3jax.errors import InputError
from r3jax.evaluation.test_views import ViewSet, load_view_set, render_view_set
from r3jax.exploration.guard import check_world
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import open_scene
from r3jax.splatting.views import load_views


@dataclass(frozen=True)
class Request:
    """The benchmark that the user requests."""

    scenes: tuple[str, ...]
    """Embedded scenes by name, or `mesh:<file>`."""

    policies: tuple[str, ...]
    """Names of the policies."""

    seeds: tuple[int, ...]
    """Seeds, with one exploration and one training each."""

    conditions: Conditions
    """Conditions of all cells."""

    max_test_views: int | None = 120
    """Maximum number of test views of a scene; None for all of the lattice."""

    settings: dict[str, Any] = field(default_factory=dict[str, Any])
    """Settings of all policies that differ from their defaults."""

    sweeps: dict[str, list[Any]] = field(default_factory=dict[str, list[Any]])
    """Values of further settings to sweep, by name; each combination becomes a cell."""

    @property
    def points(self) -> list[dict[str, Any]]:
        """The settings of each combination; the last swept one varies fastest."""
        tried = itertools.product(*self.sweeps.values())
        return [self.settings | dict(zip(self.sweeps, values, strict=True)) for values in tried]

    up: str | None = None
    """Vertical axis of mesh files; None: as their format has it."""

    scale: float = 1.0
    """Meters per unit of the mesh files."""

    cull_backfaces: bool = False
    """True to make faces invisible from behind."""


def make_plan(
    request: Request, root: Path, on_stage: Callable[[str], None] = lambda stage: None
) -> tuple[Cell, ...]:
    """Makes every cell, scene by scene; renders and stores each scene's test views.

    Args:
        request: the cells to plan.
        root: folder of the benchmark.
        on_stage: called with the name of each stage.

    Raises:
        ValueError: an unknown scene or policy, a setting that cannot work, nothing to do.
        OSError: a folder that cannot be written.
    """
    for name in ("scenes", "policies", "seeds"):
        given = getattr(request, name)
        if not given:
            raise InputError(f"there is nothing to do: no {name} are given")
        if len(set(given)) < len(given):
            raise InputError(f"{name} holds something twice: {', '.join(map(str, given))}")
    for policy, point in itertools.product(request.policies, request.points):
        # What can be checked quickly comes before the scenes.
        request.conditions.policy(policy, point)
    sources = {policy: sources_of(policy) for policy in request.policies}
    cells: list[Cell] = []
    for scene in request.scenes:
        view_set = prepare_scene(request, scene, root, on_stage)
        for policy, point, seed in itertools.product(
            request.policies, request.points, request.seeds
        ):
            cells.append(
                Cell(
                    scene=scene,
                    scene_hash=view_set.scene_hash,
                    policy=policy,
                    seed=seed,
                    conditions=request.conditions,
                    test_views_hash=view_set.hash,
                    num_test_views=len(view_set),
                    settings=point,
                    up=request.up,
                    scale=request.scale,
                    cull_backfaces=request.cull_backfaces,
                    sources=sources[policy],
                )
            )
    return tuple(cells)


def cells_left(root: Path, cells: Sequence[Cell]) -> tuple[Cell, ...]:
    """Returns the cells that have snapshots without a record."""
    return tuple(cell for cell in cells if snapshots_left(root, cell))


def prepare_scene(
    request: Request, scene: str, root: Path, on_stage: Callable[[str], None]
) -> ViewSet:
    """Computes a scene's test set, and renders and stores its images unless they are there.

    Args:
        request: how scenes are opened, and on what terms.
        scene: which one.
        root: folder of the benchmark.
        on_stage: called with the name of each stage.

    Raises:
        ValueError: an unknown scene, or one that cannot be explored.
        OSError: a folder that cannot be written.
    """
    conditions, folder = request.conditions, Path(root) / FOLDER
    on_stage(f"opening {scene}")
    # Always the same start, whatever the seeds: the test set is what can be reached from it.
    simulator = open_scene(
        scene,
        up=request.up,
        scale=request.scale,
        cull_back_faces=request.cull_backfaces,
        noise=0.0,
        seed=0,
    )
    check_world(simulator.bounds, conditions.exploration_config().cell_size)
    truth = GroundTruth(simulator)
    on_stage(f"finding the test views of {scene}")
    view_set = load_view_set(folder, truth, max_views=request.max_test_views)
    path = reference_path(root, view_set.scene_hash, view_set.hash, conditions)
    if not path.exists():
        on_stage(f"rendering {len(view_set)} test views of {scene}")
        frames = render_view_set(truth, view_set, conditions.resolution, conditions.fov)
        views = load_views(frames, conditions.train_resolution)
        poses = view_set.poses.astype(np.float32)
        save_reference_images(path, ReferenceImages(view_set.hash, poses, views))
    return view_set
