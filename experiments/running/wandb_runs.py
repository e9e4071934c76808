"""Weights & Biases (`--wandb`): each member of a run is a run there, with the names of TensorBoard's events.

No row is sent twice, and no fault of W&B costs the run:

- W&B cannot replace rows, and a resumed run makes the rows after its checkpoint again. So a row is left out if W&B has
  it. The server says which row is its last; those of the tables that it lacks are sent first.
- Offline nobody can be asked: before a row is given to the package, wandb.json says so. A kill between the two loses
  this row.
- Every call of the package is made in a thread, with a time limit. After an error or the limit, one line says that W&B
  has ended, and training continues.
- The package is silent, asks for nothing, and captures neither output nor code.

API: https://docs.wandb.ai/models/ref/python
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.commandline.arguments import FAILED, INTERRUPTED
from experiments.running import run_config, wandb_file
from experiments.running.in_threads import in_threads
from experiments.running.run_config import Member
from sqt_jax.one_line import one_line

FOLDER = "wandb"  # of the package's own files, in the run's folder
MAX_RUNS = 200  # opening them took 9 seconds against a server 0.1 seconds away
OPEN_SECONDS, SEND_SECONDS, CLOSE_SECONDS = 20.0, 20.0, 20.0
# After a signal: a batch system soon kills. The process that resumes sends the rows that the server lacks.
STOP_SECONDS = 5.0
OPEN_THREADS = 16
OFFLINE = ("offline", "dryrun")  # modes of the package
MAX_NAME, MAX_TAG = 128, 64  # characters that W&B accepts
WITHOUT = "training continues without it"
SETTINGS = {
    "silent": True,
    "console": "off",
    "symlink": False,  # a run's folder holds no links
    "save_code": False,
    "disable_git": True,  # config.json has the commit
    "init_timeout": 15.0,
    "finish_timeout": 12.0,
    "finish_timeout_raises": True,
    # The stop button of one member's page: it would send SIGINT, and a second one ends the process without saving.
    "stop_fn": lambda: None,
    "x_save_requirements": False,  # config.json has the versions
    # A kill loses what the package has not written to its files yet; its own interval is 15 seconds.
    "x_transaction_log_flush_interval": 1.0,
}


class Unavailable(Exception):
    """There will be no runs in W&B; the text says why."""


def open_runs(
    folder: Path, members: Sequence[Member], swept: Sequence[str], project: str, warn: Callable[[str], None]
) -> "WandbRuns | None":
    """The members' runs in W&B; None if there are none: `project` is empty, W&B is disabled, or `warn` said why.

    Args:
      folder: the run's folder.
      swept: swept settings other than penalty_coef.
      warn: called with a line of text.
    """
    if not project:
        return None
    runs = WandbRuns(folder, warn)
    try:
        return runs if runs.open(members, swept, project) else None
    except Exception as error:  # of any type: no fault of W&B may cost the run
        warn(f"--wandb: {error if isinstance(error, Unavailable) else one_line(error)}; {WITHOUT}")
        runs.close()
        return None


class WandbRuns:
    """The members' runs in W&B, of one group. `open_runs` makes it."""

    def __init__(self, folder: Path, warn: Callable[[str], None]):
        self.folder, self.warn = folder, warn
        self.where = ""  # where the rows can be seen, for a message
        self._runs: list[Any] = []
        self._first: list[int] = []  # the first env steps that a member's run does not have
        self._package: ModuleType | None = None  # to be shut down by `close`
        self._offline = False

    def open(self, members: Sequence[Member], swept: Sequence[str], project: str) -> bool:
        """Opens a run per member; returns whether there are any: not if W&B is disabled.

        Raises:
          Unavailable: the package or a login is missing, or there are too many members.
          Exception: any other that the package raises.
        """
        if len(members) > MAX_RUNS:
            raise Unavailable(f"expects at most {MAX_RUNS} members, a run each, not {len(members):,}")
        wandb = _package()
        if "WANDB_SERVICE" not in os.environ:  # else it belongs to the caller of run.main
            self._package = wandb
        mode = in_threads(lambda module: _start(module, self.folder), [wandb], 1, OPEN_SECONDS)[0]
        if mode == "disabled":
            self.close()
            return False
        self._offline = mode in OFFLINE
        self._sent = wandb_file.read(self.folder)
        wandb_file.write(self.folder, self._sent)  # before the server knows the id

        def start(index: int) -> Any:
            return wandb.init(
                project=project,
                id=f"{self._sent.id}-{index}",
                dir=str(self.folder),
                reinit="create_new",
                resume="allow",
                settings=_settings(wandb, x_disable_stats=index > 0),  # one run shows the machine's load
                **describe(self.folder.name, members[index], index, swept),
            )

        self._runs = in_threads(start, range(len(members)), OPEN_THREADS, OPEN_SECONDS)
        if self._offline:
            self._first = [self._sent.env_steps + 1] * len(members)
            self.where = f"W&B is offline: `wandb sync {self.folder / FOLDER}/offline-run-*` sends the rows later"
        else:
            self._first = [run.starting_step for run in self._runs]
            self.where = f"W&B: the group {self._runs[0].group} of {self._runs[0].project_url}"
            # The server gets the rows from the tables: `wandb sync` would number those of the files again.
            for file in self.folder.glob(f"{FOLDER}/offline-run-*-{self._sent.id}-*/*.wandb"):
                file.with_name(f"{file.name}.synced").touch()
        return True

    def add(self, rows: Sequence[Mapping[str, float]], env_steps: int) -> None:
        """Sends a row per member, unless W&B has it."""
        if not self._runs:
            return

        def send(_: None) -> None:
            for run, first, values in zip(self._runs, self._first, rows, strict=True):
                if env_steps >= first and values:
                    run.log(dict(values), step=env_steps, commit=True)

        try:
            if env_steps > self._sent.env_steps:
                self._sent = self._sent._replace(env_steps=env_steps)
                wandb_file.write(self.folder, self._sent)
            in_threads(send, [None], 1, SEND_SECONDS)
        except Exception as error:
            self._runs = []
            self.warn(f"no more rows for W&B, evaluations.csv has them: {one_line(error)}")

    def close(self, exit_codes: Sequence[int] | None = None) -> None:
        """Ends the members' runs, each with its exit code, by default 1. W&B shows a run as failed unless it is 0."""
        runs, self._runs = self._runs, []
        ends = [(run, exit_codes[index] if exit_codes else FAILED) for index, run in enumerate(runs)]
        seconds = STOP_SECONDS if exit_codes and INTERRUPTED in exit_codes else CLOSE_SECONDS
        try:
            in_threads(lambda end: end[0].finish(exit_code=end[1]), ends, len(ends), seconds)
        except Exception as error:
            self.warn(f"W&B may lack the last rows, evaluations.csv has them: {one_line(error)}")
        package, self._package = self._package, None
        if package:
            try:
                in_threads(lambda module: module.teardown(), [package], 1, STOP_SECONDS)
            except Exception:  # its process ends with this one
                return


