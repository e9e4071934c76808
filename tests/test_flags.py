"""The command line as `Options`: types, defaults, sweeps, files of flags, error lines."""

import os
import subprocess
import sys

import pytest

from experiments.commandline import flags


def parse(*arguments):
    return flags.parse(["run", "--algo=sac_sqt", "--env=ant", *arguments])


def test_defaults_leave_all_settings_to_the_algorithm():
    options = parse()
    assert (options.algo, options.env, options.seeds) == ("sac_sqt", "ant", (0, 1, 2, 3, 4))
    assert options.settings == {} and options.sweep == {}
    assert (options.preset, options.out, options.name) == ("paper", "runs", None)
    assert options.tensorboard is options.checkpoint_every is options.resume is None and not options.quiet


def test_settings_are_parsed_by_type():
    settings = parse(
        "--steps=1e6",
        "--warmup_steps",
        "1_000",
        "--hidden=64,32",
        "--lr=1e-3",
        "--nopenalty_inside_gamma",
        "--reduce=mean",
    ).settings
    assert settings == {
        "steps": 1_000_000,
        "warmup_steps": 1_000,
        "hidden": (64, 32),
        "lr": 1e-3,
        "penalty_inside_gamma": False,
        "reduce": "mean",
    }
    assert type(settings["steps"]) is int


def test_lists_of_scalars_are_sweeps_and_single_values_are_settings():
    options = parse("--tau=0.01", "--lr=1e-3,1e-4", "--penalty_coef=0,0.5", "--seeds=7,3")
    assert options.settings == {"tau": 0.01}
    assert list(options.sweep.items()) == [("penalty_coef", (0.0, 0.5)), ("lr", (1e-3, 1e-4))]
    assert options.seeds == (7, 3)


PAIRS = ("--paired", "--lr=1e-3,1e-3,1e-4", "--penalty_coef=0,0.5,0.5")


def test_paired_lists_are_configurations_instead_of_a_product():
    options = parse(*PAIRS)
    assert options.sweep == {"penalty_coef": (0.0, 0.5, 0.5), "lr": (1e-3, 1e-3, 1e-4)}
    assert options.configurations == [(0.0, 1e-3), (0.5, 1e-3), (0.5, 1e-4)]
    assert parse("--paired", "--lr=1e-3,1e-4", "--tau=0.1").configurations == [(1e-3,), (1e-4,)]
    assert parse("--paired").configurations == [()] == parse().configurations
    assert len(parse("--lr=1e-3,1e-4", "--tau=0.1,0.2").configurations) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--lr=0.1,0.2", "--tau=0.1,0.2,0.3"), "--paired: expects lists of one length; lr has 2, tau has 3"),
        (
            ("--lr=0.1,0.2,0.1", "--tau=0.3,0.3,0.3"),
            "--paired: expects each configuration once, got --lr=0.1 --tau=0.3 2 times",
        ),
        (("--lr=0.1,0.1",), "--paired: expects each configuration once, got --lr=0.1 2 times"),
        (
            (f"--lr={','.join(f'0.{number:05}' for number in range(5001))}", "--seeds=0,1"),
            "--seeds: expects at most 10000 members, seeds times swept values, not 10002",
        ),
    ],
)
def test_lists_that_cannot_be_paired_are_rejected(arguments, message):
    with pytest.raises(flags.UsageError) as error:
        parse("--paired", *arguments)
    assert str(error.value) == message


def test_temperature_auto_is_learned():
    assert parse("--temperature=auto").settings == {"learn_temperature": True}
    assert parse("--temperature=0.1,0.2").sweep == {"temperature": (0.1, 0.2)}


BAD = {
    "--stepz=5": "--stepz: unknown flag; did you mean --steps?",
    "--wibble": "--wibble: unknown flag; --help lists the flags",
    "--steps=many": "--steps=many: expects a whole number",
    "--steps=1.5": "--steps=1.5: expects a whole number",
    "--steps=inf": "--steps=inf: expects a whole number",
    "--steps=": "--steps=: expects a whole number",
    "--steps": "--steps: expects a whole number",
    "--steps=-5": "--steps: expects a whole number from 1 to 2147483647, not -5",
    "--lr=nan": "--lr=nan: expects a number, or a list like 0.1,0.5",
    "--lr=0.1,,0.2": "--lr=0.1,,0.2: expects a number, or a list like 0.1,0.5",
    "--lr=0.1,0.1": "--lr: expects each value once, got 0.1 2 times",
    "--penalty_coef=-0.5": "--penalty_coef: expects a number of at least 0, not -0.5",
    "--penalty_coef=0.5,-1": "--penalty_coef: expects a number of at least 0, not -1.0",
    "--exploration_noise=inf": "--exploration_noise=inf: expects a number",
    "--temperature=warm": "--temperature=warm: expects a number, a list like 0.1,0.2, or auto",
    "--hidden=64,wide": "--hidden=64,wide: expects whole numbers like 256,256",
    "--tensorboard=maybe": "--tensorboard=maybe: expects true or false",
    "--wandb=a/b": "--wandb=a/b: expects the name of a project, up to 128 characters without /\\#?%:",
    f"--wandb={'a' * 129}": f"--wandb={'a' * 40}: expects the name of a project, up to 128 characters without /\\#?%:",
    "--seeds=": "--seeds=: expects whole numbers like 0,1,2",
    "--seeds=0,1,0": "--seeds: expects each value once, got 0 2 times",
    "--seeds=-1": "--seeds=-1: expects whole numbers from 0 to 4294967295",
    "--seeds=4294967296": "--seeds=4294967296: expects whole numbers from 0 to 4294967295",
    "--seeds=0.5": "--seeds=0.5: expects whole numbers like 0,1,2",
    "--preset=fast": "--preset=fast: expects one of paper, quick, released",
    "--name=a/b": "--name=a/b: expects up to 200 bytes, no slashes or control characters: it names a folder",
    "--name=..": "--name=..: expects up to 200 bytes, no slashes or control characters: it names a folder",
    "--name=": "--name=: expects up to 200 bytes, no slashes or control characters: it names a folder",
    "--name=a\tb": "--name=a\tb: expects up to 200 bytes, no slashes or control characters: it names a folder",
    "--out=": "--out=: expects a folder",
    "extra": "extra: unexpected argument; settings are given as --flag=value",
}


