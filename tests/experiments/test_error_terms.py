"""Terms of a small real map against float64; a benchmark's cell taken apart and put together."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from experiments import error_terms
from experiments.error_terms import KAPPAS, PRODUCTS, column, columns_of, on_seen
from r3jax.apps.benchmark.record import read_records
from r3jax.apps.benchmark.run_cell import run_cell
from r3jax.evaluation.maps import map_of
from r3jax.geometry.cameras import pose_along
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.config import ScoringConfig
from r3jax.simulators.scenes.registry import open_scene
from r3jax.visibility.views import pinhole_view
from tests.apps.benchmark.tiny import CONDITIONS, make_cells
from tests.box_room import write_room

pytestmark = pytest.mark.full

CONFIG = ScoringConfig(max_range=5.0)
LOOKS = [
    ((-1.5, -1.0, 0.2), (1.0, 0.5, 0.0)),
    ((0.5, 0.8, -0.3), (-1.0, -0.4, 0.1)),
    ((0.0, 0.0, 0.0), (0.3, -1.0, 0.4)),
    ((0.6, -0.9, 0.3), (-0.2, 0.3, -1.0)),
]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("room") / "room.ply")


@pytest.fixture(scope="module")
def state(room):
    """A map of frames that leave some of the room unseen and see some of it from many sides."""
    simulator = open_scene(room, camera=CONDITIONS.camera, noise=0.01)
    rng = np.random.default_rng(0)
    frames = []
    for k in range(9):
        place = rng.uniform((-1.6, -1.1, -0.4), (0.6, 1.1, 0.4))
        toward = np.array([1.0, 0.2 * k - 0.8, rng.uniform(-0.4, 0.4)])
        pose = pose_along(jnp.asarray(place, jnp.float32), jnp.asarray(toward, jnp.float32))
        frames.append(simulator.render(np.asarray(pose, np.float64)))
    return map_of(frames, voxel_size=0.1)


@pytest.fixture(scope="module")
def poses():
    looks = [(jnp.asarray(p, jnp.float32), jnp.asarray(d, jnp.float32)) for p, d in LOOKS]
    return np.stack([np.asarray(pose_along(*look)) for look in looks])


@pytest.fixture(scope="module")
def columns(state, poses):
    return error_terms.prediction_columns(state, CONDITIONS.camera, poses, CONFIG)


def test_the_product_of_all_terms_is_renderability(state, poses, columns):
    for kappa in KAPPAS:
        config = ScoringConfig(max_range=5.0, kappa=kappa)
        expected = [
            float(r3jax.renderability(state, CONDITIONS.camera, jnp.asarray(T), config))
            for T in poses
        ]
        np.testing.assert_allclose(columns[column("R", kappa)], expected, atol=1e-6)
    assert np.ptp(columns["R"]) > 0.05


def test_means_over_seen_pixels_leave_the_others_out(columns):
    assert np.all((columns["coverage"] > 0.2) & (columns["coverage"] <= 1.0))
    assert columns["coverage"].min() < 0.95
    for name in ("cover", *(column(p, k) for p in PRODUCTS for k in KAPPAS)):
        again = columns[on_seen(name)] * columns["coverage"]
        np.testing.assert_allclose(again, columns[name], atol=1e-7)
        assert np.all(columns[on_seen(name)] <= 1.0 + 1e-6)


def test_a_view_of_nothing(state):
    away = np.asarray(pose_along(np.full(3, 80.0, np.float32), np.array([1.0, 0, 0], np.float32)))
    found = error_terms.prediction_columns(state, CONDITIONS.camera, away[None], CONFIG)
    for name, values in found.items():
        assert np.isnan(values[0]) if name.endswith("seen") else values[0] == 0.0


def test_terms_against_float64(state, poses, columns):
    """The paper's forms, voxel by voxel; only which voxel a pixel shows is taken from the map."""
    expected = [_oracle(state, T) for T in poses]
    for name in expected[0]:
        by_hand = [found[name] for found in expected]
        np.testing.assert_allclose(columns[name], by_hand, atol=1e-4, err_msg=name)
    for product in PRODUCTS:
        gap = np.abs(columns[product] - columns[column(product, "one")])
        assert gap.max() > 1e-4, f"kappa makes no difference to {product}"