def describe(name: str, member: Member, index: int, swept: Sequence[str]) -> dict[str, Any]:
    """The arguments of `wandb.init` that describe a member of the run called `name`."""
    config = member.config
    group = f"{run_config.task_folder(config.env)}/{config.algo}/{name}"
    return {
        "name": run_config.label(member, swept)[:MAX_NAME],
        "group": group[-MAX_NAME:],  # its end has the time
        "job_type": config.algo,
        "tags": [config.algo, config.env[:MAX_TAG]],
        "config": config.flat() | {"seed": member.seed, "member": index},
    }


def _package() -> ModuleType:
    """The package wandb. Raises `Unavailable`."""
    missing = Unavailable("expects the package wandb; pip install 'sqt_jax[wandb]'")
    try:
        import wandb
    except ImportError:
        raise missing from None
    # Without the package, Python imports a folder called wandb here, if there is one, as an empty package.
    if not hasattr(wandb, "init"):
        raise missing
    return wandb


def _start(wandb: ModuleType, folder: Path) -> str:
    """Starts the package's process; returns the mode. Raises `Unavailable` if it would ask for a login."""
    variables = {
        "WANDB_ERROR_REPORTING": "false",  # telemetry, which takes longer than the rows
        "WANDB_CACHE_DIR": str(folder),  # the process's log, else in the home folder
    }
    added = {name: text for name, text in variables.items() if name not in os.environ}
    os.environ.update(added)
    try:
        mode: str = wandb.setup(None if "WANDB_SERVICE" in os.environ else _settings(wandb)).settings.mode
    finally:
        for name in added:
            os.environ.pop(name)
    if mode not in (*OFFLINE, "disabled") and wandb.run is None and not wandb.login(prompt=False, verify=False):
        raise Unavailable("no login; expects `wandb login`, WANDB_API_KEY, or WANDB_MODE=offline")
    return mode


def _settings(wandb: ModuleType, **more: Any) -> Any:
    """`SETTINGS` and `more`, without those that this version of the package does not know."""
    known = wandb.Settings.model_fields
    return wandb.Settings(**{name: value for name, value in (SETTINGS | more).items() if name in known})
