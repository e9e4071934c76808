"""Train one sweep and record it: `python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4`.

Exit codes: 0 done; 1 the results could not be written; 2 bad usage (one line, nothing written); 3 a member diverged;
130 interrupted.
"""

import math
import os
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from rich.console import Console

from experiments.commandline import flag_table, flags
from experiments.commandline.arguments import UsageError, printable
from experiments.running import progress, runtime
from experiments.running.loop import BEGINNING, Outcome, Position, train_loop
from sqt_jax.algorithms import agent_of, make_trainer, replay_of
from sqt_jax.policy import save_policy
from sqt_jax.train import Sweep, TrainState, evaluation_steps, make_sweep
from sqt_jax.types import Array, Environment, Scalars

# `plan`, `records` and `figures` bring SciPy, TensorBoard and matplotlib, as much to import as all the rest: they are
# imported where they are used, so that a typing error is answered in a second.
if TYPE_CHECKING:
    from experiments.running.checkpoints import Checkpoints, Restored
    from experiments.running.plan import Plan
    from experiments.running.records import Records
    from experiments.running.run_config import Described

DONE, FAILED, BAD_USAGE, DIVERGED, INTERRUPTED = 0, 1, 2, 3, 130


def run(plan: "Plan", command: Sequence[str]) -> int:
    """Trains and records; the exit code."""
    from experiments.running import checkpoints

    console = Console()
    with ExitStack() as stack:
        _lock(plan, stack)
        display = stack.enter_context(progress.Display(console, plan.train.steps, quiet=plan.options.quiet))
        stop = stack.enter_context(_stop_on_signal())
        trainer = make_trainer(plan.config, plan.own_env)
        sweep = make_sweep(trainer, plan.layout)
        template = jax.eval_shape(make_sweep(trainer).init, *_start(plan))
        folder, replay = plan.path / "checkpoint", replay_of(plan.config, plan.env)
        store = checkpoints.Checkpoints(folder, replay, plan.layout, plan.output["keep_checkpoints"], display.message)
        stack.callback(store.wait)
        restored = _restored(plan, store, template)
        # A new folder is a run, which can be gone on with, before it is anything else; an old one stays as it is until
        # it is known that it can be gone on with.
        if not plan.resumed:
            _claim(plan, command)
        elif restored and _is_finished(plan, restored):
            if not plan.options.quiet:
                console.print(f"{plan.path} is finished", soft_wrap=True, highlight=False, markup=False)
            return DIVERGED if restored.position.diverged else DONE
        tables = stack.enter_context(_tables(plan, restored, display.message))
        if plan.resumed:
            _go_on(plan, plan.resumed, restored, command)
            store.remove_others()
        if not plan.options.quiet:
            _announce(console, plan, restored, store.sizes(template))
        outcome = _train(plan, sweep, restored, tables, store, display, lambda: bool(stop))
        try:
            curves = _results(plan, outcome)
            summary = tables.summary(outcome)  # the last file: it says that the run has ended
        except OSError as error:
            print(printable(f"the results cannot be written: {error}"), file=sys.stderr)
            return FAILED

    if not plan.options.quiet:
        console.print(progress.final_table(summary, tables.swept))
        rate = "" if outcome.steps_per_second is None else f", {outcome.steps_per_second:,.0f} training steps/s"
        console.print(
            f"{summary['status']} after {progress.format_seconds(outcome.wall_seconds)}{rate}", highlight=False
        )
        if curves:
            console.print(f"curves: {plan.path / 'curves.png'}", soft_wrap=True, highlight=False, markup=False)
        if outcome.interrupted and plan.output["checkpoint_every"]:
            command_line = f"python -m experiments.run --resume={shlex.quote(str(plan.path))}"
            console.print(f"to go on with it: {command_line}", soft_wrap=True, highlight=False, markup=False)
    return INTERRUPTED if outcome.interrupted else DIVERGED if outcome.diverged else DONE


def _lock(plan: "Plan", stack: ExitStack) -> None:
    """Makes the run's folder this process's own, until the stack is left."""
    from experiments.running import files

    try:
        stack.enter_context(files.locked(plan.path))
    except files.Busy as busy:
        flag = f"--resume={plan.path}" if plan.resumed else f"--name={plan.path.name}"
        raise UsageError(f"{flag}: process {busy.process} is at work on {plan.path}; expects another run") from None
    except OSError as error:
        raise _cannot_write(plan, error) from None


