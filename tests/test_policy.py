"""A saved policy acts like the agent it was saved from; loading rejects files that are damaged or do not fit."""

import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import algorithm_rows
import jax
import jax.numpy as jnp
import numpy as np
import probe_envs
import pytest

from experiments.commandline.presets import preset_settings
from sqt_jax import experiment, policy
from sqt_jax.algorithms import ALGORITHMS


def saved(algo, directory, members=2, **settings):
    env = probe_envs.constant_reward()
    config = experiment.make_config(algo, "cheetah", hidden=(8, 8), **settings)
    agent = experiment.agent_of(config, env)
    state = jax.jit(jax.vmap(agent.init))(jax.random.split(jax.random.key(1), members))
    state = jax.jit(jax.vmap(agent.see))(state, jnp.arange(6.0 * members).reshape(members, 3, 2))
    if settings.get("normalize_observations") and algo.startswith("td7"):  # the saved policy is the checkpoint
        moments = state.learner.statistics.moments
        policies = state.checkpoints.checkpoint._replace(moments=moments)
        state = state._replace(checkpoints=state.checkpoints._replace(checkpoint=policies))
    policy.save_policy(directory, config, env, state)
    return agent, state


CHANGED = {f"{algo} released": preset_settings("released", algo, "cheetah") for algo in ("td3", "sac", "td7")}
CHANGED |= {f"{algo} normalised": {"normalize_observations": True} for algo in ("td3", "sac", "td7")}


@algorithm_rows.every([*ALGORITHMS, *CHANGED], fast=("td3", "td7_sqt", "sac released"))
def test_a_loaded_policy_gives_the_members_actions(algo, tmp_path):
    agent, state = saved(algo.split()[0], tmp_path / "policy", **CHANGED.get(algo, {}))
    obs = jnp.linspace(-1, 1, 6).reshape(3, 2)
    for member in range(2):
        own = jax.tree.map(lambda leaf, member=member: leaf[member], state)
        expected = agent.act(own, obs, jax.random.key(0), deterministic=True)
        np.testing.assert_allclose(policy.load_policy(tmp_path / "policy", member)(obs), expected, rtol=1e-5)


def test_one_agents_state_without_an_axis_of_members_is_rejected(tmp_path):
    """Its first axis would be read as members."""
    env = probe_envs.constant_reward()
    config = experiment.make_config("td3", "cheetah", hidden=(8, 8))
    state = experiment.agent_of(config, env).init(jax.random.key(1))
    with pytest.raises(ValueError, match="that of td3 with a leading axis of members"):
        policy.save_policy(tmp_path / "policy", config, env, state, members=1)
    assert not (tmp_path / "policy").exists()
    policy.save_policy(tmp_path / "policy", config, env, jax.tree.map(lambda leaf: leaf[None], state))
    assert policy.load_policy(tmp_path / "policy")(jnp.zeros((3, env.observation_size))).shape == (3, env.action_size)


def test_an_existing_policy_is_not_overwritten(tmp_path):
    saved("td3", tmp_path / "policy")
    with pytest.raises(FileExistsError):
        saved("td3", tmp_path / "policy")


def test_parameters_of_other_sizes_are_rejected(tmp_path):
    saved("td3", tmp_path / "policy")
    path = tmp_path / "policy" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"action_size": 3}))
    with pytest.raises(ValueError, match="does not have the parameters of a"):
        policy.load_policy(tmp_path / "policy")


def test_observations_of_another_size_are_rejected(tmp_path):
    saved("td3", tmp_path / "policy")
    with pytest.raises(ValueError, match=r"^obs: expected \[B, 2\], got \[5, 3\]"):
        policy.load_policy(tmp_path / "policy")(jnp.zeros((5, 3)))


def test_a_missing_member_is_named(tmp_path):
    saved("td3", tmp_path / "policy")
    with pytest.raises(FileNotFoundError, match="member_7"):
        policy.load_policy(tmp_path / "policy", member=7)


def test_the_folder_of_a_run_has_the_policies_of_its_newest_checkpoint(td3_policy, tmp_path):
    for name in ("policy", "policy_best"):
        shutil.copytree(td3_policy, tmp_path / "checkpoint" / "step_0000000060" / name)
    (tmp_path / "config.json").write_text("{}")  # the run's own
    obs, expected = jnp.ones((1, 2)), policy.load_policy(td3_policy, 1)(jnp.ones((1, 2)))
    (tmp_path / "checkpoint" / "step_0000000080" / "policy").mkdir(parents=True)  # being removed
    for best in (False, True):
        np.testing.assert_array_equal(policy.load_policy(tmp_path, 1, best)(obs), expected)
    with pytest.raises(FileNotFoundError, match="config.json: there is no such file"):
        shutil.rmtree(tmp_path / "checkpoint" / "step_0000000060")
        policy.load_policy(tmp_path)
    with pytest.raises(ValueError, match="^best: expects the folder of a run, not"):
        policy.load_policy(td3_policy, best=True)


