"""What the README shows works: its Python runs, its commands are understood."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from absl.testing import flagsaver

from experiments import bench, play, plots, report, run, tables
from experiments.commandline import flags
from experiments.running.plan import make_plan

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w+)( continued)?\n(.*?)```", README, re.DOTALL)
PYTHON = [code for language, continued, code in BLOCKS if language == "python" and not continued]
SHELL = "\n".join(code for language, _, code in BLOCKS if language == "sh")


def commands(text, *modules):
    """The command lines in a text that start one of these modules, from the module's name on."""
    pattern = rf" -m experiments\.({'|'.join(modules)}) "
    return [shlex.split(line, comments=True)[2:] for line in text.splitlines() if re.search(pattern, line)]


COMMANDS = commands(SHELL, "run")
LOOKS = commands(SHELL, "tables", "plots", "report", "play")
BENCHES = commands(SHELL, "bench")


def understood(argv):
    """The options of a command that looks at runs."""
    modules = (tables, plots, report, play)
    return {module.__name__: module for module in modules}[argv[0]].parser().read(argv)


@pytest.mark.parametrize("code", PYTHON, ids=lambda code: code.splitlines()[0])
def test_python_examples_run(code):
    exec(compile(code, "README.md", "exec"), {})


@pytest.mark.slow
def test_the_loop_of_ones_own_trains_td7_too():
    (code,) = (code for code in PYTHON if "gymnasium.make" in code)
    for shown, td7 in [('"td3_sqt"', '"td7_sqt"'), ("replay.uniform", "lap.lap"), ("import replay", "import lap")]:
        assert code.count(shown) == 1
        code = code.replace(shown, td7)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["state"].checkpoints.assessments == 1  # an episode has 200 steps


@pytest.mark.parametrize("argv", COMMANDS, ids=lambda argv: " ".join(argv[1:3]))
def test_commands_are_understood(argv, tmp_path):
    if any(word.startswith("--resume=") for word in argv):  # of a run that is not there
        assert flags.parse(argv).resume == "runs/ant/sac_sqt/NAME"
        return
    options = flags.parse([*argv, f"--out={tmp_path}", "--replay_capacity=1000"])
    assert make_plan(options).members


@pytest.mark.parametrize("argv", LOOKS, ids=lambda argv: " ".join(argv))
def test_commands_that_look_at_runs_are_understood(argv):
    assert understood(argv).runs


@pytest.mark.parametrize("argv", BENCHES, ids=lambda argv: " ".join(argv))
def test_commands_that_measure_are_understood(argv, monkeypatch):
    monkeypatch.setattr(bench.compare, "lacks", lambda peer, interpreter: False)
    with flagsaver.flagsaver():
        assert bench.FLAGS(argv) == argv[:1]  # nothing is left over
        bench.check_flags()


def test_the_miniatures_commands_are_understood():
    made = subprocess.run(["make", "--dry-run", "miniature"], cwd=ROOT, capture_output=True, text=True, check=True)
    ((_, *sweep),) = commands(made.stdout, "sweep")
    rest = [word for word in sweep if not word.startswith(("--preset=", "--tasks="))]
    options = flags.parse(["run", "--algo=td3", "--env=ant", *rest])
    assert (options.settings["steps"], options.settings["physics"]) == (3_000, "mujoco")
    looks = commands(made.stdout, "tables", "plots", "report", "play")
    assert len(looks) == 4 and all(understood(argv).runs for argv in looks)


def test_the_readme_has_them():
    assert len(PYTHON) >= 3 and len(COMMANDS) >= 4 and len(LOOKS) >= 7 and len(BENCHES) >= 4


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_policy_of_a_run_loads_as_shown(tmp_path):
    """The example marked `continued`, on a tiny run."""
    argv = ["run", "--algo=td3", "--env=cheetah", "--seeds=0", "--steps=60", "--warmup_steps=20", "--batch_size=8"]
    argv += ["--hidden=8", "--eval_every=60", "--eval_episodes=1", f"--out={tmp_path}", "--name=tiny", "--quiet"]
    assert run.main([*argv, "--physics=mujoco"]) == 0
    shown = "\n".join(code for _, continued, code in BLOCKS if continued)
    assert shown.count("runs/cheetah/td3/NAME") == 1
    names: dict = {}
    exec(shown.replace("runs/cheetah/td3/NAME", str(tmp_path / "cheetah" / "td3" / "tiny")), names)
    assert names["action"].shape == (4, 6)
    assert names["lengths"].tolist() == [1000, 1000]
