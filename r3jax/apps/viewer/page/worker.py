"""One thread that answers the newest question, and never shows the answer to an older one."""

import functools
import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

Question = TypeVar("Question")
Answer = TypeVar("Answer")


class LatestWorker(Generic[Question, Answer]):
    """Answers questions one at a time, in a thread of its own. The last one asked wins.

    An answer may come in parts, the quick ones first. A question that is replaced while it waits
    is never worked on; of one that is replaced while it is worked on, no further part is worked
    out and none is shown. So whatever is shown belongs to the question that was asked last.
    """

    def __init__(
        self,
        answer: Callable[[Question], Iterator[Answer]],
        show: Callable[[Question, Answer], None],
        fail: Callable[[Question, Exception], None],
        *,
        quiet: float = 0.05,
        idle: Callable[[], bool] | None = None,
    ):
        """Starts the thread.

        Args:
            answer: the work, part by part; called without a lock.
            show: told each part of the answer to the newest question. A question asked meanwhile
                waits until it returns, so it should be quick; it may ask itself.
            fail: told what `answer` raised, on the same terms.
            quiet: a question is taken up when none has followed it for so long [s].
            idle: called again and again while nothing is asked, until it returns False.
        """
        self._answer, self._show, self._fail = answer, show, fail
        self._quiet, self._idle = quiet, idle
        self._changed = threading.Condition(threading.RLock())
        self._question: Question | None = None
        self._asked = self._done = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def ask(self, question: Question, mark: Callable[[], None] | None = None) -> None:
        """Replaces the question that waits or is being worked on, if any.

        Args:
            question: the new one.
            mark: called at once: after it, nothing of an earlier answer is shown any more, and
                nothing of this one's has been shown yet.
        """
        with self._changed:
            if mark is not None:
                mark()
            self._question = question
            self._asked += 1
            self._changed.notify_all()

    def wait(self, timeout: float) -> bool:
        """Returns when the newest question is answered in full; False if it takes longer [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._done == self._asked, timeout)

    def close(self) -> None:
        """Ends the thread, after the work that it is at."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (taken := self._take()) is not None:
            number, question = taken
            try:
                for part in self._answer(question):
                    if not self._tell(number, functools.partial(self._show, question, part)):
                        break
            except Exception as error:  # shown, wherever it came from; the thread must live on
                self._tell(number, functools.partial(self._fail, question, error))
            with self._changed:
                if number == self._asked:
                    self._done = number
                self._changed.notify_all()

    def _take(self) -> tuple[int, Question] | None:
        """Waits for a question, and until it is the last one for a while; None: closed."""
        while True:
            with self._changed:
                if self._closed:
                    return None
                if self._asked != self._done:
                    return self._settled()
                if self._idle is None:
                    self._changed.wait()
                    continue
            if not self._idle():
                self._idle = None

    def _settled(self) -> tuple[int, Question] | None:
        """The newest question once none has followed it for a while; the lock is held."""
        newest = -1
        while newest != self._asked and not self._closed:
            newest = self._asked
            self._changed.wait_for(functools.partial(self._is_past, newest), self._quiet)
        question = self._question
        return None if self._closed or question is None else (newest, question)

    def _is_past(self, number: int) -> bool:
        return self._closed or self._asked != number

    def _tell(self, number: int, tell: Callable[[], None]) -> bool:
        """Tells what came out; False if another question has been asked since."""
        with self._changed:
            is_newest = number == self._asked and not self._closed
            if is_newest:
                tell()
            return is_newest
