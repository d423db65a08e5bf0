"""Sends cases to the worker and tells crashes, hangs and wrong errors from right ones."""

import json
import os
import selectors
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Any

_HANG = 10.0
"""A case that takes longer hangs [s]."""

_START = 300.0
"""Importing JAX and compiling what a reader needs may take longer [s]."""

_SHOWN = 8
"""Failures that a message quotes."""

_ROOT = Path(__file__).resolve().parents[2]


class Harness:
    """A worker process that is started again whenever a case ends it."""

    def __init__(self, scratch: Path):
        self._scratch = scratch
        self._log = scratch / "stderr.txt"
        self._process: subprocess.Popen[bytes] | None = None
        self._warm: set[str] = set()
        self._cases = 0

    def check(self, name: str, count: int | None = None) -> None:
        """Runs the seeds and the first `count` cases of a reader; None: as many as it names.

        Raises:
            AssertionError: a case crashed, hung, or ended in anything but the reader's own
                error or valid values; or the cases were all harmless, or all refused.
        """
        failures: list[str] = []
        verdicts: Counter[str] = Counter()
        number = 0
        while count is None or number < count:
            count = self._warm_up(name, count)
            answer = self._ask("READERS", name, number, _HANG)
            verdicts[answer["verdict"]] += 1
            if answer["verdict"] == "failed":
                failures.append(f"case {number} ({answer['what']}): {answer['why']}")
            number += 1
        listed = "\n\n".join(failures[:_SHOWN])
        assert not failures, f"{len(failures)} of {count} cases of {name} failed:\n{listed}"
        assert verdicts["read"], f"no case of {name} was harmless: is the seed read at all?"
        assert verdicts["refused"], f"no case of {name} was refused"

    def check_all(self, table: str, name: str) -> None:
        """Runs all cases of a reader that were made by hand, or its bombs.

        Raises:
            AssertionError: as for `check`.
        """
        number, seeds, failures = 0, 1, []
        while number < seeds:
            self._warm_up(name)
            answer = self._ask(table, name, -1 - number, _HANG)
            if answer["verdict"] == "failed":
                failures.append(f"case {number}: {answer['why']}")
            number, seeds = number + 1, answer.get("seeds", seeds)
        assert not failures, "\n\n".join(failures)

    def _warm_up(self, name: str, count: int | None = None) -> int:
        """The seeds must read; it also imports and compiles what the reader needs.

        Returns:
            `count`, or how many cases the reader names.
        """
        number, seeds = 0, 1
        while name not in self._warm and number < seeds:
            answer = self._ask("READERS", name, -1 - number, _START)
            assert answer["verdict"] == "read", f"seed {number} of {name}: {answer['why']}"
            number, seeds = number + 1, answer["seeds"]
            self._cases = answer["cases"]
        self._warm.add(name)
        return self._cases if count is None else count

    def _ask(self, table: str, name: str, number: int, patience: float) -> dict[str, Any]:
        """What became of one case."""
        process = self._process or self._start()
        question = json.dumps({"table": table, "reader": name, "case": number}).encode() + b"\n"
        assert process.stdin is not None
        try:
            process.stdin.write(question)
            process.stdin.flush()
        except BrokenPipeError:
            return self._dead({"what": "before it began"})
        answer: dict[str, Any] = {"what": "making it"}
        for seconds in (_START, patience):
            line = self._line(process, seconds)
            if line is None:
                self._stop()
                return answer | {"verdict": "failed", "why": f"hangs for more than {seconds} s"}
            if not line:
                return self._dead(answer)
            answer |= json.loads(line)
        if answer["why"].startswith("memory"):
            self._stop()  # the next case shall not pay for this one
        return answer

    @staticmethod
    def _line(process: "subprocess.Popen[bytes]", seconds: float) -> bytes | None:
        """The next answer; empty if the process is dead, None if there was none in time."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            return process.stdout.readline() if selector.select(seconds) else None

    def _dead(self, answer: dict[str, Any]) -> dict[str, Any]:
        assert self._process is not None
        code = self._process.wait()
        self._stop()
        why = f"the process died with exit code {code}: {self._said()}"
        return answer | {"verdict": "failed", "why": why}

    def _said(self) -> str:
        """The end of what the process wrote: the traceback of a crash."""
        return self._log.read_text(errors="replace")[-1500:]

    def _start(self) -> "subprocess.Popen[bytes]":
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", "-m", "tests.fuzz.worker", self._scratch],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                stderr=log,
                cwd=_ROOT,
                env=os.environ | {"PYTHONPATH": str(_ROOT), "MALLOC_ARENA_MAX": "2"},
            )
        return self._process

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for stream in (self._process.stdin, self._process.stdout):
                if stream is not None:
                    try:
                        stream.close()
                    except BrokenPipeError:
                        continue
        self._process = None
        self._warm.clear()

    def __enter__(self) -> "Harness":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stop()
