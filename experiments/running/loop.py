"""The host loop: chunks of compiled training between evaluations and checkpoints, and what they report.

Everything the loop needs is a value: the compiled sweep, a display, a function that expects reports, one that expects
checkpoints, one that says whether to stop. It writes no files.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from experiments.running.progress import Display, Status, TimeLeft, time_left
from sqt_jax.config import TrainConfig
from sqt_jax.train import Sweep, TrainState, evaluation_steps, new_interval

# How long one call into the compiled program may take: the display and Ctrl-C wait for it.
CHUNK_SECONDS = 2.0


class Report(NamedTuple):
    """What the loop knows at an evaluation, or where it was stopped; arrays have the members first."""

    env_steps: int
    gradient_steps: int
    wall_seconds: float  # of training and evaluating, those of an earlier process that this one continues included
    metrics: dict[str, np.ndarray]  # name -> [S], of the steps since the last report; empty at step 0
    returns: np.ndarray | None  # [S, episodes]; None where there was no evaluation
    lengths: np.ndarray | None  # [S, episodes]
    bias: dict[str, np.ndarray] = {}  # name -> [S], of `bias.BiasSums`; empty where there was no evaluation


class Position(NamedTuple):
    """Where a run stands: with the training state, all that the loop needs to go on from there."""

    env_steps: int = 0
    evaluated: int = -1  # environment steps of the last evaluation
    diverged: tuple[tuple[int, int], ...] = ()  # (member, environment steps) of those that are known to have
    wall_seconds: float = 0.0


BEGINNING = Position()


class Outcome(NamedTuple):
    state: TrainState
    env_steps: int
    interrupted: bool
    diverged: dict[int, int]  # member -> environment steps
    wall_seconds: float
    train_seconds: float  # of this process, without compilation
    steps_per_second: float | None  # of all members together, without compilation; None before the second chunk


class Pace:
    """How long things take, without compilation: the length of the next chunk and the time left follow from it.

    Warm-up and learning differ in speed and are timed apart, by the key `learn`.
    """

    def __init__(self) -> None:
        self.compiled = False
        self.rates: dict[bool, float] = {}  # lockstep steps per second, lately
        self.steps = 0  # lockstep steps timed so far
        self.train_seconds = 0.0  # that they took
        self.evaluations = 0
        self.evaluate_seconds = 0.0  # of all but the first, which compiles

    def chunk(self, learn: bool, limit: int) -> int:
        """Lockstep steps for the next call: about `CHUNK_SECONDS`, and one where the call has to compile."""
        if not self.compiled:
            return 1
        rate = self.rates.get(learn)
        return min(limit, 10 if rate is None else max(1, int(rate * CHUNK_SECONDS)))

    def advanced(self, learn: bool, steps: int, seconds: float) -> None:
        if self.compiled:
            rate = steps / max(seconds, 1e-9)
            self.rates[learn] = 0.7 * self.rates.get(learn, rate) + 0.3 * rate  # steady enough to be read
            self.steps += steps
            self.train_seconds += seconds
        self.compiled = True

    def evaluated(self, seconds: float) -> None:
        if self.evaluations:
            self.evaluate_seconds += seconds
        self.evaluations += 1

    def time_left(self, done: int, evaluated: int, train: TrainConfig) -> TimeLeft | None:
        warmup_left = max(0, min(train.warmup_steps, train.steps) - done)
        return time_left(
            steps_left={False: warmup_left, True: train.steps - done - warmup_left},
            steps_per_second={learn: rate * train.num_envs for learn, rate in self.rates.items()},
            evaluations_left=sum(step > evaluated for step in evaluation_steps(train)),
            seconds_per_evaluation=self.evaluate_seconds / (self.evaluations - 1) if self.evaluations > 1 else None,
        )


def checkpoint_steps(every: int, start: int, end: int) -> list[int]:
    """Environment steps after `start` at which a checkpoint is due: multiples of `every`, and the end."""
    return [*range((start // every + 1) * every, end, every), end] if every and start < end else []


def train_loop(
    sweep: Sweep,
    state: TrainState,
    train: TrainConfig,
    num_members: int,
    *,
    report: Callable[[Report], None],
    display: Display,
    stop: Callable[[], bool],
    start: Position = BEGINNING,
    checkpoint_every: int = 0,
    save: Callable[[TrainState, Position], None] = lambda state, position: None,
    clock: Callable[[], float] = time.monotonic,
) -> Outcome:
    """Train `state`, which stands at `start`, to `train.steps`: evaluations at step 0, every `eval_every` and the end.

    Advances in chunks that end at evaluations, checkpoints and the end of the warm-up. `save` is called every
    `checkpoint_every` environment steps and at the end (0: never), after an evaluation's report. `stop` is asked
    between chunks; once it says True, the state is saved, what there is is reported and the loop returns. Of a state
    with more than `num_members`, the first ones count (`sqt_jax.members`).
    """
    began = clock() - start.wall_seconds
    pace = Pace()
    diverged = dict(start.diverged)
    done, evaluated, reported = start.env_steps, start.evaluated, max(start.evaluated, 0)
    interrupted = False
    last_return: float | None = None

    def of_members(leaf: jax.Array) -> np.ndarray:
        return np.asarray(leaf)[:num_members]

    def show(phase: str, learn: bool) -> None:
        rate = pace.rates[learn] * train.num_envs * num_members if learn in pace.rates else None
        display.update(Status(phase, done, rate, pace.time_left(done, evaluated, train), last_return))

    def evaluate_and_report() -> None:
        nonlocal last_return, evaluated
        show("evaluating" if pace.evaluations else "compiling the evaluation", done >= train.warmup_steps)
        before = clock()
        evaluation, bias = sweep.evaluate(state)
        returns, lengths = of_members(evaluation.returns), of_members(evaluation.lengths)
        pace.evaluated(clock() - before)
        bad = find_diverged(returns)
        # The return of the policy that a diverged member is frozen at is not what its algorithm reaches at this step.
        returns = np.where(bad[:, None], np.nan, returns)
        if not bad.all():
            last_return = float(np.nanmean(returns))
        send(returns, lengths, {name: np.where(bad, np.nan, of_members(value)) for name, value in bias.items()})
        evaluated = done
        display.evaluated(done, returns[~bad].mean(axis=1))

    def find_diverged(returns: np.ndarray | None) -> np.ndarray:
        """[S] bool; members that were not known to be are announced."""
        since = of_members(state.diverged_at)
        if returns is not None:  # an environment whose rewards are not finite
            since = np.where((since < 0) & ~np.isfinite(returns).all(axis=1), done, since)
        for member in (int(index) for index in np.flatnonzero(since >= 0)):
            if member not in diverged:
                diverged[member] = int(since[member])
                step = f"step {diverged[member]:,}"
                display.message(f"member {member} diverged at {step}: it stays as it was before, the others go on")
        return np.isin(np.arange(num_members), list(diverged))

    def send(returns: np.ndarray | None, lengths: np.ndarray | None, bias: dict[str, np.ndarray]) -> None:
        """What the state tells of the interval; nothing before the first step."""
        metrics = {name: of_members(value) for name, value in sweep.measure(state).items()} if done else {}
        report(Report(done, int(state.gradient_steps), clock() - began, metrics, returns, lengths, bias))

    def save_here() -> None:
        if checkpoint_every:
            show("saving", done >= train.warmup_steps)
            save(state, Position(done, evaluated, tuple(diverged.items()), clock() - began))

    evaluations = {step for step in evaluation_steps(train) if step > evaluated}
    checkpoints = set(checkpoint_steps(checkpoint_every, done, train.steps))
    if checkpoint_every and evaluations:  # also where the last one alone is left
        checkpoints.add(train.steps)
    for point in sorted(evaluations | checkpoints):
        while done < point and not stop():
            learn = done >= train.warmup_steps
            end = point if learn else min(point, train.warmup_steps)
            steps = pace.chunk(learn, (end - done) // train.num_envs)
            show(("training" if learn else "warm-up") if pace.compiled else "compiling the training", learn)
            before = clock()
            state = sweep.advance(state, steps, learn)
            jax.block_until_ready(state.env_steps)
            pace.advanced(learn, steps, clock() - before)
            done += steps * train.num_envs
            find_diverged(None)
        if stop():
            interrupted = True
            save_here()
            if done > reported:
                send(None, None, {})
            break
        if point in evaluations:
            evaluate_and_report()
            reported = done
            state = new_interval(state)
        if point in checkpoints:
            save_here()

    timed = pace.steps * train.num_envs * num_members
    rate = timed / pace.train_seconds if pace.train_seconds else None
    return Outcome(state, done, interrupted, diverged, clock() - began, pace.train_seconds, rate)
