"""Every reader of the package under hostile files: small good files, and what makes sense of them.

`READERS` are damaged by chance, `CRAFTED` are read as they are: cases that chance does not find.
"""

import contextlib
import io
import json
import tempfile
from collections.abc import Callable
from importlib.resources import files as resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.apps.benchmark.cells import Conditions
from r3jax.apps.benchmark.record import read_records
from r3jax.apps.benchmark.reference_images import (
    ReferenceImages,
    read_reference_images,
    save_reference_images,
)
from r3jax.apps.benchmark.submitted import conditions_of
from r3jax.apps.forecast.psnr import STATISTICS, read_calibration
from r3jax.apps.report.report import (
    quality_note,
    quality_rows,
    read_evaluated_model,
    training_figure,
)
from r3jax.captures.camera_paths import is_camera_path, read_camera_path
from r3jax.cli.commands.benchmark import print_results
from r3jax.cli.console import Console
from r3jax.errors import InputError
from r3jax.evaluation import test_views as view_sets
from r3jax.evaluation.judge import choose_views, mapped_views
from r3jax.evaluation.test_views import ViewSet, read_view_set
from r3jax.exploration.taken_views import to_integers
from r3jax.formats.captures import open_capture
from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.colmap.text import write_text
from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import read_transforms
from r3jax.formats.phones.arkit_scenes import read_arkit_scenes
from r3jax.formats.phones.polycam import read_polycam
from r3jax.formats.phones.record3d import read_record3d
from r3jax.formats.phones.stray_scanner import read_stray_scanner
from r3jax.formats.posed_images import PosedImages
from r3jax.formats.recordings import read_recording
from r3jax.formats.ros.bag_reader import read_bag
from r3jax.formats.ros.rtabmap import read_rtabmap_database, read_rtabmap_export
from r3jax.formats.sequences.llff import read_llff
from r3jax.formats.sequences.replica_slam import read_replica_slam
from r3jax.formats.sequences.scannet import read_scannet, read_sens
from r3jax.formats.sequences.seven_scenes import read_seven_scenes
from r3jax.formats.sequences.tum import read_tum
from r3jax.formats.submissions import (
    content_hash,
    parse_submission,
    read_submission,
    submission_text,
)
from r3jax.geometry.cameras import Camera, rigid_error
from r3jax.mapping.occupancy import empty_grid
from r3jax.mapping.state import empty_map
from r3jax.runs.header import RunError, header_to_json
from r3jax.runs.reader import read_run
from r3jax.runs.rows import EndRow, to_json
from r3jax.runs.stored_states import CheckpointWriter, load_checkpoint, map_tables, read_checkpoint
from r3jax.runs.writer import encode_png
from r3jax.simulators.habitat import read_stage
from r3jax.splatting.errors import CheckpointError, SceneFileError
from r3jax.splatting.model import find_model
from r3jax.splatting.ply import read_scene, write_scene
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training import checkpoints as training
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.train_step import start_state
from r3jax.splatting.views import Views
from tests.conftest import SHARED
from tests.evaluation.records import record
from tests.formats import phones, rtabmap, sequences
from tests.formats.bags import write_bag
from tests.formats.colmap_models import random_model
from tests.formats.sequences import encoded
from tests.formats.test_submissions import make_submission
from tests.fuzz import meshes
from tests.fuzz.mutations import HOSTILE_NAMES, INT_WORDS, mutate, png_bomb, zipped
from tests.fuzz.tree import Files, Link, pick_up, unsealed
from tests.fuzz.worker import Reader
from tests.runs.runs import make_header, make_view

Read = Callable[[Path], object]
Rng = np.random.Generator


def written(write: Callable[[Path], object]) -> dict[str, bytes]:
    """The files that a call writes into a folder."""
    with tempfile.TemporaryDirectory() as name:
        write(Path(name))
        return pick_up(Path(name))


def random_scene(rows: int, harmonics: int) -> GaussianScene:
    rng = np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape).astype(np.float32))
    shapes = ((rows, 3), (rows, 4), (rows, 3), (rows,), (rows, harmonics, 3))
    return GaussianScene(*(draw(*shape) for shape in shapes))


