"""Takes the pictures that an audit suggests, and compares what it promised with what came of it.

    python -m experiments.audit_promise

A person with a phone walks through an embedded scene: from place to place in straight lines, a
picture every 40 cm, turning the phone from side to side; the depth has noise of 1 %, poses are off
by 5 mm and 0.2 degrees. The capture is audited, and the suggested pictures are taken as a person
takes them: 10 cm and 5 degrees off. Then the capture is audited again, with its surfaces as they
are then known. The same is done with as many pictures at random places of the same audit.

Two shares are compared: that of the page, which chooses standpoints again; and that from the
standpoints of the first audit. What is done in `--work` is not done again. How much
less comes than was simulated is held in `apps/audit/suggest.py`.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from r3jax.apps.audit.audit import Audit, audit
from r3jax.apps.audit.diagnosis import (
    Diagnosis,
    demand_of,
    diagnose,
    score_from_standpoints,
)
from r3jax.apps.audit.settings import AuditSettings
from r3jax.apps.audit.suggest import random_poses
from r3jax.apps.benchmark.record import machine
from r3jax.captures.capture_maps import see
from r3jax.captures.source import Picture, Source
from r3jax.captures.standpoints import places_of
from r3jax.captures.survey import survey_of
from r3jax.files import make_folder, write_atomic
from r3jax.formats.lenses import pinhole_lens
from r3jax.geometry.cameras import Camera, look_at
from r3jax.simulators.base import NoisySimulator
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_scene

NAME = "audit_promise"

SCENES = ("flat", "kitchen", "loft", "apartment", "office", "classroom", "library")

_CAMERA = Camera.from_fov(320, 240, 68.0)

_STEP = 0.4
"""Between two pictures of a walk [m]."""

_HELD = (0.05, 0.3)
"""How far above the scene's own start (1.3 m) the phone is held [m]."""

_CLEARANCE = 0.35
"""A person keeps this far from everything [m]."""

_POSE_NOISE = (0.005, np.radians(0.2))
"""Of what the capture says of its poses [m], [rad]."""

_AIM = (0.1, np.radians(5.0))
"""How far off a person takes a suggested picture [m], [rad]."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Takes what audits suggest, in embedded scenes."""

    scenes: tuple[str, ...] = SCENES

    frames: tuple[int, ...] = (30, 15, 60)
    """Lengths of the walks: from sketchy to complete."""

    views: int = 10

    only_done: bool = False
    """Make the tables of the cells that are there."""

    work: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/audit-promise")

    out: Path = Path("experiments/results") / NAME


@functools.lru_cache(maxsize=2)
def opened(scene: str) -> NoisySimulator:
    """Opens a scene once, with noise of 1 % on its depth."""
    world = open_scene(scene, camera=_CAMERA)
    assert isinstance(world, NoisySimulator)
    return world


def walk(world: RaycastSimulator, num: int, rng: np.random.Generator) -> np.ndarray:
    """Draws the poses of a walk, `T_world_camera` [num, 4, 4]."""
    low, high = world.bounds
    start = world.start_pose[:3, 3]
    here = start + np.array([0.0, 0.0, rng.uniform(*_HELD)])
    poses: list[np.ndarray] = []
    while len(poses) < num:
        there = rng.uniform(low, high)
        there[2] = start[2] + rng.uniform(*_HELD)
        length = float(np.linalg.norm(there - here))
        line = here + np.linspace(0, 1, max(2, int(length / 0.1)))[:, None] * (there - here)
        if length < 1.0 or float(world.clearance(line).min()) < _CLEARANCE:
            continue
        heading = np.arctan2(*(there - here)[1::-1])
        for share in np.arange(_STEP, length, _STEP) / length:
            swing = 0.9 * np.sin(0.7 * len(poses)) + rng.normal(0.0, 0.25)
            pitch = rng.normal(-0.15, 0.15)
            level = heading + swing
            ahead = np.array([np.cos(level), np.sin(level), np.tan(pitch)])
            eye = here + share * (there - here) + rng.normal(0.0, 0.02, 3)
            poses.append(np.asarray(look_at(eye, eye + ahead), np.float64))
        here = there
    return np.stack(poses[:num])


