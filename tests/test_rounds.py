"""Where the batches of a round are trained, and the launcher that stays open."""

from pathlib import Path

import pytest

from experiments.launchers.choice import LauncherOptions
from experiments.tuning import rounds
from experiments.tuning.rounds import OpenLauncher, make_rounds


@pytest.mark.parametrize(
    ("launcher", "workers", "its_workers", "found"),
    [
        ("local", None, None, (1, 1)),
        ("local", 2, 2, (2, 2)),
        ("slurm", 3, None, (3, 0)),
        ("ray", None, None, (1, 0)),
    ],
)
def test_workers_are_the_batches_of_a_round(monkeypatch, launcher, workers, its_workers, found):
    monkeypatch.setattr(rounds, "make_launcher", lambda options: (options.launcher, options.workers))
    made = make_rounds(LauncherOptions(launcher, Path("out"), workers))
    assert made == ((launcher, its_workers), *found)


def test_a_launcher_stays_open_and_gets_everything_else():
    calls = []

    class Made:
        def __enter__(self):
            calls.append("opened")

        def __exit__(self, *error):
            calls.append("closed")

        def submit(self, cells):
            calls.append(cells)

        def ended(self):
            return ["ended"]

        def cancel(self):
            calls.append("cancelled")

    with OpenLauncher(Made()) as launcher:
        launcher.submit(["cell"])
        launcher.cancel()
        assert launcher.ended() == ["ended"]
    assert calls == [["cell"], "cancelled"]
