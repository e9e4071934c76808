"""A file of settings becomes the same command line, or is rejected (hostile files: test_bad_input.py)."""

import pytest

from experiments.commandline import config_file


def test_lines_are_arguments(tmp_path):
    path = tmp_path / "flags.yaml"
    path.write_text(
        "algo: td3_sqt\nsteps: 1e5  # a comment\nseeds: [0, 1]\ntensorboard: true\nlr: 0.1\nhidden: [64, 64]\n"
    )
    assert config_file.arguments(path) == [
        "--algo=td3_sqt",
        "--steps=1e5",
        "--seeds=0,1",
        "--tensorboard=true",
        "--lr=0.1",
        "--hidden=64,64",
    ]


@pytest.mark.parametrize(
    ("line", "argument"),
    [
        ("name: no", "--name=no"),
        ("name: 'no'", "--name=no"),
        ("name: Off", "--name=Off"),
        ("name: 2025-01-02", "--name=2025-01-02"),
        ("name: 0123", "--name=0123"),
        ("name: 12:30:45", "--name=12:30:45"),
        ("name: null", "--name=null"),
        ("lr: 3.0e-4", "--lr=3.0e-4"),
        ("steps: 1_000", "--steps=1_000"),
        ("quiet: yes", "--quiet=true"),
        ("quiet: OFF", "--quiet=false"),
        ("quiet: true", "--quiet=true"),
    ],
)
def test_words_are_as_written(tmp_path, line, argument):
    path = tmp_path / "flags.yaml"
    path.write_text(line)
    assert config_file.arguments(path, switches={"quiet"}) == [argument]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps: 1\nsteps: 2", "expects each setting once, not steps 2 times"),
        ("steps: {a: 1, a: 2}", "expects each setting once, not a 2 times"),
        ("config: other.yaml", "config is for the command line"),
        ("steps: []", "steps expects a number, a word or a list of them"),
        ("steps", "expects lines like `steps: 100000`"),
    ],
)
def test_other_files_are_rejected(tmp_path, text, message):
    path = tmp_path / "flags.yaml"
    path.write_text(text)
    with pytest.raises(config_file.InvalidConfigFile) as error:
        config_file.arguments(path)
    assert str(error.value) == message


def test_no_file(tmp_path):
    for path, message in (
        (tmp_path / "none", "there is no such file"),
        (tmp_path, "expects a file, which this is not"),
    ):
        with pytest.raises(config_file.InvalidConfigFile, match=message):
            config_file.arguments(path)
