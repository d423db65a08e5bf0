"""Fits a scene of Gaussians to views: the loop on the host round the jitted step.

Before it starts, `check_memory` compares the memory that it needs with the free memory. Its
coefficients are those of the compiled training step, rounded up;
tests/splatting/training/test_memory.py holds the estimate against XLA's own account. `Growth` adds
views, and Gaussians for what they show, while training runs.

Shape symbols: n rows of the scene; m newborn Gaussians.
"""

import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from r3jax.errors import InputError
from r3jax.geometry.arguments import checked, one, or_none
from r3jax.interrupts import deferred_interrupt
from r3jax.kernels.constants import TILE
from r3jax.splatting.errors import TooLargeError, TrainingDiverged
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene, a_scene, empty_scene
from r3jax.splatting.training.checkpoints import (
    begin_checkpoints,
    only_training,
    read_checkpoint,
    save_checkpoint,
    settings_record,
)
from r3jax.splatting.training.config import Schedule, TrainConfig
from r3jax.splatting.training.initialize import initialize
from r3jax.splatting.training.optimizer import forget
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


class Addition(NamedTuple):
    """Views and Gaussians to continue with."""

    views: Views
    """Keeps the number and the size of those before: another number would recompile the step."""

    newborn: GaussianScene | None = None
    """Gaussians that join, of the scene's harmonics; unused rows count for nothing."""


class Growth(NamedTuple):
    """When to add views."""

    every: int
    """Steps between two additions."""

    add: Callable[[int, GaussianScene], Addition]
    """Called with the number of steps and the scene, which must not be stored: the next step
    donates its buffers."""


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
    """Measurements during the training."""

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
        growth: views and Gaussians that join later; not with a folder, which holds the views
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
        raster = self.run.config.raster.with_room(needed)
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


_GEOMETRY_FLOATS = 3 + 4 + 3 + 1
"""Mean, rotation, scales and opacity of a Gaussian."""

_COPIES = 8
"""Copies of every parameter: itself, its gradient and Adam's two moments, each before and after."""

_BYTES_PER_ROW = 200
"""Projection, its gradient and the density statistics of a Gaussian."""

_BYTES_PER_INTERSECTION = 64
"""Keys, order, and the gradient that waits for its reduction."""

_BYTES_PER_PIXEL = 400
"""The rendering, the loss and their gradients."""

_ARRAYS_PER_BATCH = 12
"""Arrays of a number for each pixel and Gaussian of a batch that the gradient of `xla` holds."""

_RESERVE = 0.05
"""Share of the free memory that is left alone, for the compiler (some 300 MB) among others."""


