"""How long a robot waits: observe and decide over a mission, their 95th percentiles, and memory.

    python -m experiments.robot_rates --sizes 640x480 1280x720 --frames 300

One mission in the house for each size of image: a key frame and a decision at each goal. Rendering
the images of the robot's camera is not counted.
"""

import json
import resource
import time
from dataclasses import dataclass

import jax
import numpy as np
import tyro

import r3jax
from experiments.robots import (
    Robot,
    after,
    open_bounds,
    plan_of,
    pose_of,
    scene_world,
    start_of,
)
from r3jax.geometry.cameras import Camera
from r3jax.simulators.base import NoisySimulator
from r3jax.simulators.raycast.raycast import RaycastSimulator


@dataclass(frozen=True)
class Options:
    """Which missions."""

    scene: str = "house"
    sizes: tuple[str, ...] = ("640x480", "1280x720")
    frames: int = 300
    candidates: int = 100


def mission(options: Options, size: str) -> dict[str, object]:
    """Drives one mission; medians and percentiles of its steps [ms], and memory [GB]."""
    robot, world = Robot(height=0.6), scene_world(options.scene)
    width, height = map(int, size.split("x"))
    camera: Camera = Camera.from_fov(width, height, 69.0)
    plan = plan_of(world, 0.0, robot.low, robot.height)
    pose = pose_of(robot, plan.center(start_of(plan, robot.footprint)), 0.0)
    simulator = RaycastSimulator(world, camera, start_pose=None, max_range=5.0)
    simulator = NoisySimulator(simulator, 0.01, 0)
    policy = r3jax.make_policy("r3-pano", num_candidates=options.candidates, **after(robot))
    planner = r3jax.start(camera, open_bounds(world, 0.0), policy, starts=[pose])
    times: dict[str, list[float]] = {"observe": [], "decide": []}
    for key in jax.random.split(jax.random.key(0), options.frames):
        frame = simulator.render(pose.astype(np.float32))
        begin = time.perf_counter()
        planner = jax.block_until_ready(r3jax.observe(planner, frame))
        times["observe"].append(time.perf_counter() - begin)
        begin = time.perf_counter()
        decision, planner, info = r3jax.decide(planner, pose, key)
        times["decide"].append(time.perf_counter() - begin)
        if decision is None:
            print(info.outcome.value, info.reason)
            break
        pose = decision.T_world_camera
    row: dict[str, object] = {"size": size, "frames": len(times["observe"])}
    for name, seconds in times.items():
        # The first ones compile.
        later = 1e3 * np.array(seconds[3:])
        row |= {f"{name}_median_ms": round(float(np.median(later)), 1),
                f"{name}_p95_ms": round(float(np.percentile(later, 95)), 1),
                f"{name}_first_s": round(seconds[0], 1)}  # fmt: skip
    row["voxels"] = int(np.asarray(planner.map_state.present).sum())
    row["map_mb"] = round(sum(x.nbytes for x in jax.tree.leaves(planner.map_state)) / 1e6, 1)
    row["peak_gb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2)
    return row


def main(options: Options) -> None:
    """Prints one line of JSON for each size."""
    for size in options.sizes:
        print(json.dumps(mission(options, size)), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
