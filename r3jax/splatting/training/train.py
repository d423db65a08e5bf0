"""Fits a scene of Gaussians to views: the loop on the host round the jitted step."""

import dataclasses
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.errors import InputError
from r3jax.geometry.arguments import checked, one, or_none
from r3jax.interrupts import deferred_interrupt
from r3jax.splatting.config import fitting_budget
from r3jax.splatting.errors import TrainingDiverged
from r3jax.splatting.scene import GaussianScene, a_scene, empty_scene
from r3jax.splatting.training.checkpoints import (
    begin_checkpoints,
    only_training,
    read_checkpoint,
    save_checkpoint,
    settings_record,
)
from r3jax.splatting.training.config import Schedule, TrainConfig
from r3jax.splatting.training.growth import Growth, with_newborn
from r3jax.splatting.training.initialize import initialize
from r3jax.splatting.training.memory import check_memory
from r3jax.splatting.training.train_step import (
    DIVERGED,
    DONE,
    OVERFLOWN,
    StepInfo,
    TrainState,
    refine_step,
    reset_step,
    start_state,
    train_step,
)
from r3jax.splatting.views import Views, check_views

IN_FLIGHT = 10
"""Steps handed to the device before the host waits and looks: few enough that a step which must
be repeated costs little, many enough that the host is never the bottleneck."""


class History(NamedTuple):
    """One number for each step that was done, in order, from `first_step`."""

    first_step: int
    """Number of the first step here: 1, or what a resumed training began with."""

    loss: np.ndarray
    """Loss of the step's views before the step."""

    psnr: np.ndarray
    """PSNR of the step's views before the step [dB]."""

    num_gaussians: np.ndarray
    """Gaussians in use."""


class FitResult(NamedTuple):
    """What training gives."""

    scene: GaussianScene
    """The fitted Gaussians."""

    history: History
    """What was measured on the way."""

    interrupted: bool
    """True if Ctrl-C ended it early; with a folder, it can be resumed."""

    dropped: int
    """Gaussians that densification wanted and the capacity had no room for."""


class Progress(NamedTuple):
    """Where training stands; given to `on_progress` every few steps, but the compiling first."""

    step: int
    """Steps done."""

    iterations: int
    """Steps in all."""

    loss: float
    """Mean over the latest steps."""

    psnr: float
    """Mean over the latest steps' views [dB]."""

    num_gaussians: int
    """Rows in use."""

    dropped: int
    """Gaussians that were dropped so far."""

    seconds_left: float
    """At the mean pace of the latest hundred steps or so [s]; compilation is not counted in."""


OnProgress = Callable[[Progress], None]


class _Run(eqx.Module):
    """What stays the same during one training, the budget excepted."""

    views: Views
    extent: Float[Array, ""]
    config: TrainConfig
    schedule: Schedule


