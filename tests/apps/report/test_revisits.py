"""A real recording: what was seen before renders well before it is mapped again."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from r3jax.apps.report.figures import follow_recording, revisit_figure
from r3jax.formats.recordings import read_recording
from r3jax.plots.style import to_png

VOXEL, RANGE = 0.05, 5.0


@pytest.fixture(scope="module")
def lounge(shared):
    """The recording, what was reported, and the last map."""
    recording = read_recording(shared("recordings", "hololens_lounge"), up="y")
    steps = list(follow_recording(recording, voxel_size=VOXEL, max_range=RANGE))
    return recording, [report for report, _ in steps], steps[-1][1]


def share_seen_before(recording) -> np.ndarray:
    """Per frame, the share of its measured pixels whose voxel an earlier frame has touched."""
    seen = np.zeros(0, dtype=np.int64)
    shares = []
    camera = recording.lenses[0].camera
    u = (np.arange(camera.width) + 0.5 - float(camera.cx)) / float(camera.fx)
    v = (np.arange(camera.height) + 0.5 - float(camera.cy)) / float(camera.fy)
    rays = np.stack([*np.meshgrid(u, v), np.ones((camera.height, camera.width))], axis=-1)
    for index in range(len(recording)):
        depth = np.asarray(recording.frame(index).depth)
        pose = recording.poses[index]
        points = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        measured = points[(depth > 0) & (depth <= RANGE)]
        x, y, z = (np.floor(measured / VOXEL).astype(np.int64) + 4096).T
        voxels = (x * 8192 + y) * 8192 + z
        shares.append(np.isin(voxels, seen).mean())
        seen = np.union1d(seen, voxels)
    return np.asarray(shares)


def test_renderability_rises_where_the_path_returns_to_seen_places(lounge):
    recording, reports, _ = lounge
    before = np.array([report.renderability for report in reports])
    assert before[0] == 0.0
    assert np.all((before >= 0.0) & (before <= 1.0))
    shares = share_seen_before(recording)
    rank = spearmanr(before, shares).statistic
    # Against chance: no reordering of the frames comes close.
    rng = np.random.default_rng(0)
    shuffled = [spearmanr(before, rng.permutation(shares)).statistic for _ in range(200)]
    print(f"Spearman {rank:.2f}, best of 200 permutations {max(shuffled):.2f}")
    assert rank > max(shuffled) + 0.1
    familiar, strange = shares > np.quantile(shares, 0.75), shares < np.quantile(shares, 0.25)
    assert before[familiar].mean() > before[strange].mean() + 0.15


def test_voxels_add_up(lounge):
    recording, reports, state = lounge
    assert len(reports) == len(recording) == 48
    assert sum(report.new_voxels for report in reports) == reports[-1].voxels
    assert reports[-1].voxels == int(state.num_occupied)
    assert int(state.dropped) == 0
    length = np.linalg.norm(np.diff(recording.poses[:, :3, 3], axis=0), axis=1).sum()
    assert reports[-1].metres == pytest.approx(length)


def test_the_figure_is_a_picture(lounge):
    recording, reports, _ = lounge
    assert to_png(revisit_figure(recording, reports)).startswith(b"\x89PNG")
