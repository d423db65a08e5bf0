"""What all cells of a benchmark have in common, in one place: that is what makes it fair."""

from dataclasses import dataclass, field, fields
from typing import Any, Literal

from r3jax.exploration.config import Budget, ClockName, ExplorationConfig, parse_budget
from r3jax.geometry.cameras import Camera
from r3jax.planning.policy import Policy
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.motion import Motion, make_motion, motion_of_record
from r3jax.scoring.config import ScoringConfig
from r3jax.splatting.config import Backend, RasterConfig
from r3jax.splatting.training.config import TrainConfig

_SCORING = "scoring."
"""Prefix of the settings that go to `ScoringConfig`."""

OWN_OF_LOOP = ("voxel_size", "cell_size", "max_range", "capacity", "clock", "checkpoint_every")
"""Fields of `ExplorationConfig` that `Conditions` decides."""

_CHECKPOINT_EVERY = 25
"""Views between two checkpoints: frames and rows rebuild what comes after the last one."""

OWN_OF_TRAINER = ("iterations", "num_gaussians", "capacity", "raster", "seed")
"""The same of `TrainConfig`; the seed is the cell's."""


@dataclass(frozen=True)
class Conditions:
    """Budget, sensor, maps, clock, training and evaluating: the same for every policy.

    Raises:
        ValueError: a setting that cannot work, a snapshot beyond the budget.
    """

    budget: str = "views:60"
    """Budget of every exploration: `views:N`, `seconds:S` or `meters:M`."""

    snapshots: tuple[str, ...] = ()
    """Where a model is trained and evaluated, in any of these units; by default at the budget."""

    clock: ClockName = "wall"
    """`wall`: measured planning and mapping. `model`: fixed costs, the same run every time."""

    resolution: int = 256
    """Width and height of the explored images [px]."""

    fov: float = 60.0
    """Field of view [degrees]."""

    noise: float = 0.01
    """Standard deviation of the explored depth as a share of the depth; test views have none."""

    max_range: float = 5.0
    """Range of the depth sensor [m]."""

    voxel_size: float = 0.05
    """Edge of a voxel of the map [m]."""

    cell_size: float = 0.2
    """Edge of a cell of the coarse grid [m]."""

    map_capacity: int = 1 << 17
    """Rows of the map at the start, a power of two."""

    train_resolution: int = 128
    """Width and height of the images that are trained on and evaluated [px]."""

    iterations: int = 2000
    """Steps of every training."""

    gaussians: int = 20_000
    """Gaussians at the start of every training."""

    capacity: int = 40_000
    """Gaussians that there may ever be."""

    backend: Backend = "auto"
    """Rasterizer."""

    lpips: Literal["alex", "vgg", "none"] = "alex"
    """Network of LPIPS; `none` leaves it out."""

    loop: dict[str, Any] = field(default_factory=dict[str, Any])
    """Further settings of `ExplorationConfig` by name; those at their defaults are left out."""

    trainer: dict[str, Any] = field(default_factory=dict[str, Any])
    """Further settings of `TrainConfig` by name; those at their defaults are left out."""

    def __post_init__(self) -> None:
        """Refuses what cannot work, before anything is started."""
        if not self.snapshots:
            object.__setattr__(self, "snapshots", (self.budget,))
        budget = parse_budget(self.budget)
        parsed = [parse_budget(text) for text in self.snapshots]
        for snapshot in parsed:
            if snapshot.unit == budget.unit and snapshot.amount > budget.amount:
                raise ValueError(f"the snapshot {snapshot} lies beyond the budget {budget}")
        if len(set(parsed)) < len(parsed):
            raise ValueError(f"a snapshot is given twice: {', '.join(self.snapshots)}")
        for name in ("resolution", "train_resolution"):
            if not 16 <= getattr(self, name) <= 4096:
                raise ValueError(f"{name} must lie between 16 and 4096, got {getattr(self, name)}")
        if self.train_resolution > self.resolution:
            raise ValueError(
                f"train_resolution {self.train_resolution} is more than the images have: "
                f"resolution is {self.resolution}"
            )
        object.__setattr__(self, "loop", _further(self.loop, ExplorationConfig, OWN_OF_LOOP))
        object.__setattr__(self, "trainer", _further(self.trainer, TrainConfig, OWN_OF_TRAINER))
        # Each refuses what it cannot work with.
        _ = self.exploration_config(), self.train_config(0)

    @property
    def camera(self) -> Camera:
        """Camera of every exploration, and of the test views before they are made smaller."""
        return Camera.from_fov(self.resolution, self.resolution, self.fov)

    def exploration_config(self) -> ExplorationConfig:
        """Settings of the loop."""
        return ExplorationConfig(
            voxel_size=self.voxel_size,
            cell_size=self.cell_size,
            max_range=self.max_range,
            capacity=self.map_capacity,
            clock=self.clock,
            checkpoint_every=_CHECKPOINT_EVERY,
            **self.loop,
        )

    def train_config(self, seed: int) -> TrainConfig:
        """Settings of the training: vanilla 3DGS, whoever chose the views."""
        return TrainConfig(
            iterations=self.iterations,
            num_gaussians=self.gaussians,
            capacity=self.capacity,
            raster=RasterConfig(backend=self.backend),
            seed=seed,
            **self.trainer,
        )

    def policy(self, name: str, settings: dict[str, Any]) -> Policy:
        """A policy that scores what this sensor sees.

        Args:
            name: one of `planning.policy.policy_names()`.
            settings: fields of `PlannerConfig`; `scoring.NAME` is a field of `ScoringConfig`,
                `motion` the name of a motion or its settings.

        Raises:
            ValueError: an unknown name, or a value that is impossible.
        """
        planner = {k: v for k, v in settings.items() if not k.startswith(_SCORING)}
        scoring: dict[str, Any] = {
            k.removeprefix(_SCORING): v for k, v in settings.items() if k not in planner
        }
        known = [field.name for field in fields(ScoringConfig)]
        unknown = [name for name in scoring if name not in known]
        if unknown or "scoring" in planner:
            wrong = ", ".join(unknown) or "scoring"
            raise ValueError(
                f"there is no setting {wrong} of the scores: give scoring.NAME, one of "
                f"{', '.join(known)}"
            )
        scoring = {"max_range": self.max_range} | scoring
        if "motion" in planner:
            planner["motion"] = _motion(planner["motion"])
        try:
            return make_policy(name, scoring=ScoringConfig(**scoring), **planner)
        except TypeError as error:  # a text where a number belongs
            raise ValueError(f"policy {name!r} with {settings}: {error}") from None


def _motion(given: Any) -> Motion:
    return make_motion(given) if isinstance(given, str) else motion_of_record(given)


def _further(given: dict[str, Any], config: type, own: tuple[str, ...]) -> dict[str, Any]:
    """The given settings of a config that are not its defaults, in the order of its fields."""
    known = {field.name: field.default for field in fields(config) if field.name not in own}
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ValueError(
            f"{config.__name__} has no further setting {', '.join(unknown)}; there are "
            f"{', '.join(known)}"
        )
    return {k: given[k] for k, default in known.items() if k in given and given[k] != default}


def snapshot_slug(snapshot: str) -> str:
    """A snapshot as a part of file names: `views:30` is `views-30`."""
    return str(parse_budget(snapshot)).replace(":", "-")


def snapshot_order(snapshot: str) -> tuple[str, float]:
    """Sorts snapshots by unit, then by amount."""
    budget: Budget = parse_budget(snapshot)
    return budget.unit, budget.amount