@checked(
    views=one(Views, "r3jax.load_views makes them of frames"),
    config=or_none(one(TrainConfig, "None: its defaults")),
    scene=or_none(a_scene),
)
def fit(
    views: Views,
    config: TrainConfig | None = None,
    *,
    scene: GaussianScene | None = None,
    folder: Path | str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    checkpoint_every: int = 1000,
    growth: Growth | None = None,
    on_progress: OnProgress | None = None,
) -> FitResult:
    """Fits 3D Gaussians to views (Kerbl et al. 2023, or Kheradmand et al. 2024).

    The same input gives the same result, bit for bit with the `numba` backend, whether or not
    the training was interrupted and resumed, and whatever the first budget of intersections.

    Args:
        views: what to reproduce; at least two.
        config: settings; the paper's by default.
        scene: Gaussians to begin with; by default they come from the views' depth.
        folder: where checkpoints go. None: none are written.
        resume: go on from the newest checkpoint of `folder`.
        overwrite: delete the checkpoints of an earlier training in `folder`, just before the
            first step.
        checkpoint_every: steps between two checkpoints; there is always one at the end.
        growth: views and Gaussians that join on the way; not with a folder, which holds the views
            of the beginning alone.
        on_progress: called every few steps.

    Returns:
        The scene and the history.

    Raises:
        ViewsError: nothing, or too little, to train on.
        TooLargeError: it would not fit in memory.
        CheckpointError: nothing to resume from, a training with other settings, or another
            process that trains in `folder`.
        TrainingDiverged: the loss or a gradient is no longer finite. The last good checkpoint
            stays.
        TypeError: arguments of another kind.
        ValueError: settings that do not fit together.
    """
    config = TrainConfig() if config is None else config
    check_views(views)
    check_memory(views, config)
    folder = None if folder is None else Path(folder)
    if resume and folder is None:
        raise InputError("resume needs the folder with the checkpoints")
    if resume and overwrite:
        raise InputError("resume goes on with the checkpoints, overwrite deletes them: choose one")
    if growth is not None and folder is not None:
        raise InputError("growth leaves no checkpoints: give no folder")
    extent = scene_extent(views)
    settings = settings_record(config, views, extent)
    run = _Run(views, jnp.asarray(extent, dtype=jnp.float32), config, config.schedule())
    with nullcontext() if folder is None else only_training(folder, is_new=not resume):
        if resume and folder is not None:
            like = jax.eval_shape(lambda: start_state(empty_scene(config.rows, config.sh_degree)))
            state = read_checkpoint(folder, settings, like)
        else:
            state = start_state(_first_scene(views, config, scene))
            if folder is not None:
                begin_checkpoints(folder, settings, overwrite=overwrite)
        return _Loop(run, state, folder, checkpoint_every, growth, on_progress).result()


def scene_extent(views: Views) -> float:
    """Measures the size of the captured space [m], the unit of several settings.

    1.1 times the largest distance of a camera from the cameras' mean, as in 3DGS. Cameras that
    turn on the spot have none: then, and whenever it is larger, a tenth of the median depth.
    """
    centers = np.asarray(views.T_world_camera[:, :3, 3], dtype=np.float64)
    distance = np.linalg.norm(centers - centers.mean(axis=0), axis=1)
    depth = np.asarray(views.depth)
    measured = depth[np.isfinite(depth) & (depth > 0.0)]
    least = 0.1 * float(np.median(measured)) if len(measured) else 0.1
    return max(1.1 * float(distance.max()), least)


def _first_scene(views: Views, config: TrainConfig, scene: GaussianScene | None) -> GaussianScene:
    """Returns the given scene, or makes one from the views, with the wanted number of rows."""
    if scene is None:
        key = jax.random.key(config.seed)
        return initialize(views, config.num_gaussians, config.rows, config.sh_degree, key=key)
    if scene.sh_degree != config.sh_degree:
        raise InputError(
            f"the scene has harmonics of degree {scene.sh_degree}, the config says "
            f"{config.sh_degree}"
        )
    missing = config.rows - scene.capacity
    if missing < 0:
        raise InputError(
            f"the scene has {scene.capacity} rows, more than the capacity {config.rows}: "
            "raise capacity"
        )
    unused = empty_scene(missing, config.sh_degree)
    # A copy in any case: training gives its buffers away.
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), scene, unused)


