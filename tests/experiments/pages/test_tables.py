"""Tables: numbers recomputed another way, marks, ties, gaps, refusals, faults put in."""

import numpy as np
import pytest

from experiments.pages import comparison_tables
from r3jax.apps.benchmark import tables
from tests.evaluation.records import SKILL, benchmark, record


def fields(table):
    """Every entry by its labels and column."""
    return {
        (*row.labels, column): entry
        for row in table.rows
        for column, entry in zip(table.columns, row.entries, strict=True)
    }


def fixed(**psnr):
    """One record of one view for each policy."""
    return [record(policy.replace("_", "-"), psnr=[x]) for policy, x in psnr.items()]


def test_quality() -> None:
    """Every field is a mean of means taken from the raw records."""
    cells = benchmark()
    found = fields(tables.quality_table(cells[::-1]))
    assert len(found) == len(SKILL) * 3 * 3
    for title, name in (("PSNR [dB]", "psnr"), ("SSIM", "ssim"), ("LPIPS", "lpips")):
        for policy in SKILL:
            by_scene = {
                scene: np.mean([
                    np.mean(c["views"][name])
                    for c in cells
                    if (c["policy"], c["scene"]) == (policy, scene)
                ])
                for scene in ("flat", "house")
            }  # fmt: skip
            for scene, mean in by_scene.items():
                assert found[policy, title, scene].value == pytest.approx(mean)
            mean = np.mean(list(by_scene.values()))
            assert found[policy, title, "mean"].value == pytest.approx(mean)
            decimals = 2 if name == "psnr" else 3
            assert found[policy, title, "mean"].text == f"{mean:.{decimals}f}"


def test_gaps() -> None:
    """No record, no number; and no mean over other scenes than the others' means."""
    cells = [c for c in benchmark() if (c["policy"], c["scene"]) != ("r3", "house")]
    cells = [c for c in cells if (c["policy"], c["scene"], c["seed"]) != ("random", "flat", 2)]
    for cell in cells:
        if cell["policy"] == "active-gs":
            cell["views"]["lpips"] = None
    found = fields(tables.quality_table(cells))
    assert [found["r3", "SSIM", c].value is None for c in ("flat", "house", "mean")] == [
        False, True, True,
    ]  # fmt: skip
    assert found["r3-pano", "PSNR [dB]", "mean"].rank == 1
    assert found["active-gs", "LPIPS", "flat"].value is None
    assert found["active-gs", "SSIM", "flat"].value is not None
    table = comparison_tables.tail_table(cells, resamples=50)
    assert all(e.value is None for key, e in fields(table).items() if key[0] == "r3")
    assert {row.labels[0]: row.seeds for row in table.rows} == {
        **dict.fromkeys(SKILL, "3"), "r3": "0-3", "random": "2-3",
    }  # fmt: skip
    assert any("r3" in note and "house" in note for note in table.notes)
    for row in comparison_tables.difference_table(cells, "r3", resamples=50).rows:
        assert [entry.value is None for entry in row.entries] == [False, True, True]


def test_tails() -> None:
    """101 views with known order; LPIPS has its tail at the other end."""
    tail = comparison_tables.tail_table
    values = np.random.default_rng(0).permutation(101).astype(float)
    cells = [
        record(policy, scene, psnr=values / 2 + add)
        for policy in ("random", "r3")
        for scene, add in (("flat", 0.0), ("house", 50.5))
    ]
    found = fields(tail(cells, resamples=100))
    mine = {column: found["r3", column] for column in tail(cells, resamples=10).columns}
    assert mine["mean"].value == pytest.approx(50.25)
    low, high = mine["mean"].extra["low"], mine["mean"].extra["high"]
    assert low < 50.25 < high
    assert mine["mean"].text == f"50.25 [{low:.2f}, {high:.2f}]"
    assert (mine["worst scene"].value, mine["worst scene"].text) == (25.0, "25.00 (flat)")
    assert mine["median"].value == pytest.approx(50.25)
    assert mine["5th percentile"].value == pytest.approx(np.percentile(np.arange(202) / 2, 5))
    assert mine["worst view"].value == 0.0
    assert mine["views < 20 dB [%]"].value == pytest.approx(100 * 40 / 202)
    lpips = fields(tail(cells, metric="lpips", resamples=10))
    assert lpips["r3", "worst scene"].text.endswith("(flat)")
    assert lpips["r3", "worst view"].value == max(cells[0]["views"]["lpips"])
    assert lpips["r3", "95th percentile"].value > lpips["r3", "median"].value
    assert not any("20 dB" in column for _, column in lpips)


def test_ause() -> None:
    """0 where R orders the views as their errors do, 1 by chance; within a model, then the mean."""
    tail = comparison_tables.tail_table

    def column(*cells, metric="psnr"):
        found = fields(tail(list(cells), metric=metric, resamples=10))
        return {key[0]: entry.value for key, entry in found.items() if key[1] == "AUSE of R"}

    psnr = np.array([12.0, 17.0, 21.0, 30.0])

    def known(seed, renderability, scene="flat"):
        cell = record(scene=scene, seed=seed, psnr=psnr)
        cell["views"]["renderability"] = renderability
        return cell

    right, wrong, none = [0.1, 0.2, 0.3, 0.4], [0.4, 0.3, 0.2, 0.1], [0.5] * 4
    assert column(known(0, right)) == {"r3": pytest.approx(0.0)}
    assert column(known(0, none)) == {"r3": pytest.approx(1.0)}
    worst = column(known(0, wrong))["r3"]
    assert worst > 1.5
    assert column(known(0, right), known(1, none)) == {"r3": pytest.approx(0.5)}
    # Seeds first, then scenes: a scene with two seeds has no more weight than one with one.
    three = [known(0, right), known(1, right), known(0, none, "house")]
    assert column(*three) == {"r3": pytest.approx(0.5)}
    # The order of LPIPS is the other way round.
    assert column(known(0, right), metric="lpips") == {"r3": pytest.approx(0.0)}
    # A view without R is left out; a table without any R has no such column.
    assert column(known(0, [None, *right[1:]])) == {"r3": pytest.approx(0.0)}
    assert column(known(0, None)) == {}


def test_difference() -> None:
    """The reference minus the others, on the seeds that both have."""
    difference = comparison_tables.difference_table
    cells = benchmark(("random", "active-gs", "r3"))
    kept = [c for c in cells if (c["policy"], c["seed"]) != ("random", 1)]
    table = difference(kept, "r3", resamples=200)
    found = fields(table)
    assert [row.labels for row in table.rows] == [("random",), ("active-gs",)]
    assert [row.seeds for row in table.rows] == ["2", "3"]

    def mean(policy, scene, seeds):
        chosen = [c for c in cells if c["policy"] == policy and c["scene"] == scene]
        return np.mean([c["views"]["psnr"] for c in chosen if c["seed"] in seeds])

    for policy, seeds in (("random", (0, 2)), ("active-gs", (0, 1, 2))):
        gaps = [mean("r3", s, seeds) - mean(policy, s, seeds) for s in ("flat", "house")]
        entry = found[policy, "flat"]
        assert entry.value == pytest.approx(gaps[0])
        assert found[policy, "mean"].value == pytest.approx(np.mean(gaps))
        low, high = entry.extra["low"], entry.extra["high"]
        assert low < entry.value < high
        assert entry.text == f"{gaps[0]:+.2f} [{low:+.2f}, {high:+.2f}]"
