"""The policies of a run's members: those of the last state, and of each member that of its best evaluation.

policy/, policy_best/    both in the format of `sqt_jax.policy`, in the run's folder and in each checkpoint
policy_best/best.json    a list of the members' best evaluations: its mean return and environment steps

The best evaluation is the one that summary.json and the tables report: the first of equal ones. It is a maximum over
many, hence optimistic.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.running import files
from experiments.running.manifests import CannotResume
from sqt_jax.config import Config
from sqt_jax.experiment import agent_of
from sqt_jax.policy import EXPORTED, export_policy, read_policies, write_policies
from sqt_jax.policy_folders import BEST, LAST
from sqt_jax.trees import by_path
from sqt_jax.types import Environment, State

BEST_FILE = "best.json"
MAX_BEST_BYTES = 10_000_000

Arrays = dict[str, np.ndarray]  # parameters of policies by path, [S, ...]


class Evaluated(NamedTuple):
    """A member's best evaluation."""

    return_mean: float  # over its episodes
    env_steps: int


class Best(NamedTuple):
    """Of each of S members, the policy of its best evaluation; the initial one before the first. Never changed."""

    arrays: Arrays
    evaluations: tuple[Evaluated | None, ...]  # None: no evaluation yet, or none before the member diverged


def improved(best: Best, returns: np.ndarray, env_steps: int, arrays: Callable[[], Arrays]) -> Best:
    """The best after one more evaluation.

    Args:
      returns: [S, episodes]; those of a member that has diverged are NaN and never the best.
      arrays: returns the policies that were evaluated; called only if a member has improved.
    """
    # A row at a time, as for evaluations.csv: a mean over an axis may be rounded in another way.
    means = [float(row.mean()) for row in returns]
    old = [entry.return_mean if entry else -np.inf for entry in best.evaluations]
    better = np.array([mean > before for mean, before in zip(means, old, strict=True)])
    if not better.any():
        return best
    entries = zip(better, means, best.evaluations, strict=True)
    return Best(
        arrays={
            name: np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, best.arrays[name])
            for name, new in arrays().items()
        },
        evaluations=tuple(Evaluated(mean, env_steps) if is_better else own for is_better, mean, own in entries),
    )


class RunPolicies:
    """Keeps the members' best policies during training, and writes the last and the best ones.

    Args:
      config: of the run.
      env: the environment, for its sizes.
      members: their number. Further entries of a state are padding.
    """

    def __init__(self, config: Config, env: Environment, members: int):
        self.config, self.env, self.members = config, env, members
        self._view = agent_of(config, env).views.policy
        self.best = Best({}, (None,) * members)

    def start(self, agent_state: State) -> None:
        """The best ones of a new run: the initial policies."""
        self.best = Best(self._copy(agent_state), (None,) * self.members)

    def restore(self, checkpoint: Path) -> None:
        """The best ones of a checkpoint whose files have been verified.

        Raises:
          CannotResume: it has none, or those of another run.
        """
        try:
            arrays = read_policies(checkpoint / BEST, self.config, self.env, self.members)
            evaluations = read_evaluations(checkpoint / BEST)
            if len(evaluations) != self.members:
                raise ValueError(f"{checkpoint / BEST / BEST_FILE}: is of {len(evaluations)} members")
            self.best = Best(arrays, tuple(evaluations.values()))
        except (OSError, ValueError) as error:
            raise CannotResume(f"its best policies cannot be read: {error}") from None

    def evaluated(self, agent_state: State, env_steps: int, returns: np.ndarray) -> None:
        """Keeps the policies of members that have improved; the arguments are those of `improved`."""
        self.best = improved(self.best, returns, env_steps, lambda: self._copy(agent_state))

    def writer(self, agent_state: State) -> Callable[[Path], None]:
        """A function that writes policy/ and policy_best/ of now into a folder, also while training continues."""
        last, best = self._copy(agent_state), self.best

        def write(folder: Path) -> None:
            write_policies(folder / LAST, self.config, self.env, last)
            self._write_best(folder / BEST, best)

        return write

    def bytes_in_checkpoint(self, agent_state: State) -> int:
        """About the bytes that `writer` writes; of the state only shapes and types are used."""
        return 2 * sum(leaf.size * leaf.dtype.itemsize for leaf in by_path(self._view(agent_state)).values())

    def write_results(self, run: Path, agent_state: State) -> None:
        """Writes policy/ and policy_best/ with act.stablehlo, in place of those of an earlier process."""
        exported = export_policy(self.config, self.env)
        for name in (LAST, BEST):
            part = run / f"{name}.part"
            shutil.rmtree(part, ignore_errors=True)
            if name == BEST:
                self._write_best(part, self.best)
            else:
                write_policies(part, self.config, self.env, self._copy(agent_state))
            (part / EXPORTED).write_bytes(exported)
            shutil.rmtree(run / name, ignore_errors=True)
            part.rename(run / name)

    def _write_best(self, folder: Path, best: Best) -> None:
        write_policies(folder, self.config, self.env, best.arrays)
        content = [entry._asdict() if entry else None for entry in best.evaluations]
        (folder / BEST_FILE).write_text(json.dumps(content) + "\n")

    def _copy(self, agent_state: State) -> Arrays:
        # Copies: training reuses the memory.
        view = by_path(self._view(agent_state))
        return {name: np.array(np.asarray(leaf)[: self.members]) for name, leaf in view.items()}


def read_evaluations(folder: Path) -> dict[int, Evaluated | None]:
    """The best evaluation of each member, by its number, in a folder policy_best/.

    Raises:
      ValueError: the file is damaged.
      OSError: it is missing or cannot be read.
    """
    content = files.read_json(folder / BEST_FILE, MAX_BEST_BYTES)
    try:
        return {number: None if entry is None else _evaluated(**entry) for number, entry in enumerate(content)}
    except (ValueError, TypeError):
        raise ValueError(f"{folder / BEST_FILE}: not the best evaluations of a run's members") from None


def _evaluated(return_mean: object, env_steps: object) -> Evaluated:
    if type(return_mean) is not float or type(env_steps) is not int or env_steps < 0:
        raise ValueError
    return Evaluated(return_mean, env_steps)
