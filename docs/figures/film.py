"""The moving picture of the front page: a map turns green, then becomes splats.

    r3jax explore --scene flat --policy r3-pano --budget views:48 --resolution 256 --name film
    r3jax train runs/film --resolution 192 --gaussians 60000 --iterations 1200 --hold-out 0
    python -m docs.figures.film runs/film docs/images/film.webp

Shape symbols: H W picture size.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import tyro
from PIL import Image

import r3jax
from docs.figures.stills import Sheet, Squares, compose, draw, lines, overview
from r3jax.apps.viewer.drawing import block_colors, frustum_segments, known_at, path_segments
from r3jax.apps.viewer.story import Timeline, cut_height, scoring_of
from r3jax.runs.reader import Run, read_run

WIDTH, HEIGHT = 960, 600
"""Size of the picture [px]."""

RATE = 8
"""Pictures a second."""

_ELEVATION, _FOV = 55.0, 32.0
"""Of the camera that looks on [deg]."""

_INK, _NOW = np.array((31, 41, 55), np.uint8), np.array((220, 38, 38), np.uint8)


def main(
    run: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    orbit: float = 4.0,
    quality: int = 52,
) -> None:
    """Writes an animated WebP.

    Args:
        run: a run with a trained model.
        out: the file.
        orbit: how long the splats are shown [s].
        quality: of the pictures, 0 to 100.
    """
    record = read_run(run)
    model = r3jax.read_scene(run / "models" / "last" / "scene.ply")
    pictures = [Image.fromarray(p) for p in pictures_of(record, model, round(orbit * RATE))]
    pictures[0].save(
        out, save_all=True, append_images=pictures[1:], duration=1000 // RATE, loop=0,
        quality=quality, method=4,
    )  # fmt: skip


def pictures_of(run: Run, model: r3jax.GaussianScene, num_orbit: int) -> Iterator[np.ndarray]:
    """Yields all pictures, [H, W, 3] uint8.

    One for each view of the run, then the orbit of the splats.
    """
    timeline, config = Timeline(run), scoring_of(run.header)
    last = known_at(timeline.at(len(run.rows) - 1), run.camera, config, 400_000)
    cut = cut_height(run.rows, last.blocks.centers)
    extent = last.blocks.centers[last.blocks.centers[:, 2] < cut]
    total = len(run.rows) + num_orbit
    camera_at = lambda i: overview(
        extent, 2 * Sheet.scene_width(1280), 2 * 800, -110.0 + 50.0 * i / total, _ELEVATION, _FOV
    )
    for step in range(len(run.rows)):
        known = known_at(timeline.at(step), run.camera, config, 400_000)
        blocks = known.blocks
        colors = block_colors(blocks, known.moment.map_state, known.terms, "renderability")
        low = blocks.centers[:, 2] < cut
        layers = [Squares(blocks.centers[low], colors[low], blocks.edge), *_path(run, step)]
        yield _page(draw(*camera_at(step), layers), run, step)
    scene = _below(model, cut)
    for i in range(num_orbit):
        picture = _splats(scene, *camera_at(len(run.rows) + i))
        yield _page(picture, run, len(run.rows) - 1, "Splats of these views")


def _path(run: Run, step: int) -> list[Squares]:
    """Returns the path so far, and the newest view as a red frustum."""
    rows = run.rows[: step + 1]
    segments, colors = path_segments(rows, len(run.rows))
    frusta = [frustum_segments(run.camera, row.pose, 0.14) for row in rows]
    newest = frustum_segments(run.camera, rows[-1].pose, 0.45)
    return [
        lines(segments, colors[:, 0], 0.02, 6.0),
        lines(np.concatenate(frusta), _INK, 0.006, 2.4),
        lines(newest, _NOW, 0.02, 4.8, lift=0.3),
    ]


def _below(model: r3jax.GaussianScene, height: float) -> r3jax.GaussianScene:
    """Returns the model without its ceiling: Gaussians above a height become transparent."""
    is_above = model.means[:, 2] > height
    faint = jnp.where(is_above.reshape(model.opacity_logits.shape), -30.0, model.opacity_logits)
    return eqx.tree_at(lambda scene: scene.opacity_logits, model, faint)


def _splats(scene: r3jax.GaussianScene, camera: r3jax.Camera, pose: np.ndarray) -> np.ndarray:
    white = jnp.ones(3)
    rendering = r3jax.render(scene, camera, jnp.asarray(pose, jnp.float32), white)
    return np.rint(255.0 * np.asarray(rendering.rgb).clip(0.0, 1.0)).astype(np.uint8)


def _page(scene: np.ndarray, run: Run, step: int, subtitle: str | None = None) -> np.ndarray:
    """Returns the picture with its sheet, at its final size."""
    image, _ = run.images(step)
    sheet = Sheet.of_run(run, step, image, "renderability")
    if subtitle:
        sheet = replace(sheet, subtitle=subtitle, has_scale=False)
    height, width = scene.shape[0] // 2, scene.shape[1] // 2
    small = Image.fromarray(scene).resize((width, height), Image.Resampling.BOX)
    page = Image.fromarray(compose(np.asarray(small), sheet))
    return np.asarray(page.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS))


if __name__ == "__main__":
    tyro.cli(main)
