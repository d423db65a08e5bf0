"""r3jax beside a SLAM system: it sends RGB-D frames, r3jax answers where to look next.

    python examples/slam_stream.py

Your SLAM system is any generator of arrays (NumPy, JAX, PyTorch, ...). Here a ray caster plays
it: it drifts by 1 cm a view, then closes a loop and corrects all its poses.
"""

import dataclasses
from collections.abc import Generator

import jax
import numpy as np
from numpy import ndarray as Array

import r3jax


def slam(world) -> Generator[tuple[Array, Array, list[Array]], Array, None]:
    """Yields colors, depth [mm] and the poses of all views so far; is sent where to go next."""
    true, believed = [world.start_pose], [world.start_pose]
    while True:
        frame = world.render(true[-1])
        depth = np.where(np.isfinite(frame.depth), 1000.0 * frame.depth, 0.0).astype(np.uint16)
        goal = yield np.rint(255.0 * frame.rgb).astype(np.uint8), depth, list(believed)
        drift = np.zeros((4, 4))
        drift[2, 3] = 0.01 * (len(true) % 5)
        if not drift.any():
            believed = list(true)
        believed, true = [*believed, goal], [*true, goal - drift]


def main(views: int = 8, size: int = 128) -> list[r3jax.Frame]:
    """Explores the flat together with a SLAM system; returns the frames that are in the map."""
    world = r3jax.open_scene("flat", camera=r3jax.Camera.from_fov(size, size))
    policy = r3jax.make_policy("r3-pano", num_candidates=40, num_frontier=12)
    config = r3jax.MappingConfig(capacity=1 << 14)  # the table grows by itself
    planner = r3jax.start(
        world.camera, world.bounds, policy, starts=[world.start_pose], config=config
    )
    frames, stream = [], slam(world)
    rgb, depth, poses = next(stream)
    for view, key in enumerate(jax.random.split(jax.random.key(0), views)):
        new = r3jax.Frame.from_arrays(rgb, depth, poses[view], world.camera, depth_scale=0.001)
        frames = [*frames, new]
        if np.abs(np.stack([f.T_world_camera for f in frames]) - poses).max() > 1e-3:
            # What a voxel has seen cannot be moved: keep the key frames, and map them again.
            pairs = zip(frames, poses, strict=True)
            frames = [dataclasses.replace(f, T_world_camera=pose) for f, pose in pairs]
            planner, mapped = r3jax.rebuild(planner, frames), len(frames)
        else:
            planner, mapped = r3jax.observe(planner, new), 1
        goal, planner, info = r3jax.decide(planner, poses[view], key)
        m = planner.map_state
        print(f"view {view}: {mapped} frame(s) mapped, {int(m.num_present)} voxels", end="")
        print(f" in {m.capacity} rows; {info.outcome.value}, {goal.length if goal else 0:.2f} m")
        if goal is None:
            break
        rgb, depth, poses = stream.send(goal.T_world_camera)
    return frames


if __name__ == "__main__":
    main()
