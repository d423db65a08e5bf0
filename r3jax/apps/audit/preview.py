"""Trains a preview splat of the capture in about two minutes, to view beside its audit.

It is trained in the audit's coordinates on downscaled versions of the pictures used, with none held
out. It shows where holes and blur will appear; it is not meant as a final model.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from r3jax.apps.audit.audit import Audit
from r3jax.captures.alignment import evenly_spaced
from r3jax.geometry.cameras import Camera
from r3jax.plots.pictures import png
from r3jax.splatting.ply import write_scene
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import Progress, fit
from r3jax.splatting.views import load_views

NAME = "preview.ply"

_SIDE = 256
"""Longer side of the images [px]."""

_MOST = 150
"""Maximum number of training pictures, evenly spread."""

_ITERATIONS, _GAUSSIANS = 3000, 20_000


@dataclass(frozen=True)
class Preview:
    """Images of the preview splat for the page."""

    stills: tuple[tuple[str, bytes], ...]
    """Caption and PNG of each: a picture beside its rendering, or a rendering alone."""


def train_preview(audit: Audit, folder: Path, on_progress: Callable[[str, int], None]) -> Preview:
    """Trains a splat on the pictures of an audit, and writes it as `preview.ply`.

    Args:
        audit: the audit whose capture is trained on.
        folder: folder of the audit.
        on_progress: progress callback, as in `audit`.

    Raises:
        ViewsError, TooLargeError, TrainingDiverged: a splat cannot be trained on these pictures.
        FormatError, RunError, OSError: a picture is missing, or the disk is full.
    """
    chosen = audit.survey.chosen
    chosen = chosen[evenly_spaced(len(chosen), _MOST)]
    frames = (audit.source.frame(index, audit.survey.alignment) for index in chosen.tolist())
    views = load_views(frames, _SIDE)
    config = TrainConfig(iterations=_ITERATIONS, num_gaussians=_GAUSSIANS)
    on_progress("training a splat to look at", _ITERATIONS)
    done = 0

    def step(progress: Progress) -> None:
        nonlocal done
        on_progress("", progress.step - done)
        done = progress.step

    scene = fit(views, config, on_progress=step).scene
    write_scene(folder / NAME, scene)
    return Preview(tuple(_stills(audit, scene)))


def _stills(audit: Audit, scene: GaussianScene) -> list[tuple[str, bytes]]:
    """Draws the best and the worst picture beside their renderings, and renders the first view."""
    value = audit.renderability
    stills: list[tuple[str, bytes]] = []
    picked = {"seen best": np.nanargmax, "seen worst": np.nanargmin}
    for what, pick in picked.items() if audit.is_own_path and np.isfinite(value).any() else ():
        frame = audit.frames[int(pick(value))]
        camera = audit.source.camera(frame.index)
        photo = audit.source.read(frame.index)[0]
        image = _image(scene, camera, frame.pose)
        stills.append(
            (f"{frame.label}, {what} by the others: the picture, and the splat",
             png(np.concatenate([photo, image], axis=1)))
        )  # fmt: skip
    if audit.plan.views:
        image = _image(scene, audit.camera, audit.plan.views[0].pose)
        stills.append(("the splat at the first picture to take", png(image)))
    return stills


def _image(scene: GaussianScene, camera: Camera, pose: np.ndarray) -> np.ndarray:
    rgb = np.asarray(render(scene, camera, jnp.asarray(pose, dtype=jnp.float32)).rgb)
    return np.rint(255.0 * rgb.clip(0.0, 1.0)).astype(np.uint8)
