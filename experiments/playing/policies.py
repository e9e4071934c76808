"""Choosing a member of a run, and loading its policy."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.running import files, records, run_config, run_policies
from experiments.running.run_config import Member, RunConfig
from sqt_jax.policy import load_policy
from sqt_jax.policy_folders import PolicyFolder, read_first
from sqt_jax.types import Array, Environment

MAX_SUMMARY_BYTES = 100_000_000


class Chosen(NamedTuple):
    """The member to play."""

    number: int  # of the member in its run, from 0
    member: Member
    why: str  # the reason of the choice, in words


class Loaded(NamedTuple):
    """The policy to play."""

    policy: Callable[[Array], Array]  # obs [B, O] -> action [B, A] in [-1, 1]
    origin: str  # which one it is, in words


def read(path: Path) -> RunConfig:
    """The run in a folder. Raises `UsageError` if there is none."""
    try:
        return run_config.read(path)
    except run_config.InvalidRunConfig as error:
        raise UsageError(f"{path}: expects the folder of a run; {error}") from None


def member_returns(path: Path, count: int, best: bool = False) -> list[float]:
    """The return of each of `count` members at the run's last evaluation, or at the member's best; NaN if unknown.

    From summary.json, or from evaluations.csv before training has ended.
    """
    returns, name = [math.nan] * count, "best_return" if best else "final_return"
    try:
        for entry in _members(path):
            if type(entry["member"]) is int and 0 <= entry["member"] < count and entry[name] is not None:
                returns[entry["member"]] = float(entry[name])
    except (OSError, ValueError, TypeError, LookupError):
        return [math.nan] * count
    return returns


def _members(path: Path) -> Any:
    """The members' entries of summary.json, which may be damaged."""
    try:
        return files.read_json(path / "summary.json", MAX_SUMMARY_BYTES)["members"]
    except FileNotFoundError:
        return records.summarise(records.read_evaluations(path / "evaluations.csv"))["members"]


def choose(
    run: RunConfig,
    returns: Sequence[float],
    seed: int | None = None,
    number: int | None = None,
    at: str = "at the last evaluation",
) -> Chosen:
    """The member with this number, or the best with this seed, or the best of all.

    Args:
      returns: of each member, to find the best; NaN if unknown.
      at: when they were measured, in words.

    Raises:
      UsageError: the run has no such member.
    """
    members = run.members
    if number is not None:
        if number >= len(members):
            raise UsageError(f"--member={number}: expects one of the run's members, 0 to {len(members) - 1}")
        if seed not in (None, members[number].seed):
            own = members[number].seed
            raise UsageError(f"--seed={seed}: member {number} has seed {own}; expects only one of --seed and --member")
        return Chosen(number, members[number], f"of {len(members)}")
    found = [i for i, member in enumerate(members) if seed in (None, member.seed)]
    if not found:
        seeds = ", ".join(str(value) for value in dict.fromkeys(member.seed for member in members))
        raise UsageError(f"--seed={seed}: expects a seed of the run, one of {_short(seeds)}")
    known = [i for i in found if not math.isnan(returns[i])]
    best = max(known, key=lambda i: returns[i]) if known else found[0]
    of = f"of {len(found)}" + ("" if seed is None else " with this seed")
    if len(found) == 1:
        why = f"of {len(members)}"
    elif known:
        why = f"the best {of} {at}"
    else:
        why = f"the first {of}: none has an evaluation"
    return Chosen(best, members[best], why)


def caption(run: RunConfig, chosen: Chosen) -> str:
    """One line: algorithm, environment, member, seed, values of the swept settings, and the reason of the choice."""
    config = chosen.member.config
    values = "".join(f", {name} {getattr(config.agent, name):g}" for name in run.swept)
    return f"{config.algo} on {config.env}: member {chosen.number}, seed {chosen.member.seed}{values} ({chosen.why})"


def load(path: Path, chosen: Chosen, env: Environment, best: bool = False) -> Loaded:
    """The deterministic policy of a member of the run in `path`: the last one, or that of its best evaluation.

    Raises:
      UsageError: it is missing, damaged, or has other sizes than the environment.
    """

    def read(folder: Path) -> tuple[Callable[[Array], Array], tuple[Any, Any], str]:
        policy = load_policy(folder, chosen.number)
        return policy, _sizes(folder), _best_evaluation(folder, chosen.number) if best else "the last one"

    try:
        (policy, sizes, origin), found = read_first(path, best, read)
    except (OSError, ValueError) as error:
        raise UsageError(str(error)) from None
    if sizes != (env.observation_size, env.action_size):
        raise UsageError(f"{found.path}: is not a policy for {env.name}: its sizes are {sizes[0]} and {sizes[1]}")
    return Loaded(policy, origin + _checkpoint(found))


def _checkpoint(found: PolicyFolder) -> str:
    return "" if found.env_steps is None else f", from the checkpoint at step {found.env_steps:,}"


def _best_evaluation(folder: Path, number: int) -> str:
    """What is known of a member's best evaluation."""
    evaluation = run_policies.read_evaluations(folder).get(number)
    if evaluation is None:
        return "the initial one (the member has no evaluation)"
    return (
        f"the best evaluated one, of step {evaluation.env_steps:,} with return {evaluation.return_mean:,.1f} (the best "
        "of many evaluations: new starts usually return less)"
    )


def _sizes(folder: Path) -> tuple[Any, Any]:
    """Observation and action size; `load_policy` has checked the same file."""
    settings = json.loads((folder / "config.json").read_bytes())
    return settings["observation_size"], settings["action_size"]


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:200]}..."
