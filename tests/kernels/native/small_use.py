"""Maps, scores and trains something tiny; as a program in several threads, or without Numba."""

import json
import sys
import threading
import warnings

import numpy as np


def use() -> list[float]:
    """What three frames of a slanted wall give: renderability, utility, and losses of training."""
    import jax

    import r3jax
    from r3jax.mapping.occupancy import empty_grid, integrate_depth
    from r3jax.splatting.training import train
    from r3jax.splatting.training.config import TrainConfig
    from r3jax.splatting.views import load_views

    camera = r3jax.Camera.from_fov(48, 36, 70.0)
    u, v = np.meshgrid(np.arange(48, dtype=np.float32), np.arange(36, dtype=np.float32))
    rgb = np.stack([u / 48, v / 36, np.full_like(u, 0.5)], axis=-1)
    frames = []
    for y in (0.0, 0.2, 0.4):
        pose = np.array([[0, 0, 1, -1], [-1, 0, 0, y], [0, -1, 0, 1], [0, 0, 0, 1]], np.float32)
        frames.append(r3jax.Frame.from_arrays(rgb, 1.5 + 0.01 * u, pose, camera))
    state = r3jax.empty_map(4096, 0.1)
    grid = empty_grid(np.array([[-2.0, -2, 0], [2, 2, 2]]), 0.2)
    for frame in frames:
        state = r3jax.integrate(state, frame)
        grid = integrate_depth(grid, frame, 5.0)
    pose = frames[1].T_world_camera
    scores = (
        r3jax.renderability(state, camera, pose),
        *jax.tree.leaves(r3jax.view_utility(state, grid, camera, pose)),
    )
    config = TrainConfig(iterations=12, num_gaussians=300)
    model = train.fit(load_views(frames), config)
    return [*map(float, scores), *map(float, model.history.loss)]


def main(num_threads: int) -> None:
    """Prints results of all threads, warnings, and how kernels run here."""
    from r3jax.kernels.native.platform import describe_kernels

    said: list[str] = []
    warnings.showwarning = lambda message, *rest: said.append(str(message))
    results: list[list[float]] = []
    threads = [threading.Thread(target=lambda: results.append(use())) for _ in range(num_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print(json.dumps({"results": results, "said": said, "kernels": describe_kernels()}))


if __name__ == "__main__":
    if sys.argv[2:] == ["hidden"]:
        sys.modules |= {"numba": None, "llvmlite": None}  # type: ignore[dict-item]
    main(int(sys.argv[1]))
