"""Choosing a member of a run, and loading its policy."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from experiments.running import files, run_config
from experiments.running.run_config import Member, RunConfig
from sqt_jax.policy import load_policy
from sqt_jax.types import Array, Environment

MAX_SUMMARY_BYTES = 100_000_000


class Chosen(NamedTuple):
    """The member to play."""

    number: int  # of the member in its run, from 0
    member: Member
    why: str  # the reason of the choice, in words


def read(path: Path) -> RunConfig:
    """The run in a folder. Raises `UsageError` if there is none."""
    try:
        return run_config.read(path)
    except run_config.InvalidRunConfig as error:
        raise UsageError(f"{path}: expects the folder of a run; {error}") from None


def final_returns(path: Path, count: int) -> list[float]:
    """The return of each of `count` members at the run's last evaluation; NaN if summary.json does not have it."""
    returns = [math.nan] * count
    try:
        for entry in files.read_json(path / "summary.json", MAX_SUMMARY_BYTES)["members"]:
            if type(entry["member"]) is int and 0 <= entry["member"] < count and entry["final_return"] is not None:
                returns[entry["member"]] = float(entry["final_return"])
    except (OSError, ValueError, TypeError, KeyError):
        return [math.nan] * count
    return returns


def choose(run: RunConfig, returns: Sequence[float], seed: int | None = None, number: int | None = None) -> Chosen:
    """The member with this number, or the best with this seed, or the best of all.

    Args:
      returns: of each member, to find the best; NaN if unknown.

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
        why = f"the best {of} at the last evaluation"
    else:
        why = f"the first {of}: none has an evaluation"
    return Chosen(best, members[best], why)


def caption(run: RunConfig, chosen: Chosen) -> str:
    """One line: algorithm, environment, member, seed, values of the swept settings, and the reason of the choice."""
    config = chosen.member.config
    values = "".join(f", {name} {getattr(config.agent, name):g}" for name in run.swept)
    return f"{config.algo} on {config.env}: member {chosen.number}, seed {chosen.member.seed}{values} ({chosen.why})"


def load(path: Path, chosen: Chosen, env: Environment) -> Callable[[Array], Array]:
    """The deterministic policy of a member of the run in `path`: obs [B, O] -> action [B, A] in [-1, 1].

    Raises:
      UsageError: it is missing, damaged, or has other sizes than the environment.
    """
    folder = path / "policy"
    if not folder.is_dir():
        raise UsageError(f"{path}: expects a run with a policy, which is saved when training ends; it has none yet")
    try:
        policy = load_policy(folder, chosen.number)
        sizes = _sizes(folder)
    except (FileNotFoundError, ValueError) as error:
        raise UsageError(str(error)) from None
    if sizes != (env.observation_size, env.action_size):
        raise UsageError(f"{folder}: is not a policy for {env.name}: its sizes are {sizes[0]} and {sizes[1]}")
    return policy


def _sizes(folder: Path) -> tuple[Any, Any]:
    """Observation and action size; `load_policy` has checked the same file."""
    settings = json.loads((folder / "config.json").read_bytes())
    return settings["observation_size"], settings["action_size"]


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:200]}..."