def moved(pose: np.ndarray, by: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Moves and turns a pose at random, by standard deviations [m] and [rad]."""
    x, y, z = rng.normal(0.0, by[1], 3)
    small = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    u, _, vt = np.linalg.svd(small @ pose[:3, :3])
    found = pose.copy()
    found[:3, :3] = u @ vt
    found[:3, 3] += rng.normal(0.0, by[0], 3)
    return found


def aimed(world: RaycastSimulator, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Takes a suggested pose as a person does, not inside of anything."""
    for _ in range(20):
        found = moved(pose, _AIM, rng)
        if float(world.clearance(found[None, :3, 3]).min()) > 0.1:
            return found
    return pose


def capture(scene: str, poses: np.ndarray, rng: np.random.Generator) -> Source:
    """Takes pictures at poses; the capture says them with noise."""
    world = opened(scene)
    pictures: list[Picture] = []
    for pose in poses:
        frame = world.render(pose)
        rgb = 255.0 * np.asarray(frame.rgb) + rng.normal(0.0, 3.0, frame.rgb.shape)
        depth = np.asarray(frame.depth)
        depth = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
        pictures.append((np.rint(rgb).clip(0, 255).astype(np.uint8), depth))
    said = np.stack([moved(pose, _POSE_NOISE, rng) for pose in poses])
    return Source(
        name=scene,
        poses=said,
        lenses=(pinhole_lens(_CAMERA),) * len(poses),
        labels=tuple(f"{i:03d}.png" for i in range(len(poses))),
        kind="depth",
        is_metric=True,
        up=np.array([0.0, 0.0, 1.0]),
        stride=1,
        read=lambda index: pictures[index],
    )


def joined(first: Source, second: Source) -> Source:
    """Returns the pictures of two captures of one world as one capture."""
    num = len(first)
    return dataclasses.replace(
        first,
        poses=np.concatenate([first.poses, second.poses]),
        lenses=first.lenses + second.lenses,
        labels=first.labels + tuple(f"more {name}" for name in second.labels),
        read=lambda i: first.read(i) if i < num else second.read(i - num),
    )


def obtained(before: Audit, source: Source) -> dict[str, float]:
    """Scores what is known now: for the page, and from the standpoints of the first audit."""
    survey = survey_of(source, AuditSettings())
    seen = see(source, survey, folds=1)
    cameras = survey.alignment.points(source.poses[survey.chosen, :3, 3])
    meter = survey.alignment.scale
    places = places_of(
        seen.state,
        seen.grid,
        cameras,
        AuditSettings.num_places,
        is_dense=True,
        meter=meter,
        with_cameras=True,
    )
    there = survey.alignment.points(before.survey.alignment.points_back(before.standpoints))

    def scored(standpoints: np.ndarray) -> Diagnosis:
        demand = demand_of(seen.state, standpoints, before.config)
        scores = score_from_standpoints(seen.state, demand, before.camera.focal, before.config)
        return diagnose(seen.state, demand, scores)

    now = scored(places.standpoints)
    same = scored(there)
    return {
        "fine": now.fine_share,
        "mean": now.mean,
        "fine_there": same.fine_share,
        "mean_there": same.mean,
        "surfaces": float(now.is_seen.sum()) * survey.voxel_size**2,
    }


def cell(scene: str, frames: int, options: Options) -> dict[str, Any]:
    """Audits one capture, takes what is suggested, and audits again."""
    seed = 1000 * SCENES.index(scene) + frames
    rng = np.random.default_rng(seed)
    world = opened(scene).simulator
    assert isinstance(world, RaycastSimulator)
    source = capture(scene, walk(world, frames, rng), rng)
    found = audit(source, AuditSettings(views=options.views, seed=seed))
    back = found.survey.alignment.poses_back
    ranked = found.plan.ranked
    chosen = [aimed(world, pose, rng) for pose in back(np.stack([v.pose for v in ranked]))]
    drawn = back(random_poses(found.places.eyes, len(ranked), seed))
    drawn = [aimed(world, pose, rng) for pose in drawn]
    take = lambda poses: joined(source, capture(scene, np.stack(poses), rng))
    first = found.diagnosis
    return {
        "scene": scene,
        "frames": frames,
        "machine": machine(),
        "views": len(ranked),
        "before": {"fine": first.fine_share, "mean": first.mean,
                   "surfaces": float(first.is_seen.sum()) * found.survey.voxel_size**2},
        "promised": {"fine": ranked[-1].fine_after, "mean": ranked[-1].mean_after},
        "promised_random": {"fine": found.plan.random_fine[-1],
                            "mean": found.plan.random_mean[-1]},
        "obtained": obtained(found, take(chosen)),
        "obtained_random": obtained(found, take(drawn)),
    }  # fmt: skip


def loss(record: dict[str, Any], which: str = "") -> float:
    """Share by which less came, on the page, than was simulated."""
    return record[f"promised{which}"]["fine"] - record[f"obtained{which}"]["fine"]


def interval(values: np.ndarray) -> list[float]:
    """10th percentile, median and 90th percentile, to a tenth of a percent."""
    return [round(float(value), 3) for value in np.percentile(values, [10, 50, 90])]


def coverage(records: list[dict[str, Any]]) -> float:
    """Share of the captures within the interval from the captures of the other scenes."""
    hits: list[bool] = []
    for scene in {record["scene"] for record in records}:
        others = np.array([loss(r) for r in records if r["scene"] != scene])
        low, _, high = interval(others)
        hits += [low <= loss(r) <= high for r in records if r["scene"] == scene]
    return float(np.mean(hits))


def table(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns a row for each capture, in percent of the page."""
    percent = lambda record, what: round(100.0 * record[what]["fine"], 1)
    return [
        {
            "scene": r["scene"],
            "pictures": r["frames"],
            "before [%]": percent(r, "before"),
            "promised [%]": percent(r, "promised"),
            "came [%]": percent(r, "obtained"),
            "from the same standpoints [%]": round(100.0 * r["obtained"]["fine_there"], 1),
            "random, promised [%]": percent(r, "promised_random"),
            "random, came [%]": percent(r, "obtained_random"),
            "random, from the same standpoints [%]": round(
                100.0 * r["obtained_random"]["fine_there"], 1
            ),
            "less than promised [points]": round(100.0 * loss(r), 1),
        }
        for r in records
    ]


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Formats the constants of `apps/audit/suggest.py`, and tests them in scenes left out."""
    gain = lambda what, name: [100.0 * (r[what][name] - r["before"]["fine"]) for r in records]
    return {
        "captures": len(records),
        "loss": interval(np.array([loss(r) for r in records])),
        "loss_random": interval(np.array([loss(r, "_random") for r in records])),
        "coverage_in_other_scenes": round(coverage(records), 2),
        "mean_gain_points": {
            "promised": round(float(np.mean(gain("promised", "fine"))), 1),
            "came": round(float(np.mean(gain("obtained", "fine"))), 1),
            "came_random": round(float(np.mean(gain("obtained_random", "fine"))), 1),
            "same_standpoints": round(float(np.mean(gain("obtained", "fine_there"))), 1),
            "same_standpoints_random": round(
                float(np.mean(gain("obtained_random", "fine_there"))), 1
            ),
        },
    }


def main(options: Options) -> None:
    """Makes all cells that are not there yet, and the tables."""
    make_folder(options.work)
    records: list[dict[str, Any]] = []
    for scene in options.scenes:
        for frames in options.frames:
            path = options.work / f"{scene}-{frames}.json"
            if options.only_done and not path.exists():
                continue
            if not path.exists():
                record = cell(scene, frames, options)
                write_atomic(path, (json.dumps(record) + "\n").encode())
            records.append(json.loads(path.read_text()))
            print(path.name, round(loss(records[-1]), 3), flush=True)
    make_folder(options.out)
    origin = joint_origin("experiments.audit_promise", [r["machine"] for r in records], [None])
    lines = "\n".join(json.dumps(record) for record in records)
    write_atomic(options.out / "records.jsonl", f"{lines}\n".encode())
    found = json.dumps(summary(records), indent=1)
    write_atomic(options.out / "promise.json", f"{found}\n".encode())
    write_markdown(options.out / "table.md", [markdown_table(table(records))], origin)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
