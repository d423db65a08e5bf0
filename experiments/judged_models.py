"""Maps of what models were trained on, and how their test views came out: one file for each model.

Three kinds: the cells of a benchmark (`explored`); embedded scenes captured from random places,
whose test views are further ones (`captured`); recordings, a fold of whose frames was held out
(`recording`). What is in the folder is not made again.

Shape symbols: N rows of the map; V test views.
"""

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.error_terms import reference_images
from r3jax.apps.benchmark.conditions import snapshot_slug
from r3jax.baselines.fisher import Form, known_information
from r3jax.baselines.fisher import scores as information_scores
from r3jax.evaluation.evaluate import evaluate
from r3jax.evaluation.image_metrics import load_lpips
from r3jax.evaluation.maps import map_of
from r3jax.files import write_atomic
from r3jax.formats.captures import open_capture
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.mapping.state import MapState
from r3jax.runs.reader import read_run
from r3jax.simulators.base import NoisySimulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_world
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import fit
from r3jax.splatting.views import Views, load_views

SCORES = ("psnr", "ssim", "lpips")
"""What is known of each test view."""

MAX_RANGE = 5.0
"""Of the depth sensor [m]."""

_NUM_TEST = 40
"""Test views of a captured scene."""

_ITERATIONS, _GAUSSIANS, _RESOLUTION = 1500, 20_000, 128
"""Of a training, as in the benchmark's small size."""

FISHER = {
    "fisherrf": Form(),
    "d-opt": Form(criterion="d-opt", quirk=False),
}
"""What the models themselves say of a view, by FisherRF as published and by POp-GS."""


@dataclass(frozen=True)
class Judged:
    """One model: what it had seen, and how its test views came out."""

    name: str
    """Of the model."""

    scene: str
    """Where it was trained."""

    kind: str
    """`explored`, `captured` or `recording`."""

    state: MapState
    """Map of the frames that it was trained on."""

    cameras: tuple[Camera, ...]
    """Of the test views, as they were recorded, [V]."""

    poses: np.ndarray
    """`T_world_camera` of the test views, [V, 4, 4]."""

    scores: dict[str, np.ndarray]
    """PSNR [dB], SSIM and LPIPS, [V] each."""

    texture: np.ndarray
    """Logarithm of the mean gradient of each true image, [V]."""

    fisher: dict[str, np.ndarray]
    """What the trained model says of each view, as in `FISHER`, [V]; greater: less known."""


def judged_cells(root: Path, folder: Path) -> Iterator[Path]:
    """The models of a benchmark, from its records, runs and test images."""
    for line in (root / "cells.jsonl").read_text().splitlines():
        yield judged_cell(root, json.loads(line), folder)


def judged_cell(root: Path, record: Mapping[str, Any], folder: Path) -> Path:
    """One model of a benchmark."""
    slug = snapshot_slug(record["snapshot"])
    path = folder / f"{Path(record['run']).parent.name}-{slug}.npz"
    if not path.exists():
        run = read_run(root / record["run"])
        frames = [run.frame(step) for step in range(record["exploration"]["views"])]
        images = reference_images(root, record)
        scene = read_scene(run.path / "models" / slug / "scene.ply")
        scores = {name: record["views"][name] for name in SCORES}
        trained = np.stack([np.asarray(frame.T_world_camera) for frame in frames])
        scores |= fisher_scores(scene, trained, images.views)
        tested = [run.camera] * len(images.poses), images.poses
        _write(path, record["scene"], "explored", frames, tested, images.views, scores)
    return path


def judged_capture(scene: str, num: int, seed: int, folder: Path) -> Path:
    """A model of `num` images from random places of a scene, tried on further ones.

    Args:
        scene: a scene's name, or a mesh file as in `mesh:house.glb`.
        num: images that it is trained on.
        seed: of the places, the depth's noise and the training.
        folder: where the models are kept.
    """
    path = folder / f"{Path(scene.partition(':')[2] or scene).stem}-random{num}-{seed}.npz"
    if path.exists():
        return path
    camera = Camera.from_fov(2 * _RESOLUTION, 2 * _RESOLUTION, 60.0)
    clean = RaycastSimulator(open_world(scene), camera, max_range=MAX_RANGE)
    noisy = NoisySimulator(clean, 0.01, seed)
    poses = _random_poses(clean, num + _NUM_TEST, seed)
    frames = [noisy.render(pose) for pose in poses[:num]]
    tested = [clean.render(pose) for pose in poses[num:]]
    views = load_views(tested, _RESOLUTION)
    scores = _train(load_views(frames, _RESOLUTION), views, _GAUSSIANS, seed)
    name = path.stem.partition("-random")[0]
    _write(path, name, "captured", frames, ([camera] * len(tested), poses[num:]), views, scores)
    return path


