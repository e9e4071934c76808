"""Exact update traces of an independent PyTorch implementation (tests/data/golden/README.md).

Sizes and settings are read from each file; `SQT_GOLDEN_DIR` names another folder of such files.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sqt_jax import lap
from sqt_jax.agents import sac, td3, td7
from sqt_jax.config import AgentConfig
from sqt_jax.types import Transition

FOLDER = Path(os.environ.get("SQT_GOLDEN_DIR", Path(__file__).parent / "data" / "golden"))
FILES = sorted(path for path in FOLDER.glob("*.npz") if path.name.startswith(("td3_", "sac_", "td7_")))
TOLERANCE = {"rtol": 1e-5, "atol": 3e-6}
MODULES = {"td3": td3, "sac": sac, "td7": td7}
PENALTY = {"plain": "none", "sqt": "batch_std", "sqt_tuple": "transition_std"}


def tree(arrays: dict, prefix: str) -> dict:
    """The nested dictionary of the keys under `prefix/`."""
    out: dict = {}
    for key in [k for k in arrays if k.startswith(prefix + "/")]:
        *folders, leaf = key[len(prefix) + 1 :].split("/")
        node = out
        for folder in folders:
            node = node.setdefault(folder, {})
        node[leaf] = jnp.asarray(arrays[key])
    return out


def build(arrays: dict, algo: str, variant: str, **changes):
    """The agent that a file describes, its state before the first update, and its batches [K, B, ...]."""
    batch = tree(arrays, "batch")
    nets = tree(arrays, "init")
    kernels = [nets["critic"][layer]["kernel"] for layer in sorted(nets["critic"])]
    meta = {key[len("meta/") :]: arrays[key].item() for key in arrays if key.startswith("meta/")}
    for name in {"policy_delay", "target_update_period"} & meta.keys():
        meta[name] = int(meta[name])
    settings = {"penalty": PENALTY[variant], "ensemble_size": kernels[0].shape[0]} | meta | changes
    if algo == "td7":
        settings["embedding_size"] = nets["encoder"]["state2"]["bias"].shape[0]
        kernels = kernels[1:]  # layer0 lies before the embeddings
    config = AgentConfig(hidden=tuple(k.shape[-1] for k in kernels[:-1]), **settings)
    module = MODULES[algo]
    agent = module.make(config, batch["obs"].shape[-1], batch["action"].shape[-1])
    state = agent.init(jax.random.key(0))
    if "value_bounds" in nets:
        state = state._replace(value_bounds=td7.ValueBounds(*nets.pop("value_bounds")))
    state = state._replace(**{name: {"params": params} for name, params in nets.items()})
    return agent, config, state, batch


def noise_of(algo: str, batch: dict, k: int, config: AgentConfig):
    subset = jnp.arange(config.ensemble_size)
    if algo != "sac":
        return td3.TD3Noise(batch["target_noise"][k], subset)
    return sac.SACNoise(batch["next_action_eps"][k], batch["action_eps"][k], subset)


def replay_trace(arrays: dict, algo: str, variant: str, **changes):
    """The largest deviation from the trace, in units of the tolerance (1 is the limit), by name."""
    agent, config, state, batch = build(arrays, algo, variant, **changes)
    update = jax.jit(agent.update_with_noise)
    deviation: dict[str, float] = {}

    def compare(name, ours, theirs):
        theirs = np.asarray(theirs)
        excess = np.abs(np.asarray(ours) - theirs) / (TOLERANCE["atol"] + TOLERANCE["rtol"] * np.abs(theirs))
        deviation[name] = max(deviation.get(name, 0.0), float(excess.max()))

    for k in range(batch["obs"].shape[0]):
        transition = Transition(*(batch[field][k] for field in Transition._fields))
        noise = noise_of(algo, batch, k, config)
        target, ours = agent.td_target(state, transition, noise)
        state, td_error, _ = update(state, transition, noise)
        ours |= {"td_target": target, "priority": lap.priority(td_error, config.priority_exponent, config.min_priority)}
        for name in [key for key in arrays if key.startswith("trace/")]:
            compare(name, ours[name.split("/")[1]], arrays[name][k])
    for name, params in tree(arrays, "final").items():
        if name == "value_bounds":
            compare(name, jnp.stack(state.value_bounds), params)
            continue
        ours = getattr(state, name)["params"]
        jax.tree.map(lambda a, b, name=name: compare("final/" + name, a, b), ours, params)
    return deviation


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_update_agrees_with_the_trace(path):
    deviation = replay_trace(dict(np.load(path)), *path.stem.split("_", 1))
    assert "trace/td_target" in deviation and "final/critic" in deviation
    assert not {name: excess for name, excess in deviation.items() if not excess <= 1}


@pytest.mark.parametrize("algo", MODULES)
@pytest.mark.parametrize(
    "fault",
    [{"penalty_coef": 0.0}, {"ddof": 0}, {"actor_reduce": "min"}, {"reduce": "mean"}, {"penalty_inside_gamma": False}],
    ids=str,
)
def test_the_traces_notice_a_wrong_formula(algo, fault):
    arrays = dict(np.load(FOLDER / f"{algo}_sqt.npz"))
    assert max(replay_trace(arrays, algo, "sqt", **fault).values()) > 30
