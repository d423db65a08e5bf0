"""A robot on wheels: footprint, drift, a loop closure, a keep-out zone, a person, holes in depth.

    python examples/planar_robot.py

The robot knows its pose in the plane only (x, y, heading); its camera is off-center and tilted.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np

import r3jax
from r3jax.planning.robot.motion import make_motion

HEIGHT, TILT, AHEAD = 0.5, -15.0, 0.1  # of the camera: above the floor [m], [degrees], [m]
ZONE = [[6.6, 2.3], [8.4, 2.3], [8.4, 4.4], [6.6, 4.4]]  # the bathroom of the flat [m]


def camera_pose(x: float, y: float, heading: float) -> np.ndarray:
    """Where the camera is when the robot stands at x, y: this stands for `base_link` -> camera."""
    ahead, tilt = np.array([np.cos(heading), np.sin(heading), 0.0]), np.radians(TILT)
    eye = np.array([x, y, HEIGHT]) + AHEAD * ahead
    return np.asarray(r3jax.look_at(eye, eye + np.cos(tilt) * ahead + [0, 0, np.sin(tilt)]), float)


def main(decisions: int = 12, size: int = 96, saved: str | Path | None = None) -> list[np.ndarray]:
    """Drives through the flat; returns the true positions of the camera."""
    camera, rng = r3jax.Camera.from_fov(size, size * 3 // 4, 69.0), np.random.default_rng(0)
    true = camera_pose(3.9, 2.2, 0.0)
    world = r3jax.open_scene("flat", camera=camera, start_pose=true)
    body = r3jax.Body(footprint=0.2 + AHEAD, heights=(0.0, 0.6))  # it turns about its middle
    motion = make_motion("ground", elevations=(TILT, TILT), body=body)
    policy = r3jax.make_policy("r3-pano", motion=motion, num_candidates=40, num_frontier=12)
    bounds = np.array(world.bounds)
    bounds[0, 2] = 0.0  # the floor
    start = lambda: r3jax.keep_out(r3jax.start(camera, bounds, policy, starts=[true]), [ZONE])
    planner, frames, track, drift = start(), [], [true[:3, 3]], np.zeros(3)
    for step, key in enumerate(jax.random.split(jax.random.key(0), decisions)):
        seen = world.render(true.astype(np.float32))
        depth = np.where(np.isfinite(seen.depth), seen.depth, 0.0)
        depth[rng.random(depth.shape) < 0.1] = 0.0  # where the sensor fails
        if step == 2:
            depth[:, size // 2 : size // 2 + 8] = 0.0  # where a detector sees a person
        believed = np.array(true)
        believed[:3, 3] += drift
        frames.append(r3jax.Frame.from_arrays(seen.rgb, depth, believed, camera))
        planner = r3jax.observe(planner, frames[-1])
        if step == decisions // 2:  # a loop closes: all poses are corrected, and mapped again
            drift, believed, planner = np.zeros(3), np.array(true), start()
            for i, (frame, place) in enumerate(zip(frames, track, strict=True)):
                pose = np.array(frame.T_world_camera)
                pose[:3, 3] = place
                frames[i] = dataclasses.replace(frame, T_world_camera=pose)
                planner = r3jax.observe(planner, frames[i])
        goal, planner, info = r3jax.decide(planner, believed, key)
        if goal is None:
            print(f"step {step}: {info.outcome.value}: {info.reason}")
            break
        if step == 4:  # the base could not get there: it stays, and that goal is left alone
            planner = r3jax.refuse(planner, goal)
        else:
            true = np.array(goal.T_world_camera)
            true[:3, 3] -= drift  # it believes to be at the goal
            drift = drift + np.append(rng.normal(0.0, 0.004, 2), 0.0)
        track.append(true[:3, 3])
        print(f"step {step}: {goal.length:.2f} m, expected gain {info.expected_gain:.0f}")
    if saved is not None:
        r3jax.save(planner, saved)
    return track


if __name__ == "__main__":
    main()