def _random_poses(simulator: RaycastSimulator, num: int, seed: int) -> np.ndarray:
    """Poses at a person's height in free space, looking about, [num, 4, 4]."""
    random = np.random.default_rng(seed)
    places = GroundTruth(simulator).free_positions((0.3, 0.3, 0.3), 0.3)
    places = places[(places[:, 2] > 0.9) & (places[:, 2] < 1.9)]
    places = places[random.choice(len(places), num, replace=len(places) < num)]
    places = places + random.uniform(-0.05, 0.05, places.shape)
    poses = []
    for place in places:
        yaw = random.uniform(0.0, 2.0 * np.pi)
        pitch = np.clip(random.normal(-0.1, 0.3), -1.0, 1.0)
        level = np.cos(pitch)
        ahead = np.array([np.cos(yaw) * level, np.sin(yaw) * level, np.sin(pitch)])
        poses.append(np.asarray(look_at(place, place + ahead), np.float64))
    return np.stack(poses)


def judged_folds(
    source: Path, scene: str, folds: int, used: int, resolution: int, folder: Path
) -> Iterator[Path]:
    """The first models of a recording with every `folds`-th frame held out, each with another.

    Args:
        source: the recording.
        scene: what it is called.
        folds: into how many its frames are dealt.
        used: how many of them are held out, one after the other.
        resolution: longer side of the images [px].
        folder: where the models are kept.
    """
    paths = [folder / f"{scene}-fold{k}.npz" for k in range(used)]
    if not all(path.exists() for path in paths):
        frames = list(open_capture(source, "z").frames())
        views, numbers = load_views(frames, resolution), np.arange(len(frames))
        for k, path in enumerate(paths):
            if path.exists():
                continue
            held_out = np.flatnonzero(numbers % folds == k)
            others = np.flatnonzero(numbers % folds != k)
            test = views.take(held_out)
            scores = _train(views.take(others), test, 15_000, 0)
            tested = (
                [frames[i].camera for i in held_out],
                np.stack([np.asarray(frames[i].T_world_camera) for i in held_out]),
            )
            mapped = [frames[i] for i in others]
            _write(path, scene, "recording", mapped, tested, test, scores)
    yield from paths


def _train(train: Views, test: Views, gaussians: int, seed: int) -> dict[str, Any]:
    config = TrainConfig(iterations=_ITERATIONS, num_gaussians=gaussians, seed=seed)
    scene = fit(train, config).scene
    rows = evaluate(scene, test, lpips=load_lpips()).rows
    scores: dict[str, Any] = {name: [getattr(row, name) for row in rows] for name in SCORES}
    return scores | fisher_scores(scene, np.asarray(train.T_world_camera), test)


def fisher_scores(scene: GaussianScene, trained: np.ndarray, test: Views) -> dict[str, np.ndarray]:
    """What a model says of test views, [V] each, as in `FISHER`.

    Args:
        scene: the model.
        trained: poses of the views that it was trained on, [T, 4, 4].
        test: of one camera, as good as.
    """
    camera, poses = test.view(0).camera, np.asarray(test.T_world_camera)
    found = {}
    for name, form in FISHER.items():
        known = known_information(scene, camera, trained, form)
        found[name] = information_scores(scene, camera, poses, known, form)
    return found


def _write(
    path: Path,
    scene: str,
    kind: str,
    frames: Sequence[Frame],
    tested: tuple[Sequence[Camera], np.ndarray],
    truth: Views,
    scores: dict[str, Any],
) -> None:
    state, data = map_of(frames, max_range=MAX_RANGE), io.BytesIO()
    cameras, poses = tested
    K = [[float(x) for x in (c.fx, c.fy, c.cx, c.cy)] for c in cameras]
    arrays: dict[str, Any] = {k: np.asarray(v, np.float32) for k, v in scores.items()}
    np.savez_compressed(
        data,
        scene=scene,
        kind=kind,
        key=np.asarray(state.key),
        visited=np.asarray(state.visited),
        count=np.asarray(state.count),
        mean=np.asarray(state.mean),
        m2=np.asarray(state.m2),
        rho=np.asarray(state.resolution),
        voxel=float(state.voxel_size),
        size=np.array([cameras[0].width, cameras[0].height]),
        K=np.array(K),
        poses=np.asarray(poses, np.float32),
        texture=np.array([_texture(image) for image in np.asarray(truth.rgb)]),
        **arrays,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, data.getvalue())


def _texture(rgb: np.ndarray) -> float:
    """Logarithm of the mean gradient of an image, [H, W, 3] uint8."""
    gray = rgb.astype(np.float64).mean(axis=-1) / 255.0
    across, down = np.diff(gray, axis=1)[:-1], np.diff(gray, axis=0)[:, :-1]
    return float(np.log(np.hypot(across, down).mean() + 1e-4))


def read_judged(path: Path) -> Judged:
    """What one of the functions above has written."""
    found = dict(np.load(path))
    part = lambda name: jnp.asarray(found[name])
    state = MapState(
        key=part("key"),
        visited=part("visited"),
        count=part("count"),
        mean=part("mean"),
        m2=part("m2"),
        resolution=part("rho"),
        voxel_size=jnp.asarray(found["voxel"], jnp.float32),
        dropped=jnp.zeros((), jnp.int32),
        num_bins=64,
    )
    width, height = found["size"].tolist()
    cameras = tuple(
        Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        for fx, fy, cx, cy in found["K"].tolist()
    )
    columns = lambda names: {name: found[name].astype(np.float64) for name in names}
    return Judged(
        path.stem,
        str(found["scene"]),
        str(found["kind"]),
        state,
        cameras,
        found["poses"],
        columns(SCORES),
        found["texture"],
        columns(FISHER),
    )