def two_views(rgb: np.ndarray, depth: np.ndarray) -> Views:
    return Views(
        rgb=jnp.asarray(rgb),
        depth=jnp.asarray(depth),
        T_world_camera=jnp.asarray(np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))),
        cameras=jax.tree.map(lambda x: jnp.stack([x, x]), Camera(6, 4, 8.0, 8.0, 3.0, 2.0)),
    )


# Captures: posed images


def posed(read: Callable[[Path], PosedImages]) -> Read:
    """Reads posed images, whose values must make sense."""

    def check(folder: Path) -> None:
        images = read(folder)
        assert len(images) > 0
        assert len(images.lenses) == len(images) == len(images.poses) == len(images.depth_paths)
        for pose, lens in zip(images.poses, images.lenses, strict=True):
            assert rigid_error(pose) is None
            assert np.isfinite(lens.params).all()
            assert lens.camera.width > 0
        for path in filter(None, (*images.image_paths, *images.depth_paths)):
            assert ".." not in path.relative_to(folder).parts
        points = images.points
        if points is not None:
            assert np.isfinite(points.xyz).all()
            assert points.rgb.shape == points.xyz.shape
            assert ((points.seen_image >= 0) & (points.seen_image < len(images))).all()
            assert ((points.seen_point >= 0) & (points.seen_point < len(points))).all()
        for frame in images.frames() if any(images.depth_paths) else ():
            assert frame.rgb.shape == (*frame.depth.shape, 3)
            assert np.isfinite(frame.rgb).all()
            assert not np.isnan(frame.depth).any()
            assert (np.asarray(frame.depth) >= 0.0).all()

    return check


def capture(
    read: Callable[[Path], PosedImages], *make: Callable[[], Files], cases: int = 50
) -> Reader:
    return Reader(lambda: [one() for one in make], posed(read), (FormatError,), cases=cases)


def archive(
    read: Callable[[Path], PosedImages], make: Callable[[], dict[str, bytes]], name: str
) -> Reader:
    """In an archive: half of the cases damage a member, the others the archive."""

    def damaged(rng: Rng, files: Files) -> tuple[Files, str]:
        if rng.random() < 0.5:
            return mutate(rng, files)
        members, what = mutate(rng, make())
        plain = {key: data for key, data in members.items() if isinstance(data, bytes)}
        return {name: zipped(plain)}, what

    seeds = lambda: [{name: zipped(make())}]
    checked = posed(lambda folder: read(folder / name))
    return Reader(seeds, checked, (FormatError,), make=damaged, cases=50)


def recordings() -> list[Files]:
    """A recording with PNG, with JPEG, and the first frame of a real one where there is one."""
    rng = np.random.default_rng(0)
    files = {"K.txt": b"8 0 4.5\n0 8 3.5\n0 0 1\n", "poses.txt": b""}
    for i in range(2):
        rgb = rng.integers(0, 256, (8, 10, 3), dtype=np.uint8)
        depth = rng.integers(0, 5000, (8, 10)).astype(np.uint16)
        files[f"images/{i:03d}.png"], files[f"depth/{i:03d}.png"] = encoded(rgb), encoded(depth)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = 0.1 * i, 1.5, 0.25
        files["poses.txt"] += " ".join(f"{x:.6f}" for x in pose.reshape(-1)).encode() + b"\n"
    photos = {name: data for name, data in files.items() if not name.startswith("images/")}
    for i in range(2):
        photos[f"images/{i:03d}.jpg"] = encoded(np.full((8, 10, 3), 90 * i, np.uint8), "jpeg")
    path = SHARED / "recordings" / "hololens_lounge"
    if not path.is_dir():
        return [files, photos]
    lines = (path / "poses.txt").read_bytes().splitlines(keepends=True)
    pose = next(line for line in lines if line.strip() and not line.startswith(b"#"))
    real = {"K.txt": (path / "K.txt").read_bytes(), "poses.txt": pose}
    for image in (min((path / name).iterdir()) for name in ("images", "depth")):
        real[f"{image.parent.name}/{image.name}"] = image.read_bytes()
    return [files, photos, real]


