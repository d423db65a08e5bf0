"""What a map of the training views expects of test views, term by term; the error where it was.

For every test view of a trained model: the pixel means of each term of renderability, of their
products, and of COVER's term, from the map of the recorded frames that the model was trained on;
and the model's PSNR on the pixels that show what those frames have seen.

Shape symbols: V views; K forms of kappa; P products; h w pixels of the depth buffer.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.seen_pixels import recorded, seen_pixels
from r3jax.apps.benchmark.cells import Conditions, snapshot_slug
from r3jax.apps.benchmark.reference_images import (
    ReferenceImages,
    read_reference_images,
    reference_path,
)
from r3jax.baselines.cover import SeenBins, coverage_of_pixels
from r3jax.evaluation.evaluate import evaluate
from r3jax.evaluation.image_metrics import psnr
from r3jax.evaluation.maps import map_of
from r3jax.files import write_atomic
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import MapState
from r3jax.runs.reader import read_run
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.config import Forms, ScoringConfig
from r3jax.scoring.formulas import voxels_of_rows
from r3jax.scoring.terms import Renderability, score_voxels
from r3jax.splatting.ply import read_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.visibility.views import pinhole_view

VERSION = 1
"""Raised when what was computed by an older version of this file must not be taken over."""

KAPPAS = ("box", "one")
"""As in `ScoringConfig.kappa`: the box test, or kappa = 1 everywhere."""

PRODUCTS: Mapping[str, tuple[str, ...]] = {
    "bias": ("bias",),
    "noise": ("noise",),
    "resolution": ("resolution",),
    "bias x noise": ("bias", "noise"),
    "bias x resolution": ("bias", "resolution"),
    "noise x resolution": ("noise", "resolution"),
    "R": ("bias", "noise", "resolution"),
}
"""Terms of `Renderability` that are multiplied in every pixel, before the mean is taken."""

SMALLEST_SHARE = 0.05
"""Least share of seen pixels for which an image has a PSNR on them: fewer are an anecdote."""

FOLDER = "renderability_vs_error"
"""Folder of what was computed, beside the benchmark's cells."""


def column(product: str, kappa: str) -> str:
    """Returns the name of a prediction: `bias`, and `bias, kappa=1` without the box test."""
    return product if kappa == "box" else f"{product}, kappa=1"


def on_seen(name: str) -> str:
    """Returns the name of a prediction's mean over the pixels that show a voxel."""
    return f"{name} | seen"


class Expected(eqx.Module):
    """What a map expects of one view. Means are over all pixels; one without a voxel counts 0."""

    terms: Float[Array, "K P"]
    """Mean of every product, for both forms of kappa."""

    cover: Float[Array, ""]
    """Mean of COVER's (1 + cos) / 2 to the nearest direction that was seen."""

    coverage: Float[Array, ""]
    """Share of the pixels that show a voxel. A mean over these alone is a mean over all, divided
    by this."""


@jax.jit
def expect(
    state: MapState, camera: Camera, T_world_camera: Float[Array, "4 4"], config: ScoringConfig
) -> Expected:
    """Returns every prediction of one view, pixel by pixel as `renderability_image` has it."""
    view = pinhole_view(camera, T_world_camera, config)
    row = rows_in_pixels(state, view, config)
    seen = voxels_of_rows(state, row)
    shape, position = row.shape, T_world_camera[:3, 3]
    hit = seen.present.astype(jnp.float32)
    bins = SeenBins(seen.visited.reshape(-1, *shape), seen.num_bins)
    offset = (position[:, None] - seen.center).reshape(3, *shape)
    coverage = jnp.mean(hit)
    scored = [score_voxels(seen, position, camera.focal, Forms(kappa)) for kappa in KAPPAS]
    return Expected(
        terms=jnp.stack([_product_means(scores) for scores in scored]),
        cover=coverage * coverage_of_pixels(bins, offset, hit.reshape(shape)),
        coverage=coverage,
    )


def _product_means(scores: Renderability) -> Float[Array, " P"]:
    means = []
    for names in PRODUCTS.values():
        value = jnp.ones_like(scores.bias)
        for name in names:
            value = value * getattr(scores, name)
        means.append(jnp.mean(value))
    return jnp.stack(means)


