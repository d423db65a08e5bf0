"""Tables: numbers recomputed another way, marks, ties, gaps, refusals, faults put in."""

import numpy as np
import pytest

from experiments.pages import comparison_tables
from experiments.pages.comparison_tables import difference_table, tail_table
from r3jax.apps.benchmark import tables
from r3jax.apps.benchmark.tables import quality_table
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


def test_marks() -> None:
    """The best and the second best of each column, whichever way is better."""
    found = fields(tables.quality_table(benchmark()))
    for title in ("PSNR [dB]", "SSIM", "LPIPS"):
        for column in ("flat", "house", "mean"):
            ours = {m: entry for (m, t, c), entry in found.items() if (t, c) == (title, column)}
            order = sorted(ours, key=lambda m: ours[m].value, reverse=title != "LPIPS")
            assert [ours[m].rank for m in order] == [1, 2] + [0] * (len(order) - 2)


def test_ties() -> None:
    """Numbers that read the same share a mark."""
    quality = tables.quality_table
    ranks = lambda **psnr: {
        key[0]: entry.rank
        for key, entry in fields(quality(fixed(**psnr))).items()
        if key[1:] == ("PSNR [dB]", "mean")
    }
    assert ranks(r3=30.001, r3_pano=29.999, random=20.0, frontier=19.0) == {
        "r3": 1, "r3-pano": 1, "random": 2, "frontier": 0,
    }  # fmt: skip
    assert ranks(r3=30.0, random=20.0, frontier=20.0) == {"r3": 1, "random": 2, "frontier": 2}
    assert ranks(r3=30.0) == {"r3": 0}


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
    assert "2 to 3 seeds per cell, fewer than the 3 of the protocol." in table.notes
    assert "No record of r3 in house." in table.notes
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


def test_titles_and_notes_tell_the_terms():
    cells = benchmark(("random", "r3"), seeds=(0, 1))
    assert quality_table(cells).title == "views:60"
    assert tail_table(cells, resamples=9).title == "views:60, PSNR [dB]"
    measured = tail_table(cells, metric="psnr_measured", resamples=9)
    assert measured.title == "views:60, PSNR [dB], holes left out"
    assert "views < 20 dB [%]" in measured.columns
    assert quality_table(cells, "mine").title == "mine"
    assert difference_table(cells, "r3", resamples=9).title.endswith("r3 minus the others")
    terms, seeds, made = quality_table(cells).notes
    for told in ("views:60", "model clock", "256 px", "2000 iterations", "128 px"):
        assert told in terms
    assert seeds == "2 seeds per cell, fewer than the 3 of the protocol."
    assert made == "Made on two cores from commit abc1234."
    assert quality_table(benchmark(("random", "r3"))).notes[1] == "3 seeds per cell."
    single = quality_table([record(commit=None)]).notes
    assert single[1].startswith("1 seed per cell,")
    assert single[2] == "Made on two cores from commit unknown."
    cells = benchmark(("random", "r3"), settings={"pool": 9}, commit="0123456789abc-dirty")
    table = quality_table(cells)
    assert [row.labels[0] for row in table.rows[::3]] == ["random", "r3"]
    assert "Settings of all policies: pool=9." in table.notes
    assert table.notes[-1].endswith("from commit 0123456789-dirty.")


def test_unequal_terms_and_unknown_names_are_refused():
    cells = benchmark(("random", "r3"))
    cells[3]["test_views"]["hash"] = "another"
    for make in (quality_table, tail_table, lambda c: difference_table(c, "r3")):
        with pytest.raises(ValueError, match="the hash of the test views"):
            make(cells)
    with pytest.raises(ValueError, match="no metric 'mse'; there are psnr, psnr_measured, ssim"):
        tail_table(cells, metric="mse")
    with pytest.raises(ValueError, match="no record of 'mine'; there are random, r3"):
        difference_table(benchmark(("random", "r3")), "mine")
