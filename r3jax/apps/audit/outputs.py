"""Writes the files of an audit beside its report, in the capture's own coordinates.

voxels.ply                 voxels, colored by renderability from red to green
causes.ply                 voxels, colored by cause of low quality; the terms as properties
suggested.json             the suggested views as nerfstudio's camera_path.json
suggested_transforms.json  the same as a transforms.json
audit.json                 every number; `alignment` maps the capture to z up and units of a meter
preview.ply                a splat, in these coordinates (`--preview`)

The splat is trained in two to three minutes, on downscaled versions of the pictures used, with none
held out. It shows where holes and blur will appear; it is not meant as a final model.
"""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from r3jax.apps.audit import sentences
from r3jax.apps.audit.audit import Audit
from r3jax.apps.audit.audit_figures import cause_colors, score_colors
from r3jax.apps.audit.diagnosis import CAUSES, FEW, FINE, NOT_KNOWN, Region, ViewScore
from r3jax.apps.audit.suggest import Suggestion, promise
from r3jax.captures.alignment import evenly_spaced
from r3jax.captures.camera_paths import write_camera_path, write_path_transforms
from r3jax.captures.source import Source
from r3jax.files import write_atomic
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.formats.points import write_points
from r3jax.geometry.cameras import Camera
from r3jax.plots.pictures import png
from r3jax.splatting.ply import write_scene
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import Progress, fit
from r3jax.splatting.views import load_views
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import parse_json

SPLAT = "preview.ply"

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
    write_scene(folder / SPLAT, scene)
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


FORMAT = 1
"""Version of audit.json."""

_MAX_BYTES = 1 << 26
"""Maximum size of audit.json; an audit of 400 pictures takes a few hundred kilobytes."""


def write_outputs(
    audit: Audit, folder: Path, capture: Path, *, has_splat: bool = False
) -> dict[str, Path]:
    """Writes all files except the report.

    Args:
        audit: the result.
        folder: an existing folder.
        capture: path of the audited capture.
        has_splat: True if the folder contains the splat of a preview.

    Returns:
        The files written, keyed by their content.

    Raises:
        OSError: for example, the disk is full or not writable.
    """
    written = {
        "renderability": folder / "voxels.ply",
        "causes": folder / "causes.ply",
        "numbers": folder / "audit.json",
    }
    _write_clouds(audit, written["renderability"], written["causes"])
    poses = suggested_poses(audit)
    if len(poses):
        written["camera path"] = folder / "suggested.json"
        written["transforms"] = folder / "suggested_transforms.json"
        write_camera_path(written["camera path"], poses, audit.lens.camera)
        write_path_transforms(written["transforms"], poses, audit.lens.camera)
    if has_splat:
        written["splat"] = folder / SPLAT
    splat = SPLAT if has_splat else None
    record = {**record_of(audit), "capture_path": str(capture.resolve()), "splat": splat}
    text = json.dumps(record, indent=1, allow_nan=False)
    write_atomic(written["numbers"], (text + "\n").encode())
    return written


def audited_capture(folder: Path) -> Path | None:
    """Returns the path of the capture whose audit is in a folder, or None if not known."""
    try:
        record = parse_json(read_bytes(folder / "audit.json", _MAX_BYTES))
        return Path(record["capture_path"])
    except (OSError, ValueError, KeyError, TypeError):  # missing, an older version, or not an audit
        return None


def suggested_poses(audit: Audit) -> np.ndarray:
    """Returns `T_world_camera` of the suggested views in the capture's coordinates, [k, 4, 4]."""
    if not audit.plan.views:
        return np.zeros((0, 4, 4))
    return audit.survey.alignment.poses_back(np.stack([view.pose for view in audit.plan.views]))


def _write_clouds(audit: Audit, values: Path, causes: Path) -> None:
    state, found = audit.seen.state, audit.diagnosis
    present = np.asarray(state.occupied)
    centers = np.asarray(state.center, np.float64).T[present]
    points = audit.survey.alignment.points_back(centers)
    if not np.any(audit.survey.alignment.origin):  # near the origin float32 suffices and is usual
        points = points.astype(np.float32)
    evaluated = found.is_seen[present]
    shown = score_colors(found.value)[present]
    write_points(
        values,
        points[evaluated],
        shown[evaluated],
        {"renderability": found.value[present][evaluated]},
    )
    properties = {
        "renderability": found.value,
        "bias": found.bias,
        "noise": found.noise,
        "resolution": found.resolution,
        "directions": found.num_directions,
        "observations": np.asarray(state.count),
        "standpoints": found.num_seen,
        "cause": found.cause,
    }
    write_points(
        causes,
        points,
        cause_colors(found)[present],
        {name: np.asarray(column, np.float32)[present] for name, column in properties.items()},
    )


