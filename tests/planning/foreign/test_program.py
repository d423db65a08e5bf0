"""Programs: what dies, hangs, or talks nonsense is told in a sentence, and nothing goes on."""

import shlex
import sys

import pytest

from r3jax.planning.policies.foreign.commands import short_name, words_of
from r3jax.planning.policies.foreign.messages import Message
from r3jax.planning.policies.foreign.program import Program
from r3jax.planning.policy import PolicyError
from tests.planning.foreign.children import is_running, wait_for_end

BEGIN = """
import json, os, socket, struct, subprocess, sys, time
TEXT = struct.pack("<II", 12, 0) + b'{"kind":"a"}'
def receive():
    n, m = struct.unpack("<II", sys.stdin.buffer.read(8))
    header = json.loads(sys.stdin.buffer.read(n))
    sys.stdin.buffer.read(m)
    return header
def send(data=None, **answer):
    text = json.dumps(answer).encode()
    data = struct.pack("<II", len(text), 0) + text if data is None else data
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()
"""


def python(code):
    """A command that runs code; of the standard library alone, so that it starts quickly."""
    return shlex.join([sys.executable, "-I", "-S", "-c", BEGIN + code])


def asked(code, seconds=20.0, memory=0.0, **fields):
    program = Program(python(code), memory)
    try:
        return program.ask(Message("decide", fields), seconds)
    finally:
        program.close()


def test_a_program_answers_and_ends_with_its_input():
    program = Program(python("while True: send(kind='view', got=receive()['x'])"), 0.0)
    for x in range(3):
        assert program.ask(Message("decide", {"x": x}), 20.0).fields == {"got": x}
    process = program._process
    program.close()
    assert process.returncode is not None
    program.close()  # a second time does no harm
    with pytest.raises(PolicyError, match="has ended"):
        program.ask(Message("decide"), 1.0)


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("sys.exit(3)", "code 3"),
        ("raise ValueError('no weights')", "code 1.*no weights"),
        ("receive(); os.kill(os.getpid(), 9)", "SIGKILL"),
        ("receive(); os.close(1); time.sleep(60)", "output"),
        ("receive(); os.close(1); time.sleep(0.1); sys.exit(4)", "code 4"),
        ("print('Loading ...', flush=True); time.sleep(60)", "standard error"),
        (
            "receive(); send(b'\\x02\\0\\0\\0\\0\\0\\0\\0[]'); time.sleep(60)",
            "`header`",
        ),
        ("receive(); send(struct.pack('<II', 1 << 31, 0))", "2147483648"),
        ("receive(); send(b'\\1\\0'); sys.exit()", "code 0"),
    ],
)
def test_what_goes_wrong_is_told_and_the_program_ended(code, says):
    program = Program(python(code), 0.0)
    pid = program._process.pid
    with pytest.raises(PolicyError, match=says):
        program.ask(Message("decide"), 20.0)
    assert not is_running(pid)


def test_a_program_that_hangs_is_given_up_with_what_it_started():
    code = "import signal; signal.signal(15, signal.SIG_IGN)\n"
    code += "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
    code += "print('child', child.pid, file=sys.stderr, flush=True); time.sleep(600)"
    program = Program(python(code), 0.0)
    pid = program._process.pid
    with pytest.raises(PolicyError, match=r"`decide`.* 1 s.*child \d+") as told:
        program.ask(Message("decide"), 1.0)
    child = int(str(told.value).rpartition("child ")[2])
    wait_for_end(child)
    assert not is_running(pid)


def test_a_program_that_does_not_read_is_given_up():
    program = Program(python("time.sleep(600)"), 0.0)
    with pytest.raises(PolicyError, match=r"within 0\.5 s"):
        program.ask(Message("decide", {"x": "y" * 1_000_000}), 0.5)


@pytest.mark.parametrize("end", ["os.close(0); time.sleep(60)", "os._exit(0)"])
def test_an_answer_counts_though_the_input_is_closed_after_it(end):
    code = "import fcntl\n"  # on Linux all of the answer fits into the pipe, and waits there
    code += "hasattr(fcntl, 'F_SETPIPE_SZ') and fcntl.fcntl(1, fcntl.F_SETPIPE_SZ, 1 << 20)\n"
    code += f"receive(); send(kind='last', text='x' * 1_000_000); {end}"
    assert len(asked(code).fields["text"]) == 1_000_000


def test_a_program_may_say_much_on_its_standard_error():
    code = "sys.stderr.write('x' * 1_000_000); receive(); send(kind='fine')"
    assert asked(code).kind == "fine"


def test_memory_below_its_limit_is_free():
    code = "receive(); x = b'x' * (60 << 20); send(kind='fine')"
    assert asked(code, memory=0.25).kind == "fine"


@pytest.mark.parametrize(
    "code",
    [
        "x = b'x' * (400 << 20)",
        "import mmap; m = mmap.mmap(-1, 400 << 20)\nfor i in range(0, len(m), 4096): m[i] = 1",
        "for _ in range(4):\n    if os.fork() == 0: x = b'x' * (100 << 20); time.sleep(60)\n"
        "time.sleep(60)",
    ],
)
def test_memory_is_that_of_all_processes_and_has_a_limit(code):
    with pytest.raises(PolicyError, match=r"0\.25 GiB"):
        asked(f"receive()\n{code}\nsend(kind='fine')\ntime.sleep(60)", memory=0.25)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere shared pages count for each")
def test_what_processes_share_counts_once():
    code = (
        "x = b'x' * (120 << 20)\nfor _ in range(4):\n    if os.fork() == 0: time.sleep(60)\n"
        "receive(); time.sleep(0.5); send(kind='fine')"
    )
    assert asked(code, memory=0.3).kind == "fine"


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("", "command"),
        ("no-such-program --fast", "'no-such-program'"),
        ("python 'x", "No closing quotation"),
    ],
)
def test_a_command_that_is_none_is_refused(command, says):
    with pytest.raises(ValueError, match=says):
        words_of(command)


@pytest.mark.parametrize(
    ("name", "short"),
    [
        ("r3-pano", "r3-pano"),
        ("my.module:Highest", "Highest"),
        ("exec:python -u some/where/mine.py --fast", "mine"),
        ("exec:python", "python"),
        ("exec:/usr/bin/python3.11 mine.py", "mine"),
    ],
)
def test_a_command_has_a_short_name(name, short, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda program: program)  # wherever Python may be
    assert short_name(name) == short
