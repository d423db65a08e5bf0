"""A splat of the capture in about two minutes, to look at beside its audit.

It is trained in the audit's coordinates on small images of the pictures that were used, none held
out: it shows holes and blur where they will be, and is no model to keep.
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
"""Pictures that are trained on, evenly spread."""

_ITERATIONS, _GAUSSIANS = 3000, 20_000


@dataclass(frozen=True)
class Preview:
    """What the page shows of a splat."""

    stills: tuple[tuple[str, bytes], ...]
    """Caption and PNG of a picture beside the splat's image of it, or of that alone."""


def train_preview(audit: Audit, folder: Path, on_progress: Callable[[str, int], None]) -> Preview:
    """Trains a splat on the pictures of an audit, and writes it as `preview.ply`.

    Args:
        audit: whose capture it is.
        folder: of the audit.
        on_progress: for a progress bar, as in `audit`.

    Raises:
        ViewsError, TooLargeError, TrainingDiverged: nothing can be trained on these pictures.
        FormatError, RunError, OSError: a picture that is missing, or a disk that is full.
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
    """Draws the best and the worst picture beside the splat, and the splat at the first view."""
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
