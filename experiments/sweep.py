"""The paper's experiments, run after run: `python -m experiments.sweep --preset=table2 --steps=1000000`.

A cell is one run of `experiments.run`: an algorithm on a task, all seeds at once. Cells that are finished are left
alone and those that were interrupted are gone on with, so that the same command may be given again and again. The runs
of all presets have the same names: what one has trained, another finds.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from absl import app
from absl import flags as absl_flags

from experiments.evidence.published import PAPERS_TASKS
from experiments.running.progress import format_seconds
from sqt_jax.suggestions import expects_one_of

BASES = ("td3", "sac", "td7")
DONE, FAILED, BAD_USAGE, DIVERGED, INTERRUPTED = 0, 1, 2, 3, 130
MAX_NAME = 200


class Preset(NamedTuple):
    """A grid of runs."""

    algos: tuple[str, ...]
    tasks: tuple[str, ...] = PAPERS_TASKS
    settings: tuple[str, ...] = ()  # further flags of each run


WITH_SQT = tuple(name for base in BASES for name in (base, f"{base}_sqt"))
PRESETS = {
    "table2": Preset(WITH_SQT),
    "table3": Preset(WITH_SQT),  # another figure of the same runs
    "table4": Preset(tuple(name for base in BASES for name in (f"{base}_sqt", f"{base}_sqt_tuple"))),
    "all": Preset(tuple(name for base in BASES for name in (base, f"{base}_sqt", f"{base}_sqt_tuple"))),
    "alpha": Preset(("td3_sqt",), ("cheetah",), ("--penalty_coef=0,0.1,0.25,0.5,1",)),
}


class Cell(NamedTuple):
    task: str
    algo: str
    path: Path
    command: tuple[str, ...]  # arguments of experiments.run


def cells(preset: Preset, algos: Sequence[str], tasks: Sequence[str], out: Path, rest: Sequence[str]) -> list[Cell]:
    """The grid, a task after the other; `rest` are flags for every run."""
    found = []
    for task in tasks or preset.tasks:
        for algo in algos or preset.algos:
            flags = (*preset.settings, *rest)
            name = name_of(flags)
            command = (f"--algo={algo}", f"--env={task}", f"--out={out}", f"--name={name}", "--resume", *flags)
            found.append(Cell(task, algo, out / task / algo / name, command))
    return found


def name_of(flags: Sequence[str]) -> str:
    """A run's name, by its flags: a finished run is known by it. Where they do not all find room, with their hash."""
    name = "_".join(word.lstrip("-").replace("/", "-") for word in sorted(flags)) or "default"
    if len(name) <= MAX_NAME:
        return name
    digest = hashlib.sha256(os.fsencode("\n".join(sorted(flags))))
    return f"{name[: MAX_NAME - 13]}_{digest.hexdigest()[:12]}"


def finished(cell: Cell) -> dict[str, Any] | None:
    """The summary of a cell's run, if that has ended."""
    try:
        summary = json.loads((cell.path / "summary.json").read_text())
        return summary if summary["status"] in ("done", "diverged") else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def to_do(cell: Cell) -> bool:
    """Whether a cell is to be trained: not finished, or with a file of settings, which only the run itself compares."""
    return any(word.startswith("--config=") for word in cell.command) or not finished(cell)


def run_in_a_process(cell: Cell) -> int:
    """Trains a cell; what it shows goes to `log.txt` beside the runs of its algorithm, its errors to stderr."""
    cell.path.parent.mkdir(parents=True, exist_ok=True)
    with (cell.path.parent / f"{cell.path.name[:100]}.log.txt").open("a") as log:
        command = [sys.executable, "-m", "experiments.run", *cell.command]
        process: subprocess.Popen[str] | None = None
        stopped = False

        def pass_on(number: int, _: FrameType | None) -> None:
            nonlocal stopped
            stopped = True
            if process:
                process.send_signal(number)

        before = signal.signal(signal.SIGTERM, pass_on)
        try:
            process = subprocess.Popen(command, stdout=log, stderr=subprocess.PIPE, text=True)
            if stopped:  # before there was a process
                process.terminate()
            while True:
                try:
                    _, errors = process.communicate()
                    break
                except KeyboardInterrupt:  # the run has got it too, and saves
                    stopped = True
        finally:
            signal.signal(signal.SIGTERM, before)
    code = process.returncode
    if stopped and code not in (FAILED, BAD_USAGE):  # also where the run had just ended, or just begun
        return INTERRUPTED
    if code not in (DONE, DIVERGED, INTERRUPTED) and errors.strip():
        print(errors.strip(), file=sys.stderr)
    return code


