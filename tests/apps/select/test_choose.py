"""Which frames are chosen: laws of the greedy choice."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.select.choose import Choice, choose, component_of, in_proportion, tie_ranks
from tests.apps.select.made_up import observed_of, renderability_of, shuffled, targets_of

SEEDS = st.integers(0, 500)


def choice_of(seed: int, num: int, **settings) -> Choice:
    observed = observed_of(seed)
    return choose(observed, targets_of(observed, seed), num, **settings)


@given(SEEDS, st.integers(1, 9))
def test_the_record_is_that_of_the_maps_of_the_frames_chosen(seed, num):
    observed = observed_of(seed)
    targets = targets_of(observed, seed)
    found = choose(observed, targets, num)
    assert len(set(found.order.tolist())) == num
    np.testing.assert_allclose(np.cumsum(found.gain), found.renderability, atol=1e-5)
    oracle = renderability_of(observed, targets, found.order.tolist())
    np.testing.assert_allclose(found.per_target[-1], oracle, atol=1e-5)
    assert (found.left[found.order] == 0.0).all()


@given(SEEDS)
def test_exact_greedy_takes_the_best_of_all_in_each_step(seed):
    observed = observed_of(seed)
    targets = targets_of(observed, seed)
    found = choose(observed, targets, 3, is_exact=True)
    for step in range(3):
        before = found.order[:step].tolist()
        values = [
            renderability_of(observed, targets, [*before, frame]).mean()
            for frame in range(len(observed))
            if frame not in before
        ]
        assert found.renderability[step] == pytest.approx(max(values), abs=1e-5)


@given(SEEDS, st.integers(2, 6), st.booleans())
def test_the_order_of_the_frames_does_not_matter(seed, num, is_exact):
    rng = np.random.default_rng(seed)
    observed = observed_of(seed)
    targets, positions = targets_of(observed, seed), rng.normal(size=(len(observed), 3))
    names = [f"{i:02d}" for i in range(len(observed))]
    order = rng.permutation(len(observed))
    blur = np.ones(len(observed))
    first = choose(observed, targets, num, ranks=tie_ranks(blur, positions, names),
                   is_exact=is_exact)  # fmt: skip
    again = choose(
        shuffled(observed, order), targets, num, is_exact=is_exact,
        ranks=tie_ranks(blur, positions[order], [names[i] for i in order]),
    )  # fmt: skip
    assert order[again.order].tolist() == first.order.tolist()


def test_of_twins_the_sharper_one_is_chosen_then_the_one_in_the_middle_then_by_name():
    observed = observed_of(3, frames=3)
    twins = shuffled(observed, np.array([0, 0, 1, 1]))
    targets = targets_of(observed, 3)
    places = np.array([[5.0, 0, 0], [0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]])
    chosen = lambda ranks: set(choose(twins, targets, 2, ranks=ranks).order.tolist())
    assert chosen(tie_ranks(np.array([2.0, 1, 1, 2]), places, list("abcd"))) == {0, 3}
    assert chosen(tie_ranks(np.ones(4), places, list("abcd"))) == {1, 2}
    assert chosen(tie_ranks(np.ones(4), np.zeros((4, 3)), list("badc"))) == {1, 3}


def test_frames_to_keep_go_first_and_frames_left_out_never():
    allowed = np.ones(9, dtype=bool)
    allowed[[2, 5]] = False
    found = choice_of(7, 9, keep=[5, 1], allowed=allowed)
    assert found.order[:2].tolist() == [5, 1]
    assert 2 not in found.order
    assert len(found.order) == 8


@given(SEEDS, st.floats(0.3, 1.0))
def test_a_share_of_the_gain_ends_the_choice_as_soon_as_it_is_reached(seed, share):
    found = choice_of(seed, 9, gain=share)
    assert (found.share[:-1] < share).all()
    assert found.share[-1] >= share or len(found.order) == 9


def test_interrupting_keeps_what_was_chosen():
    whole, calls = choice_of(4, 6), itertools.count(1)
    found = choice_of(4, 6, on_choice=lambda: next(calls) == 4)
    assert found.order.tolist() == whole.order[:4].tolist()
    assert not found.is_complete


@given(SEEDS)
def test_two_scenes_are_kept_in_proportion(seed):
    observed = observed_of(seed, frames=12, rows=80, scenes=2)
    component = component_of(observed)
    sizes = np.bincount(component)
    found = choose(observed, targets_of(observed, seed), 6)
    parts = np.bincount(component[found.order], minlength=len(sizes))
    np.testing.assert_array_equal(parts, in_proportion(sizes, 6))


@given(st.lists(st.integers(1, 30), min_size=1, max_size=6), st.data())
def test_parts_add_up_and_none_is_larger_than_its_group(sizes, data):
    num = data.draw(st.integers(0, sum(sizes)))
    parts = in_proportion(np.array(sizes), num)
    assert parts.sum() == num
    assert (parts <= sizes).all()
    assert (np.abs(parts - num * np.array(sizes) / sum(sizes)) < 1.0).all()
