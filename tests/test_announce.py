"""What a run prints before training and after it."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from experiments.running.announce import SHORT, Announcer, evaluation_share, final_table, what_to_expect

MEMBER = {"member": 0, "seed": 7, "penalty_coef": 0.5, "final_return": 1.25, "best_return": 2.5, "q_std": 0.125}
GROUP = {
    "penalty_coef": 0.5,
    "seeds": [7, 8],
    "final": {"mean": 1.0, "std": 0.25},
    "score": {"mean": 2.0, "std": 0.5},
}
LOST = MEMBER | {"member": 1, "seed": 8, "best_return": None, "q_std": None}
SUMMARY = {
    "status": "interrupted",
    "members": [MEMBER, LOST],
    "groups": [GROUP],
    "diverged": [{"member": 1, "env_steps": 30}],
}


@pytest.fixture
def console():
    return Console(file=io.StringIO(), force_terminal=False, width=100, color_system=None, legacy_windows=False)


def test_share_of_evaluation_in_the_papers_protocol():
    text = evaluation_share(1_000_000, 201, 10, 1_000)
    assert "201 evaluations of 10 episodes" in text
    assert "up to 2,010,000 steps (67% of all)" in text


def test_a_short_run_says_what_its_returns_mean():
    assert "ant earns 1 per step" in what_to_expect("ant", 6_000) and "1,000 for standing" in what_to_expect(
        "ant", 6_000
    )
    assert "5,000 for standing" in what_to_expect("humanoid", 6_000)
    assert not what_to_expect("cheetah", 6_000)  # it cannot fall
    assert not what_to_expect("ant", SHORT) and not what_to_expect("brax:ant", 6_000)


def test_final_table_has_the_members_and_the_groups(console):
    console.print(final_table(SUMMARY, []))
    rows = [line.split() for line in console.file.getvalue().splitlines() if line.strip()]
    rows = [row for row in rows if row[0] in ("member", "0", "1", "mean") or set(row[0]) == {"─"}]
    assert rows[0] == ["member", "seed", "penalty_coef", "final", "return", "best", "return", "q_std"]
    assert rows[2] == ["0", "7", "0.5", "1.2", "2.5", "0.125"]
    assert rows[3] == ["1", "(diverged)", "8", "0.5", "1.2", "-", "-"]
    assert rows[-1] == ["mean", "+-", "std", "2", "seeds", "0.5", "1.0", "+-", "0.2", "2.0", "+-", "0.5"]


@pytest.mark.parametrize("quiet", [False, True])
def test_an_interrupted_run_ends_with_the_command_that_resumes_it(console, tmp_path, quiet):
    path = tmp_path / "a run"
    plan = SimpleNamespace(
        path=path,
        own_env=None,
        config=SimpleNamespace(env="ant"),
        output={"checkpoint_every": 20},
        options=SimpleNamespace(quiet=quiet),
    )
    outcome = SimpleNamespace(interrupted=True, wall_seconds=83.0, steps_per_second=1234.0)
    Announcer(console, plan).end(outcome, SUMMARY, [], curves=True)
    lines = console.file.getvalue().splitlines()
    if quiet:
        assert lines == []
        return
    assert lines[-3:] == [
        "interrupted after 1:23, 1,234 training steps/s",
        f"curves: {path / 'curves.png'}",
        f"resume with: python -m experiments.run --resume='{path}'",
    ]


@pytest.mark.parametrize(
    ("env", "command"),
    [
        ("my_tasks:make", "python -m experiments.run --resume=a --env=my_tasks:make"),
        ("gym:my_tasks:Mine-v0", "python -m experiments.run --resume=a --env=gym:my_tasks:Mine-v0"),
        ("gym:Pendulum-v1", "python -m experiments.run --resume=a"),
        ("point", "experiments.run.main(['run', '--resume=a'], env=env)"),  # handed in, and named
        (None, "experiments.run.main(['run', '--resume=a'], env=env)"),
    ],
)
def test_a_run_on_ones_own_environment_is_resumed_with_it(console, env, command):
    options = SimpleNamespace(quiet=False, env=env)
    is_gym = (env or "").startswith("gym:")
    plan = SimpleNamespace(
        path="a",
        own_env=None if is_gym else object(),
        config=SimpleNamespace(env=env if is_gym else "point"),
        output={"checkpoint_every": 20},
        options=options,
    )
    outcome = SimpleNamespace(interrupted=True, wall_seconds=83.0, steps_per_second=None)
    Announcer(console, plan).end(outcome, SUMMARY, [], curves=False)
    assert console.file.getvalue().splitlines()[-1] == f"resume with: {command}"
