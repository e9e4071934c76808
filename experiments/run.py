"""Train one sweep and record it: `python -m experiments.run --algo=sac_sqt --env=ant --seeds=0,1,2,3,4`.

Exit codes: 0 done; 2 bad usage (one line, nothing written); 3 a member diverged; 130 interrupted.
"""

import os
import re
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import psutil
from rich.console import Console

from experiments import flags, progress, runtime
from experiments.loop import train_loop
from experiments.presets import preset_settings
from sqt_jax import envs
from sqt_jax.algorithms import check_physics, make_config, make_trainer, memory_estimate
from sqt_jax.config import ConfigError
from sqt_jax.policy import save_policy
from sqt_jax.train import evaluation_steps, make_sweep
from sqt_jax.types import Environment, Scalars

# `records` and `plots` bring SciPy, TensorBoard and matplotlib, as much to import as all the rest: they are imported
# where they are used, so that a typing error is answered in a second.
if TYPE_CHECKING:
    from experiments.records import Member

DONE, BAD_USAGE, DIVERGED, INTERRUPTED = 0, 2, 3, 130


class Plan(NamedTuple):
    """A checked command line: everything a run needs, before anything is written or compiled."""

    members: list["Member"]
    swept: list[str]
    path: Path
    env: Environment
    own_env: Environment | None  # which takes the place of the named one
    options: flags.Options


def make_plan(options: flags.Options, env: Environment | None = None) -> Plan:
    """What a command line asks for; `env` takes the place of the environment that it names.

    Raises `flags.UsageError` for settings that cannot be, a directory that is taken and too little memory.
    """
    from experiments.records import make_members

    preset: dict[str, Any] = {}
    try:
        default = make_config(options.algo, options.env)
        preset = preset_settings(options.preset, default.algo, default.env)
        settings = preset | options.settings
        configs = [
            make_config(options.algo, options.env, **settings | dict(zip(options.sweep, values, strict=True)))
            for values in product(*options.sweep.values())
        ]
        check_physics(configs[0])
    except ConfigError as error:
        by_preset = error.setting in preset.keys() - options.settings.keys() - options.sweep.keys()
        raise flags.UsageError(f"{error} (set by --preset={options.preset})" if by_preset else str(error)) from None
    members = make_members(options.seeds, configs)
    path = Path(options.out) / default.env / default.algo / (options.name or _default_name(options))
    try:
        if path.is_dir() and any(path.iterdir()) and not options.overwrite:
            raise flags.UsageError(_taken(path))
    except OSError as error:
        raise flags.UsageError(f"--out={options.out}: takes a folder that can be read: {error}") from None

    own_env = env
    try:
        env = own_env or envs.make(default.env, configs[0].physics)
    except ValueError as error:
        raise flags.UsageError(f"--physics: {error}") from None
    needed, free = memory_estimate(configs[0], len(members), env), _free_memory()
    if needed > free:
        raise flags.UsageError(
            f"--replay_capacity={configs[0].train.replay_capacity}: {len(members)} members need about "
            f"{needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free; takes a smaller number, or fewer --seeds"
        )
    return Plan(members, list(options.sweep), path, env, own_env, options)


def run(plan: Plan, command: Sequence[str]) -> int:
    """Trains and records; the exit code."""
    from experiments import plots, records

    options, members, env = plan.options, plan.members, plan.env
    config = members[0].config
    train = config.train
    console = Console()
    try:
        if options.overwrite:
            records.remove_run(plan.path)
        files = records.Records(plan.path, members, plan.swept, options.tensorboard)
    except records.NotARun:
        raise flags.UsageError(
            f"--overwrite: {plan.path} holds other things than a run; takes a folder with a run alone"
        ) from None
    except records.RunExists:
        raise flags.UsageError(_taken(plan.path)) from None
    except OSError as error:
        raise flags.UsageError(f"--out={options.out}: takes a folder that can be written: {error}") from None

    with files, _stop_on_signal() as stop:
        files.config(records.describe(members, plan.swept, command, options.preset))
        if not options.quiet:
            title = f"{config.algo} on {config.env}, members: {len(members)} -> {plan.path}"
            console.print(title, soft_wrap=True, highlight=False, markup=False)
            evaluations = len(evaluation_steps(train))
            share = progress.evaluation_share(train.steps, evaluations, train.eval_episodes, env.episode_length)
            console.print(share, soft_wrap=True, highlight=False)
        sweep = make_sweep(make_trainer(config, plan.own_env))
        seeds = jnp.array([member.seed for member in members], jnp.uint32)
        scalars = Scalars(
            *(
                jnp.array([getattr(member.config.agent, name) for member in members], jnp.float32)
                for name in Scalars._fields
            )
        )
        with progress.Display(console, train.steps, quiet=options.quiet) as display:
            state = sweep.init(jax.vmap(jax.random.key)(seeds), scalars)
            outcome = train_loop(
                sweep, state, train, len(members), report=files.report, display=display, stop=lambda: bool(stop)
            )
        summary = files.summary(outcome)
        save_policy(plan.path / "policy", config, env, outcome.state.agent)
        table = records.read_evaluations(plan.path / "evaluations.csv")
        if len(table["member"]):
            plots.draw_curves(table, plan.path / "curves.png", f"{config.algo} on {config.env}")

    if not options.quiet:
        console.print(progress.final_table(summary, files.swept))
        rate = "" if outcome.steps_per_second is None else f", {outcome.steps_per_second:,.0f} training steps/s"
        console.print(
            f"{summary['status']} after {progress.format_seconds(outcome.wall_seconds)}{rate}", highlight=False
        )
        if len(table["member"]):
            console.print(f"curves: {plan.path / 'curves.png'}", soft_wrap=True, highlight=False, markup=False)
    return INTERRUPTED if outcome.interrupted else DIVERGED if outcome.diverged else DONE


def main(argv: Sequence[str], env: Environment | None = None) -> int:
    """The command line `argv`, program name first; gives the exit code."""
    try:
        options = flags.parse(argv)
        if options is None:
            print(flags.help_text())
            return DONE
        runtime.prepare()
        return run(make_plan(options, env), argv)
    except flags.UsageError as error:
        line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(error))
        print(line, file=sys.stderr)
        return BAD_USAGE
    except KeyboardInterrupt:  # before the training, or the second one
        return INTERRUPTED


@contextmanager
def _stop_on_signal() -> Iterator[list[int]]:
    """Gathers SIGINT and SIGTERM in a list instead of dying of the first; a second one ends the process at once."""
    received: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in numbers}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, _: FrameType | None) -> None:
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


def _default_name(options: flags.Options) -> str:
    from experiments.records import default_name

    changed: dict[str, Any] = {} if options.preset == "paper" else {"preset": options.preset}
    changed |= options.settings | options.sweep
    if options.seeds != flags.DEFAULT_SEEDS:
        changed["seeds"] = options.seeds
    return default_name(changed, datetime.now(UTC))


def _taken(path: Path) -> str:
    return f"--name={path.name}: {path} already holds a run; takes another name, or --overwrite replaces it"


def _free_memory() -> int:
    """Bytes that a run may take: the accelerator's, or the machine's or its container's that are free."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    free = psutil.virtual_memory().available
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        cached = re.search(r"^inactive_file (\d+)$", Path("/sys/fs/cgroup/memory.stat").read_text(), re.MULTILINE)
        reclaimable = int(cached[1]) if cached else 0
        return free if limit == "max" else min(free, int(limit) - used + reclaimable)
    except OSError:
        return free


if __name__ == "__main__":
    sys.exit(main(sys.argv))
