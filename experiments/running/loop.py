"""The host loop: compiled training in chunks, with evaluations, checkpoints and reports in between.

The loop writes no files. The compiled sweep, the display, and the functions that write reports, keep the best policies,
write checkpoints and ask whether to stop are its arguments.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from experiments.running.progress import Display, Status, TimeLeft, time_left
from sqt_jax.config import TrainConfig
from sqt_jax.train import Sweep, TrainState, evaluation_steps, new_interval

# Length of one call into the compiled program; the display and Ctrl-C wait for it.
CHUNK_SECONDS = 2.0


class Report(NamedTuple):
    """Results at an evaluation, or at the step where the loop was stopped. The first axis of arrays is the member."""

    env_steps: int
    gradient_steps: int
    wall_seconds: float  # since the run's start, without the time between processes
    metrics: dict[str, np.ndarray]  # name -> [S], over the steps since the last report; empty at step 0
    returns: np.ndarray | None  # [S, episodes]; None without an evaluation
    lengths: np.ndarray | None  # [S, episodes]
    bias: dict[str, np.ndarray] = {}  # name of `sqt_jax.bias.NAMES` -> [S]; empty without an evaluation


class Position(NamedTuple):
    """How far a run is. With the training state, this is all that the loop needs to resume."""

    env_steps: int = 0
    evaluated: int = -1  # environment steps of the last evaluation
    diverged: tuple[tuple[int, int], ...] = ()  # (member, environment steps)
    wall_seconds: float = 0.0


START = Position()


class Outcome(NamedTuple):
    state: TrainState
    env_steps: int
    interrupted: bool  # by a signal, or by an environment that failed
    diverged: dict[int, int]  # member -> environment steps
    wall_seconds: float
    train_seconds: float  # of this process, without compilation
    steps_per_second: float | None  # of all members together, without compilation; None before the second chunk


class Pace:
    """Measures speed, without compilation, to choose the length of the next chunk and to estimate the time left.

    Warm-up and learning differ in speed and are timed separately, by the key `learn`.
    """

    def __init__(self) -> None:
        self.compiled: set[bool] = set()  # the programs that have run: warm-up, training
        self.rates: dict[bool, float] = {}  # lockstep steps per second, running mean
        self.steps = 0  # lockstep steps timed so far
        self.train_seconds = 0.0  # for these steps
        self.evaluations = 0
        self.evaluate_seconds = 0.0  # of all except the first, which compiles

    def chunk(self, learn: bool, limit: int) -> int:
        """Lockstep steps of the next call: about `CHUNK_SECONDS`; one if the call has to compile."""
        if learn not in self.compiled:
            return 1
        rate = self.rates.get(learn)
        return min(limit, 10 if rate is None else max(1, int(rate * CHUNK_SECONDS)))

    def advanced(self, learn: bool, steps: int, seconds: float) -> None:
        if learn in self.compiled:
            rate = steps / max(seconds, 1e-9)
            self.rates[learn] = 0.7 * self.rates.get(learn, rate) + 0.3 * rate  # smooth enough to read
            self.steps += steps
            self.train_seconds += seconds
        self.compiled.add(learn)

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
    failed: Callable[[], bool] = lambda: False,
    keeps_failed: bool = True,
    start: Position = START,
    checkpoint_every: int = 0,
    save: Callable[[TrainState, Position], None] = lambda state, position: None,
    evaluated_at: Callable[[TrainState, int, np.ndarray], None] = lambda state, env_steps, returns: None,
    clock: Callable[[], float] = time.monotonic,
) -> Outcome:
    """Trains to `train.steps`, with evaluations at step 0, every `eval_every` steps and the end.

    Args:
      state: the training state at `start`. Only its first `num_members` members count; the rest is padding.
      report: called after each evaluation and, if there are steps since the last report, when stopped.
      stop: asked between chunks. Once it returns True, the state is saved and the loop returns.
      failed: the same, asked whether an environment on the host has failed. The state is then that before the step
        that failed; an evaluation that failed is not reported.
      keeps_failed: whether that state is reported and saved. On several devices members stop at different steps.
      checkpoint_every: environment steps between calls of `save`, which is also called at the end; 0: never.
      save: called after the report of an evaluation at the same step.
      evaluated_at: called after each evaluation with the state, its env steps, and the members' returns [S, episodes],
        which are NaN for members that have diverged.
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
        display.update(
            Status(
                phase=phase,
                env_steps=done,
                steps_per_second=rate,
                left=pace.time_left(done, evaluated, train),
                last_return=last_return,
            )
        )

    def over() -> bool:
        return stop() or failed()

    def evaluate_and_report() -> None:
        nonlocal last_return, evaluated
        show("evaluating" if pace.evaluations else "compiling the evaluation", done >= train.warmup_steps)
        before = clock()
        evaluation, bias = jax.block_until_ready(sweep.evaluate(state))
        if failed():
            return
        returns, lengths, speeds = (of_members(leaf) for leaf in evaluation)
        pace.evaluated(clock() - before)
        bad = find_diverged(returns)
        # A diverged member is frozen: its return is not a result of the algorithm at this step.
        returns = np.where(bad[:, None], np.nan, returns)
        if not bad.all():
            last_return = float(np.nanmean(returns))
        evaluated_at(state, done, returns)
        send(returns, lengths, {name: np.where(bad, np.nan, of_members(value)) for name, value in bias.items()})
        evaluated = done
        display.evaluated(done, returns[~bad], lengths[~bad], speeds[~bad])

    def find_diverged(returns: np.ndarray | None) -> np.ndarray:
        """Which members have diverged, [S] bool; prints a message for each new one."""
        since = of_members(state.diverged_at)
        if returns is not None:  # the environment's rewards may not be finite
            since = np.where((since < 0) & ~np.isfinite(returns).all(axis=1), done, since)
        for member in (int(index) for index in np.flatnonzero(since >= 0)):
            if member not in diverged:
                diverged[member] = int(since[member])
                step = f"step {diverged[member]:,}"
                display.message(
                    f"member {member} diverged at {step}: it is frozen at its last valid state; the others continue"
                )
        return np.isin(np.arange(num_members), list(diverged))

    def send(returns: np.ndarray | None, lengths: np.ndarray | None, bias: dict[str, np.ndarray]) -> None:
        """Reports the interval since the last evaluation, which has no metrics before the first step."""
        metrics = {name: of_members(value) for name, value in sweep.measure(state).items()} if done else {}
        report(
            Report(
                env_steps=done,
                gradient_steps=int(state.gradient_steps),
                wall_seconds=clock() - began,
                metrics=metrics,
                returns=returns,
                lengths=lengths,
                bias=bias,
            )
        )

    def save_here() -> None:
        if checkpoint_every:
            show("saving", done >= train.warmup_steps)
            position = Position(
                env_steps=done,
                evaluated=evaluated,
                diverged=tuple(diverged.items()),
                wall_seconds=clock() - began,
            )
            save(state, position)

    evaluations = {step for step in evaluation_steps(train) if step > evaluated}
    checkpoints = set(checkpoint_steps(checkpoint_every, done, train.steps))
    if checkpoint_every and evaluations:  # also if the last evaluation is all that is left
        checkpoints.add(train.steps)
    for point in sorted(evaluations | checkpoints):
        while done < point and not over():
            learn = done >= train.warmup_steps
            end = point if learn else min(point, train.warmup_steps)
            steps = pace.chunk(learn, (end - done) // train.num_envs)
            phase = "training" if learn else "warm-up"
            show(phase if learn in pace.compiled else f"compiling the {phase}", learn)
            before = clock()
            state = sweep.advance(state, steps, learn)
            jax.block_until_ready(state.env_steps)
            pace.advanced(learn, steps, clock() - before)
            if not failed():
                done += steps * train.num_envs
            elif keeps_failed:
                done = int(state.env_steps)
            find_diverged(None)
        interrupted = over()
        if point in evaluations and not interrupted:
            evaluate_and_report()
            interrupted = failed()
        if interrupted:
            if keeps_failed or not failed():
                save_here()
                if done > reported:
                    send(None, None, {})
            break
        if point in evaluations:
            reported = done
            state = new_interval(state)
        if point in checkpoints:
            save_here()

    timed = pace.steps * train.num_envs * num_members
    rate = timed / pace.train_seconds if pace.train_seconds else None
    return Outcome(
        state=state,
        env_steps=done,
        interrupted=interrupted,
        diverged=diverged,
        wall_seconds=clock() - began,
        train_seconds=pace.train_seconds,
        steps_per_second=rate,
    )
