"""Run folders written by hand: config.json, evaluations.csv, policies, without a training."""

import csv
import json
import math
from pathlib import Path
from unittest import mock

import jax
import numpy as np

from experiments.evidence.finished_runs import MemberCurves
from experiments.running import run_config
from experiments.running.records import EVALUATION_COLUMNS
from sqt_jax.experiment import agent_of, make_config
from sqt_jax.policy import save_policy

# Markup, and characters that no terminal should get.
HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'`${1}\x1b\ud800"
STEPS = 100  # of a made run, evaluated at 0, 50 and 100, with updates after 10


def write_run(
    folder, algo="td3", env="cheetah", curves=((0, 1, 2),), seeds=None, q_std=0.5, more=None, name="run", **settings
):
    """A run whose members have the returns `curves` [members, evaluations]; NaN is an empty field.

    Args:
      q_std: of all members and evaluations, or one per member.
      more: further columns by name, [members, evaluations] each.
      settings: of the run; `swept={"penalty_coef": (0.1, 0.5)}` makes the seeds times these values, and
        `sizes=(3, 2)` a run on an environment handed in from Python.
    """
    swept = settings.pop("swept", {})
    versions = settings.pop("versions", {"jax": "0.10.2"})
    sizes = settings.pop("sizes", None)
    settings |= {"physics": "own"} if sizes else {}
    settings = {"steps": STEPS, "warmup_steps": 10, "batch_size": 8, "eval_every": 50, "eval_episodes": 1} | settings
    configs = [make_config(algo, env, **settings)]
    if swept:
        ((scalar, values),) = swept.items()
        configs = [make_config(algo, env, **settings | {scalar: value}) for value in values]
    curves = np.array(curves, float)
    seeds = range(len(curves) // len(configs)) if seeds is None else seeds
    members = [(config, seed) for config in configs for seed in seeds]
    assert len(members) == len(curves)
    path = folder / env / algo / name
    path.mkdir(parents=True)
    content = {
        "settings": configs[0].flat(),
        "preset": "paper",
        "replay_rows": configs[0].train.capacity,
        "evaluated_on": configs[0].physics if sizes or env.startswith(("brax:", "playground:")) else "mujoco",
        "swept": list(swept),
        "members": [
            {"member": index, "seed": seed, "penalty_coef": config.agent.penalty_coef}
            | {scalar: getattr(config.agent, scalar) for scalar in swept}
            for index, (config, seed) in enumerate(members)
        ],
        "output": {},
        "command": ["run"],
        "versions": versions,
        "resumed": [],
    }
    content |= {"own_env": {"observation_size": sizes[0], "action_size": sizes[1]}} if sizes else {}
    (path / "config.json").write_text(json.dumps(content))
    q_stds = np.broadcast_to(q_std, len(members))
    with (path / "evaluations.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [*EVALUATION_COLUMNS, *(more or {})], restval="", lineterminator="\n")
        writer.writeheader()
        for evaluation in range(curves.shape[1]):
            for index, (config, seed) in enumerate(members):
                step = 50 * evaluation
                value = curves[index, evaluation]
                row = {"member": index, "env_steps": step, "gradient_steps": max(0, step - 10), "seed": seed}
                row |= {"penalty_coef": config.agent.penalty_coef, "return_mean": value, "wall_seconds": step / 10}
                row |= {"q_std": q_stds[index] if step and not math.isnan(value) else math.nan}
                row |= {name: values[index][evaluation] for name, values in (more or {}).items()}
                writer.writerow({name: "" if value != value else value for name, value in row.items()})
    return path


def made_member(algo="td3", env="cheetah", returns=(0, 1, 2), seed=0, run="run", **settings):
    """A member as `read_run` gives it, without files: for algorithms and environments that have no name here."""
    steps = np.arange(len(returns)) * 50.0
    columns = {"env_steps": steps, "gradient_steps": np.maximum(steps - 10, 0), "return_mean": np.array(returns, float)}
    columns["q_std"] = np.full(len(returns), 0.5)
    config = {"steps": STEPS, "warmup_steps": 10, "batch_size": 8, "eval_every": 50, "eval_episodes": 1}
    config = make_config("td3", "cheetah", **config).flat() | {"replay_capacity": "all", "eval_physics": "mujoco"}
    return MemberCurves(Path(run), seed, config | {"algo": algo, "env": env} | settings, {"jax": "0.10.2"}, columns)


def make_hostile(path):
    """Puts markup into every free text of a run's files."""
    content = json.loads((path / "config.json").read_text())
    content |= {"preset": HOSTILE, "started": HOSTILE, "commit": HOSTILE, "command": ["run", f"--name={HOSTILE}"]}
    content |= {"versions": {HOSTILE: HOSTILE, "jax": HOSTILE}, "device": {"platform": HOSTILE, "kind": HOSTILE}}
    content["resumed"] = [{"env_steps": HOSTILE, "command": ["run", HOSTILE], "versions": {HOSTILE: HOSTILE}}]
    (path / "config.json").write_text(json.dumps(content))
    (path / "summary.json").write_text(json.dumps({"status": HOSTILE, "wall_seconds": HOSTILE}))


def add_policies(path, env, returns=None):
    """Gives a made run untrained policies, and a summary with the members' final `returns`.

    Args:
      env: an `Environment` of the run's sizes.
    """
    run = run_config.read(path)
    config, count = run.members[0].config, len(run.members)
    agent, generator = agent_of(config, env), np.random.default_rng(1)
    shapes = jax.eval_shape(lambda key: jax.vmap(agent.init)(jax.random.split(key, count)), jax.random.key(1))
    # by NumPy: compiling the agent's own `init` takes seconds
    state = jax.tree.map(lambda leaf: generator.normal(0, 0.5, leaf.shape).astype(leaf.dtype), shapes)
    with mock.patch(
        "sqt_jax.policy.export_policy", return_value=b""
    ):  # the exported program takes seconds and is not needed
        save_policy(path / "policy", config, env, state)
    if returns is not None:
        members = [{"member": index, "final_return": value} for index, value in enumerate(returns)]
        (path / "summary.json").write_text(json.dumps({"members": members}))