def prediction_columns(
    state: MapState, camera: Camera, poses: np.ndarray, config: ScoringConfig
) -> dict[str, np.ndarray]:
    """Returns predictions of all views by name, each [V] in [0, 1].

    Args:
        state: map of the frames that the model was trained on.
        camera: of those frames, in the size in which they were recorded.
        poses: of the test views, [V, 4, 4].
        config: range of the sensor, size of the depth buffer.

    Returns:
        Columns named by `column`, with `cover` and `coverage`: means over all pixels; and by
        `on_seen` their means over the pixels that show a voxel, NaN where none does.
    """
    found = [expect(state, camera, jnp.asarray(T, jnp.float32), config) for T in poses]
    terms = np.stack([np.asarray(view.terms, np.float64) for view in found])
    columns = {
        column(product, kappa): terms[:, k, p]
        for k, kappa in enumerate(KAPPAS)
        for p, product in enumerate(PRODUCTS)
    }
    columns["cover"] = np.array([float(view.cover) for view in found])
    coverage = np.array([float(view.coverage) for view in found])
    share = np.where(coverage > 0.0, coverage, np.nan)
    columns |= {on_seen(name): values / share for name, values in columns.items()}
    return columns | {"coverage": coverage}


def error_columns(
    scene: GaussianScene,
    reference: ReferenceImages,
    frames: Sequence[Frame],
    sensing: Mapping[str, Any],
) -> dict[str, np.ndarray]:
    """The model's PSNR on seen pixels [dB], their share, and PSNR on all pixels, each [V]."""
    views, seen_by = reference.views, recorded(frames)
    far = jnp.asarray(sensing["max_range"], jnp.float32)
    edge = jnp.asarray(sensing["voxel_size"], jnp.float32)
    evaluation = evaluate(scene, views)
    share, error = [], []
    for i, render in enumerate(evaluation.renders):
        view = views.view(i)
        seen = seen_pixels(view, seen_by, far, edge)
        share.append(float(jnp.mean(seen.astype(jnp.float32))))
        error.append(float(_psnr(jnp.asarray(render), view.rgb, seen)))
    shares = np.array(share)
    return {
        "psnr_seen": np.where(shares >= SMALLEST_SHARE, np.array(error), np.nan),
        "seen_share": shares,
        "psnr_again": np.array([row.psnr for row in evaluation.rows]),
    }


@jax.jit
def _psnr(render, truth, seen):
    return psnr(render.astype(jnp.float32) / 255.0, truth, seen)


def columns_of(root: Path, record: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Returns all columns of one model's test views, from the run and the model of its cell.

    They are kept beside the cells, and not computed again for the same record.

    Args:
        root: folder of the benchmark.
        record: of the cell at one snapshot.

    Raises:
        RunError, SceneFileError, FileNotFoundError: the cell's files are not there (any more).
    """
    run_path, slug = Path(record["run"]), snapshot_slug(record["snapshot"])
    path = Path(root) / FOLDER / f"{run_path.parent.name}-{slug}.json"
    text = json.dumps([VERSION, record], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["digest"] == digest:
            return {name: np.array(v, np.float64) for name, v in kept["columns"].items()}
    columns = _compute(Path(root), record)
    plain = {
        name: [None if math.isnan(value) else value for value in values.tolist()]
        for name, values in columns.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, json.dumps({"digest": digest, "columns": plain}).encode())
    return columns


def _compute(root: Path, record: Mapping[str, Any]) -> dict[str, np.ndarray]:
    sensing, slug = record["sensing"], snapshot_slug(record["snapshot"])
    run = read_run(root / record["run"])
    frames = [run.frame(step) for step in range(record["exploration"]["views"])]
    reference = reference_images(root, record)
    state = map_of(frames, voxel_size=sensing["voxel_size"], max_range=sensing["max_range"])
    config = ScoringConfig(max_range=sensing["max_range"])
    columns = prediction_columns(state, run.camera, reference.poses, config)
    scene = read_scene(run.path / "models" / slug / "scene.ply")
    return columns | error_columns(scene, reference, frames, sensing)


def reference_images(root: Path, record: Mapping[str, Any]) -> ReferenceImages:
    """Returns the test images of a cell, by its record."""
    conditions = Conditions(
        resolution=record["resolution"],
        fov=record["sensing"]["fov"],
        train_resolution=record["training"]["resolution"],
    )
    found = record["scene_hash"], record["test_views"]["hash"]
    return read_reference_images(reference_path(root, *found, conditions))
