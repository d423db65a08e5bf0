"""Views: averaged color keeps its energy, depth keeps its values, pixels keep their place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.formats.recordings import read_recording
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at, project
from r3jax.splatting import views
from r3jax.splatting.errors import ViewsError
from r3jax.splatting.views import (
    check_views,
    fitted_size,
    load_views,
    split_views,
)


@st.composite
def sizes(draw: st.DrawFn) -> tuple[tuple[int, int], tuple[int, int]]:
    """An image size and a smaller one, mostly by no whole number."""
    height, width = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    return (height, width), (draw(st.integers(1, height)), draw(st.integers(1, width)))


def depths(shape: tuple[int, int]) -> st.SearchStrategy[np.ndarray]:
    """Few distinct values, holes and what is beyond range among them."""
    values = st.sampled_from([0.0, 0.5, 1.0, 1.25, 3.0, 7.0, np.inf])
    return hnp.arrays(np.float32, shape, elements=values)


def average_slowly(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The box filter as an integral: subpixels of the least common multiple, float64."""
    tall, wide = np.lcm(image.shape[0], height), np.lcm(image.shape[1], width)
    fine = image.astype(np.float64).repeat(tall // image.shape[0], 0)
    fine = fine.repeat(wide // image.shape[1], 1)
    blocks = fine.reshape(height, tall // height, width, wide // width, -1)
    return blocks.mean(axis=(1, 3))


def test_average() -> None:
    average = views.area_average

    @given(sizes(), st.integers(0, 2**32 - 1))
    def check(shapes, seed):
        full, small = shapes
        image = np.random.default_rng(seed).random((*full, 3)).astype(np.float32)
        found = average(image, *small)
        assert found.shape == (*small, 3)
        np.testing.assert_allclose(found, average_slowly(image, *small), atol=2e-6)
        np.testing.assert_allclose(found.mean((0, 1)), image.mean((0, 1)), atol=2e-6)

    check()


def median_slowly(depth: np.ndarray, height: int, width: int) -> np.ndarray:
    """Pixel by pixel, by the definition."""
    median = np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            inside = [
                depth[i, j]
                for i in range(depth.shape[0])
                for j in range(depth.shape[1])
                # Whole numbers: row <= (i + 1/2) h/H < row + 1.
                if 2 * row * depth.shape[0] <= (2 * i + 1) * height < 2 * (row + 1) * depth.shape[0]
                and 2 * column * depth.shape[1] <= (2 * j + 1) * width
                and (2 * j + 1) * width < 2 * (column + 1) * depth.shape[1]
            ]
            valid = sorted(value for value in inside if value > 0.0)
            median[row, column] = valid[(len(valid) - 1) // 2] if valid else 0.0
    return median


def test_median() -> None:
    median = views.median_depth

    @given(st.data())
    def check(data):
        full, small = data.draw(sizes())
        depth = data.draw(depths(full))
        found = median(depth, *small)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, median_slowly(depth, *small))
        assert np.isin(found[found > 0.0], depth).all()

    check()


def frame_of(rgb: np.ndarray, depth: np.ndarray, camera: Camera | None = None) -> Frame:
    height, width = depth.shape
    camera = camera or Camera(width, height, 9.0, 8.0, 0.4 * width, 0.55 * height)
    pose = look_at(np.array([1.0, 2.0, 0.5]), np.zeros(3))
    return Frame(jnp.asarray(rgb), jnp.asarray(depth), pose, camera)


def frames(count: int, height: int = 10, width: int = 14) -> list[Frame]:
    rng = np.random.default_rng(0)
    return [
        frame_of(
            (rng.integers(0, 256, (height, width, 3)) / 255.0).astype(np.float32),
            rng.uniform(1.0, 2.0, (height, width)).astype(np.float32),
        )
        for _ in range(count)
    ]


def test_recorded_frames_are_kept_exactly():
    recorded = frames(3)
    for resolution in (None, 14, 1000):
        views = load_views(iter(recorded), resolution)
        assert (len(views), views.height, views.width) == (3, 10, 14)
        for i, frame in enumerate(recorded):
            view = views.view(i)
            np.testing.assert_array_equal(views.rgb[i], np.rint(np.asarray(frame.rgb) * 255.0))
            np.testing.assert_allclose(view.rgb, frame.rgb, atol=1e-7)
            np.testing.assert_array_equal(view.depth, frame.depth)
            np.testing.assert_array_equal(view.T_world_camera, frame.T_world_camera)
            assert jax.tree.all(jax.tree.map(lambda a, b: a == b, view.camera, frame.camera))


@pytest.mark.parametrize(
    ("size", "resolution", "expected"),
    [
        ((540, 360), 256, (256, 171)),
        ((360, 540), 256, (171, 256)),
        ((512, 512), 128, (128, 128)),
        ((512, 512), 512, (512, 512)),
        ((64, 48), 512, (64, 48)),
        ((64, 48), None, (64, 48)),
        ((1000, 3), 10, (10, 1)),
    ],
)
def test_the_longer_side_is_as_long_as_asked(size, resolution, expected):
    assert fitted_size(*size, resolution) == expected


def test_smaller_views_are_averages_to_half_a_step():
    recorded = frames(2)
    views = load_views(recorded, resolution=5)
    assert (views.height, views.width) == (4, 5)
    for i, frame in enumerate(recorded):
        exact = average_slowly(np.asarray(frame.rgb), 4, 5)
        assert np.abs(np.asarray(views.view(i).rgb) - exact).max() <= 0.5001 / 255.0


def test_a_point_lands_on_the_same_spot_of_the_smaller_picture():
    """A bright rectangle keeps its center of light, and the camera says where it is."""
    camera = Camera(120, 90, 100.0, 110.0, 50.0, 47.0)
    point = jnp.array([[0.21, -0.13, 1.7]])
    (u, v), _ = (np.asarray(x)[0] for x in project(camera, point))
    columns, rows = np.arange(120) + 0.5, np.arange(90) + 0.5
    spot = np.exp(-((columns[None] - u) ** 2 + (rows[:, None] - v) ** 2) / (2 * 6.0**2))
    image = np.repeat(spot[..., None], 3, axis=2).astype(np.float32)
    views = load_views([frame_of(image, np.ones((90, 120), np.float32), camera)] * 2, 50)
    view = views.view(1)
    light = np.asarray(view.rgb[..., 0], dtype=np.float64)
    found_u = (light.sum(0) * (np.arange(view.camera.width) + 0.5)).sum() / light.sum()
    found_v = (light.sum(1) * (np.arange(view.camera.height) + 0.5)).sum() / light.sum()
    expected = np.asarray(project(view.camera, point)[0])[0]
    assert view.camera.width == 50
    assert view.camera.height == 38  # 37.5: not the same factor as the width's
    np.testing.assert_allclose([found_u, found_v], expected, atol=0.02)


def test_intrinsics_may_differ_from_view_to_view():
    recorded = frames(2)
    other = Camera(14, 10, 11.0, 12.0, 7.5, 4.0)
    recorded[1] = frame_of(np.asarray(recorded[1].rgb), np.asarray(recorded[1].depth), other)
    views = load_views(recorded, 7)
    np.testing.assert_allclose(views.cameras.fx, [4.5, 5.5])
    np.testing.assert_allclose(views.view(1).camera.cy, 2.0)
    picked = jax.jit(lambda i: views.view(i).camera.fx)(jnp.asarray(1))
    np.testing.assert_allclose(picked, 5.5)


def test_taking_views_keeps_their_order():
    views = load_views(frames(5))
    taken = views.take(np.array([3, 1]))
    assert len(taken) == 2
    np.testing.assert_array_equal(taken.rgb, views.rgb[jnp.array([3, 1])])
    np.testing.assert_array_equal(taken.cameras.fx, views.cameras.fx[:2])


@given(st.integers(0, 40), st.sampled_from([0, 2, 3, 8]))
def test_held_out_views_are_every_eighth_and_no_view_is_lost(count, every):
    train, test = split_views(count, every)
    assert sorted([*train, *test]) == list(range(count))
    assert list(test) == (list(range(0, count, every)) if every else [])


@pytest.mark.parametrize("every", [1, -8])
def test_holding_out_everything_is_refused(every):
    with pytest.raises(ValueError, match=f"got {every}"):
        split_views(10, every)


def test_nothing_to_train_on():
    with pytest.raises(ViewsError):
        load_views([])


def test_images_of_different_sizes_are_named():
    recorded = [*frames(2), *frames(1, height=8, width=6)]
    with pytest.raises(ViewsError, match=r"frame 2 .*6x8.*14x10"):
        load_views(recorded)


def test_a_resolution_of_no_pixels_is_refused():
    with pytest.raises(ValueError, match="got 0"):
        load_views(frames(2), 0)


def test_one_view_is_not_enough():
    views = load_views(frames(2))
    check_views(views)
    with pytest.raises(ViewsError):
        check_views(views.take(np.array([1])))
    with pytest.raises(ViewsError):
        check_views(views.take(np.array([], dtype=int)))


def test_a_real_recording_keeps_its_share_of_holes(shared):
    recording = read_recording(shared("recordings", "hololens_lounge"))
    recorded = [recording.frame(i) for i in (0, 20)]
    full, small = load_views(recorded), load_views(recorded, 135)
    assert (small.width, small.height) == (135, 90)
    for i in range(2):
        depth = np.asarray(full.depth[i]).reshape(90, 4, 135, 4).swapaxes(1, 2).reshape(90, 135, 16)
        expected = (depth > 0.0).any(axis=-1)  # a measurement anywhere in the pixel is enough
        np.testing.assert_array_equal(np.asarray(small.depth[i]) > 0.0, expected)
        assert (np.asarray(small.depth[i])[..., None] == depth).any(axis=-1)[expected].all()
        np.testing.assert_allclose(small.rgb[i].mean(), full.rgb[i].mean(), atol=0.1)
