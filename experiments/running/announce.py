"""What a run prints before training and after it; nothing with --quiet."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from experiments.running import resume
from experiments.running.loop import Outcome
from experiments.running.plan import Plan
from experiments.running.progress import format_seconds
from sqt_jax import envs
from sqt_jax.envs.factories import is_factory
from sqt_jax.envs.gym_ids import module_of
from sqt_jax.envs.gym_tasks import EPISODE_LENGTH
from sqt_jax.experiment import agent_of
from sqt_jax.train import evaluation_steps

SHORT = 100_000  # env steps: results of shorter runs need an explanation


class Announcer:
    """Prints the start and the end of the run `plan` on `console`."""

    def __init__(self, console: Console, plan: Plan):
        self.console, self.plan, self.quiet = console, plan, plan.options.quiet

    def start(self, resumed_at: int | None, sizes: tuple[int, int], tracked: str = "") -> None:
        """The members, the share of evaluation and the size of checkpoints.

        Args:
          resumed_at: env steps of the checkpoint that training resumes from; None: it starts at step 0.
          sizes: bytes of a checkpoint without replay rows, and of the rows of one env step.
          tracked: a line about Weights & Biases, if any.
        """
        if self.quiet:
            return
        plan, train = self.plan, self.plan.train
        devices = f", devices: {len(plan.layout.devices)}" if plan.layout.spread else ""
        self._line(f"{plan.config.algo} on {plan.config.env}, members: {len(plan.members)}{devices} -> {plan.path}")
        if plan.resumed:
            step = "step 0: it has no valid checkpoint" if resumed_at is None else f"step {resumed_at:,}"
            self._line(f"resuming at {step}")
            if changed := resume.changed_device(plan.resumed, len(plan.layout.devices)):
                self._line(f"not the device of before, results may differ in their last digits: {', '.join(changed)}")
            if changed := resume.changed_versions(plan.resumed, plan.env.version):
                self._line(f"package versions differ from the run's, results may differ too: {', '.join(changed)}")
            if plan.env.host:
                self._line("new episodes begin: the state of these environments is not part of a checkpoint")
        # If the critics estimate another policy than the deterministic one, both are evaluated.
        episodes = train.eval_episodes * (2 if agent_of(plan.config, plan.env).views.sample else 1)
        self._line(
            evaluation_share(train.steps, len(evaluation_steps(train)), episodes, plan.env.episode_length),
        )
        if hint := what_to_expect(plan.config.env, train.steps):
            self._line(hint)
        if every := plan.output["checkpoint_every"]:
            state, row = sizes
            self._line(
                f"a checkpoint every {every:,} steps, the last {plan.output['keep_checkpoints']} kept: "
                f"{state / 1e6:,.1f} MB each, plus one copy of the replay, up to {row * train.capacity / 1e6:,.1f} MB"
            )
        if tracked:
            self._line(tracked)

    def already_finished(self) -> None:
        if not self.quiet:
            self._line(f"{self.plan.path} is finished")

    def end(self, outcome: Outcome, summary: Mapping[str, Any], swept: Sequence[str], curves: bool) -> None:
        """The table of members, the time, where the curves are, and how to resume an interrupted run.

        Args:
          summary: the content of summary.json.
          swept: swept settings other than penalty_coef.
          curves: whether curves.png was drawn.
        """
        if self.quiet:
            return
        self.console.print(final_table(summary, swept))
        rate = "" if outcome.steps_per_second is None else f", {outcome.steps_per_second:,.0f} training steps/s"
        self._line(f"{summary['status']} after {format_seconds(outcome.wall_seconds)}{rate}")
        if curves:
            self._line(f"curves: {self.plan.path / 'curves.png'}")
        if outcome.interrupted and self.plan.output["checkpoint_every"]:
            command = f"python -m experiments.run --resume={shlex.quote(str(self.plan.path))}"
            if module_of(self.plan.config.env) or (self.plan.own_env and is_factory(self.plan.options.env or "")):
                command += f" --env={self.plan.options.env}"
            elif self.plan.own_env:
                command = f"experiments.run.main(['run', {f'--resume={self.plan.path}'!r}], env=env)"
            self._line(f"resume with: {command}")

    def _line(self, text: str) -> None:
        self.console.print(text, soft_wrap=True, highlight=False, markup=False)


def what_to_expect(env: str, steps: int) -> str:
    """Why the returns of a short run mislead on a task that rewards staying upright; empty on others."""
    task = envs.TASKS.get(env)
    if steps >= SHORT or task is None or task.healthy is None:
        return ""
    still = task.alive * EPISODE_LENGTH
    return (
        f"what to expect: {env} earns {task.alive:g} per step for staying upright: {still:,.0f} for standing still. "
        "Moving costs control and leads to falls at first: return and length drop before they rise. "
        f"{steps:,} steps are too few to learn to walk; the speed shows whether it moves"
    )


def evaluation_share(steps: int, evaluations: int, episodes: int, episode_length: int) -> str:
    """How much of a run is evaluation. Steps and episodes are one member's."""
    evaluated = evaluations * episodes * episode_length
    share = evaluated / (evaluated + steps)
    return (
        f"per member: {steps:,} training steps; {evaluations:,} evaluations of {episodes:,} episodes, up to "
        f"{evaluated:,} steps ({share:.0%} of all)"
    )


def final_table(summary: Mapping[str, Any], swept: Sequence[str]) -> Table:
    """The members of a finished run and the scores of its groups, from the content of summary.json."""

    def number(value: float | None, digits: int = 1) -> str:
        return "-" if value is None else f"{value:,.{digits}f}"

    columns = ["penalty_coef", *swept]
    table = Table(
        box=SIMPLE_HEAD,
        show_footer=False,
        caption="last rows: the mean over seeds, at the end and at its best evaluation (the paper's score)",
    )
    for name in ("member", "seed", *columns, "final return", "best return", "q_std"):
        table.add_column(name, justify="right")
    diverged = {entry["member"]: entry["env_steps"] for entry in summary["diverged"]}
    for member in summary["members"]:
        table.add_row(
            str(member["member"]) + (" (diverged)" if member["member"] in diverged else ""),
            str(member["seed"]),
            *(f"{member[name]:g}" for name in columns),
            number(member["final_return"]),
            number(member["best_return"]),
            number(member["q_std"], 3),
        )
    table.add_section()
    for group in summary["groups"]:
        final, score = group["final"], group["score"]
        table.add_row(
            "mean +- std",
            f"{len(group['seeds'])} seed" + "s" * (len(group["seeds"]) > 1),
            *(f"{group[name]:g}" for name in columns),
            f"{number(final['mean'])} +- {number(final['std'])}",
            f"{number(score['mean'])} +- {number(score['std'])}",
            "",
        )
    return table
