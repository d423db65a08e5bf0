"""A walk through a rendered flat, as blocks: what is wrong with it is what a test does to it."""

import functools

import numpy as np

import r3jax
from r3jax.captures.faults.blocks import BlockImage, block_image
from r3jax.geometry.cameras import Camera

VIEWS = 16
CAMERA = Camera.from_fov(320, 240, 70.0)

Picture = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Colors [H, W, 3] uint8, depth [H, W], pose [4, 4]."""


@functools.cache
def walk() -> tuple[Picture, ...]:
    """Steps of 10 cm and 6 degrees, colors and depth without noise."""
    return rendered([(0.1 * (i - VIEWS / 2), 6.0 * i) for i in range(VIEWS)])


@functools.cache
def scattered() -> tuple[Picture, ...]:
    """Few views far apart, as a planner takes them: 60 cm to the side, 35 degrees."""
    return rendered([(0.6 * (i % 3 - 1), 35.0 * (i // 3)) for i in range(12)])


def rendered(steps: list[tuple[float, float]]) -> tuple[Picture, ...]:
    """Views of the flat: how far to the side of its start [m], and how far turned [deg]."""
    world = r3jax.open_scene("flat", camera=CAMERA)
    start = np.asarray(world.start_pose, np.float64)
    pictures = []
    for aside, degrees in steps:
        angle = np.radians(degrees)
        turn = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        pose = start.copy()
        pose[:3, :3] = turn @ start[:3, :3]
        pose[:3, 3] += aside * start[:3, 0]
        frame = world.render(pose)
        rgb = np.rint(255 * np.asarray(frame.rgb)).astype(np.uint8)
        depth = np.asarray(frame.depth, np.float64)
        pictures.append((rgb, np.where(np.isfinite(depth), depth, 0.0), pose))
    return tuple(pictures)


def blocks(pictures) -> list[BlockImage]:
    return [block_image(rgb, depth, CAMERA, pose) for rgb, depth, pose in pictures]
