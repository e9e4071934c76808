"""A SLURM of two nodes on this machine: its own configuration, key and folders, no installed service.

For tests, and `python tests/slurm_cluster.py COMMAND...` runs a command beside one, for example a shell. Each node is a
`slurmd` on one core of its own. Starts as root only, from Debian's packages slurm-wlm and munge.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "scontrol", "unshare")
SEARCHED = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
NODES = ("sn1", "sn2")
START_SECONDS = 60.0
# cred_expire: a requeued job waits that long (120 s by default). KillWait: from SIGTERM to SIGKILL.
CONFIGURATION = """
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire={requeue_seconds}
CredType=cred/munge
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=0,sched_interval=2
SlurmdParameters=config_overrides
MpiDefault=none
ReturnToService=2
JobRequeue=0
KillWait=20
MinJobAge=10
OverTimeLimit=0
"""


def missing() -> str | None:
    """Why no cluster can be started here; None if one can."""
    absent = [name for name in PROGRAMS if shutil.which(name, path=SEARCHED) is None]
    if absent:
        return f"SLURM is not installed: no {', '.join(absent)}"
    if os.geteuid() != 0:
        return "SLURM's daemons are started as root only"
    if len(os.sched_getaffinity(0)) < len(NODES):
        return f"expects {len(NODES)} cores, one for each node"
    return None


def can_hide() -> bool:
    """Whether a node can be kept from seeing a folder. In a container that may be forbidden."""
    return (
        subprocess.run(["unshare", "-m", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True).returncode == 0
    )


class Cluster(NamedTuple):
    """A running SLURM."""

    folder: Path
    variables: Mapping[str, str]  # of the environment of its commands

    def call(self, *command: str) -> str:
        """What a command of SLURM prints. Raises `CalledProcessError`."""
        done = subprocess.run(
            command,
            env=self.variables,
            check=True,
            text=True,
            timeout=60,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        return done.stdout.strip()

    def jobs(self) -> dict[str, str]:
        """The states by job that SLURM remembers: {"3_0": "RUNNING"}."""
        return dict(line.split() for line in self.call("squeue", "-h", "-r", "-t", "all", "-o", "%i %T").splitlines())

    def bring_back(self, node: str) -> bool:
        """Asks SLURM to use a node again that is down or drained; returns whether it does."""
        with suppress(subprocess.CalledProcessError):  # it may be back already
            self.call("scontrol", "update", f"NodeName={node}", "State=RESUME")
        state = self.call("sinfo", "-h", "-N", "-n", node, "-o", "%T")
        return not state.startswith(("down", "drain"))

    def wait_until_idle(self) -> None:
        """Waits until all nodes are free. Raises `TimeoutError`."""
        _wait_until(lambda: _all_idle(self), self.folder)

    def describe(self) -> str:
        """Its nodes, its jobs and what its controller wrote last."""
        log = (self.folder / "slurmctld.log").read_text()[-4000:]
        return "\n".join([self.call("sinfo", "-N", "-l"), self.call("squeue", "-r", "-t", "all"), log])


@contextmanager
def cluster(requeue_seconds: int = 6, hidden: Path | None = None) -> Iterator[Cluster]:
    """Starts a SLURM and stops it, with its jobs.

    Args:
      requeue_seconds: how long a requeued job waits.
      hidden: a folder that the second node does not see.
    """
    variables = dict(os.environ) | {"PATH": SEARCHED}
    cores = sorted(os.sched_getaffinity(0))
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="slurm"))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        (folder / "munge.key").write_bytes(os.urandom(128))
        (folder / "munge.key").chmod(0o400)
        (folder / "state").mkdir()
        ports = _free_ports(1 + len(NODES))
        text = CONFIGURATION.format(
            host=socket.gethostname(), port=ports[0], folder=folder, requeue_seconds=requeue_seconds
        )
        for name, port in zip(NODES, ports[1:], strict=True):
            text += f"NodeName={name} NodeHostname={socket.gethostname()} NodeAddr=127.0.0.1 Port={port} CPUs=1\n"
        text += "PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP\n"
        (folder / "slurm.conf").write_text(text)
        variables["SLURM_CONF"] = str(folder / "slurm.conf")
        running = Cluster(folder, variables)

        def start(*command: str) -> None:
            with (folder / f"{Path(command[0]).name}.out").open("ab") as out:
                process = subprocess.Popen(
                    command, env=variables, cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
                )
            stack.callback(_stop, process)

        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        start("munged", "--foreground", "--force", *(f"--{flag}={folder}/munge.{end}" for flag, end in files.items()))
        _wait_until(lambda: (folder / "munge.socket").exists(), folder)
        start("slurmctld", "-D")
        for index, name in enumerate(NODES):
            command = ["taskset", "-c", str(cores[index]), "slurmd", "-D", "-N", name]
            if hidden and name == NODES[-1]:
                command = ["unshare", "-m", "sh", "-c", 'mount -t tmpfs none "$0" && exec "$@"', str(hidden), *command]
            start(*command)
        running.wait_until_idle()
        stack.callback(_end_jobs, running)
        yield running


def main(command: Sequence[str]) -> int:
    """Runs a command beside a SLURM of its own; returns its exit code."""
    if reason := missing():
        print(reason, file=sys.stderr)
        return 2
    with cluster() as running:
        return subprocess.run(command, env=running.variables).returncode


def _all_idle(running: Cluster) -> bool:
    try:
        return running.call("sinfo", "-h", "-N", "-o", "%T").split() == ["idle"] * len(NODES)
    except subprocess.SubprocessError:
        return False


def _end_jobs(running: Cluster) -> None:
    """Ends all jobs, which would outlive the daemons."""
    ids = [job for job, state in running.jobs().items() if state in ("RUNNING", "PENDING", "COMPLETING")]
    if ids:
        subprocess.run(["scancel", "--full", "--signal=KILL", *ids], env=running.variables, timeout=60)
        subprocess.run(["scancel", *ids], env=running.variables, timeout=60)
    _wait_until(lambda: not {"RUNNING", "COMPLETING"} & set(running.jobs().values()), running.folder)


def _stop(process: subprocess.Popen) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _wait_until(condition, folder: Path) -> None:
    give_up = time.monotonic() + START_SECONDS
    while not condition():
        if time.monotonic() > give_up:
            logs = "\n".join(f"{log.name}: {log.read_text()[-2000:]}" for log in sorted(folder.glob("*.log")))
            raise TimeoutError(f"SLURM is not ready after {START_SECONDS:.0f} s\n{logs}")
        time.sleep(0.2)


def _free_ports(count: int) -> Sequence[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:] or ["bash"]))
