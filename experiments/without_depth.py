"""Compares audits of photos alone with audits of the same photos and a depth camera.

    python -m experiments.hand_walks flat --out walk-flat --frames 120 --width 480
    python -m experiments.without_depth hololens_lounge walk-flat --out without_depth

Of each capture with depth its photos are matched and triangulated at its poses by pycolmap, which
gives what a structure from motion would; its depth is used for comparison only. Then it is audited
from its depth, from sparse points, from depth swept from the photos, and from a splat that was
trained on the photos and begun at the sparse points. All settings are those of `r3jax audit`.

Regions are blocks of 0.5 in the unit of the capture; of each the mean R over its surfaces is
compared by a rank correlation (Spearman), over the regions that both know; and once more with both
audits judging from the places that the one without depth chose. An interval is that of 1,000
resamplings of regions, or of frames. The views that an audit suggests are simulated on the map with
depth: how much they raise the mean R of its surfaces, as a share of what the views do that were
chosen with depth. Every photo is held out once: R of an audit, which leaves it out, against the
PSNR of a splat that was trained on the others.

Each comparison is a file in `--out`; what is there is not done again.
"""

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import tyro
from PIL import Image
from scipy.spatial import KDTree
from scipy.stats import spearmanr

from experiments.select import exposed_psnr
from r3jax.apps.audit.audit import Audit, audit
from r3jax.apps.audit.diagnosis import Diagnosis, demand_of, known_rows
from r3jax.apps.audit.settings import AuditSettings
from r3jax.apps.audit.suggest import Task
from r3jax.captures.alignment import Alignment
from r3jax.captures.settings import Surfaces
from r3jax.captures.source import Source, source_of
from r3jax.evaluation.evaluate import evaluate
from r3jax.formats.captures import open_capture
from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, colmap_pose, points_without_tracks
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.scoring.simulated import simulate_view
from r3jax.splatting.ply import write_scene
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train import fit
from r3jax.splatting.views import load_views

BLOCK = 0.5
"""Edge of a region [capture units]."""

_FEWEST_VOXELS = 3
"""A region with fewer of them is not compared."""

_FEATURES = 4000
"""SIFT features of a photo at most."""

_SAMPLES = 1000

_SPLAT = TrainConfig(iterations=4000, capacity=60_000)
"""Training of the splats."""

_SPLAT_SIDE = 270
"""Longer side of the images that they are trained on [px]."""

_FOLDS = 8

_FOLD = TrainConfig(iterations=1500, num_gaussians=10_000)
"""Training of the splats that show held-out photos."""

_FOLD_SIDE = 128


@dataclass(frozen=True)
class Options:
    """What is compared."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Captures with depth."""

    out: Path = Path("without_depth")
    """Folder of the photos, their models and the results."""

    surfaces: tuple[Surfaces, ...] = ("sweep", "points", "model")
    """Sources of surfaces that are compared with depth."""


def photos_alone(source: Source, folder: Path) -> Path:
    """Writes the photos of a capture and a COLMAP model of points triangulated at its poses.

    Args:
        source: a capture with images.
        folder: is written.

    Returns:
        The folder, as COLMAP would leave it.
    """
    if (folder / "sparse" / "0" / "points3D.bin").exists():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        made = Path(scratch) / folder.name
        for name in ("images", "known", "sparse/0"):
            (made / name).mkdir(parents=True)
        names = [f"{index:05d}.png" for index in range(len(source))]
        for index, name in enumerate(names):
            Image.fromarray(source.read(index)[0]).save(made / "images" / name)
        triangulate(made, names, pinhole_lens(source.camera(0)), source.poses, _FEATURES)
        made.rename(folder)  # fails where another program has left something there
    return folder


