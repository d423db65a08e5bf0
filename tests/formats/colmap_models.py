"""Random COLMAP models for the laws of its formats."""

import numpy as np
from hypothesis import strategies as st

from r3jax.formats.colmap.model import ColmapImage, ColmapModel, ColmapPoints
from r3jax.formats.lenses import MODELS, PANORAMA, Lens

NAMES = ("a.png", "sub folder/b c  d.jpg", "ünï.png", "#7.png", "8")
"""With blanks, not ASCII, like a comment, like a number."""


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniform; every fourth one turns by exactly 180 degrees, where formulas divide by zero."""
    quaternion = rng.normal(size=4)
    if rng.integers(4) == 0:
        quaternion = np.eye(4)[rng.integers(1, 4)]
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K  # Rodrigues


def random_pose(seed: int) -> np.ndarray:
    """`T_world_camera` within 100 of the origin."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = random_rotation(rng)
    pose[:3, 3] = rng.uniform(-100.0, 100.0, 3)
    return pose


def random_lens(rng: np.random.Generator) -> Lens:
    """Any model, with distortion."""
    names = [name for name, (number, _) in MODELS.items() if number >= 0]  # of COLMAP
    model = names[rng.integers(len(names))]
    if model == PANORAMA:
        height = int(rng.integers(1, 5000))
        return Lens(model, 2 * height, height, (2.0 * height, float(height)))
    params = rng.normal(0.0, 0.1, len(MODELS[model][1]))
    focals = 1 if MODELS[model][1][0] == "f" else 2
    params[:focals] = rng.uniform(10.0, 5000.0, focals)
    params[focals : focals + 2] = rng.uniform(0.0, 4000.0, 2)
    width, height = (int(x) for x in rng.integers(1, 9000, 2))
    return Lens(model, width, height, tuple(params.tolist()))


def random_model(seed: int) -> ColmapModel:
    """Ids with gaps in no order, keypoints with and without points, tracks of any length."""
    rng = np.random.default_rng(seed)
    camera_ids = [int(i) for i in rng.choice(1000, rng.integers(1, 4), replace=False)]
    point_ids = rng.choice(1 << 40, rng.integers(0, 6), replace=False)
    image_ids = [int(i) for i in rng.choice(1 << 31, rng.integers(1, 6), replace=False)]
    images: list[ColmapImage] = []
    for number, name in zip(image_ids, NAMES, strict=False):
        quaternion = rng.normal(size=4)
        k = int(rng.integers(0, 5))
        images.append(
            ColmapImage(
                id=number,
                name=name,
                camera_id=camera_ids[rng.integers(len(camera_ids))],
                quaternion=quaternion / np.linalg.norm(quaternion),
                translation=rng.normal(size=3) * 10.0 ** rng.integers(-6, 6),
                keypoints=rng.uniform(0, 4000, (k, 2)),
                point_ids=rng.choice(np.append(point_ids, -1), k),
            )
        )
    m = len(point_ids)
    lengths = rng.integers(0, 4, m)
    points = ColmapPoints(
        ids=point_ids,
        xyz=rng.normal(size=(m, 3)) * 10.0 ** rng.integers(-6, 6),
        rgb=rng.integers(0, 256, (m, 3), dtype=np.uint8),
        error=rng.uniform(-1.0, 3.0, m),
        track_lengths=lengths,
        track_images=rng.choice(np.array(image_ids), lengths.sum()),
        track_keypoints=rng.integers(0, 9, lengths.sum()),
    )
    return ColmapModel({i: random_lens(rng) for i in camera_ids}, tuple(images), points)


seeds = st.integers(0, 1 << 32)
"""Of random models and poses."""


def assert_equal(a: ColmapModel, b: ColmapModel) -> None:
    """Every number, bit for bit."""
    assert dict(a.cameras) == dict(b.cameras)
    assert len(a.images) == len(b.images)
    for one, other in zip((*a.images, a.points), (*b.images, b.points), strict=True):
        for field in vars(one):
            np.testing.assert_array_equal(getattr(one, field), getattr(other, field), field)