@pytest.mark.parametrize("argument", BAD)
def test_invalid_arguments_are_named_with_what_they_expect(argument):
    with pytest.raises(flags.UsageError) as error:
        parse(argument)
    assert str(error.value) == BAD[argument]


@pytest.mark.parametrize("missing", ["algo", "env"])
def test_algorithm_and_environment_are_required(missing):
    given = {"algo": "--algo=sac", "env": "--env=ant"}
    with pytest.raises(flags.UsageError, match=f"^--{missing}: is required"):
        flags.parse(["run", *(text for name, text in given.items() if name != missing)])


@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_overrides_everything_else(word):
    assert flags.parse(["run", "--stepz=5", word]) is None


@pytest.mark.parametrize(
    ("given", "project"),
    [
        ([], None),
        (["--wandb"], "sqt_jax"),
        (["--wandb", "--quiet"], "sqt_jax"),
        (["--wandb=ants"], "ants"),
        (["--wandb", "ants"], "ants"),
        (["--wandb=true"], "sqt_jax"),
        (["--wandb=false"], ""),
        (["--wandb="], ""),
        (["--nowandb"], ""),
    ],
)
def test_wandb_has_an_optional_project(monkeypatch, given, project):
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    assert parse(*given).wandb == project
    monkeypatch.setenv("WANDB_PROJECT", "mine")
    assert parse(*given).wandb == ("mine" if project == "sqt_jax" else project)


def test_td7s_settings_are_parsed():
    assert parse(
        "--target_update_period=100", "--priority_exponent=0.5", "--policy_checkpoint_switch=1e5"
    ).settings == {
        "target_update_period": 100,
        "priority_exponent": 0.5,
        "policy_checkpoint_switch": 100_000,
    }


def test_reading_the_command_line_imports_nothing_heavy():
    heavy = ("mujoco.mjx", "matplotlib", "tensorboardX", "scipy.stats")
    code = f"import sys, experiments.run; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout == "[]\n"


# Settings from a file


def write(tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_file_gives_flags_and_the_command_line_wins(tmp_path):
    path = write(
        tmp_path,
        "algo: sac_sqt\nenv: ant\nsteps: 1e5\nhidden: [64, 32]\nseeds: [3, 1]\ntemperature: auto\n"
        "penalty_coef: [0, 0.5]\npenalty_inside_gamma: false\nquiet: yes\n",
    )
    options = flags.parse(["run", f"--config={path}", "--env=walker", "--steps=200"])
    assert (options.algo, options.env, options.seeds, options.quiet) == ("sac_sqt", "walker", (3, 1), True)
    assert options.settings == {
        "steps": 200,
        "hidden": (64, 32),
        "penalty_inside_gamma": False,
        "learn_temperature": True,
    }
    assert options.sweep == {"penalty_coef": (0.0, 0.5)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepz: 5", "--stepz: unknown flag; did you mean --steps? (in "),
        ("steps: two", "--steps=two: expects a whole number (in "),
        ("steps: [5", "expects a YAML file, which this is not"),
        ("- steps", "expects lines like `steps: 100000`"),
        ("5: 6", "--5: unknown flag; --help lists the flags (in "),
        ("", "expects lines like `steps: 100000`"),
        ("steps: {a: 5}", "steps expects a number, a word or a list of them"),
        ("steps:", "steps expects a number, a word or a list of them"),
        ("seeds: []", "seeds expects a number, a word or a list of them"),
        ("config: other.yaml", "config is for the command line"),
        ("steps: !!python/object/apply:os.system ['true']", "--steps=true: expects a whole number (in "),
        ("a: &a [x, x]\nb: &b [*a, *a]\nseeds: [*b, *b]", "b expects a number, a word"),
        (b"\xff\xfe\x00", "expects a YAML file, which this is not"),
        ("[" * 5000, "expects a YAML file, which this is not"),
        ("#" * 200_000, "expects a file of at most 100000 bytes"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_an_invalid_file_is_rejected_in_one_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(flags.UsageError) as error:
        flags.parse(["run", f"--config={path}", "--algo=td3", "--env=ant"])
    line = str(error.value)
    assert message in line and "\n" not in line


def test_a_path_that_is_no_file_is_rejected(tmp_path):
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    cases = {tmp_path: "which this is not", tmp_path / "none.yaml": "no such file", fifo: "which this is not"}
    for path, message in cases.items():
        with pytest.raises(flags.UsageError, match=message):
            flags.parse(["run", f"--config={path}", "--algo=td3", "--env=ant"])


@pytest.mark.parametrize(
    ("text", "project"),
    [("ants", "ants"), ("true", "sqt_jax"), ("yes", "sqt_jax"), ("false", ""), ("no", ""), ('""', None)],
)
def test_wandb_in_a_file_is_a_project_or_a_switch(tmp_path, monkeypatch, text, project):
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    path = write(tmp_path, f"wandb: {text}\n")
    if project is None:
        with pytest.raises(flags.UsageError, match="wandb expects a number, a word or a list of them"):
            parse(f"--config={path}")
    else:
        assert parse(f"--config={path}").wandb == project
        assert parse(f"--config={path}", "--nowandb").wandb == ""
