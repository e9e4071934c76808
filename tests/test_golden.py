"""Exact update traces of an independent PyTorch implementation (tests/data/golden/README.md).

Sizes and settings are read from each file; `SQT_GOLDEN_DIR` names another folder of traces.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.commandline.presets import preset_settings
from sqt_jax import lap, q_targets
from sqt_jax.agents import released, sac, td3, td7
from sqt_jax.algorithms import ALGORITHMS, make_parts
from sqt_jax.config import AgentConfig
from sqt_jax.settings import settings_of
from sqt_jax.trees import by_path
from sqt_jax.types import Transition

DATA = Path(__file__).parent / "data" / "golden"
FOLDER = Path(os.environ.get("SQT_GOLDEN_DIR", DATA))
FILES = sorted(FOLDER.glob("*.npz"))
if not FILES:
    raise FileNotFoundError(f"no traces (*.npz) in {FOLDER}")
TOLERANCE = {"rtol": 1e-5, "atol": 3e-6}


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


def build(arrays: dict, name: str, **changes):
    """The parts of the agent that a file describes, its state before the first update, and its batches [K, B, ...].

    `name` is the file's: `[released_]<algorithm>_<plain, sqt or sqt_tuple>`. All its networks have the same hidden
    widths, those of the critics.
    """
    batch = tree(arrays, "batch")
    nets = tree(arrays, "init")
    meta = {key[len("meta/") :]: arrays[key].item() for key in arrays if key.startswith("meta/")}
    for key in {"policy_delay", "target_update_period"} & meta.keys():
        meta[key] = int(meta[key])
    algo = name.removeprefix("released_").removesuffix("_plain")
    row = ALGORITHMS[algo]
    preset = preset_settings("released", algo, "ant") if name.startswith("released_") else {}
    settings = (
        dict(row.settings)
        | {key: preset[key] for key in settings_of(AgentConfig).keys() & preset.keys()}
        | meta
        | changes
    )
    kernels = [nets["critic"][layer]["kernel"] for layer in sorted(nets["critic"])]
    settings["ensemble_size"] = kernels[0].shape[0]
    if "encoder" in nets:
        settings["embedding_size"] = nets["encoder"]["state2"]["bias"].shape[0]
        kernels = kernels[1:]  # layer0 comes before the embeddings
    config = AgentConfig(hidden=tuple(k.shape[-1] for k in kernels[:-1]), **settings)
    parts = make_parts(algo, config, batch["obs"].shape[-1], batch["action"].shape[-1])
    state = parts.agent.init(jax.random.key(0))
    bounds = nets.pop("value_bounds", None)
    networks = {name: {"params": params} for name, params in nets.items()}
    if config.value_clipping and bounds is not None:
        networks["value_bounds"] = td7.ValueBounds(*bounds)
    return parts, config, with_learner(state, **networks), batch


def learner_of(state):
    """The state that learns: TD7's is inside its policy checkpoints."""
    return getattr(state, "learner", state)


def with_learner(state, **fields):
    if hasattr(state, "learner"):
        return state._replace(learner=state.learner._replace(**fields))
    return state._replace(**fields)


def draws_of(algo: str, batch: dict, k: int, config: AgentConfig):
    subset = jnp.arange(config.ensemble_size)
    if algo.startswith("sac"):
        return sac.SACDraws(batch["next_action_eps"][k], batch["action_eps"][k], subset)
    if config.sampled_actor:
        return released.GaussianTD3Draws(batch["target_noise"][k], subset, batch["action_eps"][k])
    return td3.TD3Draws(batch["target_noise"][k], subset)