class _Loop:
    """Drives the steps; the only mutable thing here, and only while `fit` runs."""

    def __init__(
        self,
        run: _Run,
        state: TrainState,
        folder: Path | None,
        checkpoint_every: int,
        growth: Growth | None,
        on_progress: OnProgress | None,
    ):
        self.run, self.state, self.folder = run, state, folder
        self.every, self.growth, self.on_progress = checkpoint_every, growth, on_progress
        self.step = int(state.step)
        self.first_step = self.step + 1
        self.saved_step = self.step if self.step else None
        self.infos: list[StepInfo] = []
        self.paces: list[float] = []
        self.is_compiled = False

    def result(self) -> FitResult:
        """Trains to the end, or until Ctrl-C."""
        iterations = self.run.config.iterations
        # A step donates its state's buffers: an exception between the call and the assignment
        # would leave none.
        with deferred_interrupt() as interrupted:
            while self.step < iterations and not interrupted():
                self._advance(self._next_stop())
            self._save()
        self._check_finite()
        history = self._history()
        is_short = self.step < iterations
        return FitResult(self.state.scene, history, is_short, int(self.state.dropped))

    def _next_stop(self) -> int:
        """Returns the step up to which nothing interrupts the steps of the optimizer."""
        if not self.is_compiled:
            return self.step + 1
        config = self.run.config
        periods = [IN_FLIGHT, self.run.schedule.refine_every, self.run.schedule.reset_every]
        periods += [self.every] if self.folder is not None else []
        periods += [self.growth.every] if self.growth is not None else []
        ends = [(self.step // period + 1) * period for period in periods]
        return min(*ends, config.iterations)

    def _advance(self, stop: int) -> None:
        """Steps up to `stop`; fewer if one does not fit the budget, which is then raised."""
        run = self.run
        infos: list[StepInfo] = []
        begin = time.perf_counter()
        for _ in range(stop - self.step):
            self.state, info = train_step(
                self.state, run.views, run.extent, run.config, run.schedule
            )
            infos.append(info)
        infos = jax.device_get(infos)
        done = [info for info in infos if info.outcome == DONE]
        self.infos += done
        self.step += len(done)
        last = infos[-1]
        if last.outcome == OVERFLOWN:
            self._raise_budget(int(last.num_intersections))
            return
        if last.outcome == DIVERGED:
            raise TrainingDiverged(self.step + 1, float(last.loss), self.folder)
        self._after_step()
        if not self.is_compiled:  # the pace of this step says nothing
            self.is_compiled = True
            return
        self.paces.append((time.perf_counter() - begin) / len(infos))
        if self.on_progress is not None:
            self.on_progress(self._progress(done))

    def _raise_budget(self, needed: int) -> None:
        """Makes room for a view that needs more; the next step is recompiled."""
        budget = fitting_budget(needed)
        raster = dataclasses.replace(self.run.config.raster, max_intersections=budget)
        config = dataclasses.replace(self.run.config, raster=raster)
        self.run = dataclasses.replace(self.run, config=config)
        self.is_compiled = False

    def _after_step(self) -> None:
        """Runs what the schedule requires after the latest step."""
        run = self.run
        if run.schedule.refines_after(self.step):
            self.state, _ = refine_step(self.state, run.extent, run.config, run.schedule)
        if run.config.strategy == "vanilla" and run.schedule.resets_after(self.step):
            self.state = reset_step(self.state, run.config)
        if self.growth is not None and self.step % self.growth.every == 0:
            self._grow(self.growth)
        if self.step % self.every == 0:
            self._save()

    def _grow(self, growth: Growth) -> None:
        """Replaces the views, and adds Gaussians for what the new ones show."""
        if self.step < self.run.config.iterations:
            views, newborn = growth.add(self.step, self.state.scene)
            self.run = dataclasses.replace(self.run, views=views)
            if newborn is not None:
                self.state = with_newborn(self.state, newborn)

    def _save(self) -> None:
        if self.folder is not None and self.step != self.saved_step:
            self._check_finite()
            save_checkpoint(self.folder, self.state)
            self.saved_step = self.step

    def _check_finite(self) -> None:
        """Stops if the latest update left the scene unusable; no step has noticed that yet."""
        if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(self.state.scene)):
            raise TrainingDiverged(self.step, float("nan"), self.folder)

    def _progress(self, infos: list[StepInfo]) -> Progress:
        iterations = self.run.config.iterations
        return Progress(
            step=self.step,
            iterations=iterations,
            loss=float(np.mean([info.loss for info in infos])),
            psnr=float(np.mean([info.psnr for info in infos])),
            num_gaussians=int(infos[-1].num_gaussians),
            dropped=int(self.state.dropped),
            # The median: a stretch in which densification compiled does not count.
            seconds_left=float(np.median(self.paces[-10:])) * (iterations - self.step),
        )

    def _history(self) -> History:
        def column(name: str) -> np.ndarray:
            return np.array([getattr(info, name) for info in self.infos])

        return History(self.first_step, column("loss"), column("psnr"), column("num_gaussians"))
