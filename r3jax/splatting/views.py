"""The images that training and evaluation compare with, stacked and at the wanted resolution.

Shape symbols: v views; H, W size of every image; h, w size of a smaller image.
"""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from r3jax.errors import InputError
from r3jax.frame import Frame, a_frame
from r3jax.geometry.cameras import Camera
from r3jax.splatting.errors import ViewsError


class PosedImage(eqx.Module):
    """One view, as the loss wants it."""

    rgb: Float[Array, "H W 3"]
    """Color in [0, 1]."""

    depth: Float[Array, "H W"]
    """z-depth [m]. 0: no measurement. inf: nothing within the sensor's range."""

    T_world_camera: Float[Array, "4 4"]
    """Camera-to-world pose, OpenCV axes [m]."""

    camera: Camera
    """Intrinsics."""


class Views(eqx.Module):
    """Posed images of one size.

    Colors are kept in 8 bits, as recordings and the usual data sets keep them: 300 views of
    512 x 512 take 236 MB instead of 944 MB. Recorded images lose nothing; an averaged one is off
    by at most half a step (59 dB and more, which no model comes near).
    """

    rgb: UInt8[Array, "v H W 3"]
    """Color in steps of 1/255."""

    depth: Float[Array, "v H W"]
    """z-depth [m]. 0: no measurement. inf: nothing within the sensor's range."""

    T_world_camera: Float[Array, "v 4 4"]
    """Camera-to-world poses, OpenCV axes [m]."""

    cameras: Camera
    """Intrinsics; its four numbers have an axis of length v in front (focal lengths of real
    captures may vary)."""

    def __len__(self) -> int:
        return self.rgb.shape[0]

    @property
    def height(self) -> int:
        """Rows of every image [px]."""
        return self.rgb.shape[1]

    @property
    def width(self) -> int:
        """Columns of every image [px]."""
        return self.rgb.shape[2]

    def view(self, index: int | Int[Array, ""]) -> PosedImage:
        """Returns one view; the index may be traced."""
        return PosedImage(
            rgb=self.rgb[index].astype(jnp.float32) / 255.0,
            depth=self.depth[index],
            T_world_camera=self.T_world_camera[index],
            camera=jax.tree.map(lambda x: x[index], self.cameras),
        )

    def take(self, indices: np.ndarray) -> "Views":
        """Selects some of the views, in the order of the indices."""
        return jax.tree.map(lambda x: x[jnp.asarray(indices)], self)


def load_views(frames: Iterable[Frame], resolution: int | None = None) -> Views:
    """Stacks frames, each made smaller as it comes.

    Colors are averaged over the area of each new pixel (box filter, exact also where the factor
    is no whole number). Depth is never averaged: a new pixel takes the median of what was
    measured in it, so it lies on one side of an edge and ignores holes.

    Args:
        frames: of one image size; intrinsics may differ.
        resolution: length of the longer side [px]; the shorter one follows, rounded. None, or
            more than the images have: as recorded, images are never enlarged.

    Returns:
        The views in the order of the frames.

    Raises:
        TypeError: one frame alone, or another type.
        ViewsError: no frames, or frames of different sizes.
        ValueError: a resolution below 1.
    """
    if isinstance(frames, Frame):
        raise TypeError("frames must be several, got one Frame: put it into a list")
    if resolution is not None and resolution < 1:
        raise InputError(f"resolution is the longer side in pixels, at least 1, got {resolution}")
    rgb: list[np.ndarray] = []
    depth: list[np.ndarray] = []
    poses: list[np.ndarray] = []
    cameras: list[Camera] = []
    size = (0, 0)
    for number, frame in enumerate(frames):
        a_frame(f"frames[{number}]", frame)
        found = (frame.camera.width, frame.camera.height)
        size = found if number == 0 else size
        if found != size:
            raise ViewsError(
                f"all images must have one size, but frame {number} is {found[0]}x{found[1]} and "
                f"frame 0 is {size[0]}x{size[1]}: crop or scale them first"
            )
        width, height = fitted_size(*size, resolution)
        rgb.append(_to_bytes(area_average(np.asarray(frame.rgb), height, width)))
        depth.append(median_depth(np.asarray(frame.depth), height, width))
        poses.append(np.asarray(frame.T_world_camera))
        cameras.append(frame.camera.resized(width, height))
    if not cameras:
        raise ViewsError("nothing to train on: the data set holds no frames")
    return Views(
        rgb=jnp.asarray(np.stack(rgb)),
        depth=jnp.asarray(np.stack(depth)),
        T_world_camera=jnp.asarray(np.stack(poses)),
        cameras=jax.tree.map(lambda *x: jnp.stack(x), *cameras),
    )


