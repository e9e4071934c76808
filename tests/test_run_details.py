"""Details of a run for the report."""

import json

import pytest
from made_runs import write_run

from experiments.commandline.arguments import UsageError
from experiments.evidence import run_details
from experiments.evidence.pooling import collect

NAN = float("nan")


def details(path, **content):
    """Details of a run whose config.json also has `content`; keys with None are removed."""
    file = path / "config.json"
    changed = json.loads(file.read_text()) | content
    file.write_text(json.dumps({name: value for name, value in changed.items() if value is not None}))
    members = [member for group in collect([str(path)]).groups for member in group.members]
    return run_details.read(path, members)


def test_details_from_config_json(tmp_path):
    found = details(
        write_run(
            tmp_path, "td3_sqt", curves=[[0, 1, 2], [0, 3, 2]], seeds=[4, 7], versions={"jax": "1", "brax": None}
        ),
        started="2026-01-02T03:04:05+00:00",
        device={"platform": "cpu", "kind": "cpu", "cpus": 2},
        commit="abc+changes",
        command=["/somewhere/run.py", "--algo=td3_sqt", "--name=a b;$(c)"],
    )
    assert (found.algo, found.env, found.seeds, found.steps, found.physics) == (
        "td3_sqt",
        "cheetah",
        (4, 7),
        100,
        "mjx",
    )
    assert found.versions == {"jax": "1", "brax": "not installed"}
    assert found.facts == {
        "began": "2026-01-02T03:04:05+00:00",
        "evaluated on": "mujoco",
        "preset": "paper",
        "device": "cpu, 2 CPUs",
        "commit": "abc, with uncommitted changes",
    }
    (command,) = found.commands
    assert command.text == "python -m experiments.run --algo=td3_sqt '--name=a b;$(c)'"
    assert [(s.name, s.value, s.default) for s in found.settings] == [
        ("steps", "100", "1,000,000"),
        ("warmup_steps", "10", "25,000"),
        ("batch_size", "8", "256"),
        ("eval_every", "50", "5,000"),
        ("eval_episodes", "1", "10"),
    ]
    assert [(m.seed, m.env_steps, m.final, m.best, m.best_env_steps) for m in found.members] == [
        (4, "100", "2.00", "2.00", "100"),
        (7, "100", "2.00", "3.00", "50"),
    ]


def test_swept_settings_and_diverged_members(tmp_path):
    swept = {"penalty_coef": (0.1, 0.5)}
    found = details(write_run(tmp_path, "td3_sqt", curves=[[0, 1, NAN], [NAN, NAN, NAN]], swept=swept))
    assert found.settings[0] == ("penalty_coef", "0.1, 0.5", "0.5")
    assert [(m.swept, m.final, m.best) for m in found.members] == [
        (("0.1",), "- (diverged)", "1.00"),
        (("0.5",), "- (diverged)", "-"),
    ]


def test_a_resumed_run_has_all_its_commands(tmp_path):
    resumed = [
        {"env_steps": 1000, "command": ["run.py", "--resume=x"], "versions": {"jax": "0.10.2"}},
        {"env_steps": 2000, "command": ["run.py", "--resume=x"], "versions": {"jax": "0.11", "brax": "1"}},
        {"env_steps": 0, "command": ["run.py", "--config=f.yaml"]},
        "nonsense",
    ]
    first, second, other, third, fourth = details(write_run(tmp_path), resumed=resumed).commands
    assert first.text is None  # made runs have none
    assert second == ("python -m experiments.run --resume=x", "Resumed at step 1,000 with", "")
    assert other.note == "Other versions from there on: jax 0.11, brax 1."
    assert third.label == "Resumed from the start with" and "read flags from a file" in third.note
    assert fourth.text is None and "no command" in fourth.note


