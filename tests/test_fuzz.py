"""Random command lines and YAML files, up to the finished plan: a plan or one line, and nothing is written.

The other commands: up to their checked flags.
"""

import functools
import random
from pathlib import Path

import pytest
import yaml

from experiments import plots, report, tables
from experiments.commandline import flags
from experiments.commandline.arguments import UsageError, printable
from experiments.commandline.flag_table import FLAGS
from experiments.grids.grid import GRIDS, make_cells
from experiments.playing import play_flags
from experiments.running import memory, plan
from sqt_jax import envs
from sqt_jax.algorithms import ALGORITHMS

NAMES = [flag.name for group in FLAGS.values() for flag in group if flag.name not in ("help", "config")]
NUMBERS = ["0", "1", "-1", "2", "0.5", "1e3", "1e6", "1e400", "nan", "inf", "-inf", "2147483648", "1_000", "0x10", "٣"]
WORDS = [
    "true",
    "false",
    "yes",
    "no",
    "null",
    "auto",
    "",
    " ",
    "~",
    "~nobody/x",
    ".",
    "..",
    "/",
    "-",
    "--",
    "=",
    ",",
    "a b",
]
ODD = ["\n", "\0", "\x1b[31m", "\ud800", "é" * 300, "x" * 5000, "%s%n", "$HOME", "'", '"', "{}", "[1]", "!!python/none"]
# For each flag, values that are often valid, so that many inputs get far.
VALID = {
    "algo": [*ALGORITHMS] * 3,
    "env": ["ant", "cheetah", "hopper-v5", "swimmer", "Ant-v4"] * 3,
    "physics": ["mujoco", "mjx", "warp"],
    "eval_physics": ["auto", "mujoco", "mjx"],
    "seeds": ["0", "0,1", "3,1,2", "4294967295"],
    "preset": ["paper", "quick", "released"],
    "steps": ["1000", "5e3", "100"],
    "warmup_steps": ["0", "10", "100"],
    "hidden": ["8", "8,8", "256,256"],
    "penalty_coef": ["0.1", "0.1,0.5", "0"],
    "ensemble_size": ["2", "3", "5"],
    "out": ["out", "out/a"],
    "name": ["a", "run 1"],
    "resume": ["none", ""],
}
INPUTS = 10_000


def value(draw: random.Random, name: str) -> str:
    pool = VALID.get(name, NUMBERS) if draw.random() < 0.85 else draw.choice([NUMBERS, WORDS, ODD])
    text = draw.choice(pool)
    return f"{text},{draw.choice(NUMBERS)}" if draw.random() < 0.03 else text


def settings(draw: random.Random) -> dict[str, str]:
    chosen = draw.sample(NAMES, draw.randint(0, 5))
    required = [name for name in ("algo", "env") if draw.random() < 0.95]
    return {name: value(draw, name) for name in dict.fromkeys([*required, *chosen])}


def command_line(draw: random.Random, folder) -> list[str]:
    """Flags, some of them in a YAML file, or a file of random bytes."""
    given = settings(draw)
    words = [f"--{name}={text}" for name, text in given.items()]
    if draw.random() < 0.1:
        words.insert(draw.randrange(len(words) + 1), draw.choice(["--", "x", "-h1", "--no", "--nosteps", *ODD]))
    if draw.random() < 0.3:
        more = settings(draw)
        content = yaml.safe_dump(more, allow_unicode=True).encode("utf-8", "surrogatepass")
        if draw.random() < 0.3:
            content = bytes(draw.choice(content) if content else 0 for _ in range(draw.randint(0, 200)))
        elif draw.random() < 0.3:
            position = draw.randrange(len(content))
            content = content[:position] + draw.randbytes(2) + content[position:]
        (folder / "flags.yaml").write_bytes(content)
        words.append("--config=flags.yaml")
    return ["run", *words]


def run(inputs: int, seed: int, folder, monkeypatch) -> int:
    """Plans random inputs; returns how many of them were valid."""
    home = folder / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(folder)
    monkeypatch.setattr(envs, "make", functools.cache(envs.make))
    estimate = functools.cache(memory.memory_estimate)
    monkeypatch.setattr(memory, "memory_estimate", estimate)
    draw, planned = random.Random(seed), 0
    for _ in range(inputs):
        argv = command_line(draw, folder)
        try:
            options = flags.parse(argv)
            planned += options is not None and bool(plan.make_plan(options).members)
        except UsageError as error:
            text = printable(str(error))
            assert text and "\n" not in text and len(text) < 12_000, argv
        except BaseException as error:
            raise AssertionError(f"{argv} with {(folder / 'flags.yaml').read_bytes()!r}") from error
    assert {item.name for item in folder.iterdir()} <= {"home", "flags.yaml"} and not list(home.iterdir())
    return planned


def test_a_few_random_command_lines(tmp_path, monkeypatch):
    assert run(200, 1, tmp_path, monkeypatch) > 10


PARSERS = {"tables": tables.parser, "plots": plots.parser, "report": report.parser, "play": play_flags.parser}


@pytest.mark.parametrize("command", PARSERS)
def test_random_words_for_commands_that_read_runs(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    draw, accepted = random.Random(command), 0
    names = [word for action in PARSERS[command]()._actions for word in action.option_strings if word.startswith("--")]
    for _ in range(500):
        flag, text = (
            draw.choice([*names, "--no", "-x"]),
            draw.choice([*NUMBERS, *WORDS, *ODD, "a.mp4", "640x480", "png"]),
        )
        words = [".", *draw.choice([[], [flag], [f"{flag}={text}"], [flag, text], [text, f"{flag}={text}"]])]
        try:
            options = PARSERS[command]().read([command, *words])
            if command == "play":
                play_flags.check(Path(options.runs[0]), options)
            accepted += 1
        except UsageError as error:
            assert str(error) and "\n" not in printable(str(error)), words
        except SystemExit as left:  # --help
            assert left.code == 0
        except BaseException as error:
            raise AssertionError(words) from error
    assert accepted > 20 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", range(200))
def test_random_words_for_a_sweep(seed, tmp_path):
    draw = random.Random(seed)
    grid = draw.choice([*GRIDS, *GRIDS, *WORDS, *ODD, None])
    algos, tasks = ([draw.choice([*ALGORITHMS, "", "\0"]) for _ in range(draw.randint(0, 2))] for _ in range(2))
    words = [f"--{name}={text}" for name, text in settings(draw).items()]
    try:
        make_cells(grid, algos, tasks, tmp_path, words)
    except UsageError as error:
        assert str(error) and "\n" not in printable(str(error)), (grid, words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_many_random_command_lines(tmp_path, monkeypatch):
    assert run(INPUTS, 0, tmp_path, monkeypatch) > INPUTS / 20
