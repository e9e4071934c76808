"""A run on an environment that is handed in: filed, recorded and resumed under the environment's own name."""

import json

import probe_envs
import pytest

from experiments.endurance.run_results import differences, read_results
from experiments.run import main

pytestmark = pytest.mark.usefixtures("shared_programs")

NEW = (
    "--algo=td3_sqt --seeds=3,1 --warmup_steps=20 --eval_every=20 --eval_episodes=1 --batch_size=8 --hidden=8,8 "
    "--checkpoint_every=20 --replay_capacity=40 --notensorboard --quiet --name=run"
)


def run(*arguments, env):
    return main(["experiments.run", *arguments], env)


@pytest.fixture(scope="module")
def point():
    return probe_envs.constant_reward()._replace(name="my point/v0")


@pytest.fixture(scope="module")
def out(tmp_path_factory, point):
    """The folder of two runs: `out/part` has been trained to step 40, `out/all` to step 60."""
    out = tmp_path_factory.mktemp("out")
    for name, steps in (("part", 40), ("all", 60)):
        assert run(*NEW.split(), f"--steps={steps}", f"--out={out / name}", env=point) == 0
    return out


def test_the_run_is_filed_and_recorded_under_the_name_of_its_environment(out):
    path = out / "all" / "my-point-v0" / "td3_sqt" / "run"
    config = json.loads((path / "config.json").read_text())
    settings = config["settings"]
    assert (settings["env"], settings["physics"], settings["eval_physics"]) == ("my point/v0", "own", "own")
    assert config["own_env"] == {"observation_size": 2, "action_size": 1}
    assert (path / "policy").is_dir() and (path / "evaluations.csv").exists()


def test_it_is_resumed_with_the_environment_and_ends_as_without_a_break(out, point):
    path, unbroken = (out / name / "my-point-v0" / "td3_sqt" / "run" for name in ("part", "all"))
    assert run(f"--resume={path}", "--steps=60", "--quiet", env=point) == 0
    assert differences(read_results(unbroken), read_results(path)) == []
    # The same command now finds it finished.
    assert run(*NEW.split(), "--steps=60", f"--out={out / 'part'}", "--resume", env=point) == 0


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        (None, "expects the environment 'my point/v0', by --env=MODULE:FUNCTION or run.main(argv, env=...)"),
        ({"name": "other"}, "expects the run's own settings; these differ: env (its own: my point/v0, now: other)"),
        ({"observation_size": 3}, "these differ: observation_size (its own: 2, now: 3)"),
    ],
    ids=["none", "name", "size"],
)
def test_without_its_environment_resuming_is_rejected_in_one_line(out, point, capsys, env, reason):
    path = out / "all" / "my-point-v0" / "td3_sqt" / "run"
    before = {item: item.read_bytes() for item in path.rglob("*") if item.is_file()}
    assert run(f"--resume={path}", "--steps=80", env=env and point._replace(**env)) == 2
    printed, line = capsys.readouterr()
    assert printed == "" and line.startswith(f"--resume={path}: ") and reason in line and line.count("\n") == 1
    assert {item: item.read_bytes() for item in path.rglob("*") if item.is_file()} == before
