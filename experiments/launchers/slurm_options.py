"""The options of --launcher=slurm: `--slurm=partition=gpu,gpus_per_node=1,time=04:00:00`."""

import re
from pathlib import Path
from typing import NamedTuple

from experiments.commandline.arguments import UsageError

EXAMPLE = "NAME=VALUE,... as in partition=gpu,gpus_per_node=1,time=04:00:00"
SAVE_SECONDS = 300
MAX_CHARACTERS = 10_000
MAX_SETUP_BYTES = 1_000_000
# A comma that begins the next `name=`: values may have commas, as nodelist=n[1-2,4],n7.
SEPARATOR = re.compile(r",(?=[A-Za-z][\w-]*=)", re.ASCII)
NAME = re.compile(r"[a-z][a-z0-9_]*", re.ASCII)
LAUNCHERS_OWN = frozenset(
    ("array", "chdir", "clusters", "error", "job_name", "no_requeue", "open_mode", "output", "parsable", "requeue")
    + ("signal", "test_only", "wait", "wrap")
)
ONE_PROCESS = frozenset(
    ("nodes", "ntasks", "ntasks_per_core", "ntasks_per_gpu", "ntasks_per_node", "ntasks_per_socket")
)
# The forms of sbatch's --time; a lone number is minutes.
TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<first>\d+)(?::(?P<second>\d+))?(?::(?P<third>\d+))?", re.ASCII)


class Options(NamedTuple):
    """What `sbatch` gets."""

    sbatch: dict[str, str | bool]  # its options by name with underscores; True: an option without a value
    save_seconds: int  # how long before the time limit SLURM warns, so that the run saves
    setup: tuple[str, ...]  # shell lines that run first


def parse(text: str, setup_file: str | None = None) -> Options:
    """The options of `--slurm` and the lines of `--slurm_setup`.

    Raises:
      UsageError: an option is not of the form NAME=VALUE, given twice or the launcher's own, or the file is unreadable.
    """
    given: dict[str, str] = {}
    for part in SEPARATOR.split(text) if text else []:
        name, equals, value = part.partition("=")
        name = name.strip().replace("-", "_")
        if not equals or not value or not NAME.fullmatch(name) or not text.isprintable() or len(text) > MAX_CHARACTERS:
            raise UsageError(f"--slurm: expects {EXAMPLE}, not {part[:100]!r}")
        if name in given:
            raise UsageError(f"--slurm: expects each option once, not {name} twice")
        if name in LAUNCHERS_OWN:
            raise UsageError(f"--slurm={name}: is set by the launcher; expects other options of sbatch")
        if name in ONE_PROCESS:
            raise UsageError(f"--slurm={name}: has no effect, as a run is one process; expects cpus_per_task or GPUs")
        given[name] = value
    save_seconds = _save_seconds(given.pop("save_seconds", None), given.get("time"))
    sbatch: dict[str, str | bool] = {name: value == "true" or value for name, value in given.items()}
    return Options(sbatch, save_seconds, _setup_lines(setup_file))


def _save_seconds(text: str | None, time: str | None) -> int:
    """Seconds before the time limit at which SLURM warns."""
    limit = seconds(time) if time else None
    if text is None:
        return SAVE_SECONDS if limit is None else min(SAVE_SECONDS, limit // 2)
    if not (text.isascii() and text.isdecimal() and len(text) < 6 and 0 < int(text) <= 65535):  # SLURM's own limit
        raise UsageError(f"--slurm=save_seconds: expects a whole number of seconds from 1 to 65535, not {text[:50]!r}")
    if limit is not None and int(text) >= limit:
        raise UsageError(f"--slurm=save_seconds={text}: expects less than the time limit, {limit} seconds")
    return int(text)


def seconds(text: str) -> int | None:
    """A time in one of sbatch's forms, as 30, 30:00, 4:00:00, 1-12 or 1-12:00:00; None: no limit, or not a time."""
    match = TIME.fullmatch(text)
    return _seconds(match) or None if match else None


def _seconds(match: re.Match[str]) -> int:
    parts = [int(part) for part in match.group("first", "second", "third") if part is not None]
    if match["days"] is not None:
        hours, minutes, rest = [*parts, 0, 0][:3]
        return ((int(match["days"]) * 24 + hours) * 60 + minutes) * 60 + rest
    if len(parts) == 3:
        return (parts[0] * 60 + parts[1]) * 60 + parts[2]
    return parts[0] * 60 + (parts[1] if len(parts) == 2 else 0)


def _setup_lines(file: str | None) -> tuple[str, ...]:
    if file is None:
        return ()
    try:
        with Path(file).open("rb") as opened:
            content = opened.read(MAX_SETUP_BYTES + 1)
        if len(content) > MAX_SETUP_BYTES or b"\0" in content:
            raise ValueError
        return tuple(content.decode().splitlines())
    except OSError as error:
        raise UsageError(f"--slurm_setup={file}: expects a file of shell lines: {error.strerror}") from None
    except ValueError:
        raise UsageError(f"--slurm_setup={file}: expects a file of shell lines") from None
