"""The newest question wins, and nothing of an older one is shown. Events, no clocks."""

import threading

import pytest

pytest.importorskip("viser", reason="the viewer needs viser, which is not installed")

from r3jax.apps.viewer.run_page import LatestWorker

PATIENCE = 30.0  # seconds after which a test gives up


class Bench:
    """A worker whose answers wait for a sign, and what it has shown."""

    def __init__(self, idle=None):
        self.shown, self.failed, self.worked, self.marked = [], [], [], []
        self.begun = threading.Semaphore(0)
        self.may_go_on = threading.Semaphore(0)
        self.worker = LatestWorker(
            self.answer,
            lambda question, part: self.shown.append((question, part)),
            lambda question, error: self.failed.append((question, str(error))),
            quiet=0.001,
            idle=idle,
        )

    def answer(self, question):
        for part in ("a", "b"):
            self.worked.append((question, part))
            self.begun.release()
            assert self.may_go_on.acquire(timeout=PATIENCE)
            if question == "bad":
                raise ValueError("no answer")
            yield part

    def wait_for_work(self):
        assert self.begun.acquire(timeout=PATIENCE)

    def let_go(self, parts):
        self.may_go_on.release(parts)
        assert self.worker.wait(PATIENCE)


@pytest.fixture
def bench():
    bench = Bench()
    yield bench
    bench.may_go_on.release(100)
    bench.worker.close()


def test_an_answer_is_shown_part_by_part(bench):
    bench.worker.ask("one")
    bench.let_go(2)
    assert bench.shown == [("one", "a"), ("one", "b")]


def test_the_last_of_several_questions_wins(bench):
    bench.worker.ask("first")
    bench.wait_for_work()
    for question in ("second", "third", "fourth"):
        bench.worker.ask(question, lambda question=question: bench.marked.append(question))
    bench.let_go(100)
    assert bench.marked == ["second", "third", "fourth"]
    assert bench.shown == [("fourth", "a"), ("fourth", "b")]
    # Nothing was worked out for those in between, nor more than was under way for the first.
    assert bench.worked == [("first", "a"), ("fourth", "a"), ("fourth", "b")]


def test_a_part_that_is_shown_before_is_marked_before_the_next_question(bench):
    bench.worker.ask("one")
    bench.wait_for_work()
    bench.may_go_on.release()
    bench.wait_for_work()  # part a has been shown, part b is being worked out
    bench.worker.ask("two", lambda: bench.shown.append("stale"))
    bench.let_go(3)
    assert bench.shown == [("one", "a"), "stale", ("two", "a"), ("two", "b")]


def test_an_error_is_told_and_the_next_question_is_answered(bench):
    bench.worker.ask("bad")
    bench.let_go(1)
    bench.worker.ask("good")
    bench.let_go(2)
    assert bench.failed == [("bad", "no answer")]
    assert bench.shown == [("good", "a"), ("good", "b")]


def test_an_error_of_a_question_that_was_replaced_is_not_told(bench):
    bench.worker.ask("bad")
    bench.wait_for_work()
    bench.worker.ask("good")
    bench.let_go(3)
    assert bench.failed == []
    assert bench.shown == [("good", "a"), ("good", "b")]


def test_idle_work_is_done_until_it_is_done():
    left, done = [3], threading.Event()

    def idle():
        left[0] -= 1
        if left[0] == 0:
            done.set()
        return left[0] > 0

    bench = Bench(idle=idle)
    assert done.wait(PATIENCE)
    bench.worker.ask("one")
    bench.let_go(2)
    bench.worker.close()
    assert left == [0]
    assert bench.shown == [("one", "a"), ("one", "b")]


def test_a_question_comes_before_idle_work():
    begun, gate = threading.Event(), threading.Event()
    turns = []

    def idle():
        turns.append("idle")
        begun.set()
        assert gate.wait(PATIENCE)
        return True

    bench = Bench(idle=idle)
    assert begun.wait(PATIENCE)
    bench.may_go_on.release(2)
    bench.worker.ask("one")  # while idle work is under way
    assert turns == ["idle"]
    gate.set()
    assert bench.worker.wait(PATIENCE)
    bench.worker.close()
    assert bench.shown == [("one", "a"), ("one", "b")]


def test_nothing_is_shown_after_the_end(bench):
    bench.worker.ask("one")
    bench.wait_for_work()
    closing = threading.Thread(target=bench.worker.close)
    closing.start()
    bench.may_go_on.release(100)
    closing.join(PATIENCE)
    assert not closing.is_alive()
    assert len(bench.shown) <= 2
    before = list(bench.shown)
    bench.worker.ask("two")
    assert bench.shown == before
