r"""A Slurm cluster of one node on this machine, from nothing and without systemd.

Needs munged, slurmctld and slurmd (Debian: `apt-get install slurm-wlm munge`); root is not
needed, and nothing outside its own folder is read or written. A benchmark on it, by hand:

    eval "$(python -m tests.slurm.cluster start /tmp/cluster)"
    r3jax benchmark --engine slurm --jobs 2 --scenes flat --policies random,ours \
        --budget views:4 --resolution 48 --train-resolution 48 --iterations 50 \
        --test-views 6 --lpips none --out /tmp/benchmark
    python -m tests.slurm.cluster stop /tmp/cluster

The folder holds slurm.conf, keys, state and the daemons' logs. There is no accounting database,
as on many small clusters: `sacct` does not work, `squeue` and `scontrol` do.
"""

import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
"""In the order in which they are started."""

_PATIENCE = 30.0
"""A daemon that needs longer to start or to end has failed [s]."""

_CONFIG = """\
ClusterName=r3jax
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ctld_port}
SlurmdPort={slurmd_port}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
CredType=cred/munge
# A requeued job waits until its old credential has expired (5 s is the least, 120 s the default).
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
# No cgroups: they may belong to somebody else here.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1,bf_interval=1
SlurmdParameters=config_overrides
JobRequeue=1
KillWait=2
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


class ClusterError(RuntimeError):
    """A cluster that does not start, with the end of its logs."""


def missing() -> list[str]:
    """The programs that a cluster needs and that are not here."""
    return [name for name in (*DAEMONS, "sbatch", "srun", "squeue") if not _program(name)]


def start(folder: Path) -> dict[str, str]:
    """Starts a cluster whose node is ready for jobs.

    Args:
        folder: for all that it has; its path must be short (a socket's may have 107 characters).

    Returns:
        The environment variables that Slurm's commands need.

    Raises:
        ClusterError: a program is missing or does not start.
    """
    if absent := missing():
        raise ClusterError(f"not installed: {', '.join(absent)}; apt-get install slurm-wlm munge")
    folder = folder.resolve()
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    folder.chmod(0o755)  # munged refuses a folder that others may write to
    key = folder / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(64))
    ctld_port, slurmd_port = _free_ports()
    config = folder / "slurm.conf"
    config.write_text(
        _CONFIG.format(
            folder=folder,
            host=socket.gethostname().split(".")[0],
            user=getpass.getuser(),
            ctld_port=ctld_port,
            slurmd_port=slurmd_port,
            cpus=max(2, os.cpu_count() or 1),
        )
    )
    try:
        _launch(folder, "munged", *_munge_arguments(folder))
        _launch(folder, "slurmctld", "-f", str(config))
        _launch(folder, "slurmd", "-f", str(config))
        _until_idle(folder)
    except ClusterError:
        stop(folder)
        raise
    return environment(folder)


def environment(folder: Path) -> dict[str, str]:
    """The environment variables that Slurm's commands need."""
    return {"SLURM_CONF": str(folder.resolve() / "slurm.conf")}


def stop(folder: Path) -> None:
    """Ends the jobs and the daemons of a cluster; the folder stays.

    Raises:
        ClusterError: a daemon does not end.
    """
    folder = folder.resolve()
    if _is_running(folder, "slurmctld"):
        command(folder, "scancel", "--full", "--signal=KILL", f"--user={getpass.getuser()}")
        command(folder, "scancel", f"--user={getpass.getuser()}")
        queued = lambda: command(folder, "squeue", "--noheader").stdout.strip()
        _wait(lambda: not queued(), folder, "a job does not end")
    for name in reversed(DAEMONS):
        if _is_running(folder, name):
            os.kill(_pid(folder, name), signal.SIGTERM)
            _wait(lambda name=name: not _is_running(folder, name), folder, f"{name} does not end")


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Runs one of Slurm's commands on the cluster."""
    return subprocess.run(
        words,
        env=os.environ | environment(folder),
        capture_output=True,
        text=True,
        timeout=_PATIENCE,
        check=False,
    )


def _program(name: str) -> str | None:
    """Daemons lie where only root looks."""
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")


def _munge_arguments(folder: Path) -> list[str]:
    files = {"socket": "socket", "key-file": "key", "pid-file": "pid", "log-file": "log"}
    paths = [f"--{option}={folder}/munge.{end}" for option, end in files.items()]
    return [*paths, f"--seed-file={folder}/munge.seed", "--force"]


def _free_ports() -> tuple[int, int]:
    with socket.socket() as first, socket.socket() as second:
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        return first.getsockname()[1], second.getsockname()[1]


def _launch(folder: Path, name: str, *arguments: str) -> None:
    program = _program(name)
    assert program is not None
    started = subprocess.run(
        [program, *arguments], capture_output=True, text=True, timeout=_PATIENCE, check=False
    )
    if started.returncode:
        raise ClusterError(f"{name} does not start: {started.stderr.strip()}{_logs(folder)}")
    _wait(lambda: _is_running(folder, name), folder, f"{name} does not start")


def _until_idle(folder: Path) -> None:
    def is_idle() -> bool:
        return command(folder, "sinfo", "--noheader", "--format=%T").stdout.strip() == "idle"

    _wait(is_idle, folder, "the node does not become idle")


def _wait(is_so, folder: Path, otherwise: str) -> None:
    end = time.monotonic() + _PATIENCE
    while not is_so():
        if time.monotonic() > end:
            raise ClusterError(f"{otherwise}{_logs(folder)}")
        time.sleep(0.05)


def _logs(folder: Path) -> str:
    logs = [(log.name, log.read_text(errors="replace")) for log in sorted(folder.glob("*.log"))]
    return "".join(f"\n--- {name}\n" + "\n".join(t.splitlines()[-10:]) for name, t in logs)


def _pid(folder: Path, name: str) -> int:
    return int((folder / f"{'munge' if name == 'munged' else name}.pid").read_text())


def _is_running(folder: Path, name: str) -> bool:
    """Whether the process of its pid file is it, and no zombie."""
    try:
        status = Path(f"/proc/{_pid(folder, name)}/stat").read_text()
    except (OSError, ValueError):
        return False
    comm, state = status.split("(", 1)[1].rsplit(")", 1)
    return comm == name and state.split()[0] != "Z"


def main() -> None:
    """`start FOLDER` or `stop FOLDER`."""
    if len(sys.argv) != 3 or sys.argv[1] not in ("start", "stop"):
        sys.exit("usage: python -m tests.slurm.cluster start|stop FOLDER")
    folder = Path(sys.argv[2])
    try:
        if sys.argv[1] == "stop":
            stop(folder)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            for name, value in start(folder).items():
                print(f"export {name}={value}")
    except ClusterError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