def test_parameters_that_are_removed_just_now_are_missing(td3_policy, monkeypatch):
    """Not damaged: another checkpoint is read then."""

    def removed(path):
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(zipfile, "ZipFile", removed)
    with pytest.raises(FileNotFoundError, match="member_0.npz: there is no such file"):
        policy.load_policy(td3_policy)


def test_policies_that_were_written_are_read_bit_for_bit(td3_policy):
    env, config = probe_envs.constant_reward(), experiment.make_config("td3", "cheetah", hidden=(8, 8))
    arrays = policy.read_policies(td3_policy, config, env, 2)
    for member in range(2):
        with np.load(td3_policy / f"member_{member}.npz") as written:
            assert {*arrays} == {*written} and len(arrays) == 6
            assert all(arrays[name][member].tobytes() == written[name].tobytes() for name in written)
    with pytest.raises(ValueError, match="does not have the parameters of td3 on cheetah"):
        policy.read_policies(td3_policy, experiment.make_config("td3", "cheetah", hidden=(9, 8)), env, 2)


# A hostile or damaged folder. `damage` gets the folder.


class Touch:
    """Unpickling it makes a file."""

    def __reduce__(self):
        return Path.touch, (Path("hacked"),)


def written(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def settings(**changes):
    def damage(folder):
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(config | changes))

    return damage


def without(key):
    def damage(folder):
        config = json.loads((folder / "config.json").read_text())
        del config[key]
        (folder / "config.json").write_text(json.dumps(config))

    return damage


def parameters(change, save=np.savez):
    """`change` gets the arrays of member 0 by name, and returns others."""

    def damage(folder):
        with np.load(folder / "member_0.npz") as file:
            arrays = {name: file[name] for name in file.files}
        save(folder / "member_0.npz", **change(arrays))

    return damage


def every(change):
    return parameters(lambda arrays: {name: change(array) for name, array in arrays.items()})


def cut(name, keep):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:keep])