def replay_trace(arrays: dict, name: str, **changes):
    """The largest deviation from the trace, in units of the tolerance (1 is the limit), by name."""
    parts, config, state, batch = build(arrays, name, **changes)
    update = jax.jit(parts.update)
    deviation: dict[str, float] = {}

    def compare(name, ours, theirs):
        theirs = np.asarray(theirs)
        excess = np.abs(np.asarray(ours) - theirs) / (TOLERANCE["atol"] + TOLERANCE["rtol"] * np.abs(theirs))
        largest = float(np.nan_to_num(excess, nan=np.inf).max())  # Python's max would drop a NaN
        deviation[name] = max(deviation.get(name, 0.0), largest)

    for k in range(batch["obs"].shape[0]):
        transition = Transition(*(batch[field][k] for field in Transition._fields))
        draws = draws_of(name.removeprefix("released_"), batch, k, config)
        target, ours = parts.td_target(state, transition, draws)
        state, td_error, _ = update(state, transition, draws, jnp.int32(k))
        ours |= {"td_target": target, "priority": lap.priority(td_error, config.priority_exponent, config.min_priority)}
        for key in [key for key in arrays if key.startswith("trace/")]:
            compare(key, ours[key.split("/")[1]], arrays[key][k])
    learner = learner_of(state)
    for net, params in tree(arrays, "final").items():
        if net == "value_bounds":
            ours = jnp.stack(learner.value_bounds) if config.value_clipping else arrays["init/value_bounds"]  # unused
            compare(net, ours, params)
        else:
            ours = getattr(learner, net)["params"]
            jax.tree.map(lambda a, b, net=net: compare("final/" + net, a, b), ours, params)
    return deviation


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_update_agrees_with_the_trace(path):
    deviation = replay_trace(dict(np.load(path)), path.stem)
    assert needed(path.stem) <= deviation.keys()
    assert not {name: excess for name, excess in deviation.items() if not excess <= 1}


def needed(name: str) -> set[str]:
    """The quantities in which a file of this name has to be compared, at least."""
    base, variant = name.removeprefix("released_").split("_", 1)
    keys = {"trace/td_target", "final/critic", "final/target_critic", "final/actor", "final/target_actor"}
    if variant != "plain":
        keys.add("trace/penalty")
    if base == "td7":
        keys |= {"trace/priority", "final/encoder", "final/fixed_encoder", "final/fixed_encoder_target", "value_bounds"}
    if base == "sac" and not name.startswith("released_"):
        keys = keys - {"final/target_actor"} | {"trace/next_log_prob"}
    return keys


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def made_trace(name: str, **sizes) -> dict:
    """A trace of our own agent: it shows whether sizes and settings are read from the file."""
    row, updates, observation_size, action_size, batch_size = ALGORITHMS[name], 2, 5, 3, 7
    config = AgentConfig(**{**row.settings, **sizes})
    parts = make_parts(name, config, observation_size, action_size)
    first = state = parts.agent.init(jax.random.key(3))
    generator = np.random.default_rng(0)
    lead = updates, batch_size
    batch = {name: generator.normal(size=(*lead, observation_size)) for name in ("obs", "next_obs")}
    batch |= {name: generator.uniform(-1, 1, size=(*lead, action_size)) for name in ("action", "target_noise")}
    batch |= {name: generator.normal(size=(*lead, action_size)) for name in ("next_action_eps", "action_eps")}
    batch |= {"reward": generator.normal(size=lead), "discount": (generator.random(lead) < 0.8).astype(float)}
    batch = {name: jnp.asarray(value, jnp.float32) for name, value in batch.items()}
    settings = {"penalty_coef", "gamma", "lr", "policy_delay", *sizes} - {"hidden", "ensemble_size", "embedding_size"}
    arrays = {f"meta/{key}": np.asarray(getattr(config, key)) for key in settings}
    arrays |= {f"batch/{key}": value for key, value in batch.items()}
    networks = [key for key in learner_of(first)._fields if isinstance(getattr(learner_of(first), key), dict)]
    trace: dict[str, list] = {}
    update = jax.jit(parts.update)
    for k in range(updates):
        transition = Transition(*(batch[field][k] for field in Transition._fields))
        draws = draws_of(name, batch, k, config)
        target, terms = parts.td_target(state, transition, draws)
        for key, value in {"td_target": target, "penalty": terms["penalty"]}.items():
            trace.setdefault(f"trace/{key}", []).append(np.asarray(value))
        state, *_ = update(state, transition, draws, jnp.int32(k))
    for when, of in (("init", learner_of(first)), ("final", learner_of(state))):
        for network in networks:
            arrays |= {
                f"{when}/{network}/{path}": leaf for path, leaf in by_path(getattr(of, network)["params"]).items()
            }
    return arrays | {key: np.stack(values) for key, values in trace.items()}


