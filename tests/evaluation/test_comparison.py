"""What may stand side by side: every difference in terms is refused and named."""

import numpy as np
import pytest

from r3jax.evaluation.comparison import (
    check_equal_terms,
    method_name,
    methods_of,
    scenes_of,
    scores_by_method,
    seeds_by_method,
    shared_settings,
    snapshots_of,
    view_values,
    with_short_names,
)
from tests.evaluation.records import benchmark, record

DIFFERENCES = [
    (("format",), 2, "the format is 1 .* 2"),
    (("clock",), "wall", "the clock is 'model' .* 'wall'"),
    (("resolution",), 512, "the resolution of exploration is 256 .* 512"),
    (("test_views", "resolution"), 256, "the resolution of the test views is 128 .* 256"),
    (("snapshot",), "views:61", "the snapshot is 'views:60' .* 'views:61'"),
    (("sensing", "noise"), 0.0, "the exploration's noise is 0.01 .* 0.0"),
    (("sensing", "voxel_size"), 0.1, "the exploration's voxel_size is 0.05 .* 0.1"),
    (("lpips_network",), "vgg", "the network of LPIPS is 'alex' .* 'vgg'"),
    (("training", "iterations"), 7000, "training iterations is 2000 .* 7000"),
    (("training", "resolution"), 256, "training resolution is 128 .* 256"),
    (("training", "capacity"), 50000, "training capacity is 40000 .* 50000"),
    (("training", "strategy"), "mcmc", "training strategy is 'vanilla' .* 'mcmc'"),
    (("training", "degree"), 3, "training degree is None .* 3"),
    (("scene_hash",), "other", "scene's hash is 'hash of house' .* 'other'"),
    (("test_views", "hash"), "other", "hash of the test views is 'views of house' .* 'other'"),
    (("views", "view"), list(range(1, 13)), "the list of test views is .* but"),
]


@pytest.mark.parametrize(("path", "value", "message"), DIFFERENCES)
def test_unequal_terms_are_refused(path, value, message):
    cells = benchmark(("active-gs", "r3"))
    check_equal_terms(cells)
    place = cells[-1]
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    with pytest.raises(ValueError, match=message) as caught:
        check_equal_terms(cells)
    assert "house, r3, seed 2" in str(caught.value)


def test_what_may_differ():
    """Seeds (of training too), settings of policies, the machine; snapshots where asked."""
    cells = [record(seed=0), record(seed=1, machine="other"), record(settings={"bins": 32})]
    check_equal_terms(cells)
    more = [*cells, record(snapshot=60)]
    check_equal_terms(more, one_snapshot=False)
    with pytest.raises(ValueError, match="the snapshot"):
        check_equal_terms(more)


def test_records_that_occur_twice_or_not_at_all():
    with pytest.raises(ValueError, match="flat, r3, seed 0, views:30"):
        check_equal_terms([record(), record(seed=1), record() | {"budget": "views:30"}])
    with pytest.raises(ValueError, match="no records"):
        check_equal_terms([])


def test_names_and_orders_do_not_depend_on_the_order_of_records():
    cells = [
        record("r3-pano"), record("r3", settings={"pool": 9, "bins": 2}), record("r3"),
        record("active-gs", "a"), record("random"), {**record(), "policy": "mine"},
    ]  # fmt: skip
    assert method_name(cells[1]) == "r3 (bins=2, pool=9)"
    order = ["mine", "random", "active-gs", "r3", "r3 (bins=2, pool=9)", "r3-pano"]
    assert methods_of(cells) == methods_of(cells[::-1]) == order
    assert scenes_of(cells) == ["a", "flat"]
    sizes = ["views:100", "views:30", "seconds:20.5", "views:9"]
    cells = [record() | {"snapshot": size} for size in sizes]
    assert snapshots_of(cells) == ["seconds:20.5", "views:9", "views:30", "views:100"]


def test_what_is_said_of_a_policy_in_brackets_stands_behind_it():
    names = ["r3 (submitted)", "r3con (captures)", "r3", "theirs (submitted)", "r3con"]
    assert methods_of([record() | {"policy": name} for name in names]) == [
        "theirs (submitted)", "r3con", "r3con (captures)", "r3", "r3 (submitted)",
    ]  # fmt: skip


def test_scores_are_seeds_by_views():
    cells = [
        record(seed=2, psnr=[3.0, 4.0]),
        record(seed=0, psnr=[1.0, 2.0]),
        record("random", psnr=[5.0, 6.0]),
    ]
    cells[2]["views"]["lpips"] = None
    cells[2]["views"]["ssim"] = [None, 0.5]
    cells[2]["views"]["psnr_measured"] = [None, None]
    found = scores_by_method(cells, "psnr")
    np.testing.assert_array_equal(found["r3"]["flat"], [[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(found["random"]["flat"], [[5.0, 6.0]])
    assert set(scores_by_method(cells, "lpips")) == {"r3"}
    assert set(scores_by_method(cells, "psnr_measured")) == {"r3"}
    np.testing.assert_array_equal(
        scores_by_method(cells, "ssim")["random"]["flat"], [[np.nan, 0.5]]
    )
    assert view_values(cells[2], "lpips") is None
    assert view_values(cells[2], "coverage") is not None


def test_seeds_tell_what_is_missing():
    cells = [record(seed=1), record(seed=0), record("random", "house"), record(snapshot=60)]
    assert seeds_by_method(cells) == {
        "random": {"flat": [], "house": [0]},
        "r3": {"flat": [0, 1], "house": []},
    }


def test_names_are_as_short_as_the_set_allows():
    cells = [
        record("r3", "mesh:/a/room.ply", settings={"pool": 9, "bins": 2}),
        record("r3", "mesh:/b/hall.obj", settings={"pool": 9, "bins": 4}),
        record("random", settings={"pool": 9}),
    ]
    assert shared_settings(cells) == {"pool": 9}
    short = with_short_names(cells)
    assert methods_of(short) == ["random", "r3 (bins=2)", "r3 (bins=4)"]
    assert [cell["scene"] for cell in short] == ["room", "hall", "flat"]
    assert [cell["views"] for cell in short] == [cell["views"] for cell in cells]
    assert cells[0]["settings"] == {"pool": 9, "bins": 2}  # the given records stay as they are
    same = with_short_names([record(scene="mesh:/a/room.ply"), record(scene="mesh:/b/room.ply")])
    assert scenes_of(same) == ["mesh:/a/room.ply", "mesh:/b/room.ply"]
    other = [record(settings={"pool": 9}), record("random", settings={"pool": 8}), record("cover")]
    assert shared_settings(other) == {}
    assert methods_of(with_short_names(other)) == ["random (pool=8)", "cover", "r3 (pool=9)"]
