"""What runs in Ray's workers: variables of a cell's process, and asking it to end."""

import signal

import pytest

pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")

from experiments.commandline.arguments import INTERRUPTED  # noqa: E402
from experiments.launchers import ray_task  # noqa: E402
from experiments.launchers.cell import Cell, Ended  # noqa: E402

CELL = Cell("ant", "td3", None, ())
ENDED = Ended(CELL, INTERRUPTED, "interrupted")


class Process:
    """Runs until it is asked to end, and `waits` waits longer."""

    def __init__(self, waits=1, before=lambda number: None):
        self.left, self.before, self.signals, self.number = waits, before, [], 0

    def wait(self, seconds):
        self.number += 1
        self.before(self.number)
        self.left -= bool(self.signals)
        return ENDED if self.left < 0 else None

    def send_signal(self, number):
        self.signals.append(number)


def test_each_request_reaches_the_process_once():
    asked = []
    process = Process(waits=4, before=lambda number: asked.append(2) if number in (2, 4) else None)
    assert ray_task._wait(process, asked) == ENDED
    assert process.signals == [signal.SIGTERM] * 2


def test_a_worker_that_is_told_to_exit_lets_its_process_save():
    def exit_once(number):
        if number == 2:
            raise SystemExit(1)

    process = Process(before=exit_once)
    with pytest.raises(SystemExit):
        ray_task._wait(process, [])
    assert process.signals == [signal.SIGTERM] and process.number == 3  # it was waited for


@pytest.mark.parametrize(
    ("gpus", "variables", "added"),
    [
        (0, {}, {"CUDA_VISIBLE_DEVICES": ""}),
        (1, {}, {}),
        (2, {}, {}),
        (0.5, {}, {"XLA_CLIENT_MEM_FRACTION": "0.450"}),
        (0.5, {"XLA_CLIENT_MEM_FRACTION": ".2"}, {}),
    ],
)
def test_gpus_are_those_that_ray_gives(gpus, variables, added):
    assert ray_task.gpu_variables(gpus, variables) == added