def record_of(audit: Audit) -> dict[str, Any]:
    """Returns the content of audit.json."""
    survey, plan = audit.survey, audit.plan
    square = survey.length(1.0) ** 2
    return {
        "format": FORMAT,
        "capture": audit.source.name,
        "headline": sentences.headline(audit),
        "causes": [
            {
                "name": name,
                "title": f"seen {sentences.SHORT.get(name, 'well enough')}",
                "meaning": sentences.MEANING[name],
                "do": sentences.REMEDY[name],
            }
            for name in CAUSES
        ],
        "alignment": {
            "rotation": survey.alignment.rotation.tolist(),
            "scale": survey.alignment.scale,
            "origin": survey.alignment.origin.tolist(),
        },
        "unit": "metre" if audit.source.is_metric else "unknown",
        "depth_from": audit.source.kind,
        "reconstruction": _reconstruction(audit.source),
        "pictures": len(audit.source),
        "pictures_used": survey.chosen.tolist(),
        "pictures_diverged": list(survey.strays),
        "pictures_left_out": [
            {"index": index, "label": audit.source.labels[index], "why": why}
            for index, why in audit.faults.left_out.items()
        ],
        "pictures_without_depth": list(audit.faults.without_depth),
        "voxel_size": survey.length(survey.voxel_size),
        "max_range": survey.length(float(audit.config.max_range)),
        "median_depth": survey.median_depth,
        "far_depth": survey.far_depth,
        "up": survey.up.direction.tolist(),
        "up_is_within_degrees": survey.up.within,
        "taken_from_one_place": survey.is_one_place,
        "looks_inward": audit.is_object,
        "folds": len(audit.seen.folds),
        "fine_from": FINE,
        "rare_below": FEW,
        "surfaces": {
            **_surfaces(audit, survey.voxel_size**2 * square),
            "unseen_area": audit.unseen_area * square,
        },
        "regions": [_region(audit, region) for region in audit.all_regions],
        "path": {
            "own": audit.is_own_path,
            "mean": audit.mean_renderability,
            "share": audit.shares,
            "frames": [
                {
                    "index": frame.index,
                    "label": frame.label,
                    "fold": int(audit.seen.fold_of[i]) if audit.is_own_path else None,
                    **_score(frame.score),
                }
                for i, frame in enumerate(audit.frames)
            ],
        },
        "suggested": [
            {
                "camera_to_world_opengl": (pose @ OPENGL_FROM_OPENCV).tolist(),
                "rank": view.rank,
                "held_out_over_something": view.is_over,
                "stand_at": _stand_at(audit, view),
                "gain_in_voxels": view.gain,
                "unseen_cells": len(view.cells),
                "voxels_shown": len(view.shown),
                "voxels_mended": view.num_mended,
                "causes": view.causes,
                "mean_after": view.mean_after,
                "fine_after": view.fine_after,
            }
            for view, pose in zip(plan.views, suggested_poses(audit), strict=True)
        ],
        "faults": {
            "findings": [dataclasses.asdict(finding) for finding in audit.faults.findings],
            "pictures_compared": audit.faults.compared,
            "depth_fits_cameras": audit.faults.fits,
            "of_each_picture": audit.faults.record,
        },
        "mean_after_random_views": list(plan.random_mean),
        "fine_after_random_views": list(plan.random_fine),
        "promised_fine": list(promise(plan)) if plan.views and audit.source.is_complete else None,
    }


def _surfaces(audit: Audit, face: float) -> dict[str, Any]:
    """Returns shares by cause, as on the page, and areas of the known surfaces.

    Args:
        audit: the result.
        face: area of a voxel's face in the capture's units.
    """
    found = audit.diagnosis
    evaluated = int(found.is_seen.sum())
    whole = {name: found.share(name) for name in CAUSES} | {NOT_KNOWN: 0.0}
    return {
        "voxels_judged": evaluated,
        "area_judged": evaluated * face,
        "mean": found.mean,
        "share_of": "surfaces" if audit.source.is_complete else "pixels of the frames",
        "share": whole if audit.source.is_complete else audit.shares,
        "area": {name: found.share(name) * evaluated * face for name in CAUSES},
    }


def _stand_at(audit: Audit, view: Suggestion) -> list[float] | None:
    """Returns the place on the floor where a person stands, or None if that is not known."""
    if not np.isfinite(view.feet).all():
        return None
    return audit.survey.alignment.points_back(view.feet[None])[0].tolist()


def _score(score: ViewScore) -> dict[str, Any]:
    """Returns the scores of a frame; the renderability is null if it shows no known surface."""
    known = None if np.isnan(score.renderability) else score.renderability
    return {**dataclasses.asdict(score), "renderability": known}


def _reconstruction(source: Source) -> dict[str, Any] | None:
    found = source.reconstruction
    return None if found is None else dataclasses.asdict(found)


def _region(audit: Audit, region: Region) -> dict[str, Any]:
    back = audit.survey.alignment.points_back
    return {
        "center": back(region.center[None])[0].tolist(),
        "area": region.area * audit.survey.length(1.0) ** 2,
        "cause": region.cause,
        "renderability": region.renderability if region.is_known else None,
        "bad_share": region.bad_share,
    }
