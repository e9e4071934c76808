"""Time left, the live line, plain lines."""

import io

import numpy as np
import pytest
from rich.console import Console

from experiments.running.progress import (
    PLAIN_SECONDS,
    Display,
    Status,
    TimeLeft,
    counting,
    format_seconds,
    time_left,
)


def make_console(terminal):
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, color_system=None, legacy_windows=False)


def evaluation(returns, length, speed=np.nan):
    """Returns [members, episodes], lengths and speeds of an evaluation."""
    returns = np.array(returns)
    return returns, np.full(returns.shape, length), np.full(returns.shape, speed)


def test_time_left_adds_the_phases_and_the_evaluations():
    # 100 warm-up steps at 50/s, 600 learning steps at 20/s, 3 evaluations of 4 s: 2 + 30 + 12.
    assert time_left({False: 100, True: 600}, {False: 50.0, True: 20.0}, 3, 4.0) == TimeLeft(44.0)


def test_time_left_is_unknown_while_steps_of_its_kind_were_never_timed():
    assert time_left({False: 0, True: 600}, {False: 50.0}, 0, None) is None
    assert time_left({False: 100, True: 0}, {False: 50.0}, 0, None) == TimeLeft(2.0)
    assert time_left({False: 0, True: 0}, {}, 0, None) == TimeLeft(0.0)


def test_evaluations_that_were_never_timed_make_the_time_left_a_lower_bound():
    left = time_left({False: 0, True: 600}, {True: 20.0}, 1, None)
    assert left == TimeLeft(30.0, at_least=True) and str(left) == "> 0:30"
    assert str(time_left({False: 0, True: 600}, {True: 20.0}, 1, 4.0)) == "0:34"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0:00"), (59.6, "1:00"), (123, "2:03"), (3723, "1:02:03"), (360000, "100:00:00")],
)
def test_seconds_as_text(seconds, text):
    assert format_seconds(seconds) == text


def test_plain_output_is_a_line_per_evaluation_and_few_others():
    now = [0.0]
    console = make_console(terminal=False)
    with Display(console, 1_000, clock=lambda: now[0]) as display:
        display.update(Status("compiling the training", 0, None, None, None))
        for step in range(1, 61):  # a minute, one update a second
            now[0] = float(step)
            display.update(Status("training", step, 123.4, TimeLeft(60.0 - step), 5.0))
        display.evaluated(60, *evaluation([[1.0], [3.0]], 5, 0.25))
    lines = console.file.getvalue().splitlines()
    assert lines[0] == "compiling the training, step 0 of 1,000, - steps/s, return -, left -"
    assert lines[-1] == "step        60: return 2.0 +- 1.0 over 2 members, length 5, speed 0.25 m/s"
    progress = lines[1:-1]
    assert len(progress) == 60 / PLAIN_SECONDS
    assert progress[0] == "training, step 10 of 1,000, 123 steps/s, return 5.0, left 0:50"
    assert "\x1b" not in console.file.getvalue()


def test_a_terminal_gets_a_live_line():
    console = make_console(terminal=True)
    with Display(console, 1_000) as display:
        display.update(Status("warm-up", 250, 1234.0, TimeLeft(61.0), 5.0))
        display.evaluated(250, *evaluation([[7.0]], 10))
    text = console.file.getvalue()
    assert "\x1b[2K" in text  # the line is erased and written again
    assert "warm-up" in text and "250/1,000  1,234 steps/s  return 5.0  left 1:01" in text
    assert "step       250: return 7.0, length 10\n" in text


@pytest.mark.parametrize("terminal", [False, True])
def test_quiet_shows_messages_only(terminal):
    console = make_console(terminal)
    with Display(console, 1_000, quiet=True) as display:
        display.update(Status("compiling the training", 0, None, None, None))
        display.evaluated(250, *evaluation([[7.0]], 10))
        display.message("member 3 diverged")
    assert console.file.getvalue() == "member 3 diverged\n"


def test_counting_without_a_terminal_prints_a_line_every_few_seconds():
    now, console = [0.0], make_console(terminal=False)
    with counting("drawing, pictures", 1_000, console, clock=lambda: now[0]) as tell:
        for done in range(1, 1_001):
            now[0] = done / 40
            tell(done)
    assert console.file.getvalue().splitlines() == [
        "drawing, pictures: 400 of 1,000, left 0:15",
        "drawing, pictures: 800 of 1,000, left 0:05",
    ]


def test_counting_on_a_terminal_is_a_line_that_disappears():
    console = make_console(terminal=True)
    with counting("drawing, pictures", 1_000, console) as tell:
        tell(250)
    assert "drawing, pictures" in console.file.getvalue() and "/1,000  left" in console.file.getvalue()