def _cannot_write(plan: "Plan", error: OSError) -> UsageError:
    flag = f"--resume={plan.path}" if plan.resumed else f"--out={plan.options.out}"
    return UsageError(f"{flag}: expects a folder that can be written: {error}")


def _start(plan: "Plan") -> tuple[Array, Scalars]:
    """The members' keys [S] and scalars [S]."""
    seeds = jnp.array([member.seed for member in plan.members], jnp.uint32)
    agents = [member.config.agent for member in plan.members]
    scalars = (jnp.array([getattr(agent, name) for agent in agents], jnp.float32) for name in Scalars._fields)
    return jax.vmap(jax.random.key)(seeds), Scalars(*scalars)


def _restored(plan: "Plan", store: "Checkpoints", template: TrainState) -> "Restored | None":
    """Where the resumed run goes on; None is from the start."""
    from experiments.running import manifests

    if not plan.resumed:
        return None
    try:
        restored = store.restore(template)
    except manifests.Refused as error:
        raise UsageError(f"--resume={plan.path}: expects a run with checkpoints to go on from; {error}") from None
    if restored is None:
        _refuse_to_begin_again(plan.path, plan.resumed.content["output"].get("checkpoint_every"))
    return restored


def _refuse_to_begin_again(path: Path, checkpoint_every: object) -> None:
    """Where there is more to lose than what a run writes before its first checkpoint, and would write again."""
    refusal = f"--resume={path}: expects a run with checkpoints to go on from; it has none"
    if checkpoint_every == 0 or (path / "summary.json").exists():
        raise UsageError(refusal)
    # The first checkpoint is on disk when the second one is due.
    reached = _reached(path)
    if isinstance(checkpoint_every, int) and reached > 2 * checkpoint_every:
        raise UsageError(f"{refusal}, and its evaluations reach step {reached:,}; remove the folder to begin anew")


def _reached(path: Path) -> int:
    """The env steps of the last row of evaluations.csv; 0 where there is none."""
    from experiments.running import records

    try:
        return int(max(records.read_evaluations(path / "evaluations.csv")["env_steps"], default=0))
    except (OSError, ValueError, KeyError):
        return 0


def _is_finished(plan: "Plan", restored: "Restored") -> bool:
    """Whether nothing is left to do: its summary stays that of the process that ended it."""
    at = restored.position
    there = _summary(plan).exists() and (plan.path / "policy").is_dir()
    return at.env_steps == at.evaluated == plan.train.steps and there


def _summary(plan: "Plan") -> Path:
    return plan.path / "summary.json"


def _claim(plan: "Plan", command: Sequence[str]) -> None:
    """Makes the folder a run: writes config.json into it, where nothing else is or what is there may be replaced."""
    from experiments.running import records, run_config
    from experiments.running.plan import not_a_run, taken

    try:
        if plan.options.overwrite:
            records.remove_run(plan.path)
        if records.is_taken(plan.path):
            raise UsageError(taken(plan.path))
        content = run_config.describe(plan.members, plan.swept, command, plan.options.preset, plan.output)
        run_config.write(plan.path, content)
    except records.NotARun:
        raise UsageError(not_a_run(plan.path)) from None
    except OSError as error:
        raise _cannot_write(plan, error) from None


def _go_on(plan: "Plan", run: "Described", restored: "Restored | None", command: Sequence[str]) -> None:
    """Says in config.json that the run goes on, and removes what told of its end."""
    from experiments.running import run_config

    at = restored.position.env_steps if restored else 0
    try:
        run_config.write(plan.path, run_config.resumed(run.content, plan.train.steps, plan.output, at, command))
        _summary(plan).unlink(missing_ok=True)
    except OSError as error:
        raise _cannot_write(plan, error) from None


def _tables(plan: "Plan", restored: "Restored | None", warn: Callable[[str], None]) -> "Records":
    """The run's tables: new ones, or those of the resumed run as they were at its checkpoint."""
    from experiments.running import csv_rows, records

    resumed_at = None
    if plan.resumed:
        resumed_at = (restored.position.env_steps, restored.lengths) if restored else (-1, {})
    try:
        return records.Records(plan.path, plan.members, plan.swept, plan.output["tensorboard"], resumed_at, warn)
    except csv_rows.Shortened as error:
        raise UsageError(
            f"--resume={plan.path}: {error} has lost rows since the checkpoint; expects a run with whole tables"
        ) from None
    except csv_rows.OtherColumns as error:
        raise UsageError(f"--resume={plan.path}: expects a run of this version; {error} has other columns") from None
    except OSError as error:
        raise _cannot_write(plan, error) from None


