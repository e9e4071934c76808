"""A tuning from its options to its report, without training."""

import signal

import pytest
from tuned_runs import GIVEN, write_cell

from experiments.commandline.arguments import BAD_USAGE, DIVERGED, DONE, FAILED, INTERRUPTED, UsageError
from experiments.evidence.finished_runs import find
from experiments.launchers.cell import Ended
from experiments.running import folder_lock
from experiments.tuning import session
from experiments.tuning.rounds import Rounds
from experiments.tuning.session import Session
from experiments.tuning.tune_flags import check_flags


class MadeLauncher:
    """Writes each run instead of training it.

    Args:
      trained: the list that gets the cells.
      act: called with each cell before; a code that it returns is the end of the cell.
    """

    def __init__(self, trained, act=lambda cell: None):
        self.trained, self.act, self._ended, self.opened = trained, act, [], []

    def submit(self, cells):
        for cell in cells:
            self.trained.append(cell)
            code = self.act(cell)
            self._ended.append(Ended(cell, write_cell(cell) if code is None else code, "" if code is None else "why"))

    def ended(self):
        ended, self._ended = self._ended, []
        return ended

    def cancel(self):
        pass

    def __enter__(self):
        self.opened.append(True)
        return self

    def __exit__(self, *error):
        self.opened.append(False)


@pytest.fixture
def tune(tmp_path, monkeypatch):
    """Tunes in a temporary folder; returns the exit code and the cells that were trained."""
    monkeypatch.setattr(Session, "_check", lambda self: ("cheetah", "cheetah"))

    def run(act=lambda cell: None, run_flags=(), **given):
        small = {"space": "penalty_coef=0..1", "trials": 8, "batch": 4, "final_seeds": 3, "out": str(tmp_path / "out")}
        options = check_flags(GIVEN._replace(**small | given), run_flags)
        trained = []
        run.launcher = MadeLauncher(trained, act)
        code = Session(options, Rounds(run.launcher, 1, 1), retries=0, command="python -m ...").run()
        return code, [cell.path.name for cell in trained]

    return run


def test_a_study_its_winner_and_the_baseline_are_trained_once(tune, tmp_path, capsys):
    code, trained = tune()
    assert code == DONE and tune.launcher.opened == [True, False]  # one for all rounds
    winner = trained[2]
    assert trained == ["batch_0001", "batch_0002", winner, "untuned_seeds_2-4"]
    assert winner.startswith("trial_") and winner.endswith("_seeds_2-4")
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == {
        "study.log", "lock", "trials", "final", "tuning.md", "tuning.csv", "trials.csv", "tuning.png",
    }  # fmt: skip
    printed = capsys.readouterr().out
    assert "fresh seeds 2 to 4: 2 runs" in printed and "python -m experiments.run --algo=td3_sqt" in printed
    before = (out / "study.log").read_bytes()
    assert tune() == (DONE, []) and (out / "study.log").read_bytes() == before


def test_the_baseline_is_tuned_over_the_settings_that_it_has(tune, tmp_path):
    code, trained = tune(sampler="grid", space="penalty_coef=0|0.2|0.4", trials=3)
    assert code == DONE and trained[-1] == "untuned_seeds_2-4"


def test_what_is_interrupted_continues(tune):
    code, trained = tune(act=lambda cell: INTERRUPTED if cell.path.name == "batch_0002" else None)
    assert (code, trained) == (INTERRUPTED, ["batch_0001", "batch_0002"]) and tune.launcher.opened == [True, False]
    code, trained = tune(act=lambda cell: FAILED if "untuned" in cell.path.name else None)
    assert code == FAILED and trained[0] == "batch_0002" and trained[-1] == "untuned_seeds_2-4"
    assert tune() == (DONE, ["untuned_seeds_2-4"])