def training_bytes(width: int, height: int, config: TrainConfig, rows: int | None = None) -> int:
    """Estimates the memory of training besides the images of the views [bytes].

    Args:
        width: of the views [px].
        height: of the views [px].
        config: strategy, backend and sizes.
        rows: capacity of the scene. None: that of the config.
    """
    rows = config.rows if rows is None else rows
    sh_floats = 3 * (config.sh_degree + 1) ** 2
    per_row = 4 * _COPIES * (_GEOMETRY_FLOATS + sh_floats) + _BYTES_PER_ROW
    intersections = config.raster.budget(rows) * _BYTES_PER_INTERSECTION
    total = rows * per_row + intersections + width * height * _BYTES_PER_PIXEL
    if config.raster.backend == "numba":
        return total
    tiles = min(config.raster.tiles_per_batch, -(-width // TILE) * -(-height // TILE))
    pairs = tiles * TILE * TILE * config.raster.gaussians_per_chunk
    return total + 4 * _ARRAYS_PER_BATCH * pairs


def free_bytes(device: Any = None) -> int | None:
    """Returns the bytes that are free for the device's arrays; None where it is not known.

    Args:
        device: one of `jax.devices()`, the first by default. On a CPU the limits of the
            container count, too.
    """
    device = jax.devices()[0] if device is None else device
    if device.platform == "cpu":
        return min(_free_on_host(), default=None)
    stats = device.memory_stats()
    if not stats or "bytes_limit" not in stats:
        return None
    return stats["bytes_limit"] - stats.get("bytes_in_use", 0)


def _free_on_host(root: Path = Path("/")) -> Iterator[int]:
    """Measures the free memory of the machine, and of each control group of this process."""
    available = _number_after(root / "proc/meminfo", "MemAvailable:")
    if available is not None:
        yield available * 1024  # kB
    elif "SC_PHYS_PAGES" in os.sysconf_names:
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for folder, names in _control_groups(root):
        limit = _number(folder / names.limit)
        usage = _number(folder / names.usage)
        if limit is not None and usage is not None:
            cache = _number_after(folder / "memory.stat", names.cache) or 0
            yield max(0, limit - usage + cache)  # files kept in memory give way


class _Names(NamedTuple):
    """How a version of control groups calls its numbers."""

    limit: str
    usage: str
    cache: str


_VERSION_1 = _Names("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = _Names("memory.max", "memory.current", "inactive_file")


def _control_groups(root: Path) -> Iterator[tuple[Path, _Names]]:
    """Yields folders of the control groups that hold this process, innermost first."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0":
            base, names = root / "sys/fs/cgroup", _VERSION_2
        elif "memory" in controllers.split(","):
            base, names = root / "sys/fs/cgroup/memory", _VERSION_1
        else:
            continue
        inner = base / path.strip().lstrip("/")
        for folder in (inner, *inner.parents):
            yield folder, names
            if folder == base:
                break


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _number(path: Path) -> int | None:
    """Reads the number in a file; None if it is missing or says `max`."""
    text = _read(path).strip()
    return int(text) if text.isdecimal() else None


def _number_after(path: Path, name: str) -> int | None:
    """Reads the number after a name in a file of such lines."""
    for line in _read(path).splitlines():
        words = line.split()
        if len(words) >= 2 and words[0] == name and words[1].isdecimal():
            return int(words[1])
    return None


def check_memory(views: Views, config: TrainConfig, *, free: int | None = None) -> None:
    """Refuses a training that would not fit, before anything is allocated or compiled.

    Args:
        views: the training views, already in memory.
        config: sizes, strategy and backend.
        free: bytes. None: what the device has free; nothing is refused where that is not known.

    Raises:
        TooLargeError: it would not fit; the message says how much is needed, how much is free
            and how many Gaussians would fit.
    """
    free = free_bytes() if free is None else free
    if free is None:
        return
    usable = int((1.0 - _RESERVE) * free)
    needed = training_bytes(views.width, views.height, config)
    if needed <= usable:
        return
    fitting = _most_rows(views.width, views.height, config, usable)
    raise TooLargeError(
        f"room for {config.rows} Gaussians (SH degree {config.sh_degree}) needs about "
        f"{needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free: "
        + (f"at most {fitting} fit" if fitting else "none would fit; lower the resolution, too")
    )


def _most_rows(width: int, height: int, config: TrainConfig, usable: int) -> int:
    """Finds the largest capacity that fits: the estimate grows with it. 0 if not even 1 does."""
    low, high = 0, config.rows
    while high - low > 1:
        middle = (low + high) // 2
        if training_bytes(width, height, config, middle) <= usable:
            low = middle
        else:
            high = middle
    return low


def with_newborn(state: TrainState, newborn: GaussianScene) -> TrainState:
    """Puts Gaussians into unused rows, without moments; those that find none are counted."""
    is_born = np.asarray(newborn.is_alive)
    free = np.flatnonzero(~np.asarray(state.scene.is_alive))
    # Past the end where there is no room, and for rows that are not in use: dropped.
    rank = np.cumsum(is_born) - 1
    has_room = is_born & (rank < len(free))
    row = np.full(len(is_born), state.scene.capacity)
    row[has_room] = free[rank[has_room]]
    put = lambda x, y: x.at[jnp.asarray(row)].set(y, mode="drop")
    scene = jax.tree.map(put, state.scene, newborn)
    is_new = np.zeros(state.scene.capacity, dtype=bool)
    is_new[row[has_room]] = True
    lost = jnp.asarray(int(is_born.sum() - has_room.sum()), dtype=jnp.int32)
    return TrainState(
        scene=scene,
        moments=forget(state.moments, jnp.asarray(is_new)),
        statistics=state.statistics,
        step=state.step,
        dropped=state.dropped + lost,
    )


def where_new(newborn: GaussianScene, scene: GaussianScene) -> GaussianScene:
    """Keeps the Gaussians that are farther from all of a scene than they are large.

    Args:
        newborn: round Gaussians, as `initialize` makes them.
        scene: the existing Gaussians.
    """
    there = np.asarray(scene.means)[np.asarray(scene.is_alive)]
    if len(there) == 0:
        return newborn
    distance, _ = KDTree(there).query(np.asarray(newborn.means), workers=-1)
    is_known = distance < np.exp(np.asarray(newborn.log_scales)[:, 0])
    logits = jnp.where(jnp.asarray(is_known), DEAD_LOGIT, newborn.opacity_logits)
    return eqx.tree_at(lambda s: s.opacity_logits, newborn, logits)