def _announce(console: Console, plan: "Plan", restored: "Restored | None", sizes: tuple[int, int]) -> None:
    """Says what is about to happen, and what it costs."""
    from experiments.running import resume

    def say(text: str) -> None:
        console.print(text, soft_wrap=True, highlight=False, markup=False)

    train = plan.train
    devices = f", devices: {len(plan.layout.devices)}" if plan.layout.spread else ""
    say(f"{plan.config.algo} on {plan.config.env}, members: {len(plan.members)}{devices} -> {plan.path}")
    if plan.resumed:
        at = f"at step {restored.position.env_steps:,}" if restored else "from the start: it has no whole checkpoint"
        say(f"going on with it {at}")
        if others := resume.other_versions(plan.resumed):
            say(f"other versions than when it began, so that it may go on differently: {', '.join(others)}")
    # The policy whose values are judged is played beside the deterministic one, where it is another.
    episodes = train.eval_episodes * (2 if agent_of(plan.config, plan.env).views.sample else 1)
    evaluations = len(evaluation_steps(train))
    say(progress.evaluation_share(train.steps, evaluations, episodes, plan.env.episode_length))
    if every := plan.output["checkpoint_every"]:
        state, row = sizes
        say(
            f"a checkpoint every {every:,} steps, the last {plan.output['keep_checkpoints']} kept: "
            f"{state / 1e6:,.1f} MB each, and the replay's rows once, {row * train.capacity / 1e6:,.1f} MB in the end"
        )


def _train(
    plan: "Plan",
    sweep: Sweep,
    restored: "Restored | None",
    tables: "Records",
    store: "Checkpoints",
    display: progress.Display,
    stop: Callable[[], bool],
) -> Outcome:
    def save(state: TrainState, position: Position) -> None:
        try:
            lengths = tables.lengths()
        except OSError as error:
            display.message(f"no checkpoint at step {position.env_steps:,} ({error.strerror}), and the run goes on")
            return
        store.save(state, position, lengths)

    outcome = train_loop(
        sweep,
        restored.state if restored else sweep.init(*_start(plan)),
        plan.train,
        len(plan.members),
        report=tables.report,
        display=display,
        stop=stop,
        start=restored.position if restored else BEGINNING,
        checkpoint_every=plan.output["checkpoint_every"],
        save=save,
    )
    store.wait()
    return outcome


def _results(plan: "Plan", outcome: Outcome) -> bool:
    """Writes the policies and, where there are evaluations, the curves; whether there are."""
    from experiments.evidence import figures
    from experiments.running import records

    policy, part = plan.path / "policy", plan.path / "policy.part"
    shutil.rmtree(part, ignore_errors=True)
    save_policy(part, plan.config, plan.env, outcome.state.agent, len(plan.members))
    shutil.rmtree(policy, ignore_errors=True)  # of the process that this one continues
    part.rename(policy)
    table = records.read_evaluations(plan.path / "evaluations.csv")
    if not len(table["member"]):
        return False
    figures.draw_curves(table, plan.path / "curves.png", f"{plan.config.algo} on {plan.config.env}")
    return True


def main(argv: Sequence[str], env: Environment | None = None) -> int:
    """The command line `argv`, program name first; gives the exit code."""
    try:
        options = flags.parse(argv)
        if options is None:
            print(flag_table.help_text())
            return DONE
        runtime.prepare()
        from experiments.running.plan import make_plan

        return run(make_plan(options, env), argv)
    except UsageError as error:
        print(printable(str(error)), file=sys.stderr)
        return BAD_USAGE
    except KeyboardInterrupt:  # before the training, or the second one
        return INTERRUPTED


@contextmanager
def _stop_on_signal() -> Iterator[list[int]]:
    """Gathers SIGINT and SIGTERM in a list instead of dying of the first; a second one ends the process at once.

    A SIGTERM within a second of another is the same: a batch system's reaches this process and `experiments.sweep`,
    which passes it on.
    """
    received: list[int] = []
    terminated = -math.inf
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal terminated
        if number == signal.SIGTERM:
            since, terminated = time.monotonic() - terminated, time.monotonic()
            if since < 1:
                return
        if received:
            # Not by an exception: it could strike inside a callback of the compiled program.
            os._exit(INTERRUPTED)
        received.append(number)
        print("stopping when the running chunk of training or evaluation ends", file=sys.stderr)

    for number in numbers:
        signal.signal(number, handle)
    try:
        yield received
    finally:
        restore()


if __name__ == "__main__":
    sys.exit(main(sys.argv))
