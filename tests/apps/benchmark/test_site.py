"""The page of a benchmark: every record in a table, pictures from models and test views."""

import csv
import io
import json
import re

import numpy as np
import pytest
from PIL import Image

from r3jax.apps.benchmark.figures import response_figures
from r3jax.apps.benchmark.record import read_records
from r3jax.apps.benchmark.reference_images import load_reference_images
from r3jax.apps.benchmark.site import write_site
from r3jax.apps.benchmark.tables import PAPER_METRICS, metric_named
from r3jax.cli.main import main
from r3jax.evaluation.comparison import mean_over_scenes, scores_by_method
from tests.evaluation.records import benchmark, record


def written(folder, records):
    """A benchmark's folder that holds records and nothing else."""
    for number, plain in enumerate(records):
        path = (
            folder / "cells" / f"{number}" / f"snapshot-{plain['snapshot'].replace(':', '-')}.json"
        )
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(plain | {"run": f"cells/{number}/run"}))
    return folder


def test_a_page_has_every_snapshot_and_the_worst_views(finished, tmp_path):
    root, cells = finished
    page = write_site(root, tmp_path / "site")
    text = page.read_text()
    assert re.findall(r"<h2>(.*?)</h2>", text)[:2] == ["views:2", "views:3"]
    records = [r for r in read_records(root) if r["snapshot"] == "views:3"]
    found = mean_over_scenes(
        scores_by_method(records, "psnr")["random (num_candidates=10, num_frontier=3)"]
    )
    assert f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]" in text
    pictures = re.findall(r'src="(pictures/.*?)"', text)
    views = [picture for picture in pictures if "curve" not in picture]
    assert len(views) == 2  # one a method and scene for each snapshot
    assert len(pictures) == 3  # and the curve over the two snapshots
    worst = int(np.argmin(records[0]["views"]["psnr"]))
    assert f"seed 0: view {worst}, {min(records[0]['views']['psnr']):.1f} dB" in text
    image = np.asarray(Image.open(page.parent / views[-1]))
    assert image.shape == (48, 96, 3)
    views = load_reference_images(root, cells[0]).views
    np.testing.assert_array_equal(image[:, :48], views.rgb[worst])
    # The model's half has the PSNR that the record says.
    error = (image[:, :48].astype(float) - image[:, 48:]) / 255.0
    psnr = -10.0 * np.log10(np.mean(error**2))
    assert psnr == pytest.approx(records[0]["views"]["psnr"][worst], abs=0.05)
    assert write_site(root, tmp_path / "site") == page  # again: the page is replaced


def test_records_that_lie_alone_make_a_page_without_pictures(tmp_path):
    records = benchmark(("r3-pano", "active-gs"), views=6)
    odd = record("random", views=6) | {"policy": "<script>alert(1)</script>"}
    page = write_site(written(tmp_path / "out", [*records, odd]), tmp_path / "site")
    text = page.read_text()
    assert "<script>" not in text
    assert "&lt;script&gt;" in text
    assert "<img" not in text
    for metric in map(metric_named, PAPER_METRICS):
        found = mean_over_scenes(scores_by_method(records, metric.name)["r3-pano"])
        assert metric.title in text
        low, high = (f"{end:.{metric.decimals}f}" for end in (found.low, found.high))
        assert f"{found.value:.{metric.decimals}f} [{low}, {high}]" in text


def test_tables_of_other_terms_are_told_apart(tmp_path):
    records = [
        record(views=6), record(views=6, clock="wall"), record(views=6) | {"budget": "views:30"},
    ]  # fmt: skip
    text = write_site(written(tmp_path / "out", records), tmp_path / "site").read_text()
    heads = re.findall(r"<h2>(.*?)</h2>", text)
    assert heads[:3] == [
        "views:30, the clock: model",
        "views:30, the clock: wall",
        "views:30, the clock: model, table 2 on the same terms: it has a record of the same name",
    ]


def test_a_page_is_not_written_over_something_else(tmp_path, capsys):
    out = written(tmp_path / "out", [record(views=6)])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    words = ["benchmark", "--site", str(tmp_path / "mine"), "--out", str(out)]
    assert main(words) == 2
    assert "mine" in capsys.readouterr().err
    empty = ["benchmark", "--site", str(tmp_path / "site"), "--out", str(tmp_path / "none")]
    assert main(empty) == 2
    assert "none" in capsys.readouterr().err
    for _ in range(2):  # a page of ours is replaced
        assert main(["benchmark", "--site", str(tmp_path / "site"), "--out", str(out)]) == 0
    assert (tmp_path / "site" / "index.html").exists()


def test_tables_and_records_can_be_taken_from_the_page(tmp_path):
    records = benchmark(("r3-pano", "active-gs"), views=6)
    folder = write_site(written(tmp_path / "out", records), tmp_path / "site").parent
    text = (folder / "index.html").read_text()
    files = re.findall(r'href="([^"]*)" download', text)
    assert len(files) == 2
    assert all((folder / file).is_file() for file in files)
    key = lambda one: (one["scene"], one["policy"], one["seed"])
    again = sorted(read_records(folder / "cells.jsonl"), key=key)
    assert [r["views"] for r in again] == [r["views"] for r in sorted(records, key=key)]
    lines = list(csv.DictReader(io.StringIO((folder / "table.csv").read_text())))
    assert {(line["scene"], line["method"]) for line in lines} == {
        (scene, method) for scene in ("flat", "house", "all") for method in ("r3-pano", "active-gs")
    }
    chosen = {line["method"]: line for line in lines if line["scene"] == "all"}
    found = mean_over_scenes(scores_by_method(records, "psnr")["active-gs"])
    assert float(chosen["active-gs"]["PSNR [dB]"]) == pytest.approx(found.value)
    assert float(chosen["active-gs"]["PSNR [dB] low"]) == found.low
    assert chosen["r3-pano"]["minus reference"] == ""  # it is the reference


def test_swept_settings_have_a_picture_of_the_response(tmp_path):
    records = [
        record("r3-pano", scene, seed, views=6, settings={"lambda2": value})
        for scene in ("flat", "house") for seed in (0, 1) for value in (0.2, 0.5, 0.8)
    ]  # fmt: skip
    folder = write_site(written(tmp_path / "out", records), tmp_path / "site").parent
    assert re.findall(r'src="(.*?)"', (folder / "index.html").read_text()) == [
        "pictures/response-0-lambda2.png"
    ]
    (figure,) = response_figures(records).values()
    lines = {line.get_label(): line.get_data() for line in figure.axes[0].lines}
    assert set(lines) == {"r3-pano, flat", "r3-pano, house"}
    flat = [r for r in records if r["scene"] == "flat"]
    means = [np.mean([np.mean(r["views"]["psnr"]) for r in flat if r["settings"] == {"lambda2": v}])
             for v in (0.2, 0.5, 0.8)]  # fmt: skip
    np.testing.assert_allclose(lines["r3-pano, flat"], [[0.2, 0.5, 0.8], means])


PAGES = {
    "of somebody else": "<!doctype html><title>my home</title>",
    "in no encoding": "\xff\xfe",
}


@pytest.mark.parametrize("text", PAGES.values(), ids=PAGES)
def test_a_page_that_is_not_ours_stays(tmp_path, text):
    out, home = written(tmp_path / "out", [record(views=6)]), tmp_path / "home"
    home.mkdir()
    (home / "index.html").write_bytes(text.encode("latin-1"))
    with pytest.raises(OSError, match="home"):
        write_site(out, home)
    assert (home / "index.html").read_bytes() == text.encode("latin-1")
    assert [path.name for path in home.iterdir()] == ["index.html"]