def fitted_size(width: int, height: int, resolution: int | None) -> tuple[int, int]:
    """Computes width and height [px] whose longer side has at most `resolution` pixels."""
    longer = max(width, height)
    if resolution is None or resolution >= longer:
        return width, height
    scale = resolution / longer
    return max(1, round(width * scale)), max(1, round(height * scale))


def split_views(count: int, every: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Splits the views into indices for training and for testing.

    Every 8th view is held out, beginning with the first.

    Args:
        count: number of views.
        every: hold out views 0, every, 2 every, ...; 0 holds out none.

    Returns:
        Training and test indices, ascending.

    Raises:
        ValueError: `every` is negative or 1 (nothing would be left to train on).
    """
    if every < 0 or every == 1:
        raise InputError(f"every must be 0 (hold out nothing) or at least 2, got {every}")
    index = np.arange(count)
    is_test = index % every == 0 if every else np.zeros(count, dtype=bool)
    return index[~is_test], index[is_test]


def check_views(views: Views) -> None:
    """Refuses what no 3D model can be trained on.

    Raises:
        ViewsError: no views, or a single one (which a painted surface in front of its camera
            explains as well as the true scene).
    """
    if len(views) < 2:
        found = "one view only" if len(views) else "nothing to train on"
        raise ViewsError(
            f"{found}: training needs at least 2 views, from different places; views that are "
            "held out for testing do not count"
        )


def area_average(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Averages over the area of each new pixel (box filter); pixels cut in part count in part.

    Args:
        image: [H, W, c].
        height: h <= H.
        width: w <= W.

    Returns:
        [h, w, c], the image itself if it has that size already.
    """
    if image.shape[:2] == (height, width):
        return image
    rows, columns = (_overlaps(n, m) for n, m in zip(image.shape[:2], (height, width), strict=True))
    # Two products of plain matrices: einsum is four times as slow.
    channels = np.ascontiguousarray(image.transpose(2, 0, 1), dtype=np.float32)  # [c, H, W]
    return (rows @ channels @ columns.T).transpose(1, 2, 0)


def _overlaps(long: int, short: int) -> np.ndarray:
    """Computes the share of each new pixel that each old one covers, [short, long].

    Rows sum to 1.
    """
    edges = np.arange(short + 1) * (long / short)
    old = np.arange(long)
    upper = np.minimum(edges[1:, None], old[None, :] + 1)
    lower = np.maximum(edges[:-1, None], old[None, :])
    return (np.maximum(upper - lower, 0.0) * (short / long)).astype(np.float32)


def median_depth(depth: np.ndarray, height: int, width: int) -> np.ndarray:
    """Computes the lower median of the measurements whose pixel centers lie in each new pixel.

    Args:
        depth: [H, W] [m]; 0 is no measurement, inf is a measurement (beyond range).
        height: h <= H.
        width: w <= W.

    Returns:
        [h, w] [m]; every value occurs in `depth`, 0 where nothing was measured.
    """
    if depth.shape == (height, width):
        return depth
    (rows, has_row), (columns, has_column) = (
        _members(n, m) for n, m in zip(depth.shape, (height, width), strict=True)
    )
    inside = depth[rows[:, None, :, None], columns[None, :, None, :]]  # [h, w, rows, columns]
    present = has_row[:, None, :, None] & has_column[None, :, None, :] & (inside > 0.0)
    values = np.where(present, inside, np.nan).reshape(height, width, -1)
    values.sort(axis=-1)  # NaN goes to the end, behind inf
    count = present.reshape(values.shape).sum(axis=-1)
    middle = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(values, middle[..., None], axis=-1)[..., 0]
    return np.where(count > 0, median, np.float32(0.0))


def _members(long: int, short: int) -> tuple[np.ndarray, np.ndarray]:
    """Finds the old pixels whose centers lie in each new one, [short, most], and the real ones."""
    owner = ((np.arange(long) * 2 + 1) * short) // (2 * long)  # exact: whole numbers
    first = np.searchsorted(owner, np.arange(short + 1))
    index = first[:-1, None] + np.arange(np.diff(first).max())[None, :]
    return np.minimum(index, long - 1), index < first[1:, None]


def _to_bytes(rgb: np.ndarray) -> np.ndarray:
    return np.rint(rgb.clip(0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