@jax.jit
def _shown(state, T):
    """The map's row that each pixel shows, and the rows' centers."""
    voxels = state
    view = pinhole_view(CONDITIONS.camera, T, CONFIG)
    return rows_in_pixels(voxels, view, CONFIG), voxels.center


def _oracle(state, T):
    items, center = (np.asarray(x) for x in _shown(state, jnp.asarray(T)))
    items, center = items.ravel(), center.astype(np.float64).T
    shown, times = np.unique(items[items < state.capacity], return_counts=True)
    lattice = fibonacci_lattice(64).astype(np.float64)
    visited, count, deviation, best = (
        np.asarray(x) for x in (state.visited, state.count, state.m2, state.resolution)
    )
    rows = {name: [] for name in ("cover", *(column(p, k) for p in PRODUCTS for k in KAPPAS))}
    for row in shown:
        offset = T[:3, 3].astype(np.float64) - center[row]
        distance = np.linalg.norm(offset)
        r = offset / distance
        words = [int(word) for word in visited[:, row]]
        q = lattice[[words[k // 32] >> (k % 32) & 1 == 1 for k in range(64)]]
        dots = q @ r
        rows["cover"].append((1.0 + dots.max()) / 2.0)
        e1 = np.cross([0.0, 0.0, 1.0], r) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], r))
        plane = q[dots > 0.0] @ np.stack([e1, np.cross(r, e1)], axis=1)
        inside = len(plane) and np.all((plane.min(axis=0) <= 0.0) & (plane.max(axis=0) >= 0.0))
        n, m2 = float(count[row]), float(deviation[row])
        delta = 1.0 if n <= 1 else np.clip(1 - np.sqrt(2 / 1.5) * np.sqrt(m2 / (n - 1)), 0, 1)
        ratio = min(1.0, float(best[row]) * distance / float(CONDITIONS.camera.focal))
        for kappa in KAPPAS:
            power = 1.0 if inside or kappa == "one" else 2.0
            b = float(np.clip(dots.max(), 0.0, 1.0)) ** power
            terms = {"bias": b, "noise": delta ** (power * (1 - b))}
            terms["resolution"] = ratio ** (1.0 - delta * b)
            for product, names in PRODUCTS.items():
                rows[column(product, kappa)].append(np.prod([terms[name] for name in names]))
    return {name: np.array(values) @ times / len(items) for name, values in rows.items()}


@pytest.fixture(scope="module")
def cell(room, tmp_path_factory):
    """A benchmark with one cell that is done."""
    root = tmp_path_factory.mktemp("benchmark")
    run_cell(make_cells(room, root)[0], root)
    return root, read_records(root)


def test_what_the_benchmark_recorded_comes_out_again(cell):
    root, records = cell
    for record in records:
        found = columns_of(root, record)
        np.testing.assert_allclose(found["R"], record["views"]["renderability"], atol=1e-6)
        np.testing.assert_allclose(found["psnr_again"], record["views"]["psnr"], atol=1e-3)
        assert np.all((found["seen_share"] >= 0.0) & (found["seen_share"] <= 1.0))
        is_few = found["seen_share"] < error_terms.SMALLEST_SHARE
        np.testing.assert_array_equal(np.isnan(found["psnr_seen"]), is_few)
        # Where nearly all was seen the two errors are nearly one.
        whole = found["seen_share"] == 1.0
        np.testing.assert_allclose(found["psnr_seen"][whole], found["psnr_again"][whole], atol=1e-3)
    shares = [columns_of(root, record)["seen_share"].mean() for record in records]
    assert shares[0] <= shares[1]  # a third frame takes nothing back


def test_what_is_kept_is_read_and_another_record_is_not(cell, tmp_path, monkeypatch):
    root, records = cell
    first = columns_of(root, records[0])
    shutil.copytree(root, tmp_path / "copy")

    def must_not(*args):
        raise LookupError("computed again")

    monkeypatch.setattr(error_terms, "_compute", must_not)
    again = columns_of(tmp_path / "copy", records[0])
    for name, values in first.items():
        np.testing.assert_array_equal(again[name], values)
    changed = json.loads(json.dumps(records[0]))
    changed["views"]["psnr"][0] += 1.0
    with pytest.raises(LookupError):
        columns_of(tmp_path / "copy", changed)
    monkeypatch.setattr(error_terms, "VERSION", -1)
    with pytest.raises(LookupError):
        columns_of(tmp_path / "copy", records[0])
