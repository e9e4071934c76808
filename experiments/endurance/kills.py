"""Kills trainings at random moments, resumes them, and compares the results with a training without a break."""

import random
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from experiments.endurance import training_process
from experiments.endurance.run_results import differences, read_results
from experiments.endurance.training_process import Job, last_line, wait_for_tables


class Reference(NamedTuple):
    """A training without a break."""

    results: dict[str, Any]
    seconds: float  # from its first table to its end
    file_events: int  # in the run's folder


def train_reference(task: str, algo: str, folder: Path) -> Reference:
    """Trains twice without a break. The second time compiled programs come from the cache, as after a kill.

    Raises:
      RuntimeError: a training fails, or the two differ.
    """
    first, second = (_train_without_break(Job(task, algo, folder.with_name(f"{folder.name}_{i}"))) for i in (1, 2))
    wrong = differences(first.results, second.results)
    if wrong:
        raise RuntimeError(f"{task} {algo}: the same command twice differs in {', '.join(sorted(wrong))}")
    return second


def _train_without_break(job: Job) -> Reference:
    counted = job.folder / "events.txt"
    job.folder.mkdir()
    process = training_process.start(job, count_into=counted)
    wait_for_tables(process, job)
    began = time.monotonic()
    code = training_process.finish(process)
    if code:
        raise RuntimeError(f"{job.task}: training without a break ends with {code}: {last_line(job)}")
    return Reference(read_results(job.path), time.monotonic() - began, int(counted.read_text()))


def kill_and_resume(task: str, algo: str, folder: Path, reference: Reference, number: int) -> str:
    """Kills a training, one in five twice, resumes it, and returns a line of text about it.

    Args:
      number: seeds the random choice of the moment.

    Raises:
      RuntimeError: the run could not be resumed, or its results are not those of the reference.
    """
    chance = random.Random(number)
    job = Job(task, algo, folder)
    folder.mkdir()
    kills = [_kill(job, chance, reference)]
    if chance.random() < 0.2:
        kills.append(_kill_once(job, chance.random() < 0.5, chance.random(), reference) or "not again (it had ended)")
    text = ", then ".join(kills)
    steps = sorted((job.path / "checkpoint").glob("step_*")) if (job.path / "checkpoint").exists() else []
    last = f"step {int(steps[-1].name[5:15])}" if steps else "none"
    code = training_process.finish(training_process.start(job))
    if code:
        raise RuntimeError(f"kill {number} ({text}): resuming ends with {code}: {last_line(job)}")
    wrong = differences(reference.results, read_results(job.path))
    if wrong:
        raise RuntimeError(f"kill {number} ({text}): these differ: {', '.join(sorted(wrong))}")
    shutil.rmtree(folder)
    return f"{task} {algo}: killed {text}; last checkpoint {last}; resumed, identical"


def _kill(job: Job, chance: random.Random, reference: Reference) -> str:
    """Kills a training and returns when. If it ended first, another one is killed earlier."""
    at_event, share = chance.random() < 0.5, chance.random()
    while not (when := _kill_once(job, at_event, share, reference)):
        shutil.rmtree(job.path)
        share *= 0.7
    return when


def _kill_once(job: Job, at_event: bool, share: float, reference: Reference) -> str | None:
    """Kills one process and returns when, as text; None if it ended first.

    Args:
      at_event: at a file event, in the middle of writing; else after a time.
      share: of the reference's file events or seconds, from 0 to 1.

    Raises:
      RuntimeError: the process ended in another way.
    """
    if at_event:
        event = 1 + int(share * reference.file_events)
        process, when = training_process.start(job, die_at=event), f"at file event {event}"
    else:
        process, seconds = training_process.start(job), share * reference.seconds
        wait_for_tables(process, job)
        process.join(seconds)
        process.kill()
        when = f"after {seconds:.2f} s"
    code = training_process.finish(process)
    if code not in (0, -signal.SIGKILL):
        raise RuntimeError(f"training ends with {code}: {last_line(job)}")
    return when if code else None


def run_kill_test(
    cases: Sequence[tuple[str, str]], kills: int, jobs: int, folder: Path, say: Callable[[str], None]
) -> int:
    """Kills `kills` trainings, spread evenly over the cases; returns how many failed.

    Args:
      cases: (task, algorithm).
      jobs: trainings at the same time.
      say: called with each line to print.
    """
    began, failures, done = time.monotonic(), 0, 0
    with ThreadPoolExecutor(jobs) as pool:
        for index, (task, algo) in enumerate(cases):
            place = folder / f"{task}_{algo}"
            place.mkdir()
            reference = train_reference(task, algo, place / "reference")
            say(f"{task} {algo}: without a break {reference.seconds:.1f} s, {reference.file_events} file events")
            share = kills // len(cases) + (index < kills % len(cases))
            numbers = [1000 * index + number for number in range(share)]
            attempts = [
                pool.submit(kill_and_resume, task, algo, place / f"kill_{number}", reference, number)
                for number in numbers
            ]
            for attempt in attempts:
                done += 1
                left = (time.monotonic() - began) / done * (kills - done)
                try:
                    line = attempt.result()
                except (RuntimeError, TimeoutError) as error:
                    failures += 1
                    line = f"FAILED {task} {algo}: {error}"
                say(f"{done}/{kills} ({left:.0f} s left) {line}")
    say(f"{kills} kills, {kills - failures} resumed to the identical end, {failures} failed")
    return failures
