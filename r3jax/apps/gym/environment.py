"""Choosing views as a task of reinforcement learning.

    env = gymnasium.make("r3jax.apps.gym:r3jax/Explore-v0", scene="flat")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

A step takes one view: the camera flies there along known free space, and the view joins the map.
"""

import math
from typing import Any, SupportsFloat

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from r3jax.errors import InputError
from r3jax.exploration.coverage import mean_renderability, probe_poses
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.mapping.config import MappingConfig
from r3jax.mapping.occupancy import world_to_cell
from r3jax.planning.planner import Planner, decide, start, take_in
from r3jax.planning.policy import Decision
from r3jax.planning.registry import make_policy
from r3jax.planning.robot.travel import plan_travel
from r3jax.simulators.scenes.registry import open_scene

ACTIONS = ("candidates", "view")
REWARDS = ("renderability", "coverage")
Observation = dict[str, NDArray[Any]]

_REACH = 10
"""Cells of the local map on each side of the camera's: 2 m."""

_PITCH = math.radians(45.0)
"""Views of the action `view` look at most this far up or down [rad]."""

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""Classes of cells in the local map."""


class ExploreEnv(gymnasium.Env[Any, Any]):
    """Chooses the views of an unknown scene.

    Observation, a dictionary:
        image: colors [H, W, 3] uint8.
        depth: z-depth [H, W] float32 [m]; 0: no measurement, `max_range`: nothing nearer.
        pose: `T_world_camera` [4, 4] float32.
        local_map: cells round the camera [21, 21, 21] uint8, axes of the world: 0 unknown, 1 free,
            2 occupied.
        candidates: views on offer [C, 6] float32: position [m] and line of sight; zeros after the
            last one.
        mask: 1 for candidates that can be reached [C] int8.

    Action: `candidates`: the number of a candidate; `view`: five numbers from -1 to 1: the position
    in the scene's box, the heading (-180 to 180 degrees) and the elevation (-45 to 45). Where no
    known free path leads, the camera stays: `info["reached"]` is False, and the reward is 0.

    Reward: `renderability`: the gain in the sum of R over probe views in free space, divided by
    their largest number; `coverage`: the gain in the share of the grid that is known.

    `info` has the `utilities` of the candidates as the policy that drew them weighs them [C], the
    `path` to each [m], the `length` of the path flown [m] and the number of `voxels`. An episode
    terminates where no candidate is left.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012

    def __init__(
        self,
        scene: str = "flat",
        *,
        actions: str = "candidates",
        reward: str = "renderability",
        policy: str = "r3",
        num_candidates: int = 32,
        width: int = 96,
        height: int = 72,
        fov: float = 70.0,
        noise: float = 0.01,
        num_probes: int = 64,
        capacity: int = 1 << 16,
        render_mode: str | None = None,
    ):
        """Opens the scene.

        Args:
            scene: a name for `open_scene`: an embedded scene, a mesh file, a Habitat scene.
            actions: what an action is.
            reward: what an action is paid for.
            policy: draws the candidates, and weighs them for `info`.
            num_candidates: views on offer, C.
            width: columns of the images [px].
            height: rows of the images [px].
            fov: horizontal field of view [deg].
            noise: standard deviation of the depth as a share of it.
            num_probes: views that R is summed over.
            capacity: rows of the map at the start; it grows.
            render_mode: `rgb_array`: `render` returns the latest image.

        Raises:
            InputError: an unknown kind of action, reward or rendering, a scene or policy that is
                not known.
        """
        for name, value, known in (
            ("actions", actions, ACTIONS),
            ("reward", reward, REWARDS),
            ("render_mode", render_mode, (None, *self.metadata["render_modes"])),
        ):
            if value not in known:
                raise InputError(
                    f"{name} must be one of {', '.join(map(str, known))}, got {value!r}"
                )
        self.render_mode, self._actions, self._reward = render_mode, actions, reward
        self._camera = Camera.from_fov(width, height, fov)
        self._simulator = open_scene(scene, camera=self._camera, noise=noise)
        few = {"num_candidates": num_candidates, "num_frontier": num_candidates * 3 // 10}
        self._policy, self._num_probes = make_policy(policy, **few), num_probes
        self._margin = float(self._policy.config.safety_margin)  # type: ignore[attr-defined]
        # A world of a simulator stands still.
        self._config = MappingConfig(capacity=capacity, remove_moved=False)
        self._num, self._bounds = num_candidates, np.asarray(self._simulator.bounds, np.float64)
        self._planner: Planner | None = None
        self._space = self._observation_space()
        self.observation_space = self._space
        self.action_space = (
            spaces.Discrete(num_candidates)
            if actions == "candidates"
            else spaces.Box(-1.0, 1.0, (5,), np.float32)
        )

    # Any: the hints of gymnasium's own spaces are of a kind that beartype warns of.
    def _observation_space(self) -> Any:
        camera, (low, high) = self._camera, self._bounds
        least, most = -np.ones((4, 4), np.float32), np.ones((4, 4), np.float32)
        least[:3, 3], most[:3, 3] = low - 1.0, high + 1.0
        views = np.concatenate([low - 1.0, -np.ones(3)]), np.concatenate([high + 1.0, np.ones(3)])
        # Padding is zeros, wherever the box lies.
        first, last = np.minimum(views[0], 0.0), np.maximum(views[1], 0.0)
        tile = lambda row: np.tile(row.astype(np.float32), (self._num, 1))
        side = 2 * _REACH + 1
        return spaces.Dict(
            {
                "image": spaces.Box(0, 255, (camera.height, camera.width, 3), np.uint8),
                "depth": spaces.Box(
                    0.0, self._config.max_range, (camera.height, camera.width), np.float32
                ),
                "pose": spaces.Box(least, most, dtype=np.float32),
                "local_map": spaces.Box(0, OCCUPIED, (side, side, side), np.uint8),
                "candidates": spaces.Box(tile(first), tile(last), dtype=np.float32),
                "mask": spaces.MultiBinary(self._num),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode where the scene begins; the seed decides which candidates are drawn."""
        super().reset(seed=seed, options=options)
        self._key = jax.random.key(int(self.np_random.integers(2**31)))
        self._pose, self._steps = np.asarray(self._simulator.start_pose, np.float64), 0
        self._planner = start(
            self._camera, self._bounds, self._policy, starts=[self._pose], config=self._config
        )
        self._take()
        self._value = self._worth()
        return self._observe(), self._info(True, 0.0)

    def step(self, action: Any) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Flies to a view and takes it."""
        if self._planner is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        wanted, self._steps = self._wanted(action), self._steps + 1
        length = math.inf if wanted is None else self._fly(wanted)
        is_reached = math.isfinite(length)
        if is_reached:
            self._take()
        before, self._value = self._value, self._worth() if is_reached else self._value
        is_over = self._offer is None
        info = self._info(is_reached, length if is_reached else 0.0)
        return self._observe(), self._value - before, is_over, False, info

    def render(self) -> Any:
        """Returns the latest image [H, W, 3] uint8, in the mode `rgb_array`."""
        return self._observe()["image"] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Closes the scene."""
        self._planner = None

    @property
    def planner(self) -> Planner:
        """The planner, for policies that are not learned."""
        if self._planner is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        return self._planner

    def action_of(self, T_world_camera: np.ndarray) -> NDArray[np.float32]:
        """Returns the action `view` that stands for a pose [4, 4], whose roll is lost."""
        low, high = self._bounds
        axis = T_world_camera[:3, 2]
        look = [
            math.atan2(axis[1], axis[0]) / math.pi,
            math.asin(float(np.clip(axis[2], -1.0, 1.0))) / _PITCH,
        ]
        place = 2.0 * (T_world_camera[:3, 3] - low) / (high - low) - 1.0
        return np.clip(np.concatenate([place, look]), -1.0, 1.0).astype(np.float32)

    def _wanted(self, action: Any) -> np.ndarray | None:
        """The pose that an action asks for; None for a candidate that is padding."""
        if self._actions == "candidates":
            index = int(action)
            offered = 0 if self._offer is None else len(self._offer.candidates)
            return self._offer.candidates[index] if self._offer and index < offered else None
        x, y, z, turn, tilt = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        low, high = self._bounds
        place = low + 0.5 * (np.array([x, y, z]) + 1.0) * (high - low)
        yaw, pitch = math.pi * turn, _PITCH * tilt
        level = math.cos(pitch)
        axis = np.array([math.cos(yaw) * level, math.sin(yaw) * level, math.sin(pitch)])
        return np.asarray(pose_along(place, axis), np.float64)

    def _fly(self, T_wanted: np.ndarray) -> float:
        """Moves the camera along known free space; the length [m], inf where there is no path."""
        travel = plan_travel(self.planner.grid, self._pose[:3, 3], self._margin)
        place = T_wanted[:3, 3]
        length = float(travel.lengths(place[None])[0])
        cell = travel.cell_of(place)
        if not (math.isfinite(length) and travel.contains(cell) and travel.goals[cell]):
            return math.inf
        self._pose = T_wanted
        return length

    def _take(self) -> None:
        """Takes the view, and asks the policy what comes next."""
        self._frame: Frame = self._simulator.render(self._pose)
        planner = take_in(self.planner, self._frame)
        key = jax.random.fold_in(self._key, self._steps)
        offer: Decision | None
        offer, self._planner, _ = decide(planner, self._pose, key)
        self._offer = offer

    def _worth(self) -> float:
        """What rewards are the gains of."""
        planner = self.planner
        if self._reward == "coverage":
            return 1.0 - float(np.asarray(planner.grid.unexplored).mean())
        num = self._num_probes
        mean = mean_renderability(planner.map_state, planner.grid, self._camera, num)
        return mean * len(probe_poses(planner.grid, num)) / num

    def _observe(self) -> Observation:
        reach = self._config.max_range
        depth = np.minimum(np.asarray(self._frame.depth), reach).astype(np.float32)
        views, mask = np.zeros((self._num, 6), np.float32), np.zeros(self._num, np.int8)
        if self._offer is not None:
            poses = self._offer.candidates[: self._num]
            views[: len(poses)] = np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1)
            mask[: len(poses)] = np.isfinite(self._offer.utilities["path"][: self._num])
        # Rounding may put a cosine above 1.
        pose, space = self._pose.astype(np.float32), self._space
        return {
            "image": np.rint(255.0 * np.asarray(self._frame.rgb)).astype(np.uint8),
            "depth": depth,
            "pose": np.clip(pose, space["pose"].low, space["pose"].high),
            "local_map": self._local_map(),
            "candidates": np.clip(views, space["candidates"].low, space["candidates"].high),
            "mask": mask,
        }

    def _local_map(self) -> NDArray[np.uint8]:
        grid = self.planner.grid
        classes = np.where(np.asarray(grid.free), FREE, UNKNOWN)
        classes = np.where(np.asarray(grid.occupied), OCCUPIED, classes).astype(np.uint8)
        # Beyond the grid nothing is known.
        padded = np.pad(classes, _REACH, constant_values=UNKNOWN)
        cell = np.asarray(world_to_cell(grid, jnp.asarray(self._pose[:3, 3], jnp.float32)))
        cell = np.clip(cell, 0, np.array(classes.shape) - 1)
        x, y, z = (slice(int(i), int(i) + 2 * _REACH + 1) for i in cell)
        return padded[x, y, z]

    def _info(self, is_reached: bool, length: float) -> dict[str, Any]:
        utilities = np.full(self._num, -np.inf, np.float32)
        path = np.full(self._num, np.inf, np.float32)
        if self._offer is not None:
            for name, target in (("total", utilities), ("path", path)):
                values = self._offer.utilities[name][: self._num]
                target[: len(values)] = values
        return {
            "reached": is_reached,
            "length": length,
            "voxels": int(self.planner.map_state.num_present),
            "utilities": np.where(np.isfinite(path), utilities, -np.inf),
            "path": path,
        }
