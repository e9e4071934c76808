"""The options of --launcher=slurm."""

import pytest

from experiments.commandline.arguments import UsageError
from experiments.launchers.slurm_options import parse, seconds


def test_options_go_to_sbatch_as_they_are():
    options = parse("partition=gpu,gpus-per-node=1,time=1-00:00:00,nodelist=n[1-2,4],n7,exclusive=true")
    assert options.sbatch == {
        "partition": "gpu",
        "gpus_per_node": "1",
        "time": "1-00:00:00",
        "nodelist": "n[1-2,4],n7",  # commas of a value
        "exclusive": True,  # an option without a value
    }
    assert options.setup == () and parse("").sbatch == {}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("30", 1800),
        ("30:15", 1815),
        ("4:00:00", 14400),
        ("2-12", 216000),
        ("1-1:30", 91800),
        ("1-00:00:01", 86401),
        ("0", None),  # no limit
        ("UNLIMITED", None),
        ("1:2:3:4", None),
    ],
)
def test_times_have_sbatchs_forms(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize(
    ("text", "warning"), [("", 300), ("time=04:00:00", 300), ("time=5", 150), ("time=5,save_seconds=299", 299)]
)
def test_slurm_warns_before_the_time_limit(text, warning):
    """By default five minutes before; of a short limit, half of it is left to train."""
    options = parse(text)
    assert options.save_seconds == warning and "save_seconds" not in options.sbatch


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("gpu", "--slurm: expects NAME=VALUE,... as in partition=gpu,gpus_per_node=1,time=04:00:00, not 'gpu'"),
        ("partition=", "--slurm: expects NAME=VALUE,"),
        ("partition=a\n#SBATCH --x", "--slurm: expects NAME=VALUE,"),
        ("time=1,time=2", "--slurm: expects each option once, not time twice"),
        ("array=0-9", "--slurm=array: is set by the launcher; expects other options of sbatch"),
        ("ntasks=2", "--slurm=ntasks: has no effect, as a run is one process"),
        ("save_seconds=0", "--slurm=save_seconds: expects a whole number of seconds from 1 to 65535, not '0'"),
        ("time=5,save_seconds=300", "--slurm=save_seconds=300: expects less than the time limit, 300 seconds"),
    ],
)
def test_wrong_options_are_rejected(text, line):
    with pytest.raises(UsageError) as error:
        parse(text)
    assert str(error.value).startswith(line) and "\n" not in str(error.value)


def test_the_setup_file_is_read(tmp_path):
    file = tmp_path / "setup.sh"
    file.write_text("module load cuda\nsource venv/bin/activate\n")
    assert parse("", str(file)).setup == ("module load cuda", "source venv/bin/activate")
    file.write_bytes(b"\xff\xfe\x00")
    for path in (file, tmp_path / "absent", tmp_path):
        with pytest.raises(UsageError, match="^--slurm_setup=.*: expects a file of shell lines"):
            parse("", str(path))