def triangulate(
    folder: Path, names: Sequence[str], lens: Lens, poses: np.ndarray, features: int
) -> None:
    """Matches photos and triangulates points at their poses: a COLMAP model in `sparse/0`.

    Args:
        folder: with the photos in `images`, and empty folders `known` and `sparse/0`.
        names: of the photos.
        lens: of all photos.
        poses: `T_world_camera`, [n, 4, 4].
        features: most SIFT features of a photo.
    """
    import pycolmap

    database = folder / "database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = lens.model
    reader.camera_params = ",".join(map(str, lens.params))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = features
    pycolmap.extract_features(
        database,
        folder / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(database)
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        (camera,) = opened.read_all_cameras()
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    images = tuple(
        ColmapImage(ids[name], name, camera.camera_id, *colmap_pose(poses[index]), *none)
        for index, name in enumerate(names)
    )
    points = points_without_tracks(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    write_binary(folder / "known", ColmapModel({camera.camera_id: lens}, images, points))
    known = pycolmap.Reconstruction(folder / "known")
    found = pycolmap.triangulate_points(
        known, database, folder / "images", folder / "sparse" / "0", clear_points=True
    )
    found.write(folder / "sparse" / "0")


def splat_alone(photos: Source, path: Path) -> Path:
    """Trains a splat on photos, begun at their sparse points, and writes it as a PLY."""
    if not path.exists():
        as_it_is = Alignment(np.eye(3), 1.0, np.zeros(3))
        frames = (photos.frame(index, as_it_is) for index in range(len(photos)))
        found = fit(load_views(frames, _SPLAT_SIDE), _SPLAT)
        write_scene(path, found.scene)
    return path


def held_out_psnr(photos: Source, path: Path) -> np.ndarray:
    """PSNR of each photo, after a gain for each channel, by a splat of the others [dB], [n]."""
    if not path.exists():
        as_it_is = Alignment(np.eye(3), 1.0, np.zeros(3))
        frames = (photos.frame(index, as_it_is) for index in range(len(photos)))
        views, numbers = load_views(frames, _FOLD_SIDE), np.arange(len(photos))
        psnr = np.zeros(len(photos))
        for fold in range(_FOLDS):
            out = numbers[numbers % _FOLDS == fold]
            scene = fit(views.take(numbers[numbers % _FOLDS != fold]), _FOLD).scene
            judged = views.take(out)
            pairs = zip(evaluate(scene, judged).renders, np.asarray(judged.rgb), strict=True)
            psnr[out] = [exposed_psnr(*pair) for pair in pairs]
        np.save(path, psnr)
    return np.load(path)


def voxels(found: Audit, diagnosis: Diagnosis) -> tuple[np.ndarray, np.ndarray]:
    """Centers [m, 3] and R [m] of the surfaces that were judged, in the capture's coordinates."""
    centers = np.asarray(found.seen.state.center, np.float64).T[diagnosis.is_seen]
    return found.survey.alignment.points_back(centers), diagnosis.value[diagnosis.is_seen]


def regions(found: Audit, diagnosis: Diagnosis) -> dict[tuple[int, ...], float]:
    """Mean R of every block that has enough surfaces."""
    centers, value = voxels(found, diagnosis)
    block, index = np.unique(np.floor(centers / BLOCK).astype(int), axis=0, return_inverse=True)
    index = index.reshape(-1)
    count = np.bincount(index)
    mean = np.bincount(index, weights=value) / count
    return {
        tuple(block[i].tolist()): float(mean[i])
        for i in np.flatnonzero(count >= _FEWEST_VOXELS).tolist()
    }


def ranks(a: np.ndarray, b: np.ndarray) -> tuple[float, float, float]:
    """Spearman's rank correlation, with an interval of 95 % over resamplings of the pairs."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(a), size=(_SAMPLES, len(a)))
    values = [_spearman(a[rows], b[rows]) for rows in drawn]
    low, high = np.nanpercentile(values, [2.5, 97.5])
    return _spearman(a, b), float(low), float(high)


def _spearman(a: np.ndarray, b: np.ndarray) -> float:
    if np.ptp(a) == 0.0 or np.ptp(b) == 0.0:  # a sample of equal values has no ranks
        return float("nan")
    found: Any = spearmanr(a, b)
    return float(found.statistic)


def raised(truth: Audit, poses: np.ndarray) -> float:
    """Simulates views on the map with depth, and returns by how much they raise its mean R.

    Args:
        truth: the audit with depth.
        poses: of the views, [n, 4, 4] in the capture's coordinates.
    """
    state = truth.seen.state
    task = Task(truth.camera, demand_of(state, truth.standpoints, truth.config), truth.config)
    for pose in truth.survey.alignment.poses(poses):
        T = jnp.asarray(pose, dtype=jnp.float32)
        state, _ = simulate_view(state, truth.camera, T, truth.config)
    return task.evaluate(state)[1].mean - truth.diagnosis.mean


def suggested(found: Audit) -> np.ndarray:
    """Returns the suggested views in the capture's coordinates, [n, 4, 4]."""
    poses = np.reshape([view.pose for view in found.plan.views], (-1, 4, 4))
    return found.survey.alignment.poses_back(poses)


def from_places_of(truth: Audit, found: Audit) -> Diagnosis:
    """Diagnoses the map with depth from the standpoints of another audit."""
    places = found.survey.alignment.points_back(found.standpoints)
    demand = demand_of(truth.seen.state, truth.survey.alignment.points(places), truth.config)
    return Task(truth.camera, demand, truth.config).evaluate(truth.seen.state)[1]


def ranked_by_psnr(found: Audit, psnr: np.ndarray) -> tuple[float, float, float]:
    """Correlates the R of an audit's photos with their PSNR when they are held out."""
    pairs = [(f.score.renderability, psnr[f.index]) for f in found.frames if f.score.judged]
    return ranks(*np.array(pairs).T)


def compare(truth: Audit, found: Audit, psnr: np.ndarray) -> dict[str, Any]:
    """How an audit without depth compares with that from depth, and both with held-out photos."""
    there, here = regions(truth, truth.diagnosis), regions(found, found.diagnosis)
    both = sorted(there.keys() & here.keys())
    of_regions = ranks(np.array([there[k] for k in both]), np.array([here[k] for k in both]))
    same = regions(truth, from_places_of(truth, found))
    shared = sorted(same.keys() & here.keys())
    of_same = ranks(np.array([same[k] for k in shared]), np.array([here[k] for k in shared]))
    real = {frame.index: frame.score for frame in truth.frames}
    pairs = [(real[f.index], f.score) for f in found.frames if f.index in real and f.score.judged]
    of_frames = ranks(*np.array([(a.renderability, b.renderability) for a, b in pairs]).T)
    (true, _), (own, _) = voxels(truth, truth.diagnosis), voxels(found, found.diagnosis)
    to_true, _ = KDTree(true).query(own)
    to_own, _ = KDTree(own).query(true)
    best = raised(truth, suggested(truth))
    return {
        "regions_compared": len(both),
        "regions_with_depth": len(there),
        "spearman_regions": of_regions,
        "spearman_regions_from_same_places": of_same,
        "frames_compared": len(pairs),
        "spearman_frames": of_frames,
        "spearman_psnr": ranked_by_psnr(found, psnr),
        "spearman_psnr_with_depth": ranked_by_psnr(truth, psnr),
        "not_known": found.shares[found.unknown],
        "unseen": found.shares["unseen"],
        "unseen_with_depth": truth.shares["unseen"],
        "within_10_cm_of_depth": float((to_true < 0.1).mean()),
        "surface_known": float((to_own < 0.1).mean()),
        "views_raise": raised(truth, suggested(found)) / best if best > 0.0 else None,
        "random_views_raise": (truth.plan.random_mean[-1] - truth.diagnosis.mean) / best,
        "best_views_raise_mean_r_by": best,
        "mean_r_of_regions": float(np.mean([here[k] for k in both])),
        "mean_r_of_regions_with_depth": float(np.mean([there[k] for k in both])),
        "range": found.survey.length(5.0),
        "range_with_depth": truth.survey.length(5.0),
        "voxel": found.survey.length(found.survey.voxel_size),
        "standpoints": len(found.standpoints),
        "known_rows": int(known_rows(found.seen.state, found.source.is_complete).sum()),
        "voxels": len(own),
        "voxels_with_depth": len(true),
    }


def compare_capture(path: Path, out: Path, surfaces: tuple[Surfaces, ...]) -> list[dict[str, Any]]:
    """Makes the comparisons of a capture that are not there, and returns all of them."""
    capture = open_capture(path, "z")
    source = source_of(capture.source, capture.name)
    folder = out / path.name
    photos = photos_alone(source, folder / "photos")
    truth: Callable[[], Audit] = lru_cache(lambda: audit(source))
    rows: list[dict[str, Any]] = []
    for name in surfaces:
        cell = folder / f"{name}.json"
        if not cell.exists():
            bare = source_of(read_colmap(photos), capture.name)
            model = splat_alone(bare, folder / "splat.ply") if name == "model" else None
            settings = AuditSettings(surfaces=name, model=model)
            known, psnr = truth(), held_out_psnr(bare, folder / "psnr.npy")
            begun = time.perf_counter()
            found = audit(bare, settings)
            row = {"capture": path.name, "surfaces": name, "pictures": len(bare)}
            row |= {"seconds": time.perf_counter() - begun, **compare(known, found, psnr)}
            cell.write_text(json.dumps(row, indent=1) + "\n")
        rows.append(json.loads(cell.read_text()))
        print(json.dumps(rows[-1], indent=1), flush=True)
    return rows


def main(options: Options) -> None:
    """Compares, and writes `results.json`."""
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for path in options.captures:
        rows += compare_capture(path, options.out, options.surfaces)
    (options.out / "results.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