def test_a_run_on_an_environment_from_python_is_repeated_in_python(tmp_path):
    path = write_run(tmp_path, env="point", sizes=(3, 2), steps=60)
    resumed = [{"env_steps": 60, "command": ["run.py", "--resume=x y"]}]
    found = details(path, command=["", "--algo=td3", "--out=it's"], resumed=resumed)
    words = "(in Python; env is the environment that was handed in)"
    assert found.commands == [
        ("experiments.run.main(['run', '--algo=td3', \"--out=it's\"], env=env)", f"Started with {words}", ""),
        ("experiments.run.main(['run', '--resume=x y'], env=env)", f"Resumed at step 60 with {words}", ""),
    ]
    assert (found.env, found.physics) == ("point", "own")
    assert not {"physics", "eval_physics"} & {setting.name for setting in found.settings}


@pytest.mark.parametrize(
    ("words", "shell"),
    [
        (["--env=my_tasks:make", "--algo=td3"], True),
        (["--env", "my_tasks:make"], True),
        (["--algo=td3", "--name=a:b"], False),
        (["--env=point"], False),
    ],
)
def test_a_run_on_a_function_of_a_module_is_repeated_from_the_shell(tmp_path, words, shell):
    path = write_run(tmp_path, env="point", sizes=(3, 2), steps=60)
    (found, *_) = details(path, command=["", *words]).commands
    assert found.text.startswith("python -m experiments.run" if shell else "experiments.run.main([")


def test_an_environment_has_the_name_that_it_has_in_the_tables(tmp_path):
    write_run(tmp_path, env="point", name="a", sizes=(1, 1))
    write_run(tmp_path, env="point", name="b", sizes=(3, 2))
    write_run(tmp_path, env="cheetah", sizes=(3, 2))
    assert [run.env for run in run_details.read_all(collect([str(tmp_path)]))] == [
        "cheetah (own)",
        "point (obs 1, action 1)",
        "point (obs 3, action 2)",
    ]


@pytest.mark.parametrize("command", [None, [], ["run"], "run --algo=td3", ["run", 3], {"a": 1}])
def test_missing_records_are_named(tmp_path, command):
    found = details(write_run(tmp_path), command=command, device=3)
    assert found.commands[0].text is None and "no command that can be repeated" in found.commands[0].note
    assert {found.facts[name] for name in ("began", "device", "commit")} == {"not recorded in config.json"}


@pytest.mark.parametrize(
    ("summary", "status", "took"),
    [
        (None, "not ended: no summary.json", None),
        ('{"status": "done", "wall_seconds": 12.345, "steps_per_second": null}', "done", "12.3 s"),
        ('{"status": "interrupted", "wall_seconds": "<b>"}', "interrupted", None),
        ('{"status": "<script>"}', "not known: summary.json cannot be understood", None),
        ('{"status": ["done"]}', "not known: summary.json cannot be understood", None),
        ("[1]", "not known: summary.json cannot be understood", None),
        ("{", "not known: summary.json cannot be understood", None),
    ],
)
def test_how_a_run_ended(tmp_path, summary, status, took):
    path = write_run(tmp_path)
    if summary is not None:
        (path / "summary.json").write_text(summary)
    found = details(path)
    assert (found.status, found.facts.get("took")) == (status, took)


def test_training_and_speed_are_the_last_processs_where_there_were_several(tmp_path):
    path = write_run(tmp_path)
    (path / "summary.json").write_text(
        '{"status": "done", "wall_seconds": 90, "train_seconds": 20, "steps_per_second": 500}'
    )
    names = {"training": "20.0 s", "speed": "500 training steps/s", "took": "90.0 s"}
    assert names.items() <= details(path).facts.items()
    facts = details(path, resumed=[{"env_steps": 50}]).facts
    names = {"training of the last process": "20.0 s", "speed of the last process": "500 training steps/s"}
    assert (names | {"took": "90.0 s"}).items() <= facts.items()
    assert not {"training", "speed"} & facts.keys()


def test_a_folder_without_a_run_is_rejected(tmp_path):
    with pytest.raises(UsageError, match=r"it has no config.json that can be read"):
        run_details.read(tmp_path, [])
