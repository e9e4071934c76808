"""An environment of your own from start to end, as a user has it: train, resume, tables, figures, report, policy."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import sqt_jax
from experiments import play, plots, report, run, tables
from experiments.running import session

ARGV = ["run", "--algo=td3_sqt", "--seeds=0,1", "--steps=40", "--warmup_steps=20", "--eval_every=20", "--quiet"]
ARGV += ["--hidden=16,16", "--batch_size=16", "--eval_episodes=1", "--checkpoint_every=20", "--notensorboard"]


ROOT = Path(__file__).resolve().parent.parent
MODULE = """
import jax
import jax.numpy as jnp
import sqt_jax

def make():
    def start(key):
        x = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return x, x

    def advance(x, action):
        x = x + 0.1 * action
        return x, x, -jnp.abs(x[0]), jnp.abs(x[0]) > 2.0

    return sqt_jax.make_environment("slope", 1, 1, 10, start, advance)
"""


def make_point(name="point", size=1):
    def start(key):
        position = jax.random.uniform(key, (size,), minval=-1.0, maxval=1.0)
        return position, position

    def advance(position, action):
        position = position + 0.1 * action
        return position, position, -jnp.abs(position).sum(), jnp.abs(position).max() > 2

    return sqt_jax.make_environment(name, size, size, 10, start, advance)


def copy_run(name, **changes):
    """The run `first` again, in the folder `name`, with other words in its config.json."""
    path = Path("runs", name, "td3_sqt", "copy")
    shutil.copytree("runs/point/td3_sqt/first", path)
    config = json.loads((path / "config.json").read_text())
    config["settings"]["env"], config["own_env"] = name, config["own_env"] | changes
    (path / "config.json").write_text(json.dumps(config))


@pytest.mark.slow
def test_an_environment_of_ones_own_from_start_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    env, path = make_point(), "runs/point/td3_sqt/first"
    assert run.main([*ARGV, "--name=first"], env=env) == 0
    copy_run("point2")
    copy_run("point", observation_size=2, action_size=2)

    # The same command finds its run; the shell and an environment of other sizes are rejected.
    assert run.main([*ARGV, "--resume"], env=env) == 0
    assert capsys.readouterr() == ("", "")
    assert run.main(["run", f"--resume={path}", "--steps=60"]) == 2
    expected = (
        f"--resume={path}: expects the environment 'point', by --env=MODULE:FUNCTION or run.main(argv, env=...)\n"
    )
    assert capsys.readouterr() == ("", expected)
    assert run.main(["run", f"--resume={path}", "--steps=60"], env=make_point(size=3)) == 2
    assert "observation_size (its own: 1, now: 3), action_size (its own: 1, now: 3)" in capsys.readouterr().err
    assert run.main(["run", f"--resume={path}", "--steps=60", "--quiet"], env=env) == 0

    assert tables.main(["tables", "runs", "--out=tables"]) == 0
    shown = capsys.readouterr().out
    for task, size in {"point (obs 1, action 1)": 1, "point (obs 2, action 2)": 2, "point2": 1}.items():
        assert f"| {task} | own environment | {size} | {size} | - |" in (tmp_path / "tables/table1.md").read_text()
        assert task in shown
    assert plots.main(["plots", "runs", "--out=figures"]) == 0
    assert report.main(["report", "runs", "--out=report.html"]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "td3_sqt on point (obs 2, action 2), done" in page and "td3_sqt on point2, done" in page
    assert f"experiments.run.main(['run', '--resume={path}', '--steps=60', '--quiet'], env=env)" in page

    capsys.readouterr()
    assert play.main(["play", path]) == 2
    assert f"sqt_jax.load_policy('{path}') and sqt_jax.evaluate_policy(policy, env)" in capsys.readouterr().err
    assert play.main(["play", path, "--env=test_own_environment:make_point", "--episodes=2"]) == 0
    assert "episode 1: return" in capsys.readouterr().out
    policy = sqt_jax.load_policy(f"{path}/policy", member=1)
    returns, lengths = sqt_jax.evaluate_policy(policy, env, num_episodes=3)
    assert returns.shape == (3,) and (lengths <= 10).all()
    with pytest.raises(ValueError, match=r"obs: expected \[B, 1\], got \[3, 2\]"):
        sqt_jax.evaluate_policy(policy, make_point(size=2), num_episodes=3)


def test_a_command_line_without_the_programs_name_is_rejected(capsys):
    assert run.main(ARGV[1:], env=make_point()) == 2
    assert capsys.readouterr() == ("", "argv: expects the program's name first, not '--algo=td3_sqt'\n")


def test_training_functions_need_the_environment_of_their_configuration():
    env = make_point()
    config = sqt_jax.make_config("td3_sqt", env)
    for make in (sqt_jax.make_train, sqt_jax.make_trainer):
        with pytest.raises(ValueError, match="an environment of your own called point, given: none"):
            make(config)
        with pytest.raises(ValueError, match="an environment of your own called point, given: maze"):
            make(config, make_point("maze"))
        assert make(config, env)


def test_a_module_that_changes_jaxs_switches_does_not_change_those_of_the_run(tmp_path, monkeypatch):
    (tmp_path / "switches_of_a_test.py").write_text(f'{MODULE}\njax.config.update("jax_enable_x64", True)\n')
    monkeypatch.syspath_prepend(tmp_path)
    seen = []

    def start_session(plan, argv):
        seen.append(jax.config.values["jax_enable_x64"])
        return SimpleNamespace(run=lambda: 0)

    monkeypatch.setattr(session, "start_session", start_session)
    try:
        assert run.main([*ARGV, "--env=switches_of_a_test:make", f"--out={tmp_path}"]) == 0
    finally:
        jax.config.update("jax_enable_x64", False)
    assert seen == [False]


@pytest.mark.slow
def test_a_function_of_a_module_from_start_to_end(tmp_path, monkeypatch, capsys):
    """`--env=module:function`, from the shell: a module in the current folder."""
    (tmp_path / "my_tasks.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)

    def command(*words):
        variables = os.environ | {"PYTHONPATH": str(ROOT)}
        made = [sys.executable, "-m", *words]
        return subprocess.run(made, env=variables, capture_output=True, text=True, cwd=tmp_path)

    train = ["experiments.run", "--env=my_tasks:make", *ARGV[1:], "--name=first"]
    path = "runs/slope/td3_sqt/first"
    assert command(*train).returncode == 0
    refused = command("experiments.run", f"--resume={path}", "--steps=60")
    assert refused.returncode == 2 and "by --env=MODULE:FUNCTION" in refused.stderr
    done = command("experiments.run", f"--resume={path}", "--env=my_tasks:make", "--steps=60", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    played = command("experiments.play", path, "--env=my_tasks:make")
    assert played.returncode == 0 and "episode 0: return" in played.stdout
    assert command("experiments.tables", "runs").returncode == 0
    assert command("experiments.report", "runs").returncode == 0
    assert "experiments.run --env=my_tasks:make --algo=td3_sqt" in (tmp_path / "report.html").read_text()