def test_a_signal_stops_before_the_next_batch(tune):
    code, trained = tune(act=lambda cell: signal.raise_signal(signal.SIGINT))
    assert (code, trained) == (INTERRUPTED, ["batch_0001"])


@pytest.fixture
def no_figure(monkeypatch):
    """Drawing takes most of a tuning's time here."""
    monkeypatch.setattr(session.score_figure, "draw", lambda *_: None)


@pytest.mark.usefixtures("no_figure")
def test_only_the_present_winners_runs_on_fresh_seeds_are_shown(tune, tmp_path):
    """Tables, plots and the report read all runs below OUT, without its trials."""
    out = tmp_path / "out"

    def shown():
        return {path.name for path in find([str(out)])[0]}

    tune(trials=4, final_seeds=2)
    first = shown()
    _, trained = tune(trials=4, final_seeds=3)
    assert shown() == set(trained) == {name.replace("2-3", "2-4") for name in first}
    # Back again, with nothing to train; then another trial wins.
    assert tune(trials=4, final_seeds=2) == (DONE, []) and shown() == first
    _, trained = tune(trials=8, final_seeds=2)
    winner = trained[-1]
    assert winner.startswith("trial_") and shown() == {winner, "untuned_seeds_2-3"} != first


def test_other_settings_need_another_folder(tune):
    tune()
    for given in ({"batch": 5}, {"seeds": ["0", "2"]}, {"objective": "final"}, {"run_flags": ["--steps=2000000"]}):
        with pytest.raises(UsageError, match="^--out=.*: expects the settings of the study there; these differ: "):
            tune(**given)
    assert tune(trials=12)[0] == DONE  # more trials continue it


def test_one_process_tunes_in_a_folder(tune, tmp_path):
    with (
        folder_lock.locked(tmp_path / "out"),
        pytest.raises(UsageError, match="^--out=.*: host .*, process .* is tuning there; "),
    ):
        tune()


def refuse(cell):
    raise UsageError("--slurm: why")


def test_a_new_folder_is_as_before_when_its_first_batch_is_refused(tune, tmp_path):
    out = tmp_path / "out"
    for existing in (False, True):
        if existing:
            out.mkdir()
            (out / "mine").touch()
        with pytest.raises(UsageError, match="^--slurm: why$"):
            tune(act=refuse)
        assert out.exists() == existing
    assert [path.name for path in out.iterdir()] == ["mine"]


def test_a_study_stays_when_a_batch_is_refused(tune, tmp_path):
    tune(act=lambda cell: INTERRUPTED)
    before = (tmp_path / "out" / "study.log").read_bytes()
    with pytest.raises(UsageError, match="^--slurm: why$"):
        tune(act=refuse)
    assert (tmp_path / "out" / "study.log").read_bytes() == before


@pytest.mark.usefixtures("no_figure")
def test_a_report_that_cannot_be_written_is_no_bad_usage(tune, tmp_path):
    (tmp_path / "out" / "trials.csv").mkdir(parents=True)
    with pytest.raises(OSError):
        tune()


def test_divergence_on_fresh_seeds_is_the_exit_code(tune):
    code, trained = tune(space="penalty_coef=0.91|0.95", sampler="grid", trials=2, objective="final")
    assert code == DIVERGED and trained == ["batch_0001", "untuned_seeds_2-4"]  # all trials diverged


def test_a_check_that_fails_is_one_line(tmp_path, monkeypatch):
    options = check_flags(GIVEN._replace(out=str(tmp_path / "out")), [])
    made = Session(options, Rounds(MadeLauncher([]), 1, 1), 0, "")
    command = ["sh", "-c", f"echo warning >&2; echo '--physics: why' >&2; exit {BAD_USAGE}"]
    real = session.subprocess.run
    monkeypatch.setattr(session.subprocess, "run", lambda _, **how: real(command, **how))
    with pytest.raises(UsageError, match="^--physics: why$"):
        made.run()
    assert not (tmp_path / "out").exists()