SIZES = {"ensemble_size": 3, "hidden": (12, 9), "penalty_coef": 0.3, "gamma": 0.9}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["td3_sqt", "sac_sqt_tuple", "td7_sqt_tuple"])
def test_sizes_and_settings_are_those_of_the_file(name, tmp_path):
    more = {"embedding_size": 6, "target_update_period": 2} if name.startswith("td7") else {"tau": 0.1}
    np.savez(tmp_path / f"{name}.npz", **made_trace(name, **SIZES, **more))
    deviation = replay_trace(dict(np.load(tmp_path / f"{name}.npz")), name)
    assert {"trace/td_target", "trace/penalty", "final/critic", "final/actor"} <= deviation.keys()
    assert max(deviation.values()) < 0.1


def test_a_nan_agrees_with_nothing(monkeypatch):
    name = "td3_sqt"
    arrays = dict(np.load(DATA / f"{name}.npz"))
    monkeypatch.setattr(lap, "priority", lambda *_: jnp.nan)
    arrays["trace/priority"] = np.ones((arrays["batch/obs"].shape[0], 1), np.float32)
    assert replay_trace(arrays, name)["trace/priority"] == np.inf


def test_there_is_a_trace_of_each_of_the_nine_and_of_the_released_code():
    names = {path.stem for path in DATA.glob("*.npz")}
    bases = ("td3", "sac", "td7")
    nine = {f"{base}_{variant}" for base in bases for variant in ("plain", "sqt", "sqt_tuple")}
    assert names == nine | {f"released_{base}_sqt" for base in bases}


def swapped(clip_and_penalty):
    """`q_targets.td_target` with the penalty before the clipping."""

    def td_target(*args, penalty, value_bounds=None, reduce=q_targets.min_over_critics, **rest):
        def penalised(next_q):
            return reduce(next_q) - penalty(next_q)

        return clip_and_penalty(*args, reduce=penalised, value_bounds=value_bounds, **rest)

    return td_target


@pytest.mark.parametrize("name", ["td7_sqt", *map(slow, ["td7_sqt_tuple", "released_td7_sqt"])])
def test_the_traces_notice_a_penalty_before_the_clipping(name, monkeypatch):
    monkeypatch.setattr(q_targets, "td_target", swapped(q_targets.td_target))
    assert replay_trace(dict(np.load(DATA / f"{name}.npz")), name)["trace/td_target"] > 30


FORMULA = [
    {"penalty_coef": 0.0},
    {"ddof": 0},
    {"actor_reduce": "min"},
    {"reduce": "mean"},
    {"penalty_inside_gamma": False},
]
RELEASED = {
    "released_td3_sqt": [{"sampled_actor": False}, {"train_encoder": True}, {"value_clipping": True}],
    "released_sac_sqt": [{"squashed_log_prob": True}, {"train_encoder": True}, {"policy_delay": 1}],
    "released_td7_sqt": [{"sampled_actor": False}, {"train_encoder": False}, {"value_clipping": False}],
}
FAULTS = [(name, fault) for name in ("td3_sqt", "sac_sqt", "td7_sqt") for fault in FORMULA]
FAULTS += [(name, fault) for name, faults in RELEASED.items() for fault in faults]
# Fast: one of each formula, and of each agent one.
FAST = [*(("td3_sqt", fault) for fault in FORMULA[2:]), ("sac_sqt", FORMULA[0]), ("td7_sqt", FORMULA[1])]


@pytest.mark.parametrize(("name", "fault"), [each if each in FAST else slow(*each) for each in FAULTS], ids=str)
def test_the_traces_notice_a_wrong_formula(name, fault):
    arrays = dict(np.load(DATA / f"{name}.npz"))
    if fault == {"sampled_actor": False}:  # the deterministic actor has no log_std head
        arrays = {key: value for key, value in arrays.items() if "/log_std/" not in key}
    assert max(replay_trace(arrays, name, **fault).values()) > 30