def transforms() -> list[Files]:
    """A transforms.json as r3jax writes it, and as Blender does."""
    pose = [[1.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    rng = np.random.default_rng(0)
    files: dict[str, bytes] = {}
    frames: list[dict[str, Any]] = []
    for i in range(2):
        files[f"images/{i}.png"] = encoded(rng.integers(0, 256, (8, 10, 3), dtype=np.uint8))
        files[f"depth/{i}.png"] = encoded(rng.integers(0, 5000, (4, 5)).astype(np.uint16))
        names = {"file_path": f"images/{i}.png", "depth_file_path": f"depth/{i}.png"}
        frames.append({**names, "transform_matrix": pose})
    ours = {"w": 10, "h": 8, "fl_x": 12.5, "fl_y": 12.25, "cx": 5.0, "cy": 4.0}
    ours |= {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    ours |= {"depth_unit_scale_factor": 0.0002, "depth_beyond_range_value": 65535}
    blender = {"camera_angle_x": 0.7, "applied_transform": pose[:3], "applied_scale": 0.5}
    bare = [{**frame, "file_path": frame["file_path"].removesuffix(".png")} for frame in frames]
    return [
        {**files, "transforms.json": json.dumps({**ours, "frames": frames}).encode()},
        {**files, "transforms.json": json.dumps({**blender, "frames": bare}).encode()},
    ]


def hostile_transforms() -> list[Files]:
    """Names that lead elsewhere, and a picture that unpacks to far more than it takes."""
    seed = transforms()[0]
    content = json.loads(as_bytes(seed["transforms.json"]))
    found: list[Files] = []
    for field in ("file_path", "depth_file_path"):
        for name in HOSTILE_NAMES:
            frames = [{**content["frames"][0], field: name}]
            changed = json.dumps({**content, "frames": frames}).encode()
            found.append({**seed, "transforms.json": changed})
    for name in ("images/0.png", "depth/0.png"):
        found.append({**seed, name: png_bomb()})
        huge = json.dumps({**content, "w": 65536, "h": 65536}).encode()
        found.append({**seed, name: png_bomb(), "transforms.json": huge})
    return found


def as_bytes(entry: object) -> bytes:
    assert isinstance(entry, bytes)
    return entry


def colmap_models() -> list[Files]:
    """Two models in each form."""
    found: list[Files] = []
    for write, seed in ((write_binary, 0), (write_text, 0), (write_binary, 5), (write_text, 7)):
        files = written(lambda folder, write=write, seed=seed: write(folder, random_model(seed)))
        found.append({f"sparse/0/{name}": data for name, data in files.items()})
    return found


def hostile_models() -> list[Files]:
    """Every count and every other word of a binary as a hostile number, and names that lead out."""
    binary, text = colmap_models()[:2]
    found: list[Files] = []
    for name, data in binary.items():
        data = as_bytes(data)
        for word in (*(word.to_bytes(8, "little") for word in INT_WORDS), b"\xff" * 8):
            for at in (0, *range(8, min(len(data), 120), 4)):
                found.append({**binary, name: data[:at] + word + data[at + 8 :]})
    lines = as_bytes(text["sparse/0/images.txt"])
    for hostile in (b"../../x", b"/etc/passwd", b"..\\x", b".", b"a/../../outside/secret", b"\0"):
        found.append({**text, "sparse/0/images.txt": lines.replace(b"a.png", hostile)})
    return [*found, {**binary, "images": Link("/")}]


def bag(kind: str) -> Callable[[], Files]:
    name = "drive.bag" if kind == "bag" else "drive"
    return lambda: written(lambda folder: write_bag(folder / name, kind=kind))


def one_file(read: Callable[[Path], PosedImages], name: str) -> Callable[[Path], PosedImages]:
    return lambda folder: read(folder / name)


CAPTURES = {
    "recording": Reader(recordings, posed(read_recording), (FormatError,)),
    "transforms": Reader(transforms, posed(read_transforms), (FormatError,)),
    "colmap": Reader(colmap_models, posed(read_colmap), (FormatError,)),
    "polycam": capture(read_polycam, phones.polycam),
    "polycam zip": archive(read_polycam, phones.polycam, "scan.zip"),
    "record3d": capture(read_record3d, phones.record3d),
    "record3d r3d": archive(read_record3d, phones.record3d, "scan.r3d"),
    "record3d export": capture(read_record3d, phones.record3d_export),
    "stray scanner": capture(read_stray_scanner, phones.stray_scanner),
    "arkit scenes": capture(read_arkit_scenes, phones.arkit_scenes),
    "scannet": capture(read_scannet, phones.scannet),
    "scannet sens": capture(read_sens, lambda: {"scene.sens": phones.sens()}),
    "replica slam": capture(read_replica_slam, sequences.replica_slam, cases=80),
    "tum": capture(read_tum, sequences.tum, cases=80),
    "seven scenes": capture(read_seven_scenes, sequences.seven_scenes, cases=80),
    "llff": capture(read_llff, sequences.llff, cases=80),
    "bag mcap": capture(one_file(read_bag, "drive"), bag("mcap"), cases=100),
    "bag db3": capture(one_file(read_bag, "drive"), bag("db3"), cases=100),
    "bag": capture(read_bag, bag("bag"), cases=100),
    "rtabmap export": capture(read_rtabmap_export, rtabmap.export, cases=100),
    "rtabmap database": capture(
        one_file(read_rtabmap_database, "map.db"),
        lambda: {"map.db": rtabmap.database()},
        lambda: {"map.db": rtabmap.database(optimized=False)},
        cases=100,
    ),
}


# Runs and what lies beside them


def runs() -> list[Files]:
    """A run with images, and its rows alone."""
    files = {"run.json": header_to_json(make_header()).encode()}
    lines: list[str] = []
    for step in range(3):
        row, frame = make_view(step)
        rgb, depth = to_integers(frame)
        files[f"frames/{step:06d}.png"] = encode_png(rgb)
        files[f"frames/{step:06d}.depth.png"] = encode_png(depth)
        lines.append(to_json(row))
    lines.append(to_json(EndRow("budget", "all views taken", 3)))
    files["trace.jsonl"] = "".join(line + "\n" for line in lines).encode()
    timing = json.dumps({"step": 0, "render": 0.1, "plan": 0.25}) + "\n"
    files["timings.jsonl"] = 3 * timing.encode()
    files = unsealed(files)
    return [files, {name: files[name] for name in ("run.json", "trace.jsonl", "timings.jsonl")}]


def read_a_run(folder: Path) -> None:
    run = read_run(folder)
    camera = run.camera
    assert all(np.isfinite(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    assert np.asarray(run.header.bounds).shape == (2, 3)
    for row in run.rows:
        assert rigid_error(row.pose) is None
        assert np.isfinite([row.seconds, row.metres, row.radians, *row.charged.values()]).all()
        assert np.isfinite([float(x) for x in vars(row.coverage).values()]).all()
        if row.choice is not None:
            assert np.isfinite(row.choice.waypoints).all()
            assert row.choice.waypoints.shape[1:] == (3,)
    for timing in run.timings:
        assert np.isfinite(list(timing.values())).all()
    assert run.outcome
    for frame in run.frames() if (folder / "frames").exists() else ():
        assert np.isfinite(frame.rgb).all()
        assert not np.isnan(frame.depth).any()


def models() -> list[Files]:
    """A run with a model's train.json, evaluation.json and history.csv."""
    run = {k: v for k, v in runs()[0].items() if not k.startswith("frames")}
    train = {
        "data": "case", "resolution": 8, "train_views": [0, 1], "test_views": [2],
        "config": {"background": "white"}, "packages": {"r3jax": "0"},
    }  # fmt: skip
    metric = {
        "views": 1, "mean": 21.5, "interval": [20.0, 23.0], "median": 21.0, "percentile_5": 18.0,
        "worst": 17.5, "worst_view": 2, "poor_share": 0.25,
    }  # fmt: skip
    evaluation = {
        "model": "case/models/last/scene.ply", "gaussians": 5, "data": "case", "numbers": [2],
        "trained_on": 0, "width": 8, "height": 6, "bootstrap_seed": 0,
        "metrics": {"psnr": metric, "ssim": metric | {"poor_share": None}},
    }  # fmt: skip
    rows = "".join(f"{i},0.{i},{20 + i}.5,{100 * i}\n" for i in range(1, 6))
    return [
        run
        | {
            "models/last/scene.ply": b"ply\n",
            "models/last/train.json": json.dumps(train, indent=1).encode(),
            "models/last/history.csv": f"step,loss,psnr,gaussians\n{rows}".encode(),
            "report/evaluation.json": json.dumps(evaluation, indent=1).encode(),
            "report/evaluation.png": b"\x89PNG",
        }
    ]


def damage_model(rng: Rng, files: Files) -> tuple[Files, str]:
    """The run itself stays whole."""
    parts = ("models/last/train.json", "models/last/history.csv", "report/")
    changed, what = mutate(rng, {k: v for k, v in files.items() if k.startswith(parts)})
    return {k: v for k, v in files.items() if not k.startswith(parts)} | changed, what


def read_a_model(folder: Path) -> None:
    opened = open_capture(folder)
    trained = find_model(opened.models, opened.path)
    test = choose_views("heldout", opened, trained)
    assert all(0 <= number < len(opened) for number in test.numbers)
    assert all(0 <= n < len(opened) for n in mapped_views(trained, test, opened))
    assert np.isfinite(trained.background).all()
    assert opened.run is not None
    model = read_evaluated_model(opened.run)
    if model is not None:
        # What is accepted can be shown: nothing breaks later.
        assert "nan" not in str(quality_rows(model.evaluation))
        assert quality_note(model.evaluation)
        if model.history:
            training_figure(model.history)


def checkpoints(folder: Path) -> None:
    grid = empty_grid(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    writer = CheckpointWriter(folder)
    writer.save(3, map_tables(empty_map(64), grid))
    writer.close()


def read_checkpoints(folder: Path) -> None:
    tables = load_checkpoint(folder, 3)
    assert all(isinstance(x, np.ndarray) for table in tables.values() for x in table.values())
    step, map_state, grid = read_checkpoint(folder)
    assert step == 3
    for leaf in jax.tree.leaves((map_state, grid)):
        assert not np.isnan(leaf).any()


def training_settings() -> dict[str, Any]:
    views = two_views(np.zeros((2, 4, 6, 3), np.uint8), np.ones((2, 4, 6), np.float32))
    return training.settings_record(TrainConfig(), views, 1.5)


def training_checkpoints(folder: Path) -> None:
    training.begin_checkpoints(folder, training_settings())
    training.save_checkpoint(folder, start_state(random_scene(6, 4)))


def read_training_checkpoints(folder: Path) -> None:
    like = start_state(random_scene(6, 4))
    restored = training.read_checkpoint(folder, training_settings(), like)
    for leaf, wanted in zip(jax.tree.leaves(restored), jax.tree.leaves(like), strict=True):
        assert (leaf.shape, leaf.dtype) == (wanted.shape, wanted.dtype)
        assert np.isfinite(leaf).all()


def splats() -> list[Files]:
    """Binary, with and without harmonics, and text with an element before the Gaussians."""
    one, four = (
        unsealed(written(lambda at, n=n: write_scene(at / "scene.ply", random_scene(5, n))))
        for n in (1, 4)
    )
    head, _, body = one["scene.ply"].partition(b"end_header\n")
    head = head.replace(b"binary_little_endian", b"ascii").replace(
        b"element vertex", b"element camera 1\nproperty float fov\nelement vertex"
    )
    table = np.frombuffer(body, "<f4").reshape(5, -1)
    rows = "\n".join(" ".join(f"{x:.6g}" for x in row) for row in table)
    return [one, four, {"scene.ply": head + b"end_header\n60\n" + rows.encode() + b"\n"}]


def read_splats(folder: Path) -> None:
    scene = read_scene(folder / "scene.ply")
    for leaf in jax.tree.leaves(scene):
        assert np.isfinite(leaf).all()
    assert np.asarray(scene.is_alive).any()


# Benchmarks


def records() -> list[Files]:
    files = {}
    for policy, snapshot in (("r3", 30), ("r3", 60), ("random", 60)):
        plain = record(policy, snapshot=snapshot)
        path = f"cells/flat-{policy}-seed0/snapshot-views-{snapshot}.json"
        files[path] = json.dumps(plain, separators=(",", ":")).encode() + b"\n"
    return [files]


def read_all_records(folder: Path) -> None:
    found = read_records(folder)
    if found:  # what is accepted can be shown: nothing breaks later
        print_results(Console(file=io.StringIO(), width=200), found)


def reference_images(folder: Path) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.0, 4.0, (2, 4, 6)).astype(np.float32)
    depth[0, 0, 0] = np.inf
    views = two_views(rng.integers(0, 256, (2, 4, 6, 3), dtype=np.uint8), depth)
    poses = np.asarray(views.T_world_camera)
    save_reference_images(folder / "views.npz", ReferenceImages("ab" * 32, poses, views))


def read_references(folder: Path) -> None:
    reference = read_reference_images(folder / "views.npz")
    views = reference.views
    assert isinstance(reference.hash, str)
    assert len(views) == len(reference.poses) > 0
    assert views.depth.shape == (len(views), views.height, views.width)
    assert (np.asarray(views.depth) >= 0.0).all()
    for pose in [*reference.poses, *np.asarray(views.T_world_camera)]:
        assert rigid_error(pose) is None
    for x in (views.cameras.fx, views.cameras.fy, views.cameras.cx, views.cameras.cy):
        assert np.isfinite(x).all()


def view_set(folder: Path) -> None:
    positions = np.array([[0.5, 0.25, 1.0], [1.5, 0.25, 1.0], [1.5, 1.25, 1.0001]])
    toy = ViewSet("toy", "ab" * 32, (1.0, 1.0, 0.75), 0.3, 12, positions, ("+x", "-y", "-z"))
    view_sets._write(folder / "set.json", toy)


def damage_view_set(rng: Rng, files: Files) -> tuple[Files, str]:
    """Most damage is found by the hash, so that of some damaged sets is made right again."""
    changed, what = mutate(rng, files)
    data = changed.get("set.json")
    if rng.random() < 0.5 and isinstance(data, bytes):
        with (
            contextlib.suppress(ValueError, KeyError, TypeError, OverflowError, AttributeError),
            contextlib.suppress(RecursionError),
            np.errstate(all="ignore"),
        ):
            plain = json.loads(data)
            plain["hash"] = view_sets._from_record(plain).hash
            changed["set.json"] = json.dumps(plain).encode()
    return changed, what


def read_a_view_set(folder: Path) -> None:
    found = read_view_set(folder / "set.json")
    assert len(found) == len(found.positions) > 0
    assert np.isfinite([*found.spacing, found.margin]).all()
    assert found.max_views is None or found.max_views > 0
    for pose in found.poses:
        assert rigid_error(pose) is None


def submissions() -> list[Files]:
    robot = {"heights": [-0.1, 0.4], "speed": 0.5, "turn_rate": 45.0}
    given = make_submission(3, motion=robot, exploration={"clock": "model", "voxel_size": 0.1})
    return [{"theirs.jsonl": submission_text(s).encode()} for s in (make_submission(2), given)]


def read_a_submission(folder: Path) -> None:
    submission = read_submission(folder / "theirs.jsonl")
    # What is accepted can be written again, and its terms are told or refused in words.
    again = parse_submission(submission_text(submission).encode())
    assert content_hash(again) == content_hash(submission)
    assert len(submission.paths()) == len(submission.frames)
    with contextlib.suppress(ValueError):
        conditions_of(submission, Conditions(train_resolution=16))


def read_a_calibration(folder: Path) -> None:
    calibration = read_calibration(folder / "calibration.json")
    mixture = calibration.model.mixture(np.array([0.0, 1.0]), np.array([0.0, 0.5]))
    assert mixture.shape == (2, len(calibration.model.residuals))
    for name in STATISTICS:
        assert calibration.half_width(name, 0.8) == calibration.half_width(name, 0.8)


# Other JSON


def camera_paths() -> list[Files]:
    matrix = np.eye(4)
    matrix[:3, 3] = 1.0, 2.0, 3.0
    camera = {"camera_to_world": matrix.ravel().tolist(), "fov": 60.0, "aspect": 1.5}
    content = {
        "camera_type": "perspective", "render_width": 96, "render_height": 64, "fps": 24,
        "seconds": 4.0, "camera_path": [camera, camera], "keyframes": [],
    }  # fmt: skip
    return [{"path.json": json.dumps(content).encode()}]


def read_a_camera_path(folder: Path) -> None:
    is_camera_path(folder / "path.json")  # never raises
    path = read_camera_path(folder / "path.json")
    assert len(path.poses) == len(path.lenses) > 0
    for pose, lens in zip(path.poses, path.lenses, strict=True):
        assert rigid_error(pose) is None
        assert np.isfinite(lens.params).all()
        assert lens.is_pinhole


def stage_configs() -> list[Files]:
    axes = {"up": [0, 0, 1], "front": [0.0, 1.0, 0.0]}
    more = {"scale": [1, 1, 1], "origin": [0, 0, 0], "units_to_meters": 1.0, "margin": 0.03}
    config = {"render_asset": "mesh.ply", **axes, **more}
    return [{"a.stage_config.json": json.dumps(config).encode(), "mesh.ply": b"ply\n"}]


def read_a_stage(folder: Path) -> None:
    stage = read_stage(folder / "a.stage_config.json")
    assert stage.mesh.is_file()
    turn = stage.habitat_from_file
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)


CALIBRATION = resources("r3jax.apps.forecast") / "calibration.json"
MISSING_OR_BROKEN = (InputError, FileNotFoundError)
OF_A_MODEL = (FormatError, SceneFileError, RunError)

READERS = CAPTURES | {
    "run": Reader(runs, read_a_run, (RunError,)),
    "model": Reader(models, read_a_model, OF_A_MODEL, make=damage_model),
    "run checkpoint": Reader(
        lambda: [unsealed(written(checkpoints))], read_checkpoints, (RunError,), cases=50
    ),
    "training checkpoint": Reader(
        lambda: [unsealed(written(training_checkpoints))],
        read_training_checkpoints,
        (CheckpointError,),
        cases=50,
    ),
    "splats": Reader(splats, read_splats, (SceneFileError,)),
    "records": Reader(records, read_all_records, MISSING_OR_BROKEN),
    "reference images": Reader(
        lambda: [written(reference_images)], read_references, MISSING_OR_BROKEN
    ),
    "view set": Reader(
        lambda: [written(view_set)], read_a_view_set, MISSING_OR_BROKEN, make=damage_view_set
    ),
    "submission": Reader(submissions, read_a_submission, (FormatError,)),
    "calibration": Reader(
        lambda: [{"calibration.json": CALIBRATION.read_bytes()}],
        read_a_calibration,
        MISSING_OR_BROKEN,
    ),
    "camera path": Reader(camera_paths, read_a_camera_path, (FormatError,), cases=100),
    "stage config": Reader(stage_configs, read_a_stage, (InputError,)),
    "mesh": Reader(meshes.seeds, meshes.read, (InputError,)),
}
"""The readers that are damaged by chance."""

CRAFTED = {
    "transforms": Reader(hostile_transforms, posed(read_transforms), (FormatError,)),
    "colmap": Reader(hostile_models, posed(read_colmap), (FormatError,)),
    "mesh": Reader(meshes.crafted, meshes.read, (InputError,)),
}
"""Cases that chance does not find."""
