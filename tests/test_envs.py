"""Environments by name: sizes, aliases, Gymnasium ids, unknown names."""

import pytest

from sqt_jax import envs


@pytest.mark.parametrize("name", envs.TASKS)
def test_sizes_are_those_of_gymnasium_and_of_the_papers_table_1(name):
    sizes = {"cheetah": (17, 6), "walker": (17, 6), "ant": (27, 8), "humanoid": (376, 17)}
    sizes |= {"hopper": (11, 3), "swimmer": (8, 2), "humanoid_standup": (376, 17)}
    v5 = {"ant-v5": (105, 8), "humanoid-v5": (348, 17), "humanoid_standup-v5": (348, 17)}
    env = envs.make(name, "mujoco")
    assert (env.observation_size, env.action_size) == v5.get(name, sizes[name.removesuffix("-v5")])
    assert env.episode_length == 1000
    assert env.name == name


@pytest.mark.parametrize(("alias", "name"), envs.ALIASES.items())
def test_aliases(alias, name):
    assert envs.resolve(alias) == name
    assert name in envs.TASKS


@pytest.mark.parametrize("name", envs.TASKS)
def test_gymnasiums_own_ids_are_names(name):
    assert envs.resolve(envs.TASKS[name].gymnasium_id) == name


@pytest.mark.parametrize(
    ("alias", "name"), [("ant-v4", "ant"), ("walker2d-v5", "walker-v5"), ("HumanoidStandup-v5", "humanoid_standup-v5")]
)
def test_versions_of_names_and_aliases(alias, name):
    assert envs.resolve(alias) == name


@pytest.mark.parametrize("name", ["ant-v3", "ant-v6", "ant-v", "ant-v5-v5", "-v5", ""])
def test_other_versions_are_unknown(name):
    with pytest.raises(ValueError, match="expects one of cheetah, "):
        envs.resolve(name)


@pytest.mark.parametrize("call", [envs.resolve, envs.make], ids=["resolve", "make"])
def test_the_message_for_an_unknown_name_lists_all_and_the_nearest(call):
    with pytest.raises(ValueError, match=r"cheetah, walker, ant, humanoid.*'humanoit'; did you mean humanoid\?"):
        call("humanoit")


def test_the_message_for_unknown_physics_lists_all_and_the_nearest():
    with pytest.raises(ValueError, match=r"physics: expects one of mjx.*'mjxx'; did you mean mjx\?"):
        envs.make("ant", physics="mjxx")
