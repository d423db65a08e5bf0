"""Compares audits of photos alone with audits of the same photos and a depth camera.

    python -m experiments.without_depth ../shared/recordings/hololens_lounge --out /tmp/without

Of each capture with depth its photos are matched and triangulated at its poses by pycolmap, which
gives what a structure from motion would; its depth is used for comparison only. Then it is audited
from its depth, from sparse points, from depth swept from the photos, and from trained splats
(`--models`, one for each). Regions are blocks of 0.5 in the unit of the capture; of each the
mean R over its surfaces is compared by a rank correlation (Spearman), over the regions that both
know. An interval is that of 1,000 resamplings of the regions.
"""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from PIL import Image
from scipy.spatial import KDTree
from scipy.stats import spearmanr

from r3jax.apps.audit.audit import Audit, audit
from r3jax.apps.audit.settings import AuditSettings
from r3jax.captures.settings import Surfaces
from r3jax.captures.source import Source, source_of
from r3jax.captures.survey import RANGE
from r3jax.formats.captures import open_capture
from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, colmap_pose, points_without_tracks
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.lenses import pinhole_lens

BLOCK = 0.5
"""Edge of a region [capture units]."""

_FEWEST_VOXELS = 3
"""A region with fewer of them is not compared."""

_FEATURES = 4000
"""SIFT features of a photo at most."""

_SAMPLES = 1000

_SPARSE_VOXEL = 0.1
"""Edge of a voxel of sparse points [capture units]: with finer ones walls have gaps."""


@dataclass(frozen=True)
class Options:
    """What is compared."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Captures with depth."""

    out: Path = Path("without_depth")
    """Folder of the photos, their models and the results."""

    models: tuple[Path, ...] = ()
    """A trained splat for each capture."""

    surfaces: tuple[Surfaces, ...] = ("points", "sweep")
    """Sources of surfaces that are compared with depth."""

    views: int = 0
    """Views to suggest, whose overlap is compared."""


def photos_alone(source: Source, folder: Path) -> Path:
    """Writes the photos of a capture and a COLMAP model of points triangulated at its poses.

    Args:
        source: a capture with images.
        folder: is written.

    Returns:
        The folder, as COLMAP would leave it.
    """
    import pycolmap

    if (folder / "sparse" / "0" / "points3D.bin").exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("images", "known", "sparse/0"):
        (folder / name).mkdir(parents=True)
    names = [f"{index:05d}.png" for index in range(len(source))]
    for index, name in enumerate(names):
        Image.fromarray(source.read(index)[0]).save(folder / "images" / name)
    database = folder / "database.db"
    lens = pinhole_lens(source.camera(0))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = ",".join(map(str, lens.params))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = _FEATURES
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
        ColmapImage(ids[name], name, camera.camera_id, *colmap_pose(source.poses[index]), *none)
        for index, name in enumerate(names)
    )
    points = points_without_tracks(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    write_binary(folder / "known", ColmapModel({camera.camera_id: lens}, images, points))
    known = pycolmap.Reconstruction(folder / "known")
    found = pycolmap.triangulate_points(
        known, database, folder / "images", folder / "sparse" / "0", clear_points=True
    )
    found.write(folder / "sparse" / "0")
    return folder


def voxels(found: Audit) -> tuple[np.ndarray, np.ndarray]:
    """Centers [m, 3] and R [m] of the surfaces that were judged, in the capture's coordinates."""
    judged = found.diagnosis.is_seen
    centers = np.asarray(found.seen.state.center, np.float64).T[judged]
    return found.survey.alignment.points_back(centers), found.diagnosis.value[judged]


def regions(found: Audit) -> dict[tuple[int, ...], float]:
    """Mean R of every block that has enough surfaces."""
    centers, value = voxels(found)
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


def compare(truth: Audit, found: Audit) -> dict[str, Any]:
    """How an audit without depth compares with that from depth."""
    there, here = regions(truth), regions(found)
    both = sorted(there.keys() & here.keys())
    of_regions = ranks(np.array([there[k] for k in both]), np.array([here[k] for k in both]))
    real = {frame.index: frame.score.renderability for frame in truth.frames}
    pairs = [
        (real[f.index], f.score.renderability)
        for f in found.frames
        if f.index in real and np.isfinite(f.score.renderability)
    ]
    of_frames = ranks(*np.array(pairs).T)
    (true, _), (own, _) = voxels(truth), voxels(found)
    to_true, _ = KDTree(true).query(own)
    to_own, _ = KDTree(own).query(true)
    return {
        "regions_compared": len(both),
        "regions_with_depth": len(there),
        "spearman_regions": of_regions,
        "spearman_frames": of_frames,
        "not_known": found.shares[found.unknown],
        "within_10_cm_of_depth": float((to_true < 0.1).mean()),
        "surface_known": float((to_own < 0.1).mean()),
        "mean_r_of_regions": float(np.mean([here[k] for k in both])),
        "mean_r_of_regions_with_depth": float(np.mean([there[k] for k in both])),
        "mean_r": found.diagnosis.mean,
        "mean_r_with_depth": truth.diagnosis.mean,
        "voxels": len(own),
        "voxels_with_depth": len(true),
    }


def main(options: Options) -> None:
    """Compares, and writes `results.json`."""
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for number, path in enumerate(options.captures):
        capture = open_capture(path, "z")
        source = source_of(capture.source, capture.name)
        photos = photos_alone(source, options.out / capture.name)
        truth = audit(source, AuditSettings(views=options.views))
        # The same vertical: what is compared is surfaces, not a guess of up.
        up = ",".join(f"{value:.9f}" for value in truth.survey.up.direction)
        wanted: list[tuple[Surfaces, Path | None]] = [(name, None) for name in options.surfaces]
        if number < len(options.models):
            wanted.append(("model", options.models[number]))
        for name, model in wanted:
            bare = source_of(read_colmap(photos), capture.name)
            voxel = _SPARSE_VOXEL if name == "points" else None
            settings = AuditSettings(
                views=options.views,
                up=up,
                surfaces="auto" if name == "model" else name,
                model=model,
                max_range=RANGE * truth.survey.length(1.0),
                voxel_size=voxel or truth.survey.length(truth.survey.voxel_size),
            )
            begun = time.perf_counter()
            found = audit(bare, settings)
            row = {"capture": capture.name, "surfaces": name, **compare(truth, found)}
            row["seconds"] = time.perf_counter() - begun
            row["pictures"] = len(bare)
            print(json.dumps(row, indent=1), flush=True)
            rows.append(row)
    (options.out / "results.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