def sweep(
    grid: Sequence[Cell],
    train: Callable[[Cell], int],
    say: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> int:
    """Trains what is not finished; the exit code: of the first cell that could not be trained, or the worst."""
    todo = [cell for cell in grid if to_do(cell)]
    say(f"{len(grid)} runs, {len(grid) - len(todo)} of them finished")
    began, worst = clock(), DONE
    for number, cell in enumerate(todo, start=1):
        started = clock()
        code = train(cell)
        if code not in (DONE, DIVERGED):
            on = "" if code == BAD_USAGE else "; the same command goes on from there"
            say(f"{cell.algo} on {cell.task}: ended with exit code {code}{on}")
            return code
        worst = max(worst, code)
        left = (clock() - began) / number * (len(todo) - number)
        say(
            f"{number}/{len(todo)} {cell.algo} on {cell.task}: {told(finished(cell))} in "
            f"{format_seconds(clock() - started)}; {format_seconds(left)} left"
        )
    return worst


def told(summary: dict[str, Any] | None) -> str:
    """A run's scores, in a few words."""
    if summary is None:
        return "no summary"
    scores = [group["score"] for group in summary["groups"]]
    parts = ["nothing" if s["mean"] is None else f"{s['mean']:,.0f} +- {s['std']:,.0f}" for s in scores]
    lost = len(summary["diverged"])
    return f"score {', '.join(parts)}" + (f" ({lost} diverged)" if lost else "")


FLAGS = absl_flags.FLAGS


def main(argv: Sequence[str]) -> int:
    from sqt_jax import envs
    from sqt_jax.algorithms import ALGORITHMS

    if FLAGS.preset is None:
        return refuse(f"--preset: expects one of {', '.join(PRESETS)}")
    if FLAGS.preset not in PRESETS:
        return refuse(f"--preset: {expects_one_of(str(FLAGS.preset), PRESETS)}")
    for algo in FLAGS.algos:
        if algo not in ALGORITHMS:
            return refuse(f"--algos: {expects_one_of(algo, ALGORITHMS)}")
    try:
        tasks = [envs.resolve(task) for task in FLAGS.tasks]
    except ValueError as error:
        return refuse(f"--tasks: {error}")
    own = ("algo", "env", "out", "name", "resume", "overwrite")
    for word in argv[1:]:
        if not word.startswith("--") or word.lstrip("-").split("=")[0] in own:
            return refuse(
                f"{word}: expects flags of experiments.run in the form --flag=value, but for --{', --'.join(own)}"
            )
    grid = cells(PRESETS[FLAGS.preset], FLAGS.algos, tasks, Path(FLAGS.out), argv[1:])
    return sweep(grid, run_in_a_process, lambda line: print(line, flush=True))


def refuse(line: str) -> int:
    print(line, file=sys.stderr)
    return BAD_USAGE


if __name__ == "__main__":
    absl_flags.DEFINE_string("preset", None, f"What to run: {', '.join(PRESETS)}.")
    absl_flags.DEFINE_list("algos", [], "Algorithms, if not the preset's.")
    absl_flags.DEFINE_list("tasks", [], "Tasks, if not the preset's.")
    absl_flags.DEFINE_string("out", "runs", "Results go to OUT/TASK/ALGO/NAME/.")
    # This command's own flags are taken out; what is left goes to every run.
    app.run(main, flags_parser=lambda argv: FLAGS(argv, known_only=True))