def flipped(folder):
    content = bytearray((folder / "member_0.npz").read_bytes())
    content[len(content) // 3] ^= 255
    (folder / "member_0.npz").write_bytes(content)


def header(text):
    """Arrays with the header `text` and no data."""

    def damage(folder):
        with zipfile.ZipFile(folder / "member_0.npz") as archive:
            names = archive.namelist()
        magic = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little")
        with zipfile.ZipFile(folder / "member_0.npz", "w") as archive:
            for name in names:
                archive.writestr(name, magic + text.encode())

    return damage


def bomb(folder):
    """Few bytes that decompress to many."""
    with zipfile.ZipFile(folder / "member_0.npz") as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(folder / "member_0.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content + bytes(10_000_000))


def pickled(folder):
    (folder / "member_0.npz").write_bytes(pickle.dumps(Touch()))


def a_pipe(folder):
    (folder / "member_0.npz").unlink()
    os.mkfifo(folder / "member_0.npz")


NOT_SETTINGS, NOT_PARAMETERS, OTHER = (
    "not the settings of",
    "not the parameters of",
    "does not have the parameters of a",
)
HOSTILE = {
    "config truncated": (cut("config.json", -20), NOT_SETTINGS),
    "config empty": (written("config.json", b""), NOT_SETTINGS),
    "config a list": (written("config.json", b"[1, 2]"), NOT_SETTINGS),
    "config a number": (written("config.json", b"1"), NOT_SETTINGS),
    "config deep": (written("config.json", b"[" * 100_000), NOT_SETTINGS),
    "config large": (written("config.json", b" " * 1_000_001), NOT_SETTINGS),
    "config pickled": (written("config.json", b"\x80\x04K\x01."), NOT_SETTINGS),
    "config missing": (lambda folder: (folder / "config.json").unlink(), "there is no such file"),
    "no algorithm": (without("algo"), NOT_SETTINGS),
    "no size": (without("action_size"), NOT_SETTINGS),
    "another algorithm": (settings(algo="ppo"), NOT_SETTINGS),
    "algorithm a list": (settings(algo=["td3"]), NOT_SETTINGS),
    "unknown setting": (settings(stepz=1), NOT_SETTINGS),
    "out of range": (settings(gamma=2), NOT_SETTINGS),
    "environment a path": (settings(env="../../x"), NOT_SETTINGS),
    "size too large": (settings(observation_size=10**12), NOT_SETTINGS),
    "size far too large": (settings(action_size=10**400), NOT_SETTINGS),
    "size zero": (settings(observation_size=0), NOT_SETTINGS),
    "size a word": (settings(observation_size="2"), NOT_SETTINGS),
    "size true": (settings(action_size=True), NOT_SETTINGS),
    "other size": (settings(action_size=1_000_000), OTHER),
    "wide": (settings(hidden=[65536, 65536]), OTHER),
    "layers without end": (settings(hidden=[8] * 10_000), NOT_SETTINGS),
    "critics without end": (settings(ensemble_size=10**9), NOT_SETTINGS),
    "parameters truncated": (cut("member_0.npz", -50), NOT_PARAMETERS),
    "parameters empty": (cut("member_0.npz", 0), NOT_PARAMETERS),
    "parameters flipped": (flipped, "not the parameters of|does not hold"),
    "parameters pickled": (pickled, NOT_PARAMETERS),
    "objects": (every(lambda array: np.full(array.shape, Touch(), dtype=object)), OTHER),
    "other type": (every(lambda array: array.astype(np.float64)), OTHER),
    "other byte order": (every(lambda array: array.astype(">f4")), OTHER),
    "other shape": (every(lambda array: array[None]), OTHER),
    "no shape": (every(lambda array: np.float32(0)), OTHER),
    "one array": (lambda folder: np.save((folder / "member_0.npz").open("wb"), np.zeros(3)), NOT_PARAMETERS),
    "none of the arrays": (parameters(lambda arrays: {}), OTHER),
    "one array more": (parameters(lambda arrays: arrays | {"../../more": np.zeros(3)}), OTHER),
    "absurd shape": (header("{'descr': '<f4', 'fortran_order': False, 'shape': (10**15,), }"), NOT_PARAMETERS),
    "large shape": (header("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }"), OTHER),
    "header a call": (header("__import__('os').mkdir('hacked')"), NOT_PARAMETERS),
    "header of nothing": (header("((("), NOT_PARAMETERS),
    "header indented": (header("{\n  1\n 2"), NOT_PARAMETERS),
    "bomb": (bomb, NOT_PARAMETERS),
    "a pipe": (a_pipe, "there is no such file"),
}


@pytest.fixture(scope="module")
def td3_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("td3") / "policy"
    saved("td3", folder)
    return folder


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_folder_is_rejected_in_one_line(td3_policy, tmp_path, monkeypatch, case):
    damage, message = HOSTILE[case]
    folder = tmp_path / "policy"
    shutil.copytree(td3_policy, folder)
    monkeypatch.chdir(tmp_path)
    damage(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        policy.load_policy(folder)
    line = str(error.value)
    assert line.startswith(str(folder)) and line.isprintable() and len(line) < len(str(folder)) + 500
    assert [item.name for item in tmp_path.iterdir()] == ["policy"]  # no code was run


def test_a_compressed_policy_is_read_too(td3_policy, tmp_path):
    folder = tmp_path / "policy"
    shutil.copytree(td3_policy, folder)
    parameters(lambda arrays: {name: np.asfortranarray(array) for name, array in arrays.items()}, np.savez_compressed)(
        folder
    )
    obs = jnp.linspace(-1, 1, 6).reshape(3, 2)
    np.testing.assert_array_equal(policy.load_policy(folder)(obs), policy.load_policy(td3_policy)(obs))


ELSEWHERE = """
import pathlib, sys
import jax, jax.export
import numpy as np
act = jax.export.deserialize(pathlib.Path("policy/act.stablehlo").read_bytes())
obs = np.linspace(-1, 1, 6, dtype=np.float32).reshape(3, 2)
np.save("action.npy", act.call(dict(np.load("policy/member_1.npz")), obs))
assert "sqt_jax" not in sys.modules and "flax" not in sys.modules
"""


@algorithm_rows.every(["td3", "sac_sqt", "td7", "sac normalised"], fast=("td3", "td7"))
def test_the_exported_policy_runs_without_this_package(algo, tmp_path):
    saved(algo.split()[0], tmp_path / "policy", **CHANGED.get(algo, {}))
    subprocess.run([sys.executable, "-c", ELSEWHERE], cwd=tmp_path, check=True, timeout=120)
    obs = jnp.linspace(-1, 1, 6).reshape(3, 2)
    expected = policy.load_policy(tmp_path / "policy", 1)(obs)
    np.testing.assert_allclose(np.load(tmp_path / "action.npy"), expected, rtol=1e-5, atol=1e-6)
