"""How much sooner two cameras are: the table by hand, and a short flight for real."""

import pytest

from experiments.team import CREWS, SIZES, Size, fly, page, time_rows, time_to

pytestmark = pytest.mark.full


def record(crew, seed, known):
    """A flight by hand: a view every second."""
    views = [
        {"seconds": float(k), "member": 0, "voxels": int(100 * share), "known_share": share}
        for k, share in enumerate(known, 1)
    ]
    flight = {"crew": crew, "seed": seed, "scene": "flat", "commit": "abc"}
    return {"flight": flight, "machine": "m", "views": views}


@pytest.fixture
def records():
    return [
        record("one", 0, [0.1, 0.2, 0.3, 0.4, 0.4, 0.5]),
        record("one", 1, [0.2, 0.3, 0.4, 0.5, 0.9, 1.0]),
        record("two in touch", 0, [0.3, 0.45, 0.5]),
        record("two in touch", 1, [0.3, 0.85, 1.0]),
        record("two every 10 s", 0, [0.3, 0.4]),
        record("two every 10 s", 1, [0.9, 1.0]),
    ]


def test_the_time_to_a_level():
    views = record("one", 0, [0.1, 0.4, 0.3])["views"]
    assert time_to(views, "known_share", 0.1) == 1.0
    assert time_to(views, "voxels", 30) == 2.0
    assert time_to(views, "known_share", 0.41) is None


def test_times_are_compared_at_what_one_camera_knows(records):
    rows = [row for row in time_rows(records) if row["of"] == "known_share"]
    # 0.8: levels 0.4 and 0.8; one after 4 and 5 s, two after 2 and 2 s.
    assert rows[0]["one [s]"] == 4.5
    assert rows[0]["two in touch [s]"] == 2.0
    assert rows[0]["two in touch / one"] == pytest.approx(2.0 / 4.5)
    assert rows[0]["two every 10 s [s]"] == 1.5
    # 0.9: levels 0.45 and 0.9; one flight never gets there, and no mean is made of the other.
    assert rows[1]["two in touch [s]"] == 2.5
    assert rows[1]["two every 10 s / one"] is None
    assert any("| known_share |" in paragraph for paragraph in page(records, "smoke"))


def test_two_cameras_fly_from_two_places():
    size = Size("flat", (0,), 3.0, resolution=32, candidates=8)
    views = fly(CREWS["two in touch"], 0, size, "ours-pano")
    assert {view["member"] for view in views} == {0, 1}
    assert views[-1]["seconds"] <= 2.0 + 0.02
    assert [view["seconds"] for view in views] == sorted(view["seconds"] for view in views)


@pytest.mark.slow
def test_two_cameras_take_at_most_three_fifths_of_the_time():
    size = SIZES["small"]
    records = [
        {"flight": {"crew": crew, "seed": seed}, "views": fly(CREWS[crew], seed, size, "ours-pano")}
        for seed in size.seeds
        for crew in CREWS
    ]
    shares = [row["two in touch / one"] for row in time_rows(records) if row["of"] == "voxels"]
    assert max(shares) <= 0.6, shares
