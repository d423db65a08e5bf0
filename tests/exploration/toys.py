"""A world and policies so small that the loop's own behavior is what the tests see."""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.planning.policy import Decision, DecisionOutcome, PlanInfo

LOWER, UPPER = np.zeros(3), np.array([4.0, 3.0, 2.4])


def rays_of(camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
    """Ray of every pixel in the world, [H, W, 3], with depth 1; no component is zero."""
    u = (np.arange(camera.width) + 0.5 - float(camera.cx)) / float(camera.fx)
    v = (np.arange(camera.height) + 0.5 - float(camera.cy)) / float(camera.fy)
    rays = np.stack([*np.meshgrid(u, v), np.ones((camera.height, camera.width))], axis=-1)
    rays = rays @ T_world_camera[:3, :3].T
    return np.where(np.abs(rays) < 1e-9, 1e-9, rays)


def wavy_frame(
    camera: Camera, T_world_camera: np.ndarray, rays: np.ndarray, depth: np.ndarray
) -> Frame:
    """The frame of surfaces that carry waves of color."""
    points = T_world_camera[:3, 3] + rays * depth[..., None]
    rgb = 0.5 + 0.4 * np.sin(3.0 * points + np.array([0.0, 1.0, 2.0]))
    images = (jnp.asarray(x, jnp.float32) for x in (rgb, depth, T_world_camera))
    return Frame(*images, camera)


@dataclass
class BoxRoom:
    """An empty room with wavy walls, seen by an exact ray caster in NumPy."""

    camera: Camera = field(default_factory=lambda: Camera.from_fov(48, 48, 90.0))
    bounds: np.ndarray = field(default_factory=lambda: np.stack([LOWER, UPPER]))
    start_pose: np.ndarray = field(
        default_factory=lambda: np.asarray(
            pose_along(jnp.array([1.2, 1.1, 1.3]), jnp.array([1.0, 0.3, 0.0])), np.float64
        )
    )
    rendered: list[np.ndarray] = field(default_factory=list)
    """Every pose that a picture was asked for."""

    def render(self, T_world_camera: np.ndarray) -> Frame:
        self.rendered.append(T_world_camera)
        rays, position = rays_of(self.camera, T_world_camera), T_world_camera[:3, 3]
        depth = np.where(rays > 0, (UPPER - position) / rays, (LOWER - position) / rays).min(-1)
        return wavy_frame(self.camera, T_world_camera, rays, depth)


@dataclass
class Wander:
    """Flies to a random near place and looks in a random direction."""

    name: str = "wander"
    reach: float = 0.4
    last_step: int | None = None
    """After so many decisions there is nowhere to go."""

    def init(self, camera: Camera, grid: Any, *, key: Any) -> dict[str, int]:
        return {"decisions": 0, "frames": 0}

    def observe(self, state: dict[str, int], map_state: Any, frame: Frame) -> dict[str, int]:
        return state | {"frames": state["frames"] + 1}

    def decide(self, state, map_state, grid, T_world_camera, *, key):
        if state["decisions"] == self.last_step:
            return None, state, PlanInfo(DecisionOutcome.NO_REACHABLE_CANDIDATE, 9, 0)
        numbers = np.asarray(jax.random.uniform(key, (5, 6)), dtype=np.float64)
        here = T_world_camera[:3, 3]
        places = np.clip(here + self.reach * (2 * numbers[:, :3] - 1), LOWER + 0.5, UPPER - 0.5)
        candidates = np.stack(
            [
                np.asarray(pose_along(jnp.asarray(p, jnp.float32), jnp.asarray(d, jnp.float32)))
                for p, d in zip(places, numbers[:, 3:] - 0.5, strict=True)
            ]
        ).astype(np.float64)
        length = float(np.linalg.norm(candidates[0, :3, 3] - here))
        decision = Decision(
            T_world_camera=candidates[0],
            waypoints=np.stack([here, candidates[0, :3, 3]]),
            length=length,
            score=float(numbers[0, 0]),
            candidates=candidates,
            utilities={"total": numbers[:, 0], "path": np.full(5, length)},
        )
        info = PlanInfo(DecisionOutcome.MOVED, 5, 5, {"scoring": 0.01})
        return decision, state | {"decisions": state["decisions"] + 1}, info

    def follow(self, state, map_state, grid, T_world_camera, waypoints):
        return state
