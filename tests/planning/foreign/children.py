"""Programs that choose views, for the tests: one of them in the standard library alone."""

import shlex
import sys
import time
from pathlib import Path

import psutil

BEGIN = """
import json, random, struct, sys

def receive():
    prefix = sys.stdin.buffer.read(8)
    if len(prefix) < 8:
        sys.exit()
    header = json.loads(sys.stdin.buffer.read(struct.unpack("<II", prefix)[0]))
    if "view" in header:
        asked["view"] = header["view"]
    arrays = {}
    codes = {"uint8": "B", "int32": "i", "int64": "q", "float32": "f", "float64": "d"}
    for entry in header["arrays"]:
        count = 1
        for n in entry["shape"]:
            count *= n
        form = "<%d%s" % (count, codes[entry["dtype"]])
        data = struct.unpack(form, sys.stdin.buffer.read(struct.calcsize(form)))
        arrays[entry["name"]] = (entry["shape"], data)
    return header, arrays

asked = {}

def send(**answer):
    text = json.dumps(asked | answer).encode()
    sys.stdout.buffer.write(struct.pack("<II", len(text), 0) + text)
    sys.stdout.buffer.flush()

hello, _ = receive()
send(kind="hello", protocol=1)
"""

HIGHEST = """
while True:
    _, arrays = receive()
    heights = arrays["position"][1][2::3]
    send(kind="candidate", index=heights.index(max(heights)))
"""
"""The highest candidate."""

LOTS = """
draw = random.Random(hello["seed"])
while True:
    question, arrays = receive()
    send(kind="candidate", index=draw.randrange(len(arrays["path"][1])))
"""
"""Remembers how often it has drawn."""


def command_of(folder: Path, code: str, python: str = sys.executable) -> str:
    """Writes a program of the standard library into a folder; the command that runs it."""
    path = folder / "program.py"
    path.write_text(BEGIN + code)
    return shlex.join([python, "-I", str(path)])


def is_running(pid: int) -> bool:
    """Whether a process is there and has not ended; one that has may wait to be reaped."""
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def wait_for_end(pid: int) -> None:
    """Waits until a process that was killed has ended."""
    end = time.monotonic() + 60.0
    while is_running(pid):
        assert time.monotonic() < end
        time.sleep(0.01)
