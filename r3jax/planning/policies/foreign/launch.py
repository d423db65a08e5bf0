"""Becomes a program under limits: `python -I -S launch.py MEMORY NETWORK COMMAND ...`.

Runs before the program, in its process: after a fork, a process full of threads may not do this
much. Imports nothing but the standard library, and of that little.
"""

import ctypes
import os
import signal
import sys

CANNOT = 125
"""Exit code where a limit cannot be set, or there is no such program."""

_PARENT_DEATH_SIGNAL, _ADOPT_ORPHANS = 1, 36
_NEW_USER, _NEW_NETWORK = 0x10000000, 0x40000000


def main(memory: int, network: str, command: list[str]) -> None:
    """Sets the limits and becomes the command.

    Args:
        memory: that each of its processes may take [bytes]; 0: no limit.
        network: `none` or `shared`.
        command: program and arguments.
    """
    try:
        import resource  # not on Windows, where this is imported but never run

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if memory:
            # Not the address space: that of GPUs and of sparse tables is reserved, never used.
            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
            # Files in memory (/dev/shm, memfd) count for no process: none may be larger either.
            resource.setrlimit(resource.RLIMIT_FSIZE, (memory, memory))
        if network == "none":
            leave_network()
        if sys.platform == "linux":
            system = ctypes.CDLL(None)
            # A parent that is killed ends its programs, hung and paused ones too.
            system.prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
            # What the program starts stays below it, so that it is found and paused.
            system.prctl(_ADOPT_ORPHANS, 1)
        os.execvp(command[0], command)
    except (ImportError, OSError, ValueError, AttributeError) as error:
        print(f"{command[0]}: {error}", file=sys.stderr)
        sys.exit(CANNOT)


def leave_network() -> None:
    """Moves this process into a network of its own, in which there is nothing.

    Raises:
        OSError: the system does not allow it.
        AttributeError: the system has no such thing.
    """
    library = ctypes.CDLL(None, use_errno=True)
    user, group = os.getuid(), os.getgid()
    if library.unshare(_NEW_NETWORK) == 0:  # root may
        return
    if library.unshare(_NEW_USER | _NEW_NETWORK) != 0:
        raise OSError(ctypes.get_errno(), "cannot leave the network")
    # The same user inside as outside: files stay its own.
    for name, text in (
        ("setgroups", "deny"),
        ("uid_map", f"{user} {user} 1"),
        ("gid_map", f"{group} {group} 1"),
    ):
        with open(f"/proc/self/{name}", "w") as file:
            file.write(text)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3:])
